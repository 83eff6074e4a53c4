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
    Ground,
    Krylov,
    LinearSolver,
    SparseLU,
    dense,
    is_symmetric,
    linear_solver,
)
from pbdkit.results.progress import Watch

Floats = NDArray[np.floating[Any]]
SAFETY = 3.0
"""What an estimate that may come out too small is multiplied with."""
ACCURACY = 1e-9
"""Of solutions, relative; corrections are corrected where more is wanted."""
ROUGH = 1e-3
"""The relative accuracy of solutions that only serve a bound."""
TURNS = 20
"""Of inverse iteration."""
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
    def solve(self, r: Floats, owed: Floats | None = None) -> Floats:
        """The x to which steps from x = 0 converge; `owed` is what invariants have to gain. Raises
        DriftingError where there is none."""

    @abstractmethod
    def solve_transposed(self, weights: Floats) -> Floats:
        """λ with λ · r = weights · x for the x of every r that has one, nothing being owed."""

    @property
    def name(self) -> str:
        """The method."""
        return self._solver.name if self._solver else "lu"

    @property
    def iterations(self) -> int:
        """Of the linear solver."""
        return self._solver.iterations if self._solver else 0

    def farthest(self, r: Floats, rounding: float) -> float:
        """max |A⁻¹ r|, and what rounding of r by so much may add to it."""
        if self._solver is None:
            return math.inf if r.any() or rounding else 0.0
        found = np.abs(self._inverted(r)).max(initial=0.0)
        return float(found) + self._spread * rounding

    @property
    def how(self) -> str:
        """How the bound is obtained."""
        return "inverse" if isinstance(self._solver, Dense) else "solution"

    def is_stable(self) -> bool:
        """Whether no eigenvalue is negative: of small matrices none at all, of others none of those
        nearest to 0, through which they pass as the load goes on."""
        if self._solver is None or self._borders:
            return True
        if isinstance(self._solver, Dense):
            eigenvalues = np.linalg.eigvals(self._solver.inverse)
            return bool((eigenvalues.real > 0.0).all())
        v: Floats = np.random.default_rng(0).normal(size=self._size)
        for _ in range(TURNS):
            w = self._inverted(v / np.linalg.norm(v))
            v, before = w, v
        return bool(v @ before > 0.0)

    def _inverted(self, r: Floats) -> Floats:
        """A⁻¹ r, roughly."""
        assert self._solver is not None
        b = np.append(r, np.zeros(self._borders))
        return self._solver.solve(b, ROUGH)[: self._size]

    @cached_property
    def _spread(self) -> float:
        """How far A⁻¹ takes numbers of up to 1: the largest row sum of |A⁻¹| where the inverse is
        at hand; else some times as far as it takes random ones, as rounding is."""
        if isinstance(self._solver, Dense):
            inverse = np.abs(self._solver.inverse[: self._size, : self._size])
            return float(inverse.sum(axis=1).max(initial=0.0))
        self._watch.begin("bounding the error")
        signs = np.random.default_rng(0).choice([-1.0, 1.0], self._size)
        return SAFETY * float(np.abs(self._inverted(signs)).max(initial=0.0))


class Held(Part):
    """A part whose matrix has an inverse. Raises LinAlgError where it is worth nothing in double
    precision."""

    def __init__(
        self,
        matrix: Any,
        method: str,
        ground: Ground,
        watch: Watch,
    ) -> None:
        if isinstance(matrix, np.ndarray) and method not in ("auto", "lu"):
            from scipy.sparse import csr_array

            matrix = csr_array(matrix)
        self._how: dict[str, Any] = {"symmetric": is_symmetric(matrix), "ground": ground}
        self._matrix = matrix
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        solver = linear_solver(matrix, method, watch=watch, **self._how)
        super().__init__(matrix.shape[0], solver, watch)
        if not self._spread < 1.0 / SINGULAR:
            raise np.linalg.LinAlgError("singular")

    def solve(self, r: Floats, owed: Floats | None = None) -> Floats:
        """By this method; nothing is owed, for what is held has no invariants."""
        if not r.any():
            return np.zeros_like(r)
        self._watch.begin("solving")
        assert self._solver is not None
        x = self._solver.solve(r, ACCURACY)
        if self._is_stuck(self._matrix, x, r):
            x = self._factorised().solve(r, ACCURACY)
        return x

    def solve_transposed(self, weights: Floats) -> Floats:
        """By the same method."""
        assert self._solver is not None
        found = self._solver.solve_transposed(weights, ACCURACY)
        if self._is_stuck(self._matrix.T, found, weights):
            found = self._factorised().solve_transposed(weights, ACCURACY)
        return found

    def _is_stuck(self, matrix: Any, x: Floats, r: Floats) -> bool:
        """Whether there is another choice than the iteration that found x, and it got nowhere."""
        if not (isinstance(self._solver, Krylov) and self._has_choice):
            return False
        left = float(np.linalg.norm(r - matrix @ x))
        return not left <= 100 * ACCURACY * float(np.linalg.norm(r))

    def _factorised(self) -> LinearSolver:
        self._solver = linear_solver(self._matrix, "lu", **self._how)
        return self._solver

    def farthest(self, r: Floats, rounding: float) -> float:
        """Of what an iteration leaves, some times as far as it leads if it goes on."""
        if not isinstance(self._solver, Krylov):
            return super().farthest(r, rounding)
        x = self._inverted(r)
        ahead = self._inverted(r - self._matrix @ x)
        found, left = (float(np.abs(way).max(initial=0.0)) for way in (x, ahead))
        return found + SAFETY * left + self._spread * rounding


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

    def solve(self, r: Floats, owed: Floats | None = None) -> Floats:
        """By this method."""
        push = self._left.T @ r
        large = SINGULAR * max(1.0, float(np.linalg.norm(r)))
        if (r.any() and self._solver is None) or np.abs(push).max(initial=0.0) > large:
            raise DriftingError
        if self._solver is None:
            return np.zeros_like(r)
        kept = np.zeros(len(push)) if owed is None else self._left.T @ owed
        b = np.concatenate([r - self._left @ push, kept])
        return self._solver.solve(b, ACCURACY)[: self._size]

    def solve_transposed(self, weights: Floats) -> Floats:
        """By the same method; nothing that pushes the part on for ever has a share."""
        if self._solver is None:
            return np.zeros_like(weights)
        b = np.append(weights, np.zeros(self._borders))
        found = self._solver.solve_transposed(b, ACCURACY)[: self._size]
        return np.asarray(found - self._left @ (self._left.T @ found))


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
