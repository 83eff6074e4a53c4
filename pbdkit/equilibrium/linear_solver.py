"""Solvers of linear systems of particles with known coordinates: an inverse, factors, an iteration.

Small matrices are inverted. Narrow ones are factorised as bands by LAPACK, with particles in rows
across the shorter side of the body. Others are factorised by SuperLU, in an order that fills in
little: nested dissection (A. George, Nested dissection of a regular finite element mesh, SIAM J.
Numer. Anal. 10, 1973), where a strip that no coupling crosses parts the body in two, both halves
are parted in the same way, and the strip is eliminated last. SuperLU has no such order of its own.
Large ones are solved by iteration, with multigrid (amg.py) as preconditioner. Measurements stand in
docs/decisions/0010.
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
"""Smallest relative residual that is asked of an iteration."""
LARGEST_LU = 30_000
"""Unknowns up to which `auto` takes an LU factorisation."""
LARGEST_COUPLED_LU = 200_000
"""The same where the axes move each other."""
WIDEST_BAND = 120
"""Largest half-bandwidth that is factorised as a band: beyond, factors of a body as long as wide
take more memory than sparse ones, and soon more time."""
PIVOT_THRESHOLD = 0.1
"""Diagonal entries that are this share of the largest of their columns serve as pivots."""
PATTERN_ASYMMETRY = 1.2
"""Largest ratio of the entries of a matrix and its transpose together to those of the matrix for
its pattern to count as nearly symmetric."""
SYMMETRY_RTOL = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""
FEWEST, LEAF = 1000, 40
"""Places from which dissection pays (measured), and so few that they are parted no further."""
TINY = 1e-300
WIDEST = 0.25
"""The share of all places that the first strip may take for dissection to be worth its while."""


@dataclass(frozen=True)
class Coordinates:
    """Where the unknowns lie, `axes` of each particle next to each other: the places of particles
    and of leaders, (particle, axis of space); which unknowns are `held`, each alone in its row and
    column (None: none)."""

    axes: int
    places: Floats
    led: Floats
    held: NDArray[np.bool_] | None = None

    def grids(self, matrix: Any) -> Preconditioner:
        """Multigrid for a matrix of these unknowns."""
        return SparseGrids(matrix, self.axes, self.places, self.led, self.held)


class LinearSolver(ABC):
    """Solves A x = b for one matrix, with an unknown a row."""

    name: str
    iterations = 0

    @abstractmethod
    def solve(self, b: Floats, accuracy: float) -> Floats:
        """x with ‖b - A x‖₂ ≤ accuracy · ‖b‖₂ as far as the method gets."""

    @abstractmethod
    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """The same of Aᵀ x = b."""


class Dense(LinearSolver):
    """The inverse itself, for small matrices."""

    name = "lu"

    def __init__(self, matrix: Floats) -> None:
        self.inverse = np.linalg.inv(matrix)

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """By a product."""
        return self.inverse @ b

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By a product."""
        return self.inverse.T @ b


class BandLU(LinearSolver):
    """LAPACK's LU factors of a band matrix, with unknowns in an order of their own."""

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
        """By the factors."""
        return self._by_factors(b, 0)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By the same factors."""
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
    """SuperLU. Where the pattern is nearly symmetric, in an order that fills in little: by nested
    dissection where it is known where the many unknowns lie, else by minimum degree."""

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
        """By the factors."""
        return self._by_factors(b, "N")

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By the same factors."""
        return self._by_factors(b, "T")

    def _by_factors(self, b: Floats, how: str) -> Floats:
        if self._order is None:
            return np.asarray(self._factors.solve(b, trans=how))
        x = np.empty_like(b, dtype=float)
        x[self._order] = self._factors.solve(b[self._order], trans=how)
        return x


class PreconditionedKrylov(LinearSolver):
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
        self._matrix, self._symmetric, self._watch = matrix, symmetric, watch
        self._grids = grids
        self._cycle = grids(matrix) if grids else np.copy
        self._most = MAX_ITERATIONS + (0 if grids else 20 * math.isqrt(matrix.shape[0]))

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Until it is accurate enough, or most iterations are made."""
        from scipy.sparse.linalg import LinearOperator, cg, gmres

        accuracy, whole = max(accuracy, MIN_RESIDUAL), float(np.linalg.norm(b))
        if not 0.0 < whole < math.inf:
            return np.zeros_like(b)

        def tell(left: float) -> None:
            self.iterations += 1
            self._watch.look(math.log(left) / math.log(accuracy) if 0.0 < left < 1.0 else 0.0)

        def told(r: Floats) -> Floats:
            """Conjugate gradients precondition the residual of every iteration."""
            tell(float(np.linalg.norm(r)) / whole)
            return self._cycle(r)

        first = told if self._symmetric else self._cycle
        M = LinearOperator(self._matrix.shape, matvec=first, dtype=float)
        how: dict[str, Any] = {"M": M, "rtol": accuracy, "atol": 0.0}
        with np.errstate(all="ignore"):  # A that is no matrix for it: what comes out shows it
            if self._symmetric:
                x, _ = cg(self._matrix, b, maxiter=self._most, **how)
            else:
                how |= {"callback": tell, "callback_type": "pr_norm", "restart": 30}
                x, _ = gmres(self._matrix, b, maxiter=MAX_ITERATIONS // 30, **how)
        self._watch.look(1.0)
        return np.asarray(x)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By grids of the transpose, where that is another matrix."""
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
    """Return the solver for a matrix by a method; `auto` is LU up to a number of unknowns and
    multigrid beyond.

    `coordinates` are those of the unknowns; multigrid needs them, and orders of elimination follow
    from them. Raises LinAlgError where the matrix is found to be singular.
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
    """The matrix as an array."""
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())


def is_symmetric(matrix: Any) -> bool:
    """Whether a matrix equals its transpose, up to rounding."""
    difference = abs(matrix - matrix.T)
    return bool(difference.max() <= SYMMETRY_RTOL * max(1.0, abs(matrix).max()))


def is_nearly_symmetric(matrix: Any) -> bool:
    """Whether a sparse matrix has most entries where its transpose has them."""
    from scipy.sparse import csr_array

    ones = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    return bool((ones + ones.T).nnz <= PATTERN_ASYMMETRY * matrix.nnz)


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
