"""Large singular matrices: their kernels, and systems bordered by them, by one factorisation."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE
from pbdkit.equilibrium.krylov import LinearSolver
from pbdkit.equilibrium.linear_solver import Dense, is_symmetric, linear_solver
from pbdkit.equilibrium.system_parts import SAFETY, SINGULAR, DriftingError, Part, estimated_norm

Floats = NDArray[np.float64]
SHIFT = 1e-11
MOST_MODES = 6
ROUNDS = 2
"""A round of solving and refining leaves a share of about SHIFT · |A⁺| of the residual."""


class Shifted:
    """The factors of A + ε, with orthonormal bases of all y with yᵀ A = 0, `left`, and of all z
    with A z = 0, `right`, both (unknown, mode); few, for connected parts."""

    def __init__(self, matrix: Any) -> None:
        from scipy.sparse import eye_array

        self.matrix, symmetric = matrix, is_symmetric(matrix)
        shifted = (matrix + SHIFT * eye_array(matrix.shape[0])).tocsr()
        self.factors = linear_solver(shifted, "lu", symmetric=symmetric)
        self.left = _kernel(self.factors.solve_transposed, matrix.T)
        self.right = self.left if symmetric else _kernel(self.factors.solve, matrix)


class Deflated(LinearSolver):
    """A x + Y μ = r, K x = k with Y the left kernel of A, K as many `rows`, and b = (r, k).

    μ = Yᵀ r. What the factors of A + ε answer to r - Y μ is right but for a share of the right
    kernel Z, which follows from K x = k. Raises LinAlgError where K Z is singular: A has modes that
    grow.
    """

    name = "lu"

    def __init__(self, shifted: Shifted, rows: Floats) -> None:
        self._matrix, self._factors = shifted.matrix, shifted.factors
        self._left, self._right, self._rows = shifted.left, shifted.right, rows
        corner = rows @ self._right
        if corner.shape[0] != corner.shape[1] or np.linalg.cond(corner) > 1.0 / SINGULAR:
            raise np.linalg.LinAlgError("modes that grow")
        self._corner = np.linalg.inv(corner)

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        r, k = np.split(b, [len(b) - len(self._corner)])
        mu = self._left.T @ r
        x = np.zeros_like(r)
        for _ in range(ROUNDS):
            x += self._factors.solve(r - self._left @ mu - self._matrix @ x, accuracy)
            x += self._right @ (self._corner @ (k - self._rows @ x))
        return np.concatenate([x, mu])

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """The same for Aᵀ y + Kᵀ ν = r, Yᵀ y = k."""
        r, k = np.split(b, [len(b) - len(self._corner)])
        nu = self._corner.T @ (self._right.T @ r)
        y = np.zeros_like(r)
        for _ in range(ROUNDS):
            left = r - self._rows.T @ nu - self._matrix.T @ y
            y += self._factors.solve_transposed(left, accuracy)
            y += self._left @ (k - self._left.T @ y)
        return np.concatenate([y, nu])


def _kernel(solve: Callable[[Floats, float], Floats], matrix: Any) -> Floats:
    """By inverse iteration: whatever is not in the kernel shrinks by ε / λ a turn."""
    basis = np.random.default_rng(0).normal(size=(matrix.shape[0], MOST_MODES))
    for _ in range(4):
        basis = np.linalg.qr(solve(basis, 0.0))[0]
    _, values, turned = np.linalg.svd(matrix @ basis, full_matrices=False)
    return np.asarray(basis @ turned[values <= SINGULAR].T)


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
