"""Krylov's iterations, preconditioned by multigrid or not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.linear_solver import is_symmetric, linear_solver
from pbdkit.equilibrium.newton import LinearSolver
from pbdkit.equilibrium.system_parts import SINGULAR
from pbdkit.equilibrium.watch import Watch

Floats = NDArray[np.float64]
Preconditioner = Callable[[Floats], Floats]
MOST_ITERATIONS = 400
FINEST = 1e-14
"""No residual becomes smaller than this share."""


class Krylov(LinearSolver):
    """Conjugate gradients for symmetric matrices, GMRES for others; `grids` makes the multigrid
    preconditioner of a matrix, None for none."""

    def __init__(
        self,
        matrix: Any,
        symmetric: bool,
        watch: Watch,
        grids: Callable[[Any], Preconditioner] | None = None,
    ) -> None:
        inner = "conjugate-gradients" if symmetric else "gmres"
        self.name = f"multigrid, {inner}" if grids else inner
        self._symmetric, self._grids, self._watch = symmetric, grids, watch
        self._upright = self._prepared(matrix)
        self._transposed: tuple[Any, Preconditioner | None] | None = None
        if symmetric:
            self._transposed = self._upright

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self._iterated(*self._upright, b, max(accuracy, FINEST))

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        if self._transposed is None:
            self._transposed = self._prepared(self._upright[0].T.tocsr())
        return self._iterated(*self._transposed, b, max(accuracy, FINEST))

    def _prepared(self, matrix: Any) -> tuple[Any, Preconditioner | None]:
        return matrix, self._grids(matrix) if self._grids else None

    def _iterated(
        self, matrix: Any, preconditioner: Preconditioner | None, b: Floats, accuracy: float
    ) -> Floats:
        def count(left: float) -> None:
            self.iterations += 1
            self._watch.look(math.log(left) / math.log(accuracy) if 0.0 < left < 1.0 else 0.0)

        if self._symmetric:
            most = MOST_ITERATIONS if preconditioner else 20 * math.isqrt(len(b)) + MOST_ITERATIONS
            return conjugate_gradients(matrix, b, accuracy, preconditioner, most, count)
        from scipy.sparse.linalg import LinearOperator, gmres

        how: dict[str, Any] = {"callback_type": "pr_norm", "restart": 30, "atol": 0.0}
        if preconditioner:
            how["M"] = LinearOperator(matrix.shape, matvec=preconditioner, dtype=float)
        most = MOST_ITERATIONS // 30
        x, _ = gmres(matrix, b, rtol=accuracy, maxiter=most, callback=count, **how)
        return np.asarray(x)


def conjugate_gradients(
    matrix: Any,
    b: Floats,
    accuracy: float,
    preconditioner: Preconditioner | None,
    most: int,
    tell: Callable[[float], None],
) -> Floats:
    """x with ‖b - A x‖₂ ≤ accuracy · ‖b‖₂, or what was reached after `most` iterations.

    `tell` is handed ‖b - A x‖₂ / ‖b‖₂ after each. It ends where the curvature along a direction is
    not positive: A is no matrix for it, or rounding has the last word.
    """
    x, r = np.zeros_like(b), b.copy()
    whole = math.sqrt(product(b, b))
    if not 0.0 < whole < math.inf:
        return x
    p, before = np.zeros_like(b), 1.0
    for _ in range(most):
        z = preconditioner(r) if preconditioner else r
        now = product(r, z)
        p *= now / before
        p += z
        q = matrix @ p
        curvature = product(p, q)
        if not 0.0 < curvature < math.inf:
            break
        x += (now / curvature) * p
        q *= now / curvature
        r -= q
        before = now
        left = math.sqrt(product(r, r)) / whole
        tell(left)
        if left <= accuracy:
            break
    return x


def product(a: Floats, b: Floats) -> float:
    """a · b, the same on any number of processors, and with no threads to wait for."""
    return float(np.einsum("i,i->", a, b))


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
