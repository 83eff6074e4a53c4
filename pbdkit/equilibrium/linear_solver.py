"""Solvers of sparse linear systems: an inverse, factors, or an iteration."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE
from pbdkit.equilibrium.dissection import dissected
from pbdkit.equilibrium.sparse_multigrid import SparseGrids
from pbdkit.results.progress import Watch

Floats = NDArray[np.floating[Any]]
Preconditioner = Callable[[Floats], Floats]
MOST_ITERATIONS = 400
FINEST = 1e-14
"""No residual becomes smaller than this share."""
LARGEST_LU, LARGEST_COUPLED_LU = 30_000, 200_000
"""Unknowns up to which `auto` takes an LU factorisation; more where the axes move each other."""
STURDY = 0.1
"""Diagonal entries that are this share of the largest of their columns serve as pivots."""
LOPSIDED = 1.2
"""A matrix and its transpose together may have so many times its entries for it to count as nearly
symmetric."""
SAME = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""


@dataclass(frozen=True)
class Ground:
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


class SparseLU(LinearSolver):
    """SuperLU. Where the pattern is nearly symmetric, in an order that fills in little: by nested
    dissection where it is known where the many unknowns lie, else by minimum degree."""

    name = "lu"

    def __init__(self, matrix: Any, symmetric: bool, ground: Ground | None = None) -> None:
        from scipy.sparse.linalg import splu

        how: dict[str, Any] = {}
        self._order = None
        if symmetric:
            how = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        elif is_nearly_symmetric(matrix):
            how = {"diag_pivot_thresh": STURDY}
        if how:
            how["permc_spec"] = "MMD_AT_PLUS_A"
            places = ground.places.repeat(ground.axes, axis=0) if ground else None
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
        self._matrix, self._symmetric, self._watch = matrix, symmetric, watch
        self._grids = grids
        self._cycle = grids(matrix) if grids else np.copy
        self._most = MOST_ITERATIONS + (0 if grids else 20 * math.isqrt(matrix.shape[0]))

    def solve(self, b: Floats, accuracy: float) -> Floats:
        """Until it is accurate enough, or most iterations are made."""
        from scipy.sparse.linalg import LinearOperator, cg, gmres

        accuracy, whole = max(accuracy, FINEST), float(np.linalg.norm(b))
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
                x, _ = gmres(self._matrix, b, maxiter=MOST_ITERATIONS // 30, **how)
        self._watch.look(1.0)
        return np.asarray(x)

    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """By grids of the transpose, where that is another matrix."""
        return (self if self._symmetric else self._transposed).solve(b, accuracy)

    @cached_property
    def _transposed(self) -> Krylov:
        return Krylov(self._matrix.T.tocsr(), False, self._watch, self._grids)


def linear_solver(
    matrix: Any,
    method: str,
    *,
    symmetric: bool,
    ground: Ground | None = None,
    watch: Watch | None = None,
) -> LinearSolver:
    """The solver for a sparse matrix by a method, or by what serves its size.

    `ground` says where the unknowns lie: grids need it, and an order of elimination where axes
    move each other gains by it. Raises LinAlgError where the matrix is found to be singular.
    """
    size, coupled = matrix.shape[0], ground is not None and ground.axes > 1
    if method == "auto":
        large = size > (LARGEST_COUPLED_LU if coupled else LARGEST_LU)
        method = "multigrid" if large and ground else "lu"
    if method == "lu":
        if size <= DENSE:
            return Dense(dense(matrix))
        return SparseLU(matrix, symmetric, ground if coupled else None)
    grids = ground.grids if ground and method == "multigrid" else None
    return Krylov(matrix, symmetric, watch or Watch(), grids)


def dense(matrix: Any) -> Floats:
    """The matrix as an array."""
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())


def is_symmetric(matrix: Any) -> bool:
    """Whether a matrix equals its transpose, up to rounding."""
    difference = abs(matrix - matrix.T)
    return bool(difference.max() <= SAME * max(1.0, abs(matrix).max()))


def is_nearly_symmetric(matrix: Any) -> bool:
    """Whether a sparse matrix has most entries where its transpose has them."""
    from scipy.sparse import csr_array

    ones = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    return bool((ones + ones.T).nnz <= LOPSIDED * matrix.nnz)
