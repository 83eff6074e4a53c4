"""Large singular matrices: their kernels, and systems bordered by them, by one factorisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.linear import LinearSolver, is_symmetric, linear_solver

Floats = NDArray[np.float64]
SINGULAR = 1e-10
"""Relative size below which a singular value counts as zero."""
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
