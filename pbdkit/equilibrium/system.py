"""The linear system of an equilibrium, A c = move with A = 1 - (step operator), and who solves it.

Moves and displacements are planes, (axis, sublattice, cell, cell), as in a state.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.errors import ExperimentError
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]


@cache
def _libraries(with_scipy: bool) -> ThreadpoolController:
    """Those that are loaded by now; scipy has one of its own."""
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Libraries of linear algebra that are loaded by now work on one thread meanwhile: on how many
    they work decides the order of their sums, and the last digits."""
    loaded = _libraries("scipy.linalg" in sys.modules)
    found: AbstractContextManager[object] = loaded.limit(limits=1, user_api="blas")
    return found


ACCURACY = 1e-2
"""Of solutions that only have to be known roughly, as a share of themselves."""
FAR, TURNS = 8.0, 4
"""Where they come to so many times less than was taken they are solved for once more, at most so
often."""


PUSH = 1e-10
"""The share of moves, known by differences perhaps, that may push a part that nothing holds."""


class StuckError(Exception):
    """An iteration got nowhere."""


class NoEquilibriumError(ExperimentError):
    """A part of the body has no equilibrium, or none that is unique."""


class IndefiniteError(StuckError):
    """Some way does not lead uphill: the body is not stable there."""


class System(ABC):
    """A c = move for the followers of a scene, linearised at a state with the roles of a step."""

    @property
    @abstractmethod
    def methods(self) -> str:
        """The names of the methods used."""

    @property
    @abstractmethod
    def how(self) -> str:
        """How the distance from the solution is obtained."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """Of all linear solvers together."""

    @property
    def is_stuck(self) -> bool:
        """Whether an iteration has got nowhere, and its method allows no other."""
        return False

    @property
    def amplification(self) -> float:
        """How much larger moves are, in rounding too, than the displacements that make them."""
        return 1.0

    @abstractmethod
    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """The correction c, to within a length. A state is `owed` to where the step looks back:
        what the invariants of parts that nothing holds have yet to gain. `rounding` is how far it
        may have put the moves off.

        Raises ExperimentError where a part is pushed on for ever.
        """

    @abstractmethod
    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """A⁻¹ moves to a share of its largest number; answers that are `near`, as those of systems
        alike, save iterations."""

    @abstractmethod
    def pushed_by(self, led: Floats) -> Floats | None:
        """The moves of followers whose leaders are displaced so much, as linear as A; None where
        the system does not know of leaders."""

    @abstractmethod
    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """λ, zero but at followers, with Σ λ · moves = Σ weights · A⁻¹ moves for all moves: Aᵀ λ =
        weights, to a share of its largest number."""

    @abstractmethod
    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """|A c + after - before| / |A c|: how far from linear the moves before and after a
        displacement c are."""

    @abstractmethod
    def distance(self, moves: Floats, rounding: float) -> float:
        """How far any follower is from the solution at most, given its moves and what rounding may
        have done to them."""

    @abstractmethod
    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raises ExperimentError where a part that nothing holds has moves left: only linear rules
        tell where it ends."""

    @abstractmethod
    def is_stable(self) -> bool:
        """Whether no eigenvalue of A, as far as they are looked at, is negative: a small
        disturbance of the solution then dies away, with a relaxation that is small enough."""


def solved(system: System, moves: Floats, size: float, rows: Rows = ALL) -> Floats:
    """A⁻¹ moves, taken to come to that size, to a share of what it comes to."""
    found = system.solve(moves, ACCURACY * size)
    for _ in range(TURNS):
        most = rows.largest(found)
        if most * FAR >= size:
            break
        size = most
        found = system.solve(moves, ACCURACY * size)
    return found
