"""The parts of a body in a linear system: those that leaders hold, and those that nothing holds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.matrices import DENSE
from pbdkit.equilibrium.deflated import SINGULAR, Deflated, Shifted
from pbdkit.equilibrium.linear import Dense, Krylov, LinearSolver, is_symmetric, linear_solver

Floats = NDArray[np.float64]
SAFETY = 3.0
"""What an estimated norm, which may come out too small, is multiplied with."""
ROUGH = 1e-3
"""The accuracy of solutions that only serve a bound."""
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

    def __init__(self, matrix: Any, method: str, near_kernel: Floats | None = None) -> None:
        if isinstance(matrix, np.ndarray) and method not in ("auto", "lu"):
            from scipy.sparse import csr_array

            matrix = csr_array(matrix)
        self._matrix, self._symmetric = matrix, is_symmetric(matrix)
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        self._solver: LinearSolver = linear_solver(
            matrix, method, symmetric=self._symmetric, near_kernel=near_kernel
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
        x = self._solver.solve(r, accuracy)
        if isinstance(self._solver, Krylov) and self._has_choice:
            left = float(np.linalg.norm(r - self._matrix @ x))
            if left > 100 * accuracy * float(np.linalg.norm(r)):  # the iteration got stuck
                self._solver = linear_solver(self._matrix, "lu", symmetric=self._symmetric)
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
        |A⁻¹ r| ≤ v · max(|r| / A v)."""
        entries = self._matrix.tocoo()
        if (entries.data[entries.coords[0] != entries.coords[1]] > 0.0).any():
            return None
        height = self._solver.solve(np.ones(self._matrix.shape[0]), ROUGH)
        climb = self._matrix @ height
        return (height, climb) if min(height.min(), climb.min()) > 0.0 else None

    @cached_property
    def _norm(self) -> float:
        return SAFETY * estimated_norm(self._solver, self._matrix.shape[0])

    @property
    def conditioned(self) -> bool:
        """Whether the inverse is worth anything in double precision."""
        ones = np.ones(self._matrix.shape[0])
        found = self.farthest(ones) if isinstance(self._solver, Dense) else None
        if found is None:
            found = float(np.abs(self._solver.solve(ones, ROUGH)).max())
        return bool(np.isfinite(found)) and found < 1.0 / SINGULAR


class Floating(Part):
    """A part with modes that no step changes: what their invariants Yᵀ u, Yᵀ A = 0, were, they
    remain. `before` is the share of A that looks back a step: it has a share in the invariants."""

    def __init__(self, matrix: Any, before: Any) -> None:
        self._size = matrix.shape[0]
        shifted = Shifted(matrix) if self._size > DENSE else None
        self._left = shifted.left if shifted else _left_kernel(matrix)
        rows = self._left.T + (self._left.T @ before if before is not None else 0.0)
        self._solver: LinearSolver | None = None
        with suppress(np.linalg.LinAlgError):  # modes that grow: only rest is an equilibrium
            self._solver = (
                Deflated(shifted, np.asarray(rows))
                if shifted
                else Dense(_bordered(matrix, self._left, np.asarray(rows)))
            )

    @property
    def name(self) -> str:
        """That of the linear solver."""
        return "lu"

    def solve(self, r: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """By this method."""
        push = self._left.T @ r
        if self._solver is None:
            if r.any():
                raise DriftingError
            return np.zeros(self._size)
        if np.abs(push).max(initial=0.0) > SINGULAR * max(1.0, float(np.linalg.norm(r))):
            raise DriftingError
        kept = np.zeros(len(push)) if owed is None else self._left.T @ owed
        x = self._solver.solve(np.concatenate([r - self._left @ push, kept]), accuracy)
        return x[: self._size]

    def farthest(self, r: Floats) -> float:
        """From the inverse where it is at hand, else from a bound on it."""
        if isinstance(self._solver, Dense):
            own = np.abs(self._solver.inverse[: self._size, : self._size])
            return float((own @ r).max(initial=0.0))
        if self._solver is None:
            return math.inf if r.any() else 0.0
        return self._norm * float(r.max(initial=0.0))

    @property
    def how(self) -> str:
        """By the inverse where it is at hand, else by what the matrix allows."""
        return "inverse" if isinstance(self._solver, Dense) else "estimated norm of the inverse"

    @cached_property
    def _norm(self) -> float:
        assert self._solver is not None
        return SAFETY * estimated_norm(self._solver, self._size + self._left.shape[1])


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


def _left_kernel(matrix: Any) -> Floats:
    """(unknown, mode): an orthonormal basis of all y with yᵀ A = 0."""
    left, values, _ = np.linalg.svd(_dense(matrix))
    basis: Floats = left[:, values <= SINGULAR * max(1.0, values.max(initial=0.0))]
    return basis


def _bordered(matrix: Any, left: Floats, rows: Floats) -> Floats:
    corner = np.zeros((left.shape[1], left.shape[1]))
    return np.block([[_dense(matrix), left], [rows, corner]])


def _dense(matrix: Any) -> Floats:
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())
