"""Linear system of an equilibrium as a block-triangular sparse matrix.

If the axes x and y are not coupled, there are two diagonal blocks, which are often equal. If only
one of the axes depends on the other (mixed-coordinate rule), the axis that does not depend on the
other is solved first. Within a block, all particles that leaders hold, directly or through bonds,
are solved together. Each floating part has a singular matrix and is solved separately.
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
"""Safety factor by which estimates are multiplied that can be too small."""
ACCURACY = 1e-9
"""Relative accuracy of solutions; a second correction improves it if necessary."""
ROUGH = 1e-3
"""Relative accuracy of solutions from which only a bound is computed."""
TURNS = 20
"""Number of inverse iterations."""
SOFT = 1e10
"""Norm of A⁻¹ above which a part may be floating."""
TOO_SOFT = 1e13
"""Norm of A⁻¹ outside the rigid modes, above which soft modes cannot be distinguished from rigid
modes in double precision."""
NOTHING = 64.0 * float(np.finfo(float).eps)
"""A sum of terms that cancel counts as zero if its size, relative to the terms, is at most this
number. Such sums are A y and the load on y, for a rigid mode y."""
RANDOM_SHARE = 0.1
"""Smallest component along one mode that a normalised vector of random numbers is assumed to have,
multiplied by the square root of the number of unknowns."""
SHIFT = 1e-13
"""Number that is added to the diagonal of a large singular matrix, relative to the largest entry of
the matrix."""
MODES = 6
"""Number of modes that are computed at first in order to find the kernel of a matrix."""
MAX_MODES = 96
"""Maximum number of modes that are computed in order to find the kernel."""
LARGEST_FALLBACK = 400_000
"""Number of unknowns up to which an LU factorisation replaces an iteration that makes no
progress."""


class UnbalancedLoadError(Exception):
    """A floating part is under a load that is not balanced."""


class TooSoftError(UnbalancedLoadError):
    """A part is held so softly that it cannot be distinguished from a floating part in double
    precision."""


class Subsystem(ABC):
    """Linear system A x = r of a part. It has a solver for its unknowns and for the additional rows
    and columns by which a singular A is bordered. If there is no solver, the only equilibrium that
    can be computed is the state at rest."""

    def __init__(
        self, size: int, solver: LinearSolver | None, watch: Watch, borders: int = 0
    ) -> None:
        self._size, self._solver, self._watch, self._borders = size, solver, watch, borders

    has_stagnated = False
    """True if an iteration makes no progress and no other method can replace it."""

    @abstractmethod
    def solve(
        self, r: Floats, invariant_change: Floats | None = None, rounding: float = 0.0
    ) -> Floats:
        """Return the x to which steps from x = 0 converge. `invariant_change` is the change of the
        invariants that the previous state causes, and `rounding` the rounding error of r.

        Raises UnbalancedLoadError if there is no such x.
        """

    @abstractmethod
    def solve_transposed(self, weights: Floats) -> Floats:
        """Return λ such that λ · r = weights · x for every r for which there is a solution x."""

    @property
    def name(self) -> str:
        """Name of the method of the linear solver."""
        return self._solver.name if self._solver else "lu"

    @property
    def iterations(self) -> int:
        """Number of iterations of the linear solver."""
        return self._solver.iterations if self._solver else 0

    def farthest(self, r: Floats, rounding: float) -> float:
        """Return max |A⁻¹ r| plus the effect of rounding of r."""
        if self._solver is None:
            return math.inf if r.any() or rounding else 0.0
        distance = float(np.abs(self._inverted(r)).max(initial=0.0))
        return distance + (self._spread * rounding if rounding else 0.0)

    @property
    def bound_kind(self) -> str:
        """Kind of the bound."""
        return "inverse" if isinstance(self._solver, Dense) else "solution"

    def is_stable(self) -> bool:
        """Return whether no eigenvalue is negative. All eigenvalues of a small matrix are computed.
        Of a large matrix only the eigenvalues nearest to 0 are computed, because an eigenvalue
        passes through 0 when it becomes negative as the load increases."""
        if self._solver is None or self._borders:
            return True
        if isinstance(self._solver, Dense):
            eigenvalues = np.linalg.eigvals(self._solver.inverse)
            return bool((eigenvalues.real > 0.0).all())
        v: Floats = np.random.default_rng(0).normal(size=self._size)
        for _ in range(TURNS):
            w = self._inverted(v / np.linalg.norm(v))
            v, previous = w, v
        return bool(v @ previous > 0.0)

    def _inverted(self, r: Floats, accuracy: float = ROUGH) -> Floats:
        """Return A⁻¹ r with a low accuracy."""
        assert self._solver is not None
        b = np.append(r, np.zeros(self._borders))
        return self._solver.solve(b, accuracy)[: self._size]

    @property
    def is_soft(self) -> bool:
        """True if a mode is so soft that rigid modes cannot be distinguished from it within
        rounding."""
        return not self._spread < SOFT

    @cached_property
    def _spread(self) -> float:
        """Norm of A⁻¹ for all unknowns."""
        return self.spread_of(np.ones(self._size, bool))

    def spread_of(self, some: Mask) -> float:
        """Return the maximum norm of A⁻¹ for right-hand sides that are zero outside some unknowns.

        The norm is computed from the inverse if it is available. Otherwise it is estimated from the
        solution for random signs as the right side, because rounding errors have random signs too.
        """
        if self._solver is None:
            return math.inf if some.any() else 0.0
        if isinstance(self._solver, Dense):
            inverse = np.abs(self._solver.inverse[: self._size, : self._size])
            return float(inverse[:, some].sum(axis=1).max(initial=0.0))
        self._watch.begin("bounding the error")
        signs = np.random.default_rng(0).choice([-1.0, 1.0], self._size) * some
        # The softest mode is only a small component of the random numbers. The accuracy is chosen
        # such that it is resolved.
        accuracy = min(ROUGH, RANDOM_SHARE / math.sqrt(max(1, self._size)))
        return SAFETY * float(np.abs(self._inverted(signs, accuracy)).max(initial=0.0))


class ConstrainedSubsystem(Subsystem):
    """Linear system of a part with a regular matrix.

    Raises LinAlgError if some motion has no stiffness.
    """

    def __init__(
        self,
        matrix: Any,
        method: str,
        coordinates: Coordinates | None,
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

    def solve(
        self, r: Floats, invariant_change: Floats | None = None, rounding: float = 0.0
    ) -> Floats:
        """Return the solution by the method of the linear solver; `invariant_change` is not used,
        since a part that is held has no invariants."""
        if not r.any():
            return np.zeros_like(r)
        self._watch.begin("solving")
        return self._solved(r, ACCURACY, 100 * ACCURACY)

    def solve_transposed(self, weights: Floats) -> Floats:
        """Return the solution of the transposed system by the same method."""
        return self._solved(weights, ACCURACY, 100 * ACCURACY, transposed=True)

    def _solved(
        self, b: Floats, accuracy: float, max_residual: float, *, transposed: bool = False
    ) -> Floats:
        """Return the solution. If the residual of an iteration remains larger than `max_residual`,
        the iteration is replaced by an LU factorisation where the method of the solver permits
        this."""
        matrix = self._matrix.T if transposed else self._matrix
        for _ in range(2):
            assert self._solver is not None
            solve = self._solver.solve_transposed if transposed else self._solver.solve
            x = solve(b, accuracy)
            if not isinstance(self._solver, PreconditionedKrylov):
                break
            residual = float(np.linalg.norm(b - matrix @ x))
            self._is_short = not residual <= max_residual * float(np.linalg.norm(b))
            if not (self._is_short and self._has_choice):
                self.has_stagnated |= self._is_short
                break
            self._solver = linear_solver(self._matrix, "lu", coordinates=self._coordinates)
            self._is_short = False
        return x

    def _inverted(self, r: Floats, accuracy: float = ROUGH) -> Floats:
        """Return A⁻¹ r with a low accuracy. Return infinity if an iteration makes no progress,
        because no bound can be computed from its result."""
        x = self._solved(r, accuracy, 2.0 * accuracy)
        return np.full_like(x, math.inf) if self._is_short else x

    def farthest(self, r: Floats, rounding: float) -> float:
        """Return max |A⁻¹ r| plus the effect of rounding. The remaining error of an iteration is
        estimated by solving for its residual."""
        x = self._inverted(r)
        distance = float(np.abs(x).max(initial=0.0))
        if isinstance(self._solver, PreconditionedKrylov) and math.isfinite(distance):
            residual = r - self._matrix @ x
            ahead = self._inverted(residual)
            distance += SAFETY * float(np.abs(ahead).max(initial=0.0))
            if math.isfinite(distance):
                rounding += float(np.abs(residual - self._matrix @ ahead).max(initial=0.0))
        return distance + (self._spread * rounding if rounding else 0.0)


class SingularSubsystem(Subsystem):
    """Linear system of a floating part. Steps do not change its invariants Yᵀ u, where the columns
    of Y are the vectors y with yᵀ A = 0.

    `before` is the matrix that multiplies the state before the last one, which contributes to the
    invariants: K = Yᵀ (1 + before). The system is A x + Y μ = r, K x = k. It has no solver if a
    mode grows, or if a mode that is not rigid has almost no stiffness.
    """

    def __init__(self, matrix: Any, before: Any, watch: Watch) -> None:
        self._matrix, self._left = matrix, _left_kernel(matrix)
        kernel = self._left
        rows = kernel.T + (kernel.T @ before if before is not None else 0.0)
        size, modes = kernel.shape
        solver: LinearSolver | None = None
        with suppress(np.linalg.LinAlgError):
            if size <= DENSE:
                corner = np.zeros((modes, modes))
                solver = Dense(np.block([[dense(matrix), kernel], [rows, corner]]))
            else:
                from scipy.sparse import block_array

                bordered = block_array([[matrix, kernel], [np.asarray(rows), None]], format="csr")
                solver = SparseLU(bordered, False)
        super().__init__(size, solver, watch, modes)
        if solver is not None and not self._spread < TOO_SOFT:
            self._solver = None

    def solve(
        self, r: Floats, invariant_change: Floats | None = None, rounding: float = 0.0
    ) -> Floats:
        """Return the solution of the bordered system."""
        if self._solver is None:
            if r.any():
                raise TooSoftError
            return np.zeros_like(r)
        push = self._left @ (self._left.T @ r)
        invariants = (
            np.zeros(self._borders) if invariant_change is None else self._left.T @ invariant_change
        )
        x = self._solver.solve(np.concatenate([r - push, invariants]), ACCURACY)[: self._size]
        terms = abs(self._matrix) @ np.abs(x)
        large = NOTHING * float(terms.max(initial=0.0)) + 8.0 * rounding
        if not np.abs(push).max(initial=0.0) <= large:
            raise UnbalancedLoadError
        return x

    def solve_transposed(self, weights: Floats) -> Floats:
        """Return the solution of the transposed system. Only the part of the load that is in
        balance has an effect, because nothing holds the floating part."""
        if self._solver is None:
            return np.zeros_like(weights)
        b = np.append(weights, np.zeros(self._borders))
        solution = self._solver.solve_transposed(b, ACCURACY)[: self._size]
        return np.asarray(solution - self._left @ (self._left.T @ solution))


def _left_kernel(matrix: Any) -> Floats:
    """Return an orthonormal basis of shape (unknown, mode) of all y with yᵀ A = 0 within rounding.
    For large matrices it is computed by inverse iteration. Compared with vectors of the kernel,
    each iteration multiplies a mode with the eigenvalue λ by about SHIFT / λ."""
    size = matrix.shape[0]
    largest = float(abs(matrix).max()) if size else 0.0
    if not largest > 0.0:
        return np.eye(size)
    # A is 1 minus the step operator: terms of size 1 cancel even if the result is tiny.
    nothing = NOTHING * max(1.0, float(abs(matrix).sum(axis=1).max()))
    if size <= DENSE:
        vectors, values, _ = np.linalg.svd(dense(matrix))
        kernel: Floats = vectors[:, values <= nothing]
        return kernel
    from scipy.sparse import eye_array

    shift = SHIFT * largest
    shifted = SparseLU(matrix + shift * eye_array(size), is_symmetric(matrix))
    count = MODES
    while True:
        basis = np.random.default_rng(0).normal(size=(size, count))
        for _ in range(4):
            basis = np.linalg.qr(shifted.solve_transposed(basis, 0.0))[0]
        _, values, turned = np.linalg.svd(matrix.T @ basis, full_matrices=False)
        is_kernel = values <= nothing
        if not is_kernel.all() or count >= min(MAX_MODES, size):
            return np.asarray(basis @ turned[is_kernel].T)
        count = min(4 * count, MAX_MODES, size)


@dataclass
class DiagonalBlock:
    """Unknowns of one axis, or of both axes if they are coupled, divided into parts. `into` is the
    coupling to the axis that was solved before."""

    axes: list[int]
    parts: list[tuple[Indices, Subsystem]]
    into: Any = None


DRIFTS = (
    "there is no equilibrium: a part of {} is loaded, but not constrained; constrain it with a "
    "leader group"
)
"""Message for a floating part under a load."""
SOFT_MESSAGE = (
    "in double precision a part of {} is not constrained: it can rotate about a single particle, "
    "is too slender, or is attached by too soft a region; constrain more of it with leaders, or "
    "use stiffer regions or fewer particles"
)
"""Message for a part that is too soft for double precision."""


class MatrixSystem(System):
    """Linear system that is stored as a sparse matrix and solved by a direct or an iterative
    method. With `damping` it is the system of an implicit step, (A + damping) c = move."""

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
        # If the axes are coupled, the invariants of one axis contain displacements along the other.
        parts = [part for block in self._blocks for _, part in block.parts]
        floats = any(isinstance(part, SingularSubsystem) for part in parts)
        if not self._blocks or (floats and both.couples(1 - first, first)):
            self._blocks = [self._block([0, 1])]
        else:
            self._blocks.append(self._following(first))

    @property
    def amplification(self) -> float:
        """Largest entry of the diagonal."""
        return self._amplification

    @property
    def methods(self) -> str:
        """Names of the methods used."""
        names = {part.name for block in self._blocks for _, part in block.parts}
        return ", ".join(sorted(names)) or "nothing to solve"

    @property
    def bound_kind(self) -> str:
        """Kind of the bound: computed from the inverse matrices or, if the inverse of some part is
        not available, from a solution."""
        if self._damping:
            return "damped"
        kinds = {part.bound_kind for block in self._blocks for _, part in block.parts}
        return next((kind for kind in ("solution", "inverse") if kind in kinds), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Number of iterations of all linear solvers."""
        parts = {id(part): part for block in self._blocks for _, part in block.parts}
        return sum(part.iterations for part in parts.values())

    def _table(self, planes: Floats) -> Floats:
        """Return planes as a table, (follower, axis)."""
        return planes.reshape(len(planes), -1)[:, self._place].T

    def _planes(self, table: Floats) -> Floats:
        """Return a table of shape (follower, axis) as planes."""
        planes = np.zeros(self._shape)
        planes.reshape(len(planes), -1)[:, self._place] = table.T
        return planes

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raise ExperimentError if the moves of a floating part exceed their rounding error."""
        table = self._table(moves)
        for block in self._blocks:
            for members, part in block.parts:
                r = table[:, block.axes].ravel()[members]
                if (
                    isinstance(part, SingularSubsystem)
                    and np.abs(r).max(initial=0.0) > 8 * rounding
                ):
                    raise NoEquilibriumError(
                        "there is no unique equilibrium: leaders do not constrain a part of "
                        f"{self._named(block, members)}; constrain it with a leader group, or use "
                        "solver: {type: stepping}",
                        ("leaders",),
                    )

    @property
    def has_stagnated(self) -> bool:
        """True if the iteration for some part makes no progress."""
        return any(part.has_stagnated for block in self._blocks for _, part in block.parts)

    def solve(
        self,
        moves: Floats,
        tolerance: float,
        invariant_state: State | None = None,
        rounding: float = 0.0,
    ) -> Floats:
        """Return the solution, computed block by block and part by part."""
        back = None if invariant_state is None else self._invariant_change(invariant_state)
        return self._planes(self._solved(self._table(moves), back, rounding))

    def _solved(self, moves: Floats, invariant_change: Floats | None, rounding: float) -> Floats:
        solution = np.zeros_like(moves)
        for block in self._blocks:
            r = moves[:, block.axes].ravel()
            if block.into is not None:
                r = r + block.into @ solution[:, 1 - block.axes[0]]
            back = None if invariant_change is None else invariant_change[:, block.axes].ravel()
            x = np.zeros_like(r)
            for members, part in block.parts:
                try:
                    part_change = None if back is None else back[members]
                    x[members] = part.solve(r[members], part_change, rounding)
                except UnbalancedLoadError as error:
                    soft = isinstance(error, TooSoftError) or (
                        part.is_soft and self._is_fixed(block.axes, members)
                    )
                    text = SOFT_MESSAGE if soft else DRIFTS
                    named = self._named(block, members)
                    raise NoEquilibriumError(text.format(named), ("leaders",)) from None
            solution[:, block.axes] = x.reshape(-1, len(block.axes))
        return solution

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """Return the solution of `solve`, which does not use a tolerance."""
        return self.solve(moves, 0.0, rounding=PUSH * float(np.abs(moves).max(initial=0.0)))

    def pushed_by(self, led: Floats) -> None:
        """Return None: leaders are not part of the matrix."""

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Return the solution of the transposed blocks, in reverse order."""
        table = self._table(weights)
        solution = np.zeros_like(table)
        for block in reversed(self._blocks):
            b = table[:, block.axes].ravel()
            x = np.zeros_like(b)
            for members, part in block.parts:
                x[members] = part.solve_transposed(b[members])
            solution[:, block.axes] = x.reshape(-1, len(block.axes))
            if block.into is not None:
                table[:, 1 - block.axes[0]] += block.into.T @ x
        solution[self._guided] = 0.0
        return self._planes(solution)

    def _invariant_change(self, state: State) -> Floats | None:
        """Return the array before · (u(t-1) - u(t)) of shape (follower, axis), by which the
        previous state changes the invariants. Return None if a step does not depend on the previous
        state."""
        if not self._operator.couplings_previous.parts:
            return None
        u, previous = self._table(state.u), self._table(state.previous)
        return self._operator.couplings_previous.times((previous - u).astype(float))

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Return the mismatch with the step operator."""
        table = self._table(c)
        with np.errstate(all="ignore"):
            pull = table - self._both.times(table)
            difference = pull + self._table(after) - self._table(before)
            return float(np.linalg.norm(difference) / np.linalg.norm(pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """Return the bound on the distance from equilibrium: the size of the solution with the
        remaining moves as right-hand side, plus the effect of rounding."""
        table, bounds = self._table(moves), np.zeros(2)
        for block in self._blocks:
            r = table[:, block.axes].ravel()
            unsure = np.full(len(r), rounding)
            if block.into is not None:
                unsure += abs(block.into).sum(axis=1) * bounds[1 - block.axes[0]]
            far = (
                part.farthest(r[members], float(unsure[members].max(initial=0.0)))
                for members, part in block.parts
            )
            bounds[block.axes] = max(far, default=0.0)
        return math.hypot(*bounds)

    def is_stable(self) -> bool:
        """Return whether all parts are stable."""
        return all(part.is_stable() for block in self._blocks for _, part in block.parts)

    def _named(self, block: DiagonalBlock, unknowns: Indices) -> str:
        numbers = np.unique(self._operator.followers[unknowns // len(block.axes)]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"

    def _following(self, first: int) -> DiagonalBlock:
        """Return the block of the other axis. It shares the solvers of the block of the axis
        `first` if both blocks are equal."""
        other, leader_couplings = 1 - first, self._operator.couplings_leader
        coupled = self._both.couples(other, first)
        into = self._both.entries([other], [first]).matrix() if coupled else None
        if self._both.is_isotropic() and leader_couplings.is_isotropic():
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
        leader_entries = self._operator.couplings_leader.entries(axes)
        count, label = connected(matrix, strongly=False)
        guided, alone = self._guided[:, axes].ravel(), np.zeros(count, bool)
        # A prescribed component has no couplings. It belongs to the part of its particle or, if the
        # particle has no other component, to no part.
        alone[label[guided]] = True
        if len(axes) > 1:
            label = np.where(guided, label.reshape(-1, 2)[:, ::-1].ravel(), label)
        has_leader = np.zeros(count, bool)
        has_leader[label[leader_entries.rows[leader_entries.values != 0.0]]] = True
        # Followers that leaders hold, directly or through bonds, are solved together, and each
        # floating part separately.
        groups = [np.flatnonzero((has_leader & ~alone)[label])] if has_leader.any() else []
        groups += [np.flatnonzero(label == n) for n in np.flatnonzero(~has_leader & ~alone)]
        block = DiagonalBlock(axes, [])
        for members in groups:
            held = bool(has_leader[label[members[0]]])
            part = self._part(_within(matrix, members), axes, members, held)
            block.parts.append((members, part))
        return block

    def _part(self, matrix: Any, axes: list[int], members: Indices, held: bool) -> Subsystem:
        """Return the system of a part. The matrix of a held part can be inverted, unless a motion
        of the part is not constrained by leaders."""
        if held:
            coordinates = self._coordinates(axes, members)
            with suppress(np.linalg.LinAlgError):
                return ConstrainedSubsystem(matrix, self._method, coordinates, self._watch)
        previous = self._operator.couplings_previous
        back = _within(previous.entries(axes).matrix(), members) if previous.parts else None
        return SingularSubsystem(matrix, back, self._watch)

    def _is_fixed(self, axes: list[int], members: Indices) -> bool:
        """Return whether leaders and prescribed components adjacent to some unknowns suppress all
        rigid motions: translation along each axis and, with two axes, rotation."""
        leader_entries = self._operator.couplings_leader.entries(axes)
        is_adjacent = np.isin(leader_entries.rows, members) & (leader_entries.values != 0.0)
        leaders, count = np.unique(leader_entries.columns[is_adjacent]), len(axes)
        guided = members[self._guided[:, axes].ravel()[members]]
        at = np.concatenate([self._led[leaders // count], self._X[guided // count]])
        along = np.concatenate([leaders, guided]) % count
        if not len(at):
            return False
        motions = np.eye(count)[along]
        if count > 1:
            x, y = (at - at[0]).T / (float(np.ptp(at, axis=0).max()) or 1.0)
            motions = np.column_stack([motions, np.where(along == 0, -y, x)])
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    def _coordinates(self, axes: list[int], members: Indices) -> Coordinates | None:
        """Return the coordinates of the given unknowns. If the unknowns belong to one axis,
        particles with a prescribed component along this axis are listed with the leaders.

        Return None if a component of a particle belongs to another part: the last intact bonds of
        the particle may couple one component only.
        """
        where, is_guided = members[:: len(axes)] // len(axes), self._guided[:, axes]
        if not np.array_equal(members // len(axes), np.repeat(where, len(axes))[: len(members)]):
            return None
        positions = self._X[is_guided[:, 0]] if len(axes) == 1 else self._X[:0]
        guided = is_guided[where].ravel() if len(axes) > 1 and is_guided.any() else None
        return Coordinates(
            len(axes), self._X[where], np.concatenate([self._led, positions]), guided
        )


def _within(matrix: Any, unknowns: Indices) -> Any:
    return matrix if len(unknowns) == matrix.shape[0] else matrix[unknowns][:, unknowns]
