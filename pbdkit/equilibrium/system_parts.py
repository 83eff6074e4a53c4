"""The parts of a body in a linear system: those that leaders hold, and those that nothing holds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE
from pbdkit.equilibrium.linear_solver import (
    Dense,
    Krylov,
    LinearSolver,
    SparseLU,
    dense,
    is_symmetric,
    linear_solver,
)
from pbdkit.results.progress import Watch

Floats = NDArray[np.float64]
SAFETY = 3.0
"""What an estimated norm, which may come out too small, is multiplied with."""
ROUGH, ROUGHER = 1e-3, 1e-2
"""The accuracy of solutions that only serve a bound, and of those for barriers: smoothing mends the
rest."""
LEVEL, MOST_SMOOTHINGS = 0.5, 10
"""A barrier's A v, aimed at 1, is smoothed until it is nowhere below, at most so many times."""
SINGULAR = 1e-10
"""Relative size below which a singular value counts as zero."""
SHIFT, MOST_MODES = 1e-11, 6
"""A large singular matrix is shifted by so much to find its kernel of so many modes at most, few
for connected parts."""
LARGEST_FALLBACK = 400_000
"""Unknowns up to which an LU factorisation takes over where an iteration gets stuck."""


class DriftingError(Exception):
    """A part that nothing holds is pushed on for ever."""


class Part(ABC):
    """A x = r for the unknowns of a part, by a solver for them and, after them, for what borders
    A; without one only rest is an equilibrium."""

    def __init__(
        self, size: int, solver: LinearSolver | None, watch: Watch, borders: int = 0
    ) -> None:
        self._size, self._solver, self._watch, self._borders = size, solver, watch, borders

    @abstractmethod
    def solve(self, r: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """The x to which steps from x = 0 converge; `owed` is what invariants have to gain. Raises
        DriftingError where there is none."""

    @property
    def barrier(self) -> tuple[Floats, Floats] | None:
        """v > 0 with A v > 0, and A v, where A is known to have such a v that bounds A⁻¹."""
        return None

    @property
    def name(self) -> str:
        """The method."""
        return self._solver.name if self._solver else "lu"

    @property
    def iterations(self) -> int:
        """Of the linear solver."""
        return self._solver.iterations if self._solver else 0

    def farthest(self, r: Floats) -> float:
        """A bound on max |A⁻¹ r'| over all |r'| ≤ r, r ≥ 0: from the inverse where it is at hand,
        else from a bound on it."""
        if self._solver is None:
            return math.inf if r.any() else 0.0
        if isinstance(self._solver, Dense):
            inverse = np.abs(self._solver.inverse[: self._size, : self._size])
            return float((inverse @ r).max(initial=0.0))
        if self.barrier:
            height, climb = self.barrier
            return float(height.max() * (r / climb).max())
        return self._norm * float(r.max(initial=0.0))

    @property
    def how(self) -> str:
        """How the bound is obtained."""
        if isinstance(self._solver, Dense):
            return "inverse"
        return "barrier" if self.barrier else "estimated norm of the inverse"

    @cached_property
    def _norm(self) -> float:
        """Three times an estimate from below of the largest row sum of |A⁻¹| (Higham, Tisseur)."""
        from scipy.sparse.linalg import LinearOperator, onenormest

        solver, size = self._solver, self._size
        assert solver is not None
        self._watch.begin("bounding the error")
        nothing = np.zeros(self._borders)
        transposed = LinearOperator(
            (size, size),
            matvec=lambda b: solver.solve_transposed(np.append(b, nothing), ROUGH)[:size],
            rmatvec=lambda b: solver.solve(np.append(b, nothing), ROUGH)[:size],
            dtype=float,
        )
        return SAFETY * float(onenormest(transposed))


class Held(Part):
    """A part whose matrix has an inverse. Raises LinAlgError where it is worth nothing in double
    precision."""

    def __init__(
        self,
        matrix: Any,
        method: str,
        near_kernel: Floats | None,
        watch: Watch,
        places: Floats | None = None,
    ) -> None:
        if isinstance(matrix, np.ndarray) and method not in ("auto", "lu"):
            from scipy.sparse import csr_array

            matrix = csr_array(matrix)
        self._how: dict[str, Any] = {"symmetric": is_symmetric(matrix), "places": places}
        self._matrix = matrix
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        solver = linear_solver(matrix, method, near_kernel=near_kernel, watch=watch, **self._how)
        super().__init__(matrix.shape[0], solver, watch)
        ones = np.ones(self._size)
        most = self.farthest(ones) if isinstance(solver, Dense) else np.abs(self._of_ones).max()
        if not most < 1.0 / SINGULAR:
            raise np.linalg.LinAlgError("singular")

    def solve(self, r: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """By this method; nothing is owed, for what is held has no invariants."""
        if not r.any():
            return np.zeros_like(r)
        self._watch.begin("solving")
        assert self._solver is not None
        x = self._solver.solve(r, accuracy)
        if isinstance(self._solver, Krylov) and self._has_choice:
            left = float(np.linalg.norm(r - self._matrix @ x))
            if not left <= 100 * accuracy * float(np.linalg.norm(r)):  # the iteration got stuck
                self._solver = linear_solver(self._matrix, "lu", **self._how)
                x = self._solver.solve(r, accuracy)
        return x

    @cached_property
    def barrier(self) -> tuple[Floats, Floats] | None:
        """v > 0 with A v > 0, where no entry off the diagonal is positive: then A⁻¹ ≥ 0, and
        |A⁻¹ r| ≤ v · max(|r| / A v). Any such v will do; it is near A⁻¹ 1, made smooth by
        v + (1 - A v)/2, half a step of an averaging rule."""
        if not self._may_have_barrier:
            return None
        height = self._of_ones
        climb = self._matrix @ height
        for _ in range(MOST_SMOOTHINGS):
            if climb.min() >= LEVEL:
                break
            height = height + 0.5 * (1.0 - climb)
            climb = self._matrix @ height
        return (height, climb) if min(height.min(), climb.min()) > 0.0 else None

    @cached_property
    def _may_have_barrier(self) -> bool:
        diagonal = self._matrix.diagonal()
        return bool((self._matrix.data > 0.0).sum() == (diagonal > 0.0).sum())

    @cached_property
    def _of_ones(self) -> Floats:
        """A⁻¹ 1, roughly."""
        self._watch.begin("bounding the error")
        accuracy = ROUGHER if self._may_have_barrier else ROUGH
        assert self._solver is not None
        return self._solver.solve(np.ones(self._matrix.shape[0]), accuracy)


class Floating(Part):
    """A part with modes that no step changes: what their invariants Yᵀ u, Yᵀ A = 0, were, they
    remain. `before` is the share of A that looks back a step: it has a share in the invariants,
    K = Yᵀ (1 + before). Solves A x + Y μ = r, K x = k; without a solver where modes grow."""

    def __init__(self, matrix: Any, before: Any, watch: Watch) -> None:
        self._left = left = _left_kernel(matrix)
        rows = left.T + (left.T @ before if before is not None else 0.0)
        size, modes = left.shape
        solver: LinearSolver | None = None
        with suppress(np.linalg.LinAlgError):
            if size <= DENSE:
                corner = np.zeros((modes, modes))
                solver = Dense(np.block([[dense(matrix), left], [rows, corner]]))
            else:
                solver = _sparse_bordered(matrix, left, np.asarray(rows))
        super().__init__(size, solver, watch, modes)

    def solve(self, r: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """By this method."""
        push = self._left.T @ r
        large = SINGULAR * max(1.0, float(np.linalg.norm(r)))
        if (r.any() and self._solver is None) or np.abs(push).max(initial=0.0) > large:
            raise DriftingError
        if self._solver is None:
            return np.zeros_like(r)
        kept = np.zeros(len(push)) if owed is None else self._left.T @ owed
        b = np.concatenate([r - self._left @ push, kept])
        return self._solver.solve(b, accuracy)[: self._size]


def _sparse_bordered(matrix: Any, left: Floats, rows: Floats) -> LinearSolver:
    """Raises LinAlgError where the bordered matrix is singular."""
    from scipy.sparse import block_array

    solver = SparseLU(block_array([[matrix, left], [rows, None]], format="csr"), False)
    if not np.abs(solver.solve(np.ones(sum(left.shape)), 0.0)).max() < 1.0 / SINGULAR:
        raise np.linalg.LinAlgError("modes that grow")
    return solver


def _left_kernel(matrix: Any) -> Floats:
    """(unknown, mode): an orthonormal basis of all y with yᵀ A = 0; of large matrices by inverse
    iteration: whatever is not in the kernel shrinks by SHIFT / λ a turn."""
    if matrix.shape[0] <= DENSE:
        left, values, _ = np.linalg.svd(dense(matrix))
        found: Floats = left[:, values <= SINGULAR * max(1.0, values.max(initial=0.0))]
        return found
    from scipy.sparse import eye_array

    shifted = SparseLU(matrix + SHIFT * eye_array(matrix.shape[0]), is_symmetric(matrix))
    basis = np.random.default_rng(0).normal(size=(matrix.shape[0], MOST_MODES))
    for _ in range(4):
        basis = np.linalg.qr(shifted.solve_transposed(basis, 0.0))[0]
    _, values, turned = np.linalg.svd(matrix.T @ basis, full_matrices=False)
    return np.asarray(basis @ turned[values <= SINGULAR].T)
