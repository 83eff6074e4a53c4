"""Algebraic multigrid: one V-cycle over the grids that pyamg makes of a matrix."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Grids:
    """Approximates A⁻¹ r by one V-cycle, in the precision of the grids.

    The cycle is made here and not by pyamg, which takes the residual of the finest grid twice more
    to tell how far it came.
    """

    def __init__(self, hierarchy: Any) -> None:
        self._levels, self._coarsest = hierarchy.levels, hierarchy.coarse_solver
        self._precision = self._levels[0].A.dtype

    def __call__(self, r: Floats) -> Floats:
        """One cycle from zero. `r` is scaled to 1, for it may be tiny in single precision."""
        scale = float(np.abs(r).max(initial=0.0))
        if not 0.0 < scale < np.inf:
            return r.copy()
        x: Floats = self._cycled(0, (r * (1.0 / scale)).astype(self._precision)).astype(float)
        x *= scale
        return x

    def _cycled(self, depth: int, b: Any) -> Any:
        level = self._levels[depth]
        if depth == len(self._levels) - 1:
            return self._coarsest(level.A, b)
        x = np.zeros_like(b)
        level.presmoother(level.A, x, b)
        x += level.P @ self._cycled(depth + 1, level.R @ (b - level.A @ x))
        level.postsmoother(level.A, x, b)
        return x


def classical(matrix: Any) -> Grids:
    """Of Ruge and Stüben, in single precision: they only precondition, and half the bytes move."""
    import pyamg

    # One way down the unknowns, the other way up: half the work of both ways each time, for an
    # iteration or two more, and symmetric all the same.
    down, up = (("gauss_seidel", {"sweep": way}) for way in ("forward", "backward"))
    narrow = _narrow(matrix, np.float32)
    return Grids(pyamg.ruge_stuben_solver(narrow, presmoother=down, postsmoother=up))


def aggregated(matrix: Any, near_kernel: Floats, *, symmetric: bool) -> Grids:
    """By smoothed aggregation, for matrices that couple the axes: unknowns 2n and 2n + 1 stay
    together, and `near_kernel` (unknown, mode) are what the matrix hardly changes."""
    import pyamg

    symmetry = "symmetric" if symmetric else "nonsymmetric"
    blocks = _narrow(matrix, np.float64).tobsr((2, 2))
    return Grids(pyamg.smoothed_aggregation_solver(blocks, B=near_kernel, symmetry=symmetry))


def _narrow(matrix: Any, precision: type[np.floating[Any]]) -> Any:
    """A copy as pyamg wants it: a scipy matrix with indices of 32 bits."""
    import scipy.sparse

    found = scipy.sparse.csr_matrix(matrix, dtype=precision, copy=True)
    found.indices, found.indptr = found.indices.astype(np.int32), found.indptr.astype(np.int32)
    return found
