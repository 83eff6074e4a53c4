"""How the equilibrium of a scene changes with a parameter: ∂u/∂θ = A⁻¹ ∂m/∂θ.

An equilibrium is where no follower moves, m(u, θ) = 0. A = -∂m/∂u is the system by which it was
found, so that each parameter costs one more solution, and the moves of a few scenes in which it is
a little more or less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pbdkit.equilibrium.certificate import Certificate, scale_of
from pbdkit.equilibrium.increments import settle
from pbdkit.equilibrium.linearisation import linearised
from pbdkit.equilibrium.moves import Moves
from pbdkit.equilibrium.newton import Finder
from pbdkit.equilibrium.system import Floats, System, one_thread, solved
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.parameter import STEP, WEIGHTS, Parameter
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene, build_scene, renumbered
from pbdkit.stepping.prescription import place, prescribe
from pbdkit.stepping.state import State, initial_state

GEOMETRY = ("lattice", "body", "regions", "neighbours", "frame", "initial", "loads", "cuts")
"""The parts of an experiment that its scene is built of besides numbers and motions."""
ACCURACY = 1e-12
"""Of solutions, as a share of themselves."""


@dataclass(frozen=True)
class Resting:
    """A scene at its equilibrium; `accuracy` is that of derivatives, as a share of the largest."""

    scene: Scene
    state: State
    certificate: Certificate
    accuracy: float = ACCURACY

    @classmethod
    def of(
        cls, experiment: Experiment, start: Scene | None = None, accuracy: float = ACCURACY
    ) -> Resting:
        """The equilibrium of an experiment; with the scene of one that differs by parameters of its
        parts alone, nothing but its numbers is made anew. Raises ExperimentError where bonds
        changed on the way, or obstacles stand there: what comes after hangs on the way then."""
        scene = scene_like(start, experiment) if start else build_scene(experiment)
        if scene.barriers:
            raise ExperimentError(
                "followers that touch an obstacle change what holds them as they move: no "
                "sensitivities; leave the obstacles out",
                ("obstacles",),
            )
        state = initial_state(scene)
        before = _bonds(state)
        certificate = settle(scene, state, compiles=False)
        if any((a != b).any() for a, b in zip(before, _bonds(state), strict=True)):
            raise ExperimentError(
                "bonds break or soften on the way to this equilibrium: where it lies is no smooth "
                "function of parameters; take a smaller load, or fracture: {type: none}",
                ("fracture",),
            )
        return cls(scene, state, certificate, accuracy)

    @cached_property
    def finder(self) -> Finder:
        """What knows whether the scene is linear."""
        asked, scale = self.scene.experiment.solver.sought, scale_of(self.scene, self.state)
        return Finder(
            self.scene, asked.tolerance * scale, scale, asked.method, Watch(), compiles=False
        )

    @cached_property
    def system(self) -> System:
        """A, at the equilibrium; of a linear scene at rest, where stencils are exact."""
        at = self.state
        if self.finder.linear:
            at = replace(at, u=np.zeros_like(at.u))
        steps, method = self.scene.experiment.steps, self.finder.method
        with one_thread():
            return linearised(self.scene, at, steps, method, Watch(), self.finder.moves)

    def change(self, parameter: Parameter) -> Floats:
        """∂u/∂θ as planes, (axis, sublattice, cell, cell): leaders as they are led, followers as
        they follow, the frame in line. Raises ExperimentError."""
        pushed = parameter.derivative(self.scene.experiment, self._pushed)
        led, moves = pushed
        return self._with_frame(led + self._answer(moves))

    def answer(self, led: Floats) -> Floats:
        """∂u of leaders that go on so much, as planes: followers follow."""
        if self.finder.linear:
            moves: Floats = self._moves(self.state.u + led) - self._moves_here
        else:
            moves = along(self._moves, self.state.u, led, linear=False)
        return self._with_frame(led + self._answer(moves, float(np.abs(led).max())))

    def _moves(self, u: Floats) -> Floats:
        steps = self.scene.experiment.steps
        return self.finder.moves.at(replace(self.state, u=u), steps)

    @cached_property
    def _moves_here(self) -> Floats:
        return self._moves(self.state.u.copy())

    def _pushed(self, experiment: Experiment) -> Floats:
        """Where leaders stand in an experiment like this one, and the moves of followers among
        them, (2, axis, sublattice, cell, cell)."""
        scene = scene_like(self.scene, experiment)
        u = self.state.u.copy()
        led, _ = prescribe(scene, replace(self.state, u=u), experiment.steps)
        place(u, led)
        moves = Moves(scene, compiles=False).at(replace(self.state, u=u.copy()), experiment.steps)
        return np.stack([u, moves])

    def _with_frame(self, change: Floats) -> Floats:
        if self.scene.frame:
            flat = change.reshape(len(change), -1)
            self.scene.frame.follow(flat, flat)
        return change

    def _answer(self, moves: Floats, size: float = 0.0) -> Floats:
        """A⁻¹ moves, which come to that size, if it is known."""
        if not moves.any():
            return moves
        with one_thread():
            if size == 0.0:
                size = float(np.abs(solved(self.system, moves, self.finder.scale)).max())
            return self.system.solve(moves, self.accuracy * size)


def along(function: Callable[[Floats], Floats], u: Floats, way: Floats, linear: bool) -> Floats:
    """The derivative of a function of displacements along a way: of a linear one its difference,
    else by central differences."""
    if linear:
        return function(u + way) - function(u)
    step = STEP / max(float(np.abs(way).max()), 1e-300)
    pairs = ((n * step, weight / step) for n, weight in enumerate(WEIGHTS, 1))
    parts = [w * (function(u + h * way) - function(u - h * way)) for h, w in pairs]
    return np.asarray(sum(parts))


def scene_like(scene: Scene, experiment: Experiment) -> Scene:
    """The scene of an experiment that differs by numbers, as much as possible of it as it was.

    Raises ExperimentError where they decide which particles there are.
    """
    own = scene.experiment
    if all(getattr(experiment, name) is getattr(own, name) for name in GEOMETRY):
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


def _bonds(state: State) -> list[Floats]:
    """What may change in bonds."""
    kept = [] if state.broken_step is None else [state.broken_step.copy()]
    return [*kept, *(value.copy() for value in state.bond_values)]
