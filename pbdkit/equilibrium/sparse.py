"""The linear system of an equilibrium as a sparse matrix, in its diagonal blocks.

Where x and y do not move each other there are two blocks, often equal; where one moves the other
only (mixed coordinates), it is solved first. Within a block, what leaders hold is solved together,
and each part of the body that nothing holds by itself: its matrix is singular.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.equilibrium.linear_solver import (
    Coordinates,
    Dense,
    LinearSolver,
    PreconditionedKrylov,
    SparseLU,
    dense,
    is_symmetric,
    linear_solver,
)
from pbdkit.equilibrium.system import PUSH, NoEquilibriumError, System
from pbdkit.linear.block_matrix import DENSE, connected, identity_like, one_minus
from pbdkit.linear.operator import step_operator
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

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


class Subsystem(ABC):
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


class ConstrainedSubsystem(Subsystem):
    """A part whose matrix has an inverse. Raises LinAlgError where some motion costs nothing."""

    def __init__(
        self,
        matrix: Any,
        method: str,
        coordinates: Coordinates,
        watch: Watch,
    ) -> None:
        if isinstance(matrix, np.ndarray) and method not in ("auto", "lu"):
            from scipy.sparse import csr_array

            matrix = csr_array(matrix)
        self._coordinates = coordinates
        self._matrix, self._is_short = matrix, False
        self._has_choice = method == "auto" and matrix.shape[0] <= LARGEST_FALLBACK
        solver = linear_solver(matrix, method, coordinates=coordinates, watch=watch)
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
            if not isinstance(self._solver, PreconditionedKrylov):
                break
            left = float(np.linalg.norm(b - matrix @ x))
            self._is_short = not left <= most * float(np.linalg.norm(b))
            if not (self._is_short and self._has_choice):
                self.is_stuck |= self._is_short
                break
            self._solver = linear_solver(self._matrix, "lu", coordinates=self._coordinates)
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
        if isinstance(self._solver, PreconditionedKrylov) and math.isfinite(found):
            left = r - self._matrix @ x
            ahead = self._inverted(left)
            found += SAFETY * float(np.abs(ahead).max(initial=0.0))
            if math.isfinite(found):
                rounding += float(np.abs(left - self._matrix @ ahead).max(initial=0.0))
        return found + (self._spread * rounding if rounding else 0.0)


class SingularSubsystem(Subsystem):
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


@dataclass
class DiagonalBlock:
    """The unknowns of one axis, or of both where they move each other, with their parts: who
    belongs to each. `into` is what the axis solved before adds to the moves."""

    axes: list[int]
    parts: list[tuple[Indices, Subsystem]]
    into: Any = None


DRIFTS = (
    "there is no equilibrium: nothing holds a part of {}, and it is pushed on for ever; let a "
    "leader hold it"
)
SOFT_MESSAGE = (
    "double precision does not tell what holds a part of {}: it turns about a single particle, is "
    "too slender, or held by too soft a region; let leaders hold more of it, or take stiffer "
    "regions or fewer particles"
)


class MatrixSystem(System):
    """The system by one of the solver's methods, direct or iterative; with `damping` that of an
    implicit step, (A + damping) c = move."""

    def __init__(
        self,
        scene: Scene,
        state: State,
        method: str,
        watch: Watch,
        step: int | None = None,
        damping: float = 0.0,
    ) -> None:
        self._damping = damping
        self._shape, self._amplification = state.u.shape, 1.0
        self._operator = operator = step_operator(scene, state, step)
        self._method, self._watch = method, watch
        self._X = scene.raster.reference(operator.followers)
        self._led = scene.raster.reference(operator.leaders)
        self._place = scene.raster.place_of(operator.followers)
        self._guided = np.zeros((len(operator.followers), scene.axes), bool)
        self._guided.ravel()[operator.prescribed_unknowns] = True
        self._both = both = operator.couplings_steady
        first = 1 if both.couples(0, 1) else 0
        self._blocks = [] if both.couples(first, 1 - first) else [self._block([first])]
        # One axis has a share in the invariants of the other, where it moves it.
        parts = [part for block in self._blocks for _, part in block.parts]
        floats = any(isinstance(part, SingularSubsystem) for part in parts)
        if not self._blocks or (floats and both.couples(1 - first, first)):
            self._blocks = [self._block([0, 1])]
        else:
            self._blocks.append(self._following(first))

    @property
    def amplification(self) -> float:
        """By the largest entry of the diagonal."""
        return self._amplification

    @property
    def methods(self) -> str:
        """The names of the methods used."""
        names = {part.name for block in self._blocks for _, part in block.parts}
        return ", ".join(sorted(names)) or "nothing to solve"

    @property
    def how(self) -> str:
        """By the solution; its rounding by the inverse itself where that is at hand."""
        if self._damping:
            return "damped"
        ways = {part.how for block in self._blocks for _, part in block.parts}
        return next((way for way in ("solution", "inverse") if way in ways), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Of all linear solvers together."""
        parts = {id(part): part for block in self._blocks for _, part in block.parts}
        return sum(part.iterations for part in parts.values())

    def _table(self, planes: Floats) -> Floats:
        """(follower, axis) of planes."""
        return planes.reshape(len(planes), -1)[:, self._place].T

    def _planes(self, table: Floats) -> Floats:
        """Planes of (follower, axis)."""
        planes = np.zeros(self._shape)
        planes.reshape(len(planes), -1)[:, self._place] = table.T
        return planes

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Looks at each part by itself."""
        table = self._table(moves)
        for block in self._blocks:
            for unknowns, part in block.parts:
                r = table[:, block.axes].ravel()[unknowns]
                if (
                    isinstance(part, SingularSubsystem)
                    and np.abs(r).max(initial=0.0) > 8 * rounding
                ):
                    raise NoEquilibriumError(
                        "there is no unique equilibrium: leaders do not hold a part of "
                        f"{self._named(block, unknowns)}; let one hold it, or take solver: "
                        "{type: stepping}",
                        ("leaders",),
                    )

    @property
    def is_stuck(self) -> bool:
        """Subsystem by part."""
        return any(part.is_stuck for block in self._blocks for _, part in block.parts)

    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """DiagonalBlock by block, part by part."""
        back = None if owed is None else self._owed(owed)
        return self._planes(self._solved(self._table(moves), back, rounding))

    def _solved(self, moves: Floats, owed: Floats | None, rounding: float) -> Floats:
        found = np.zeros_like(moves)
        for block in self._blocks:
            r = moves[:, block.axes].ravel()
            if block.into is not None:
                r = r + block.into @ found[:, 1 - block.axes[0]]
            back = None if owed is None else owed[:, block.axes].ravel()
            x = np.zeros_like(r)
            for some, part in block.parts:
                try:
                    own = None if back is None else back[some]
                    x[some] = part.solve(r[some], own, rounding)
                except DriftingError as error:
                    soft = isinstance(error, TooSoftError) or (
                        part.is_soft and self._is_fixed(block.axes, some)
                    )
                    text = SOFT_MESSAGE if soft else DRIFTS
                    named = self._named(block, some)
                    raise NoEquilibriumError(text.format(named), ("leaders",)) from None
            found[:, block.axes] = x.reshape(-1, len(block.axes))
        return found

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """By `solve`, which knows no tolerance."""
        return self.solve(moves, 0.0, rounding=PUSH * float(np.abs(moves).max(initial=0.0)))

    def pushed_by(self, led: Floats) -> None:
        """Unknown."""

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """The last block first."""
        table = self._table(weights)
        found = np.zeros_like(table)
        for block in reversed(self._blocks):
            b = table[:, block.axes].ravel()
            x = np.zeros_like(b)
            for some, part in block.parts:
                x[some] = part.solve_transposed(b[some])
            found[:, block.axes] = x.reshape(-1, len(block.axes))
            if block.into is not None:
                table[:, 1 - block.axes[0]] += block.into.T @ x
        found[self._guided] = 0.0
        return self._planes(found)

    def _owed(self, state: State) -> Floats | None:
        """What followers have yet to get, (follower, axis), where the step looks back:
        before · (u(t-1) - u(t)), None elsewhere."""
        if not self._operator.couplings_previous.parts:
            return None
        u, previous = self._table(state.u), self._table(state.previous)
        return self._operator.couplings_previous.times((previous - u).astype(float))

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """By the operator."""
        table = self._table(c)
        with np.errstate(all="ignore"):
            pull = table - self._both.times(table)
            left = pull + self._table(after) - self._table(before)
            return float(np.linalg.norm(left) / np.linalg.norm(pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """Solves once more for what is left of the moves, and adds what rounding may make of it."""
        table, bounds = self._table(moves), np.zeros(2)
        for block in self._blocks:
            r = table[:, block.axes].ravel()
            unsure = np.full(len(r), rounding)
            if block.into is not None:
                unsure += abs(block.into).sum(axis=1) * bounds[1 - block.axes[0]]
            far = (
                part.farthest(r[some], float(unsure[some].max(initial=0.0)))
                for some, part in block.parts
            )
            bounds[block.axes] = max(far, default=0.0)
        return math.hypot(*bounds)

    def is_stable(self) -> bool:
        """Subsystem by part."""
        return all(part.is_stable() for block in self._blocks for _, part in block.parts)

    def _named(self, block: DiagonalBlock, unknowns: Indices) -> str:
        numbers = np.unique(self._operator.followers[unknowns // len(block.axes)]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"

    def _following(self, first: int) -> DiagonalBlock:
        """The block of the other axis; it shares the solvers of the first where both are alike."""
        other, led = 1 - first, self._operator.couplings_leader
        coupled = self._both.couples(other, first)
        into = self._both.entries([other], [first]).matrix() if coupled else None
        if self._both.is_isotropic() and led.is_isotropic():
            return DiagonalBlock([other], self._blocks[0].parts, into)
        block = self._block([other])
        block.into = into
        return block

    def _block(self, axes: list[int]) -> DiagonalBlock:
        matrix = one_minus(self._both.entries(axes).matrix())
        if self._damping:
            matrix = matrix + self._damping * identity_like(matrix)
        largest = float(np.abs(matrix.diagonal()).max(initial=0.0))
        self._amplification = max(self._amplification, largest)
        led = self._operator.couplings_leader.entries(axes)
        count, label = connected(matrix, strongly=False)
        guided, alone = self._guided[:, axes].ravel(), np.zeros(count, bool)
        # A component that leads stands alone: it goes with its particle, or is left out.
        alone[label[guided]] = True
        if len(axes) > 1:
            label = np.where(guided, label.reshape(-1, 2)[:, ::-1].ravel(), label)
        held = np.zeros(count, bool)
        held[label[led.rows[led.values != 0.0]]] = True
        # What leaders move directly or not is solved together, each part that floats by itself.
        groups = [np.flatnonzero((held & ~alone)[label])] if held.any() else []
        block = DiagonalBlock(axes, [])
        for some in groups + [np.flatnonzero(label == n) for n in np.flatnonzero(~held & ~alone)]:
            part = self._part(_within(matrix, some), axes, some, bool(held[label[some[0]]]))
            block.parts.append((some, part))
        return block

    def _part(self, matrix: Any, axes: list[int], some: Indices, held: bool) -> Subsystem:
        """Held parts have an inverse, unless leaders leave them some freedom."""
        if held:
            coordinates = self._coordinates(axes, some)
            with suppress(np.linalg.LinAlgError):
                return ConstrainedSubsystem(matrix, self._method, coordinates, self._watch)
        before = self._operator.couplings_previous
        back = _within(before.entries(axes).matrix(), some) if before.parts else None
        return SingularSubsystem(matrix, back, self._watch)

    def _is_fixed(self, axes: list[int], some: Indices) -> bool:
        """Whether what leads, led components and leaders beside these unknowns, leaves them no
        motion as a whole: along the axes and, of two, a turn."""
        led = self._operator.couplings_leader.entries(axes)
        beside = np.isin(led.rows, some) & (led.values != 0.0)
        leaders, count = np.unique(led.columns[beside]), len(axes)
        own = some[self._guided[:, axes].ravel()[some]]
        at = np.concatenate([self._led[leaders // count], self._X[own // count]])
        along = np.concatenate([leaders, own]) % count
        if not len(at):
            return False
        motions = np.eye(count)[along]
        if count > 1:
            x, y = (at - at[0]).T / (float(np.ptp(at, axis=0).max()) or 1.0)
            motions = np.column_stack([motions, np.where(along == 0, -y, x)])
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    def _coordinates(self, axes: list[int], some: Indices) -> Coordinates:
        """Where these unknowns lie; who leads along the one axis asked for is a leader."""
        where, held = some[:: len(axes)] // len(axes), self._guided[:, axes]
        led = self._X[held[:, 0]] if len(axes) == 1 else self._X[:0]
        guided = held[where].ravel() if len(axes) > 1 and held.any() else None
        return Coordinates(len(axes), self._X[where], np.concatenate([self._led, led]), guided)


def _within(matrix: Any, unknowns: Indices) -> Any:
    return matrix if len(unknowns) == matrix.shape[0] else matrix[unknowns][:, unknowns]
