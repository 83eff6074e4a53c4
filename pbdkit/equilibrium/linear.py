"""Linear systems: each method factorises a matrix once and solves for many right-hand sides."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.matrices import DENSE
from pbdkit.errors import ExperimentError

Floats = NDArray[np.float64]
LARGEST_LU = 30_000
"""Unknowns up to which `auto` takes an LU factorisation (measured: multigrid is as fast there)."""
MOST_ITERATIONS = 400
SAME = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""


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


class Dense(LinearSolver):
    """The inverse itself, for small matrices."""

    name = "lu"

    def __init__(self, matrix: Floats) -> None:
        self.inverse = np.linalg.inv(matrix)

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self.inverse @ b

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self.inverse.T @ b


class SparseLU(LinearSolver):
    """SuperLU; symmetric matrices without pivoting, which fills in less."""

    name = "lu"

    def __init__(self, matrix: Any, symmetric: bool) -> None:
        from scipy.sparse.linalg import splu

        how: dict[str, Any] = {}
        if symmetric:
            how = {
                "permc_spec": "MMD_AT_PLUS_A",
                "diag_pivot_thresh": 0.0,
                "options": {"SymmetricMode": True},
            }
        try:
            self._factors = splu(matrix.tocsc(), **how)
        except RuntimeError as error:  # "Factor is exactly singular"
            raise np.linalg.LinAlgError(str(error)) from None

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return np.asarray(self._factors.solve(b))

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return np.asarray(self._factors.solve(b, trans="T"))


class Krylov(LinearSolver):
    """Conjugate gradients for symmetric matrices, GMRES for others; `grids` makes the multigrid
    preconditioner of a matrix, None for none."""

    def __init__(
        self, matrix: Any, symmetric: bool, grids: Callable[[Any], Any] | None = None
    ) -> None:
        inner = "conjugate-gradients" if symmetric else "gmres"
        self.name = f"multigrid, {inner}" if grids else inner
        self._symmetric, self._grids = symmetric, grids
        self._upright = self._prepared(matrix)
        self._transposed: tuple[Any, Any] | None = self._upright if symmetric else None

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self._iterated(*self._upright, b, accuracy)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        if self._transposed is None:
            self._transposed = self._prepared(self._upright[0].T.tocsr())
        return self._iterated(*self._transposed, b, accuracy)

    def _prepared(self, matrix: Any) -> tuple[Any, Any]:
        if self._grids is None:
            return matrix, None
        return matrix, self._grids(matrix).aspreconditioner(cycle="V")

    def _iterated(self, matrix: Any, preconditioner: Any, b: Floats, accuracy: float) -> Floats:
        from scipy.sparse.linalg import cg, gmres

        def count(_: Any) -> None:
            self.iterations += 1

        how: dict[str, Any] = {"rtol": max(accuracy, 1e-14), "atol": 0.0, "M": preconditioner}
        if self._symmetric:
            most = MOST_ITERATIONS if preconditioner else 20 * math.isqrt(len(b)) + MOST_ITERATIONS
            x, _ = cg(matrix, b, maxiter=most, callback=count, **how)
        else:
            how |= {"callback_type": "pr_norm", "restart": 30}
            x, _ = gmres(matrix, b, maxiter=MOST_ITERATIONS // 30, callback=count, **how)
        return np.asarray(x)


def linear_solver(
    matrix: Any, method: str, *, symmetric: bool, near_kernel: Floats | None = None
) -> LinearSolver:
    """The solver for a sparse matrix by a method, or by what serves its size.

    `near_kernel` (unknown, mode) are what the matrix hardly changes, for the coarser grids of
    matrices that couple the axes. Raises LinAlgError where the matrix is found to be singular, and
    ExperimentError where the method is not installed.
    """
    size = matrix.shape[0]
    if method == "auto":
        grids = size > LARGEST_LU and find_spec("pyamg") is not None
        method = "multigrid" if grids else "lu"
    if method == "lu":
        if size <= DENSE:
            return Dense(matrix.toarray() if not isinstance(matrix, np.ndarray) else matrix)
        return SparseLU(matrix, symmetric)
    if method == "conjugate-gradients":
        return Krylov(matrix, symmetric)
    if find_spec("pyamg") is None:
        raise ExperimentError(
            "method multigrid needs pyamg: pip install 'pbdkit[fast]'", ("solver", "method")
        )
    return Krylov(matrix, symmetric, partial(_grids, symmetric, near_kernel))


def _grids(symmetric: bool, near_kernel: Floats | None, matrix: Any) -> Any:
    import pyamg
    import scipy.sparse

    matrix = scipy.sparse.csr_matrix(matrix)
    matrix.indices = matrix.indices.astype(np.int32)
    matrix.indptr = matrix.indptr.astype(np.int32)
    if near_kernel is None:
        return pyamg.ruge_stuben_solver(matrix)
    return pyamg.smoothed_aggregation_solver(
        matrix.tobsr((2, 2)),
        B=near_kernel,
        symmetry="symmetric" if symmetric else "nonsymmetric",
    )


def is_symmetric(matrix: Any) -> bool:
    """Whether a matrix equals its transpose, up to rounding."""
    difference = abs(matrix - matrix.T)
    return bool(difference.max() <= SAME * max(1.0, abs(matrix).max()))
