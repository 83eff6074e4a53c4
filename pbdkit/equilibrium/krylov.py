"""Krylov's iterations, preconditioned by multigrid or not."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.watch import Watch

Floats = NDArray[np.float64]
Preconditioner = Callable[[Floats], Floats]
MOST_ITERATIONS = 400
FINEST = 1e-14
"""No residual becomes smaller than this share."""


class LinearSolver(ABC):
    """Solves A x = b for one matrix, with an unknown a row."""

    name: str
    iterations = 0

    @abstractmethod
    def solve(self, b: Floats, accuracy: float) -> Floats:
        """x with ‖b - A x‖₂ ≤ accuracy · ‖b‖₂ as far as the method gets."""

    @abstractmethod
    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """The same for Aᵀ."""


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
