"""Choice of the linear system of a scene: stencils on its lattice, or a matrix."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import TypeVar

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.lattice_system import lattice_system
from pbdkit.equilibrium.sparse import MatrixSystem
from pbdkit.equilibrium.system import (
    ALL,
    IndefiniteError,
    Moves,
    Rows,
    StagnationError,
    System,
    one_thread,
    random_displacements,
)
from pbdkit.errors import NotSharedError
from pbdkit.progress import Watch
from pbdkit.scene.memory_estimate import asks_for_grids
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

T = TypeVar("T")
NOT_SHARED = (
    "has an equilibrium that several processes cannot share: leaders must constrain the whole "
    "body, it must be stable at rest, frame points must follow nearby particles, and the coupling "
    "of the axes must be mutual or absent; run it in one process"
)
"""Reason why several ranks cannot compute the equilibrium of an experiment together."""


def linearised(
    scene: Scene,
    state: State,
    moment: float,
    method: str,
    watch: Watch,
    moves: Moves | None = None,
    rows: Rows = ALL,
) -> System:
    """Return the linear system of a scene at a state. The roles are those of the step that contains
    the moment, and the system is solved by `method`, a method of the solver settings. A given
    evaluation of `moves` is reused.

    A scene that is distributed among processes has a system on stencils only. Raises
    ExperimentError if there is no unique solution, or if such a scene has no system on stencils.
    """
    if rows.strip:
        return _shared(scene, state, math.ceil(moment), watch, rows)
    if scene.barriers:
        return ContactSystem(scene, state, moment, method, watch, moves or Moves(scene))
    step = math.ceil(moment)

    def by_matrix() -> System:
        return MatrixSystem(scene, state, method, watch, step)

    by_grids = asks_for_grids(scene.experiment, method, scene.raster.count) and find_spec("numba")
    if by_grids and (system := lattice_system(scene, state, step, watch, moves)):
        return _Replaceable(system, by_matrix, at_rest=not state.u.any())
    return by_matrix()


def mismatch_at_rest(scene: Scene, moves: Moves, size: float, method: str, watch: Watch) -> float:
    """Return a measure of the nonlinearity of the moves: the result of `System.mismatch` for the
    linearisation at rest and random displacements of a given size."""
    start, steps = initial_state(scene), scene.experiment.steps
    rest = replace(start, u=np.zeros_like(start.u))
    with one_thread():
        system = linearised(scene, rest, steps, method, watch)
        probe = random_displacements(scene, size)
        moves_of_both = [moves.at(replace(rest, u=u), steps) for u in (rest.u, probe.copy())]
        return system.mismatch(probe, *moves_of_both)


def _shared(scene: Scene, state: State, step: int, watch: Watch, rows: Rows) -> System:
    system = lattice_system(scene, state, step, watch, rows=rows)
    if system is None:
        raise NotSharedError(NOT_SHARED, ("rule",))
    return system


class _Replaceable(System):
    """System that is replaced by a second one when its iteration stagnates. It is not replaced if
    the state is not at rest and the body is unstable there."""

    def __init__(self, system: System, otherwise: Callable[[], System], *, at_rest: bool) -> None:
        self._system, self._otherwise, self._past = system, otherwise, 0
        self._at_rest = at_rest

    def solve(
        self,
        moves: Floats,
        tolerance: float,
        invariant_state: State | None = None,
        rounding: float = 0.0,
    ) -> Floats:
        """Return the solution of the first system that converges."""
        return self._first_able(
            lambda system: system.solve(moves, tolerance, invariant_state, rounding)
        )

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """Return the solution of the first system that converges."""
        return self._first_able(lambda system: system.answer(moves, share, near))

    def pushed_by(self, led: Floats) -> Floats | None:
        """Return the result of the current system."""
        return self._system.pushed_by(led)

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Return the solution of the first system that converges."""
        return self._first_able(lambda system: system.solve_transposed(weights, share))

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Return the result of the current system."""
        return self._system.mismatch(c, before, after)

    def distance(self, moves: Floats, rounding: float) -> float:
        """Return the bound of the first system that has one."""
        return self._first_able(lambda system: system.distance(moves, rounding))

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Check by the current system."""
        self._system.refuse_moving_floats(moves, rounding)

    def is_stable(self) -> bool:
        """Return the result of the current system."""
        return self._system.is_stable()

    def _first_able(self, does: Callable[[System], T]) -> T:
        try:
            return does(self._system)
        except StagnationError as error:
            if isinstance(error, IndefiniteError) and not self._at_rest:
                raise
            self._past += self._system.iterations
            self._system = self._otherwise()
            return does(self._system)

    @property
    def methods(self) -> str:
        """Methods of the current system."""
        return self._system.methods

    @property
    def has_stagnated(self) -> bool:
        """True if the current system makes no progress."""
        return self._system.has_stagnated

    @property
    def bound_kind(self) -> str:
        """Kind of the error bound that the current system gives."""
        return self._system.bound_kind

    @property
    def amplification(self) -> float:
        """Amplification of the current system."""
        return self._system.amplification

    @property
    def iterations(self) -> int:
        """Number of iterations of both systems."""
        return self._past + self._system.iterations
