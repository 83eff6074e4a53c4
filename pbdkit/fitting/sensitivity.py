"""Sensitivity of an equilibrium to a parameter: ∂u/∂θ = A⁻¹ ∂m/∂θ.

At equilibrium no follower moves, m(u, θ) = 0. A = -∂m/∂u is the system by which it was found, so
that each parameter costs one more solution, and the moves of a few scenes with slightly changed
parameters. The change of a single number J of the displacements costs one solution for all
parameters, λ = A⁻ᵀ w: dJ/dθ = λ · ∂m/∂θ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pbdkit.equilibrium.certificate import Certificate, spacing_of
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.newton import Finder
from pbdkit.equilibrium.solve import finder_of, settle
from pbdkit.equilibrium.system import Floats, Moves, System, one_thread
from pbdkit.errors import ExperimentError
from pbdkit.fitting.parameter import STEP, WEIGHTS, Parameter
from pbdkit.model.experiment import Experiment
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene, renumbered
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import State, initial_state

GEOMETRY = ("lattice", "body", "regions", "neighbours", "frame", "initial", "loads", "cuts")
"""The parts of an experiment that its scene is built of besides numbers and motions."""


def scene_like(scene: Scene, experiment: Experiment) -> Scene:
    """The scene of an experiment that differs by numbers, as much as possible of it as it was.

    Raises ExperimentError where they decide which particles there are.
    """
    own = scene.experiment
    groups = zip(experiment.leaders, own.leaders, strict=True)
    same_leaders = all(a.select == b.select and a.axes == b.axes for a, b in groups)
    if same_leaders and all(getattr(experiment, name) is getattr(own, name) for name in GEOMETRY):
        if experiment.leaders is not own.leaders:
            pairs = zip(scene.leading, experiment.leaders, strict=True)
            leading = tuple(replace(leading, group=group) for leading, group in pairs)
            scene = replace(scene, leading=leading)
        return renumbered(scene, experiment)
    found = build_scene(experiment)
    if found.raster.shape != scene.raster.shape or (found.raster.kind != scene.raster.kind).any():
        raise ExperimentError(
            "the number decides which particles there are, one by one, and that is no smooth way; "
            "sensitivities are of rules, fields, loads and motions"
        )
    return found


__all__ = ["Adjoint", "Resting", "along", "scene_like"]

ACCURACY = 1e-12
"""Of solutions, as a share of themselves."""
FORMER = 2
"""How many equilibria before one lend it their answers."""


@dataclass(frozen=True)
class Resting:
    """A scene at its equilibrium; `accuracy` is that of derivatives, as a share of the largest.
    `finder` has the numbers of the last step, and knows whether the scene is linear then."""

    scene: Scene
    state: State
    certificate: Certificate
    finder: Finder = field(repr=False)
    accuracy: float = ACCURACY
    former: tuple[dict[bytes, Floats], ...] = field(default=(), repr=False)
    """The answers of equilibria before this one, by what was led."""

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        start: Scene | Resting | None = None,
        accuracy: float = ACCURACY,
    ) -> Resting:
        """The equilibrium of an experiment; with the scene of one that differs by parameters of its
        parts alone, nothing but its numbers is made anew, and with the equilibrium of such a one
        its answers are where those of this one begin. Raises ExperimentError where bonds changed
        on the way, or obstacles stand there: what comes after hangs on the way then."""
        like = start.scene if isinstance(start, Resting) else start
        scene = scene_like(like, experiment) if like else build_scene(experiment)
        if scene.barriers:
            raise ExperimentError(
                "followers that touch an obstacle change what holds them as they move: no "
                "sensitivities; leave the obstacles out",
                ("obstacles",),
            )
        state = initial_state(scene)
        before, finder = _bonds(state), finder_of(scene, state, compiles=False)
        certificate = settle(scene, state, finder=finder)
        if any((a != b).any() for a, b in zip(before, _bonds(state), strict=True)):
            raise ExperimentError(
                "bonds break or soften on the way to this equilibrium: where it lies is no smooth "
                "function of parameters; take a smaller load, or fracture: {type: none}",
                ("fracture",),
            )
        former = start.lent if isinstance(start, Resting) else ()
        return cls(scene, state, certificate, finder.at(experiment.steps), accuracy, former)

    @property
    def lent(self) -> tuple[dict[bytes, Floats], ...]:
        """The answers that the next equilibrium may begin from."""
        return (self._answers, *self.former)[:FORMER]

    @cached_property
    def _answers(self) -> dict[bytes, Floats]:
        return {}

    @cached_property
    def system(self) -> System:
        """A, at the equilibrium; of a linear scene at rest, where stencils are exact: that by which
        it was found. Raises ExperimentError where a part that nothing holds was displaced."""
        found = self._linearised()
        try:
            found.refuse_moving_floats(self.state.u, self.finder.moves.rounding(self.state.u))
        except ExperimentError as error:
            raise ExperimentError(
                "nothing holds a part of the body: where it comes to rest hangs on how it started, "
                "too, so that there are no sensitivities; let a leader hold it",
                error.where,
            ) from None
        return found

    def _linearised(self) -> System:
        if self.finder.linear and self.finder.at_rest:
            return self.finder.at_rest[0]
        at = self.state
        if self.finder.linear:
            at = replace(at, u=np.zeros_like(at.u))
        steps, method = self.scene.experiment.steps, self.finder.method
        with one_thread():
            return linearised(self.finder.scene, at, steps, method, Watch(), self.finder.moves)

    def change(self, parameter: Parameter) -> Floats:
        """∂u/∂θ as planes, (axis, sublattice, cell, cell): leaders as they are led, followers as
        they follow, the frame in line. Raises ExperimentError."""
        shown, moves = self._pushed_by(parameter)
        return self._with_frame(shown, self._answer(moves, parameter.path.encode()))

    def gradient(self, weights: Floats, parameters: Sequence[Parameter]) -> Floats:
        """dJ/dθ of J = Σ weights · u, (parameter,): by one solution for all of them. `weights` are
        planes over leaders, followers and frame points. Raises ExperimentError."""
        found = self.adjoint(weights)
        return np.array([found.along(*self._pushed_by(parameter)) for parameter in parameters])

    def adjoint(self, weights: Floats) -> Adjoint:
        """What J = Σ weights · u hangs on."""
        own = self._from_frame(weights)
        with one_thread():
            pull = self.system.solve_transposed(own, self.accuracy)
        return Adjoint(weights, own, pull)

    def answer(self, led: Floats) -> Floats:
        """∂u of leaders that go on so much, as planes: followers follow."""
        pushed = self.system.pushed_by(led) if self.finder.linear else None
        moves = self.along(self._moves, led) if pushed is None else pushed
        return self._with_frame(0.0, led + self._answer(moves, led.tobytes()))

    def along(self, function: Callable[[Floats], Floats], way: Floats) -> Floats:
        """The derivative of a function of displacements along a way from here: of a linear scene
        its difference, else by central differences."""
        linear, u = self.finder.linear, self.state.u
        if linear and function == self._moves:
            return self._moves(u + way) - self._moves_here
        return along(function, u, way, linear, spacing_of(self.scene))

    def _moves(self, u: Floats) -> Floats:
        steps = self.scene.experiment.steps
        return self.finder.moves.at(replace(self.state, u=u), steps)

    @cached_property
    def _moves_here(self) -> Floats:
        return self._moves(self.state.u.copy())

    def _pushed_by(self, parameter: Parameter) -> tuple[Floats, Floats]:
        """How leaders, and the frame points of a body that stays, are moved by a parameter, and the
        moves of followers among them."""
        shown, moves = parameter.derivative(self.scene.experiment, self._pushed, self.accuracy)
        return shown, moves

    def _pushed(self, experiment: Experiment) -> Floats:
        """Where leaders and frame points stand in an experiment like this one, and the moves of
        followers among them, (2, axis, sublattice, cell, cell)."""
        scene = scene_like(self.scene, experiment)
        u, steps = self.state.u.copy(), experiment.steps
        led, _ = prescribe(scene, replace(self.state, u=u), steps)
        place(u, led)
        moves = Moves(scene.at(steps), compiles=False).at(replace(self.state, u=u), steps)
        return np.stack([u, moves])

    def _with_frame(self, shown: Floats | float, change: Floats) -> Floats:
        """Both together, the frame going with the change."""
        if frame := self.finder.scene.frame:
            flat = change.reshape(len(change), -1)
            frame.follow(flat, flat)
        return shown + change

    def _from_frame(self, weights: Floats) -> Floats:
        """What weights of frame points come to at those whom they follow, with the others'."""
        found, frame = weights.astype(float), self.finder.scene.frame
        if frame:
            flat = found.reshape(len(found), -1)
            seen, weight = flat[:, frame.place[frame.map.point]], frame.map.weight
            back = weight * seen if weight.ndim == 1 else np.einsum("eba,be->ae", weight, seen)
            flat[:, frame.place] = 0.0
            for plane, values in zip(flat, back, strict=True):
                plane += np.bincount(frame.body_place, values, plane.size)
        return found

    def _answer(self, moves: Floats, of: bytes) -> Floats:
        """A⁻¹ moves, kept by what they are the moves of."""
        if not moves.any():
            return moves
        near = [known[of] for known in self.former if of in known]
        with one_thread():
            found = self.system.answer(moves, self.accuracy, near)
        self._answers[of] = found.copy()
        return found


@dataclass(frozen=True)
class Adjoint:
    """What J = Σ weights · u hangs on: dJ/dθ is Σ weights · ∂u/∂θ of leaders and frame points, the
    body being where it is, and Σ pull · ∂m/∂θ, pull = A⁻ᵀ own, where `own` are the weights with
    those of frame points at whom they follow. All are planes."""

    weights: Floats
    own: Floats
    pull: Floats

    def along(self, shown: Floats, moves: Floats) -> float:
        """dJ/dθ of a parameter by which leaders and frame points move so much, and followers are
        moved so much."""
        return float((self.weights * shown).sum() + (self.pull * moves).sum())


def along(
    function: Callable[[Floats], Floats],
    u: Floats,
    way: Floats,
    linear: bool,
    spacing: float = 1.0,
) -> Floats:
    """The derivative of a function of displacements along a way: of a linear one its difference,
    else by central differences of a share of the spacing."""
    if linear:
        return function(u + way) - function(u)
    step = STEP * spacing / max(float(np.abs(way).max()), 1e-300)
    pairs = ((n * step, weight / step) for n, weight in enumerate(WEIGHTS, 1))
    parts = [w * (function(u + h * way) - function(u - h * way)) for h, w in pairs]
    return np.asarray(sum(parts))


def _bonds(state: State) -> list[Floats]:
    """What may change in bonds."""
    kept = [] if state.broken_step is None else [state.broken_step.copy()]
    return [*kept, *(value.copy() for value in state.bond_values)]
