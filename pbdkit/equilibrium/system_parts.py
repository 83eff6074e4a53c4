"""The parts of a body in a linear system, and those of them that leaders hold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.krylov import Krylov, LinearSolver
from pbdkit.equilibrium.linear_solver import Dense, is_symmetric, linear_solver
from pbdkit.equilibrium.watch import Watch

Floats = NDArray[np.float64]
SAFETY = 3.0
"""What an estimated norm, which may come out too small, is multiplied with."""
ROUGH, ROUGHER = 1e-3, 1e-2
"""The accuracy of solutions that only serve a bound, and of those for barriers: smoothing mends the
rest."""
LEVEL, MOST_SMOOTHINGS = 0.5, 10
"""A barrier's A v, aimed at 1, is smoothed until it is nowhere below, at most so many times."""
SINGULAR = 1e-10
"""Relative size below which a singular value counts as zero."""
LARGEST_FALLBACK = 400_000
"""Unknowns up to which an LU factorisation takes over where an iteration gets stuck."""


class DriftingError(Exception):
    """A part that nothing holds is pushed on for ever."""


class Part(ABC):
    """A x = r for the unknowns of a part."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The method."""

    @abstractmethod
    def solve(self, r: Floats, accuracy: float) -> Floats:
        """The x to which steps from x = 0 converge. Raises DriftingError where there is none."""

    @abstractmethod
    def farthest(self, r: Floats) -> float:
        """A bound on max |A⁻¹ r'| over all |r'| ≤ r, r ≥ 0."""

    @property
    @abstractmethod
    def how(self) -> str:
        """How the bound is obtained."""

    @property
    def iterations(self) -> int:
        """Of the linear solver."""
        return 0


class Held(Part):
    """A part whose matrix has an inverse."""

    def __init__(
        self,
        matrix: Any,
        method: str,
        near_kernel: Floats | None = None,
        watch: Watch | None = None,
        places: Floats | None = None,
    ) -> None:
        if isinstance(matrix, np.ndarray) and method not in ("auto", "lu"):
            from scipy.sparse import csr_array

            matrix = csr_array(matrix)
        self._matrix, self._symmetric = matrix, is_symmetric(matrix)
        self._watch = watch or Watch()
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        self._places = places
        self._solver: LinearSolver = linear_solver(
            matrix,
            method,
            symmetric=self._symmetric,
            near_kernel=near_kernel,
            places=places,
            watch=self._watch,
        )

    @property
    def name(self) -> str:
        """That of the linear solver."""
        return self._solver.name

    @property
    def iterations(self) -> int:
        """Those of the linear solver."""
        return self._solver.iterations

    def solve(self, r: Floats, accuracy: float) -> Floats:
        """By this method."""
        self._watch.begin("solving")
        x = self._solver.solve(r, accuracy)
        if isinstance(self._solver, Krylov) and self._has_choice:
            left = float(np.linalg.norm(r - self._matrix @ x))
            if left > 100 * accuracy * float(np.linalg.norm(r)):  # the iteration got stuck
                self._solver = linear_solver(
                    self._matrix, "lu", symmetric=self._symmetric, places=self._places
                )
                x = self._solver.solve(r, accuracy)
        return x

    def farthest(self, r: Floats) -> float:
        """From the inverse where it is at hand, else from a bound on it."""
        if isinstance(self._solver, Dense):
            return float((np.abs(self._solver.inverse) @ r).max(initial=0.0))
        if self._barrier:
            height, climb = self._barrier
            return float(height.max() * (r / climb).max())
        return self._norm * float(r.max(initial=0.0))

    @property
    def how(self) -> str:
        """By the inverse where it is at hand, else by what the matrix allows."""
        if isinstance(self._solver, Dense):
            return "inverse"
        return "barrier" if self._barrier else "estimated norm of the inverse"

    @cached_property
    def _barrier(self) -> tuple[Floats, Floats] | None:
        """v > 0 with A v > 0, where no entry off the diagonal is positive: then A⁻¹ ≥ 0, and
        |A⁻¹ r| ≤ v · max(|r| / A v). Any such v will do; it is near A⁻¹ 1, made smooth by
        v + (1 - A v)/2, half a step of an averaging rule."""
        if not self._may_have_barrier:
            return None
        height = self._of_ones
        climb = self._matrix @ height
        for _ in range(MOST_SMOOTHINGS):
            if climb.min() >= LEVEL:
                break
            height = height + 0.5 * (1.0 - climb)
            climb = self._matrix @ height
        return (height, climb) if min(height.min(), climb.min()) > 0.0 else None

    @cached_property
    def _may_have_barrier(self) -> bool:
        diagonal = self._matrix.diagonal()
        return bool((self._matrix.data > 0.0).sum() == (diagonal > 0.0).sum())

    @cached_property
    def _of_ones(self) -> Floats:
        """A⁻¹ 1, roughly."""
        self._watch.begin("bounding the error")
        accuracy = ROUGHER if self._may_have_barrier else ROUGH
        return self._solver.solve(np.ones(self._matrix.shape[0]), accuracy)

    @cached_property
    def _norm(self) -> float:
        self._watch.begin("bounding the error")
        return SAFETY * estimated_norm(self._solver, self._matrix.shape[0])

    @property
    def conditioned(self) -> bool:
        """Whether the inverse is worth anything in double precision."""
        if isinstance(self._solver, Dense):
            found = self.farthest(np.ones(self._matrix.shape[0]))
        else:
            found = float(np.abs(self._of_ones).max())
        return bool(np.isfinite(found)) and found < 1.0 / SINGULAR


def estimated_norm(solver: LinearSolver, size: int) -> float:
    """An estimate from below of the largest row sum of |A⁻¹| (Higham and Tisseur)."""
    from scipy.sparse.linalg import LinearOperator, onenormest

    transposed = LinearOperator(
        (size, size),
        matvec=lambda b: solver.solve_transposed(np.ravel(b), ROUGH),
        rmatvec=lambda b: solver.solve(np.ravel(b), ROUGH),
        dtype=float,
    )
    return float(onenormest(transposed))
