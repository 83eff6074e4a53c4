"""In which order to eliminate unknowns that lie in a plane: nested dissection.

A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973): a
strip that the couplings cannot leap over parts the body in two, which do not fill in each other's
entries. Both are parted in the same way, the strip comes last.
"""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE
from pbdkit.equilibrium.krylov import Krylov, LinearSolver
from pbdkit.equilibrium.multigrid import aggregated, classical
from pbdkit.equilibrium.watch import Watch
from pbdkit.errors import ExperimentError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

FEWEST, LEAF = 1000, 40
"""Places from which dissection pays (measured), and so few that they are parted no further."""
TINY = 1e-300
WIDEST = 0.25
"""The share of all places that the first strip may take for dissection to be worth its while."""


def dissected(matrix: Any, places: Floats) -> Indices | None:
    """The unknowns of a sparse matrix, in the order of elimination; `places` (unknown, axis) says
    where they lie, those of one place next to each other. None where couplings reach too far, or
    where there are few places."""
    fresh = np.ones(len(places), bool)
    fresh[1:] = (places[1:] != places[:-1]).any(axis=1)
    sites, every = places[fresh], np.arange(np.count_nonzero(fresh))
    reach = _reach(matrix, places)
    first = _halves(sites, every, reach) if len(every) > FEWEST else None
    if first is None or len(first[2]) > WIDEST * len(every):
        return None
    order: list[Indices] = []
    _dissect(sites, every, reach, order)
    rank = np.empty_like(every)
    rank[np.concatenate(order)] = every
    return np.argsort(rank[np.cumsum(fresh) - 1], kind="stable")


def _reach(matrix: Any, places: Floats) -> Floats:
    """How far couplings reach along each axis; a hair more, for rounding, and never nothing."""
    row, column = matrix.tocoo().coords
    found = [float(np.abs(x[row] - x[column]).max(initial=0.0)) for x in places.T.copy()]
    return 1.001 * np.array(found) + 1e-9 * np.ptp(places) + TINY


def _dissect(places: Floats, some: Indices, reach: Floats, order: list[Indices]) -> None:
    halves = _halves(places, some, reach) if len(some) > LEAF else None
    if halves is None:
        order.append(some)
        return
    below, above, strip = halves
    _dissect(places, below, reach, order)
    _dissect(places, above, reach, order)
    order.append(strip)


def _halves(
    places: Floats, some: Indices, reach: Floats
) -> tuple[Indices, Indices, Indices] | None:
    """Those below a strip across the longer side, those above it, and the strip; None where it
    leaves nobody on one side."""
    here = places[some]
    sides = np.ptp(here, axis=0)
    axis = int(sides[1] / reach[1] > sides[0] / reach[0])
    along, width = here[:, axis], reach[axis]
    middle = np.partition(along, len(along) // 2)[len(along) // 2] - width / 2
    below, above = along <= middle, along > middle + width
    if not (below.any() and above.any()):
        return None
    return some[below], some[above], some[~(below | above)]


LARGEST_LU = 30_000
"""Unknowns up to which `auto` takes an LU factorisation (measured: multigrid, with the import of
pyamg, takes as long there)."""
LARGEST_COUPLED_LU = 200_000
"""The same where the axes move each other and it is known where the unknowns lie (measured: for
elastic bodies of 40 000 to 100 000 unknowns multigrid takes five times as long, and LU 2 s and
0.4 GiB for 170 000)."""
STURDY = 0.1
"""Diagonal entries that are this share of the largest of their columns serve as pivots."""
LOPSIDED = 1.2
"""A matrix and its transpose together may have so many times its entries for it to count as nearly
symmetric."""
SAME = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""


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
    """SuperLU. Where the pattern is nearly symmetric, in an order that fills in little: by nested
    dissection where it is known where the many unknowns lie, else by minimum degree."""

    name = "lu"

    def __init__(self, matrix: Any, symmetric: bool, places: Floats | None = None) -> None:
        from scipy.sparse.linalg import splu

        how: dict[str, Any] = {}
        self._order = None
        if symmetric:
            how = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        elif is_nearly_symmetric(matrix):
            how = {"diag_pivot_thresh": STURDY}
        if how:
            how["permc_spec"] = "MMD_AT_PLUS_A"
            self._order = None if places is None else dissected(matrix, places)
        if self._order is not None:
            how["permc_spec"] = "NATURAL"
            matrix = matrix[self._order][:, self._order]
        try:
            self._factors = splu(matrix.tocsc(), **how)
        except RuntimeError as error:  # "Factor is exactly singular"
            raise np.linalg.LinAlgError(str(error)) from None

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self._solved(b, "N")

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By this method."""
        return self._solved(b, "T")

    def _solved(self, b: Floats, how: str) -> Floats:
        if self._order is None:
            return np.asarray(self._factors.solve(b, trans=how))
        x = np.empty_like(b, dtype=float)
        x[self._order] = self._factors.solve(b[self._order], trans=how)
        return x


def linear_solver(
    matrix: Any,
    method: str,
    *,
    symmetric: bool,
    near_kernel: Floats | None = None,
    places: Floats | None = None,
    watch: Watch | None = None,
) -> LinearSolver:
    """The solver for a sparse matrix by a method, or by what serves its size.

    `places` (unknown, axis) says where the unknowns lie, two of each place where the matrix couples
    the axes: then an order of elimination by them pays.
    `near_kernel` (unknown, mode) are what the matrix hardly changes, for the coarser grids of
    matrices that couple the axes. Raises LinAlgError where the matrix is found to be singular, and
    ExperimentError where the method is not installed.
    """
    size = matrix.shape[0]
    if method == "auto":
        large = size > (LARGEST_LU if places is None else LARGEST_COUPLED_LU)
        method = "multigrid" if large and find_spec("pyamg") is not None else "lu"
    if method == "lu":
        if size <= DENSE:
            return Dense(matrix.toarray() if not isinstance(matrix, np.ndarray) else matrix)
        return SparseLU(matrix, symmetric, places)
    if method == "conjugate-gradients":
        return Krylov(matrix, symmetric, watch or Watch())
    if find_spec("pyamg") is None:
        raise ExperimentError(
            "method multigrid needs pyamg: pip install 'pbdkit[fast]'", ("solver", "method")
        )
    grids = (
        classical
        if near_kernel is None
        else partial(aggregated, near_kernel=near_kernel, symmetric=symmetric)
    )
    return Krylov(matrix, symmetric, watch or Watch(), grids)


def is_symmetric(matrix: Any) -> bool:
    """Whether a matrix equals its transpose, up to rounding."""
    difference = abs(matrix - matrix.T)
    return bool(difference.max() <= SAME * max(1.0, abs(matrix).max()))


def is_nearly_symmetric(matrix: Any) -> bool:
    """Whether a sparse matrix has most entries where its transpose has them."""
    from scipy.sparse import csr_array

    ones = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    return bool((ones + ones.T).nnz <= LOPSIDED * matrix.nnz)
