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
Mask = NDArray[np.bool_]
SAFETY = 3.0
"""What an estimate that may come out too small is multiplied with."""
ACCURACY = 1e-9
"""Of solutions, relative; corrections are corrected where more is wanted."""
ROUGH = 1e-3
"""The relative accuracy of solutions that only serve a bound."""
TURNS = 20
"""Of inverse iteration."""
SOFT = 1e10
"""Where A⁻¹ takes numbers of up to 1 farther, the part may be one that nothing holds."""
TOO_SOFT = 1e13
"""Where it takes them farther beside the modes that cost nothing, these cannot be told from soft
ones in double precision."""
NOTHING = 64.0 * float(np.finfo(float).eps)
"""What rounding leaves of A y and of the push on a mode y that costs nothing, relative to the terms
that cancel."""
RANDOM_SHARE = 0.1
"""The share that any one mode has in random numbers, over the root of how many they are, at
least."""
SHIFT, MODES, MOST_MODES = 1e-13, 6, 96
"""A large singular matrix is shifted by so much, relative to its largest entry, to find its kernel
among so many modes; among up to so many more where all of them belong to it."""
LARGEST_FALLBACK = 400_000
"""Unknowns up to which an LU factorisation takes over where an iteration gets stuck."""


class DriftingError(Exception):
    """A part that nothing holds is pushed on for ever."""


class TooSoftError(DriftingError):
    """Double precision does not tell whether a part is held softly or not at all."""


class Part(ABC):
    """A x = r for the unknowns of a part, by a solver for them and, after them, for what borders
    A; without one only rest is an equilibrium."""

    def __init__(
        self, size: int, solver: LinearSolver | None, watch: Watch, borders: int = 0
    ) -> None:
        self._size, self._solver, self._watch, self._borders = size, solver, watch, borders

    is_stuck = False
    """Whether an iteration has got nowhere, and there is no other choice."""

    @abstractmethod
    def solve(self, r: Floats, owed: Floats | None = None, rounding: float = 0.0) -> Floats:
        """The x to which steps from x = 0 converge; `owed` is what invariants have to gain,
        `rounding` how far r may be off. Raises DriftingError where there is none."""

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
        found = float(np.abs(self._inverted(r)).max(initial=0.0))
        return found + (self._spread * rounding if rounding else 0.0)

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

    def _inverted(self, r: Floats, accuracy: float = ROUGH) -> Floats:
        """A⁻¹ r, roughly."""
        assert self._solver is not None
        b = np.append(r, np.zeros(self._borders))
        return self._solver.solve(b, accuracy)[: self._size]

    @property
    def is_soft(self) -> bool:
        """Whether some motion that costs something costs so little that others may that cost
        nothing as it seems."""
        return not self._spread < SOFT

    @cached_property
    def _spread(self) -> float:
        """That of all unknowns."""
        return self.spread_of(np.ones(self._size, bool))

    def spread_of(self, some: Mask) -> float:
        """How far A⁻¹ takes numbers of up to 1 in some unknowns: the largest row sum of |A⁻¹| where
        the inverse is at hand; else some times as far as it takes random ones, as rounding is."""
        if self._solver is None:
            return math.inf if some.any() else 0.0
        if isinstance(self._solver, Dense):
            inverse = np.abs(self._solver.inverse[: self._size, : self._size])
            return float(inverse[:, some].sum(axis=1).max(initial=0.0))
        self._watch.begin("bounding the error")
        signs = np.random.default_rng(0).choice([-1.0, 1.0], self._size) * some
        # So accurately that the softest mode, with its share in random numbers, is not left out.
        accuracy = min(ROUGH, RANDOM_SHARE / math.sqrt(max(1, self._size)))
        return SAFETY * float(np.abs(self._inverted(signs, accuracy)).max(initial=0.0))


class Held(Part):
    """A part whose matrix has an inverse. Raises LinAlgError where some motion costs nothing."""

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
        self._matrix, self._is_short = matrix, False
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        solver = linear_solver(matrix, method, watch=watch, **self._how)
        super().__init__(matrix.shape[0], solver, watch)
        if self._spread < SOFT or matrix.shape[0] > LARGEST_FALLBACK:
            return
        if _left_kernel(matrix).size:
            raise np.linalg.LinAlgError("singular")

    def solve(self, r: Floats, owed: Floats | None = None, rounding: float = 0.0) -> Floats:
        """By this method; nothing is owed, for what is held has no invariants."""
        if not r.any():
            return np.zeros_like(r)
        self._watch.begin("solving")
        return self._solved(r, ACCURACY, 100 * ACCURACY)

    def solve_transposed(self, weights: Floats) -> Floats:
        """By the same method."""
        return self._solved(weights, ACCURACY, 100 * ACCURACY, transposed=True)

    def _solved(
        self, b: Floats, accuracy: float, most: float, *, transposed: bool = False
    ) -> Floats:
        """By factors where the iteration leaves more than `most` of b and there is that choice."""
        matrix = self._matrix.T if transposed else self._matrix
        for _ in range(2):
            assert self._solver is not None
            solve = self._solver.solve_transposed if transposed else self._solver.solve
            x = solve(b, accuracy)
            if not isinstance(self._solver, Krylov):
                break
            left = float(np.linalg.norm(b - matrix @ x))
            self._is_short = not left <= most * float(np.linalg.norm(b))
            if not (self._is_short and self._has_choice):
                self.is_stuck |= self._is_short
                break
            self._solver = linear_solver(self._matrix, "lu", **self._how)
            self._is_short = False
        return x

    def _inverted(self, r: Floats, accuracy: float = ROUGH) -> Floats:
        """Not finite where an iteration gets stuck: what it has found then bounds nothing."""
        x = self._solved(r, accuracy, 2.0 * accuracy)
        return np.full_like(x, math.inf) if self._is_short else x

    def farthest(self, r: Floats, rounding: float) -> float:
        """Of what an iteration leaves, some times as far as it leads if it goes on, and as far as
        what that leaves may lead."""
        x = self._inverted(r)
        found = float(np.abs(x).max(initial=0.0))
        if isinstance(self._solver, Krylov) and math.isfinite(found):
            left = r - self._matrix @ x
            ahead = self._inverted(left)
            found += SAFETY * float(np.abs(ahead).max(initial=0.0))
            if math.isfinite(found):
                rounding += float(np.abs(left - self._matrix @ ahead).max(initial=0.0))
        return found + (self._spread * rounding if rounding else 0.0)


class Floating(Part):
    """A part with modes that no step changes: what their invariants Yᵀ u, Yᵀ A = 0, were, they
    remain. `before` is the share of A that looks back a step: it has a share in the invariants,
    K = Yᵀ (1 + before). Solves A x + Y μ = r, K x = k; without a solver where modes grow, or where
    other modes cost hardly more than nothing."""

    def __init__(self, matrix: Any, before: Any, watch: Watch) -> None:
        self._matrix, self._left = matrix, _left_kernel(matrix)
        left = self._left
        rows = left.T + (left.T @ before if before is not None else 0.0)
        size, modes = left.shape
        solver: LinearSolver | None = None
        with suppress(np.linalg.LinAlgError):
            if size <= DENSE:
                corner = np.zeros((modes, modes))
                solver = Dense(np.block([[dense(matrix), left], [rows, corner]]))
            else:
                from scipy.sparse import block_array

                bordered = block_array([[matrix, left], [np.asarray(rows), None]], format="csr")
                solver = SparseLU(bordered, False)
        super().__init__(size, solver, watch, modes)
        if solver is not None and not self._spread < TOO_SOFT:
            self._solver = None

    def solve(self, r: Floats, owed: Floats | None = None, rounding: float = 0.0) -> Floats:
        """By this method."""
        if self._solver is None:
            if r.any():
                raise TooSoftError
            return np.zeros_like(r)
        push = self._left @ (self._left.T @ r)
        kept = np.zeros(self._borders) if owed is None else self._left.T @ owed
        x = self._solver.solve(np.concatenate([r - push, kept]), ACCURACY)[: self._size]
        terms = abs(self._matrix) @ np.abs(x) + np.abs(r)
        large = NOTHING * float(terms.max(initial=0.0)) + 8.0 * rounding
        if not np.abs(push).max(initial=0.0) <= large:
            raise DriftingError
        return x

    def solve_transposed(self, weights: Floats) -> Floats:
        """By the same method; nothing that pushes the part on for ever has a share."""
        if self._solver is None:
            return np.zeros_like(weights)
        b = np.append(weights, np.zeros(self._borders))
        found = self._solver.solve_transposed(b, ACCURACY)[: self._size]
        return np.asarray(found - self._left @ (self._left.T @ found))


def _left_kernel(matrix: Any) -> Floats:
    """(unknown, mode): an orthonormal basis of all y with yᵀ A = 0 to rounding; of large matrices
    by inverse iteration: whatever is not in the kernel shrinks by SHIFT / λ a turn."""
    size = matrix.shape[0]
    largest = float(abs(matrix).max()) if size else 0.0
    if not largest > 0.0:
        return np.eye(size)
    # A = 1 - (step operator): the terms that cancel are of size 1, however little they leave.
    nothing = NOTHING * max(1.0, float(abs(matrix).sum(axis=1).max()))
    if size <= DENSE:
        left, values, _ = np.linalg.svd(dense(matrix))
        found: Floats = left[:, values <= nothing]
        return found
    from scipy.sparse import eye_array

    shift = SHIFT * largest
    shifted = SparseLU(matrix + shift * eye_array(size), is_symmetric(matrix))
    count = MODES
    while True:
        basis = np.random.default_rng(0).normal(size=(size, count))
        for _ in range(4):
            basis = np.linalg.qr(shifted.solve_transposed(basis, 0.0))[0]
        _, values, turned = np.linalg.svd(matrix.T @ basis, full_matrices=False)
        some = values <= nothing
        if not some.all() or count >= min(MOST_MODES, size):
            return np.asarray(basis @ turned[some].T)
        count = min(4 * count, MOST_MODES, size)
