"""Sensitivity of an equilibrium to a parameter: ∂u/∂θ = A⁻¹ ∂m/∂θ.

In equilibrium, no follower moves, m(u, θ) = 0. A = -∂m/∂u is the matrix of the equilibrium solver.
Each parameter therefore requires one further solution of a linear system. ∂m/∂θ is computed from
the moves of a few scenes with slightly different parameters. The derivatives of a scalar J = w · u
with respect to all parameters require a single solution, λ = A⁻ᵀ w: dJ/dθ = λ · ∂m/∂θ (adjoint
method).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import ErrorBound, spacing_of
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.load_stepping import equilibrate, finder_of
from pbdkit.equilibrium.newton import Finder
from pbdkit.equilibrium.system import Moves, System, one_thread
from pbdkit.errors import ExperimentError
from pbdkit.fitting.parameter import STEP, WEIGHTS, Parameter
from pbdkit.model.experiment import Experiment
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene, renumbered
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import State, initial_state

GEOMETRY = ("lattice", "body", "regions", "neighbours", "frame", "initial", "loads", "cuts")
"""Parts of an experiment that determine which particles its scene has."""


def scene_like(scene: Scene, experiment: Experiment) -> Scene:
    """Return the scene of an experiment that differs from a scene in parameters only.

    Data that do not depend on the parameters are shared with that scene.

    Raises
    ------
    ExperimentError
        If the parameters change which particles exist.
    """
    original = scene.experiment
    groups = zip(experiment.leaders, original.leaders, strict=True)
    has_same_leaders = all(a.select == b.select and a.axes == b.axes for a, b in groups)
    if has_same_leaders and all(
        getattr(experiment, name) is getattr(original, name) for name in GEOMETRY
    ):
        if experiment.leaders is not original.leaders:
            pairs = zip(scene.leading, experiment.leaders, strict=True)
            leading = tuple(replace(leading, group=group) for leading, group in pairs)
            scene = replace(scene, leading=leading)
        return renumbered(scene, experiment)
    new_scene = build_scene(experiment)
    if (
        new_scene.raster.shape != scene.raster.shape
        or (new_scene.raster.kind != scene.raster.kind).any()
    ):
        raise ExperimentError(
            "the parameter changes the set of particles, so that there is no derivative; "
            "sensitivities exist for parameters of rules, fields, loads and motions"
        )
    return new_scene


__all__ = ["Adjoint", "RestingScene", "along", "scene_like"]

ACCURACY = 1e-12
"""Relative accuracy of solutions."""
FORMER = 2
"""Number of earlier equilibria that provide initial guesses for linear solutions."""


@dataclass(frozen=True)
class RestingScene:
    """A scene in equilibrium.

    Parameters
    ----------
    scene, state
        The scene and its state.
    error_bound
        Error bound of the equilibrium.
    finder
        Object that computes equilibria, with the parameters of the last step.
    accuracy
        Accuracy of derivatives, relative to the largest.
    former
        Solutions of linear systems at earlier equilibria, by the key of the right-hand side.
    """

    scene: Scene
    state: State
    error_bound: ErrorBound
    finder: Finder = field(repr=False)
    accuracy: float = ACCURACY
    former: tuple[dict[bytes, Floats], ...] = field(default=(), repr=False)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        start: Scene | RestingScene | None = None,
        accuracy: float = ACCURACY,
    ) -> RestingScene:
        """Compute the equilibrium of an experiment.

        Parameters
        ----------
        experiment
            The experiment.
        start
            Scene or equilibrium of an experiment that differs in parameters only. Its scene is
            reused, and solutions of an equilibrium serve as initial guesses.
        accuracy
            Accuracy of derivatives, relative to the largest.

        Raises
        ------
        ExperimentError
            If bonds changed before the equilibrium was reached, or if the scene has obstacles. In
            both cases the equilibrium depends on the loading path.
        """
        similar = start.scene if isinstance(start, RestingScene) else start
        scene = scene_like(similar, experiment) if similar else build_scene(experiment)
        if scene.barriers:
            raise ExperimentError(
                "there are no sensitivities with obstacles, since contacts change with the "
                "displacements; remove the obstacles",
                ("obstacles",),
            )
        state = initial_state(scene)
        initial_bonds, finder = _bonds(state), finder_of(scene, state, compiles=False)
        error_bound = equilibrate(scene, state, finder=finder)
        if any((a != b).any() for a, b in zip(initial_bonds, _bonds(state), strict=True)):
            raise ExperimentError(
                (
                    "bonds break or soften on the load path to this equilibrium, which then is "
                    "not a smooth function of parameters; use a smaller load, or fracture: {type: "
                    "none}"
                ),
                ("fracture",),
            )
        former = start.guesses if isinstance(start, RestingScene) else ()
        return cls(scene, state, error_bound, finder.at(experiment.steps), accuracy, former)

    @property
    def guesses(self) -> tuple[dict[bytes, Floats], ...]:
        """Return the solutions that serve as initial guesses for the next equilibrium."""
        return (self._solutions, *self.former)[:FORMER]

    @cached_property
    def _solutions(self) -> dict[bytes, Floats]:
        return {}

    @cached_property
    def system(self) -> System:
        """Return A at the equilibrium. For linear scenes, it is the same as for the body at rest.

        Raises
        ------
        ExperimentError
            If some part of the body is not constrained and was displaced.
        """
        system = self._linearised()
        try:
            system.refuse_moving_floats(self.state.u, self.finder.moves.rounding(self.state.u))
        except ExperimentError as error:
            raise ExperimentError(
                "a part of the body is not constrained: its equilibrium depends on the initial "
                "state, so that there are no sensitivities; constrain it with a leader group",
                error.where,
            ) from None
        return system

    def _linearised(self) -> System:
        if self.finder.linear and self.finder.at_rest:
            return self.finder.at_rest[0]
        state = self.state
        if self.finder.linear:
            state = replace(state, u=np.zeros_like(state.u))
        steps, method = self.scene.experiment.steps, self.finder.method
        with one_thread():
            return linearised(self.finder.scene, state, steps, method, Watch(), self.finder.moves)

    def change(self, parameter: Parameter) -> Floats:
        """Return ∂u/∂θ as rasters, (axis, sublattice, cell, cell).

        The derivative is computed for leaders, followers and frame points.

        Raises
        ------
        ExperimentError
            If the derivative does not exist.
        """
        direct, moves = self._derivatives(parameter)
        return self._with_frame(direct, self._solve(moves, parameter.path.encode()))

    def gradient(self, weights: Floats, parameters: Sequence[Parameter]) -> Floats:
        """Return the derivatives dJ/dθ of J = Σ weights · u in an array of shape (parameter,). One
        solution is sufficient for all parameters.

        Parameters
        ----------
        weights
            Weights of leaders, followers and frame points, as rasters.
        parameters
            The parameters θ.

        Raises
        ------
        ExperimentError
            If the derivative does not exist.
        """
        adjoint = self.adjoint(weights)
        return np.array([adjoint.along(*self._derivatives(parameter)) for parameter in parameters])

    def adjoint(self, weights: Floats) -> Adjoint:
        """Return the adjoint solution of J = Σ weights · u."""
        combined = self._from_frame(weights)
        with one_thread():
            pull = self.system.solve_transposed(combined, self.accuracy)
        return Adjoint(weights, combined, pull)

    def answer(self, leaders: Floats) -> Floats:
        """Return the change of u that displacements of leaders cause, as rasters.

        Followers remain in equilibrium.
        """
        load = self.system.pushed_by(leaders) if self.finder.linear else None
        moves = self.along(self._moves, leaders) if load is None else load
        return self._with_frame(0.0, leaders + self._solve(moves, leaders.tobytes()))

    def along(self, function: Callable[[Floats], Floats], direction: Floats) -> Floats:
        """Return the derivative of a function of displacements along a direction.

        For linear scenes, it is computed by a one-sided difference, which is exact, otherwise by a
        central difference.
        """
        linear, u = self.finder.linear, self.state.u
        if linear and function == self._moves:
            return self._moves(u + direction) - self._moves_at_equilibrium
        return along(function, u, direction, linear, spacing_of(self.scene))

    def _moves(self, u: Floats) -> Floats:
        steps = self.scene.experiment.steps
        return self.finder.moves.at(replace(self.state, u=u), steps)

    @cached_property
    def _moves_at_equilibrium(self) -> Floats:
        return self._moves(self.state.u.copy())

    def _derivatives(self, parameter: Parameter) -> tuple[Floats, Floats]:
        """Differentiate the prescribed displacements, and the moves of followers, with respect to a
        parameter."""
        direct, moves = parameter.derivative(
            self.scene.experiment, self._leaders_and_moves, self.accuracy
        )
        return direct, moves

    def _leaders_and_moves(self, experiment: Experiment) -> Floats:
        """Return two rasters of an experiment with other parameters, (2, axis, sublattice, cell,
        cell).

        They are the displacements of leaders and frame points, and the moves of followers.
        """
        scene = scene_like(self.scene, experiment)
        u, steps = self.state.u.copy(), experiment.steps
        leaders, _ = prescribe(scene, replace(self.state, u=u), steps)
        place(u, leaders)
        moves = Moves(scene.at(steps), compiles=False).at(replace(self.state, u=u), steps)
        return np.stack([u, moves])

    def _with_frame(self, direct: Floats | float, change: Floats) -> Floats:
        """Return `direct + change`, after the frame points of `change` have been computed."""
        if frame := self.finder.scene.frame:
            flat = change.reshape(len(change), -1)
            frame.follow(flat, flat)
        return direct + change

    def _from_frame(self, weights: Floats) -> Floats:
        """Add the weights of frame points to those of the particles that they follow."""
        result, frame = weights.astype(float), self.finder.scene.frame
        if frame:
            flat = result.reshape(len(result), -1)
            frame_weights, map_weight = flat[:, frame.place[frame.map.point]], frame.map.weight
            contributions = (
                map_weight * frame_weights
                if map_weight.ndim == 1
                else np.einsum("eba,be->ae", map_weight, frame_weights)
            )
            flat[:, frame.place] = 0.0
            for plane, values in zip(flat, contributions, strict=True):
                plane += np.bincount(frame.body_place, values, plane.size)
        return result

    def _solve(self, moves: Floats, key: bytes) -> Floats:
        """Return A⁻¹ moves, and store it under a key."""
        if not moves.any():
            return moves
        guesses = [solutions[key] for solutions in self.former if key in solutions]
        with one_thread():
            solution = self.system.answer(moves, self.accuracy, guesses)
        self._solutions[key] = solution.copy()
        return solution


@dataclass(frozen=True)
class Adjoint:
    """Adjoint solution of J = Σ weights · u.

    dJ/dθ = Σ weights · ∂u/∂θ + Σ pull · ∂m/∂θ. Here ∂u/∂θ is the derivative of the displacements of
    leaders and frame points while followers are fixed. All arrays are rasters.

    Parameters
    ----------
    weights
        Weights of J.
    combined
        Weights of J in which the weights of frame points are added to those of the particles that
        they follow.
    pull
        A⁻ᵀ combined.
    """

    weights: Floats
    combined: Floats
    pull: Floats

    def along(self, direct: Floats, moves: Floats) -> float:
        """Return dJ/dθ of a parameter.

        Parameters
        ----------
        direct, moves
            Derivatives of the displacements of leaders and frame points, and of the moves of
            followers.
        """
        return float((self.weights * direct).sum() + (self.pull * moves).sum())


def along(
    function: Callable[[Floats], Floats],
    u: Floats,
    direction: Floats,
    linear: bool,
    spacing: float = 1.0,
) -> Floats:
    """Return the derivative of a function of displacements along a direction.

    Parameters
    ----------
    linear
        Whether the function is linear, so that a one-sided difference is exact. Otherwise a central
        difference is used.
    spacing
        Length by which the step of the difference is scaled.
    """
    if linear:
        return function(u + direction) - function(u)
    step = STEP * spacing / max(float(np.abs(direction).max()), 1e-300)
    pairs = ((n * step, weight / step) for n, weight in enumerate(WEIGHTS, 1))
    parts = [
        factor * (function(u + size * direction) - function(u - size * direction))
        for size, factor in pairs
    ]
    return np.asarray(sum(parts))


def _bonds(state: State) -> list[Floats]:
    """Copy those arrays of the state that belong to bonds and can change."""
    arrays = [] if state.broken_step is None else [state.broken_step.copy()]
    return [*arrays, *(value.copy() for value in state.bond_values)]
