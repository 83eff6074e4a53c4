"""Direct and iterative solvers of linear systems of particles with known coordinates.

Small matrices are inverted. Matrices of narrow bodies are factorised as band matrices by LAPACK;
their unknowns are ordered row by row across the shorter side of the body. Other matrices are
factorised by SuperLU, with the unknowns in the order of nested dissection, which causes little
fill-in (A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10,
1973). In this order a strip, which is wide enough that no coupling crosses it, divides the body
into two halves. Both halves are divided in the same way, and the strip is eliminated last. SuperLU
itself does not offer this order. Large systems are solved by iteration, with multigrid (amg.py) as
preconditioner. docs/decisions/0010 contains measurements.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.equilibrium.amg import SparseGrids
from pbdkit.equilibrium.system import one_thread
from pbdkit.linear.block_matrix import DENSE
from pbdkit.progress import Watch

Preconditioner = Callable[[Floats], Floats]
MAX_ITERATIONS = 400
"""Maximum number of Krylov iterations with a preconditioner."""
MIN_RESIDUAL = 1e-14
"""Smallest relative residual of iterations."""
LARGEST_LU = 30_000
"""Number of unknowns up to which `auto` selects an LU factorisation."""
LARGEST_COUPLED_LU = 200_000
"""Number of unknowns up to which `auto` selects an LU factorisation if the axes are coupled."""
WIDEST_BAND = 120
"""Largest half-bandwidth that is factorised as a band. For wider bands, the band factors of a
square body need more memory than sparse factors. If the bands are still wider, they also need more
time."""
PIVOT_THRESHOLD = 0.1
"""A diagonal entry is used as a pivot if it is at least this fraction of the largest entry of its
column."""
PATTERN_ASYMMETRY = 1.2
"""The pattern of A counts as nearly symmetric if A + Aᵀ has at most this number times as many
nonzeros as A."""
SYMMETRY_RTOL = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""
FEWEST = 1000
"""Number of places from which nested dissection is faster (measured)."""
LEAF = 40
"""Number of places up to which a part is not divided."""
TINY = 1e-300
"""Lower bound on the reach of couplings. It is positive because the reach is used as a divisor."""
WIDEST = 0.25
"""Largest fraction of all places in the first strip of a dissection."""


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of the unknowns, `axes` for each particle, stored next to each other.

    The class contains the positions of the particles and of the leaders, as arrays of shape
    (particle, axis of space), and a mask of the `held` unknowns. The row and the column of a held
    unknown contain only the diagonal entry. The mask is None if no unknown is held.
    """

    axes: int
    places: Floats
    led: Floats
    held: NDArray[np.bool_] | None = None

    def grids(self, matrix: Any) -> Preconditioner:
        """Return the multigrid preconditioner of a matrix."""
        return SparseGrids(matrix, self.axes, self.places, self.led, self.held)


class LinearSolver(ABC):
    """Solver of A x = b for one matrix, with one row for each unknown."""

    name: str
    iterations = 0

    @abstractmethod
    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Return x with ‖b - A x‖₂ ≤ accuracy · ‖b‖₂, or the best x that the method can reach."""

    @abstractmethod
    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution of Aᵀ x = b with the same accuracy."""


class Dense(LinearSolver):
    """Inverse of a small matrix."""

    name = "lu"

    def __init__(self, matrix: Floats) -> None:
        self.inverse = np.linalg.inv(matrix)

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Return the product with the inverse."""
        return self.inverse @ b

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """Return the product with the transpose of the inverse."""
        return self.inverse.T @ b


class BandLU(LinearSolver):
    """LAPACK's LU factors of a band matrix, with the unknowns reordered."""

    name = "lu"

    def __init__(self, matrix: Any, order: Indices, half: int) -> None:
        from scipy.linalg.lapack import dgbtrf

        self._order, self._half = order, half
        rank = np.argsort(order)
        entries = matrix.tocoo()
        row, column = (rank[unknowns] for unknowns in entries.coords)
        band = np.zeros((3 * half + 1, matrix.shape[0]), order="F")
        band[2 * half + row - column, column] = entries.data
        with one_thread():
            self._factors, self._pivots, info = dgbtrf(band, half, half, overwrite_ab=1)
        if info:
            raise np.linalg.LinAlgError(f"the pivot of unknown {info} is zero")

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution, computed with the factors."""
        return self._by_factors(b, 0)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution, computed with the transposed factors."""
        return self._by_factors(b, 1)

    def _by_factors(self, b: Floats, trans: int) -> Floats:
        from scipy.linalg.lapack import dgbtrs

        half, x = self._half, np.empty_like(b, dtype=float)
        right = b[self._order]
        with one_thread():
            x[self._order], _ = dgbtrs(self._factors, half, half, right, self._pivots, trans=trans)
        return x


def band_order(matrix: Any, coordinates: Coordinates) -> tuple[Indices, int]:
    """Return the unknowns row by row across the shorter side of the body, and the half-bandwidth
    of a sparse matrix in that order."""
    places = coordinates.places.round(9)
    shorter_first = np.argsort(np.ptp(places, axis=0), kind="stable")
    sites = np.lexsort(places.T[shorter_first])
    order = (coordinates.axes * sites[:, None] + np.arange(coordinates.axes)).ravel()
    rank = np.argsort(order)
    row, column = (rank[unknowns] for unknowns in matrix.tocoo().coords)
    return order, int(np.abs(row - column).max(initial=0))


class SparseLU(LinearSolver):
    """SuperLU factors. A nearly symmetric pattern is reordered to reduce fill-in: by nested
    dissection if the coordinates of many unknowns are known, else by minimum degree."""

    name = "lu"

    def __init__(
        self, matrix: Any, symmetric: bool, coordinates: Coordinates | None = None
    ) -> None:
        from scipy.sparse.linalg import splu

        how: dict[str, Any] = {}
        self._order = None
        if symmetric:
            how = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        elif is_nearly_symmetric(matrix):
            how = {"diag_pivot_thresh": PIVOT_THRESHOLD}
        if how:
            how["permc_spec"] = "MMD_AT_PLUS_A"
            places = coordinates.places.repeat(coordinates.axes, axis=0) if coordinates else None
            self._order = None if places is None else dissected(matrix, places)
        if self._order is not None:
            how["permc_spec"] = "NATURAL"
            matrix = matrix[self._order][:, self._order]
        try:
            self._factors = splu(matrix.tocsc(), **how)
        except RuntimeError as error:  # "Factor is exactly singular"
            raise np.linalg.LinAlgError(str(error)) from None

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution, computed with the factors."""
        return self._by_factors(b, "N")

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution, computed with the transposed factors."""
        return self._by_factors(b, "T")

    def _by_factors(self, b: Floats, how: str) -> Floats:
        if self._order is None:
            return np.asarray(self._factors.solve(b, trans=how))
        x = np.empty_like(b, dtype=float)
        x[self._order] = self._factors.solve(b[self._order], trans=how)
        return x


class PreconditionedKrylov(LinearSolver):
    """Conjugate gradients for symmetric matrices, and GMRES for others. The function `grids`
    returns the multigrid preconditioner of a matrix, or None."""

    def __init__(
        self,
        matrix: Any,
        symmetric: bool,
        watch: Watch,
        grids: Callable[[Any], Preconditioner] | None = None,
    ) -> None:
        inner = "conjugate-gradients" if symmetric else "gmres"
        self.name = f"multigrid, {inner}" if grids else inner
        self._matrix, self._symmetric, self._watch = matrix, symmetric, watch
        self._grids = grids
        self._cycle = grids(matrix) if grids else np.copy
        self._maxiter = MAX_ITERATIONS + (0 if grids else 20 * math.isqrt(matrix.shape[0]))

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Iterate until the residual is small enough or the maximum number of iterations is
        reached."""
        from scipy.sparse.linalg import LinearOperator, cg, gmres

        accuracy, whole = max(accuracy, MIN_RESIDUAL), float(np.linalg.norm(b))
        if not 0.0 < whole < math.inf:
            return np.zeros_like(b)

        def report(residual: float) -> None:
            self.iterations += 1
            self._watch.look(
                math.log(residual) / math.log(accuracy) if 0.0 < residual < 1.0 else 0.0
            )

        def precondition(r: Floats) -> Floats:
            """Return the preconditioned residual."""
            report(float(np.linalg.norm(r)) / whole)
            return self._cycle(r)

        first = precondition if self._symmetric else self._cycle
        M = LinearOperator(self._matrix.shape, matvec=first, dtype=float)
        how: dict[str, Any] = {"M": M, "rtol": accuracy, "atol": 0.0}
        # The preconditioner may be invalid for A; the residual is checked afterwards.
        with np.errstate(all="ignore"):
            if self._symmetric:
                x, _ = cg(self._matrix, b, maxiter=self._maxiter, **how)
            else:
                how |= {"callback": report, "callback_type": "pr_norm", "restart": 30}
                x, _ = gmres(self._matrix, b, maxiter=MAX_ITERATIONS // 30, **how)
        self._watch.look(1.0)
        return np.asarray(x)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """Return the solution. If the matrix is not symmetric, a preconditioner is built for its
        transpose."""
        return (self if self._symmetric else self._transposed).solve(b, accuracy)

    @cached_property
    def _transposed(self) -> PreconditionedKrylov:
        return PreconditionedKrylov(self._matrix.T.tocsr(), False, self._watch, self._grids)


def linear_solver(
    matrix: Any,
    method: str,
    *,
    coordinates: Coordinates | None = None,
    watch: Watch | None = None,
) -> LinearSolver:
    """Return a solver that uses the given method for a matrix; `auto` selects LU up to a certain
    number of unknowns, and multigrid above.

    `coordinates` are the coordinates of the unknowns. Multigrid requires them, and LU uses them to
    determine the order of elimination. Raises LinAlgError if a factorisation finds the matrix to be
    singular.
    """
    size, coupled = matrix.shape[0], coordinates is not None and coordinates.axes > 1
    if method == "auto":
        large = size > (LARGEST_COUPLED_LU if coupled else LARGEST_LU)
        method = "multigrid" if large and coordinates else "lu"
    if method != "lu":
        grids = coordinates.grids if coordinates and method == "multigrid" else None
        return PreconditionedKrylov(matrix, is_symmetric(matrix), watch or Watch(), grids)
    if size <= DENSE:
        return Dense(dense(matrix))
    if coordinates:
        order, half = band_order(matrix, coordinates)
        if half <= WIDEST_BAND:
            return BandLU(matrix, order, half)
    return SparseLU(matrix, is_symmetric(matrix), coordinates if coupled else None)


def dense(matrix: Any) -> Floats:
    """Return the matrix as an array."""
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())


def is_symmetric(matrix: Any) -> bool:
    """Return whether a matrix equals its transpose, up to rounding."""
    difference = abs(matrix - matrix.T)
    return bool(difference.max() <= SYMMETRY_RTOL * max(1.0, abs(matrix).max()))


def is_nearly_symmetric(matrix: Any) -> bool:
    """Return whether most entries of a sparse matrix have a counterpart in its transpose."""
    from scipy.sparse import csr_array

    ones = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    return bool((ones + ones.T).nnz <= PATTERN_ASYMMETRY * matrix.nnz)


def dissected(matrix: Any, places: Floats) -> Indices | None:
    """Return the unknowns of a sparse matrix in the order of nested dissection. `places` (unknown,
    axis) are their positions; unknowns at the same place are adjacent in this order. Return None if
    couplings extend too far, or if there are so few places that the order saves no time."""
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
    """Return the range of the couplings along each axis. It contains a margin for rounding, so that
    it is positive."""
    row, column = matrix.tocoo().coords
    distances = [float(np.abs(x[row] - x[column]).max(initial=0.0)) for x in places.T.copy()]
    return 1.001 * np.array(distances) + 1e-9 * np.ptp(places) + TINY


def _dissect(places: Floats, members: Indices, reach: Floats, order: list[Indices]) -> None:
    halves = _halves(places, members, reach) if len(members) > LEAF else None
    if halves is None:
        order.append(members)
        return
    below, above, strip = halves
    _dissect(places, below, reach, order)
    _dissect(places, above, reach, order)
    order.append(strip)


def _halves(
    places: Floats, members: Indices, reach: Floats
) -> tuple[Indices, Indices, Indices] | None:
    """Divide the members of a part by a strip across its longer side. Return the members on both
    sides of the strip and in the strip. Return None if there is no member on one of the sides."""
    positions = places[members]
    sides = np.ptp(positions, axis=0)
    axis = int(sides[1] / reach[1] > sides[0] / reach[0])
    along, width = positions[:, axis], reach[axis]
    middle = np.partition(along, len(along) // 2)[len(along) // 2] - width / 2
    below, above = along <= middle, along > middle + width
    if not (below.any() and above.any()):
        return None
    return members[below], members[above], members[~(below | above)]
