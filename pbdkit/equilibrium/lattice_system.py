"""Linear system of an equilibrium, solved on the stencils of the lattice.

The error e of a state satisfies K e = r. A few iterations remove most of the error. The energy of
the remaining error is at most rᵀ B r / λ, where B is the multigrid cycle and λ is the smallest
eigenvalue of B K. λ is estimated from the coefficients of conjugate gradients (Lanczos). The
displacement of a place is at most √(g · energy), where g is the compliance of the place and is
extrapolated from coarse grids. λ and g are estimates, so that the bound is not rigorous; for safety
λ is halved.

The slowest mode of the steps is computed by inverse iteration, v ← A⁻¹ v.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.krylov import (
    BiconjugateGradients,
    ConjugateGradients,
    Descent,
    KrylovResult,
    LatticeKrylov,
    best_of,
)
from pbdkit.equilibrium.multigrid import (
    Multigrid,
    PartedGrids,
    StencilGrid,
    UnconstrainedMotionError,
    grids_of,
)
from pbdkit.equilibrium.stencil_matrix import (
    DIFFERENCED,
    EXACT,
    NUDGE,
    StencilMatrix,
    balanced,
    constrained,
    differenced_matrix,
    held_components,
    inverses,
    is_held,
    kernels,
    leads_one_way,
    stencil_matrix,
    transposed,
)
from pbdkit.equilibrium.system import (
    ALL,
    IndefiniteError,
    Moves,
    Rows,
    StagnationError,
    System,
    random_displacements,
)
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

ENOUGH = 8
"""Number of iterations in the estimate of the compliance of a place."""


def compliance(grids: Multigrid | PartedGrids) -> float:
    """Estimate the largest displacement of a place under a unit load. The increase from the
    coarsest grid to the next finer one is computed; the same increase is assumed for each further
    grid."""
    coarse, last = grids.whole, len(grids) - 1
    axis, place, displacement = coarse.softest
    if last == 0:
        return displacement
    depth = len(coarse) - 2
    grid, (i, j) = coarse.grid(depth), coarse.finer_place(depth + 1, place)
    b = grid.field(np.float64)
    if i >= b.shape[1] or j >= b.shape[2] or grid.code[i, j] < 0:
        return displacement * (last + 1)
    b[axis, i, j] = 1.0
    x = ConjugateGradients(coarse, depth).solve(b, lambda d: len(d.steps) >= ENOUGH).x
    return displacement + max(0.0, float(x[axis, i, j]) - displacement) * last


def field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """Return the rasters of a displacement in the scene as a field of the grid."""
    if matrix.at is None:
        return planes.reshape(2, *matrix.code.shape)
    out = np.zeros((2, *matrix.code.shape))
    out.reshape(2, -1)[:, matrix.at] = planes.reshape(2, -1)[:, matrix.place]
    return out


def free_field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """Return the rasters of a displacement in the scene as a field that is zero except at free
    places."""
    return np.where(matrix.code >= 0, field_of(matrix, planes), 0.0)


def planes_of(matrix: StencilMatrix, field: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the values of a field of the grid in an array of the given shape, which has a raster
    of the scene for each axis."""
    if matrix.at is None:
        return field.reshape(shape)
    planes = np.zeros(shape)
    planes.reshape(2, -1)[:, matrix.place] = field.reshape(2, -1)[:, matrix.at]
    return planes


MAX_TURNS = 32
"""Maximum number of inverse iterations on a coarser grid."""
TURN = 3
"""Maximum number of inner iterations in each inverse iteration."""


@dataclass(frozen=True)
class SlowMode:
    """Slowest decaying mode of the steps. `planes` of shape (axis, sublattice, cell, cell)
    are its displacements, and `slowness` is 1 / (1 - λ) with its eigenvalue λ."""

    planes: Floats
    slowness: float

    def improved(self, system: System, accuracy: float) -> SlowMode:
        """Return the mode after one inverse iteration, which is solved with a relative accuracy."""
        force = self.planes / np.abs(self.planes).max()
        planes = system.solve(force, accuracy * self.slowness)
        return SlowMode(planes, float((planes * planes).sum() / (planes * force).sum()))


def softest(grids: Multigrid, krylov: type[LatticeKrylov]) -> tuple[Floats, float]:
    """Estimate the largest eigenvalue of K⁻¹ and its mode on the finest grid, up to a factor, by
    inverse iteration from the coarsest to the third-finest grid."""
    mode, softness = grids.softest_field(), 1.0
    for depth in range(len(grids) - 1, 0, -1):
        solver, finer = krylov(grids, depth), grids.grid().unknowns / grids.grid(depth).unknowns
        for _ in range(min(4 ** (depth - 1) // 2, MAX_TURNS)):
            force = mode.astype(float) / np.abs(mode).max()
            mode = solver.solve(force.copy(), lambda d: len(d.jumps) >= TURN).x
            softness = finer * float((mode * mode).sum() / (mode * force).sum())
        mode = grids.finer_field(depth, mode)
    return mode.astype(float), softness


LOOKS_AHEAD = 2
"""Number of iterations that remove most of an error before the remainder is bounded."""
SAFETY = 2.0
"""Divisor of the estimated eigenvalue λ."""
NEAR = 0.01
"""An iteration counts as having removed most of an error if the estimated distance from the
solution is at most this fraction of the first jump of the iteration."""
TURNS = 6
"""Number of inverse iterations."""


class LatticeSystem(System):
    """Linear system solved by multigrid on stencils; `has_leaders` is true if the matrix contains
    the coupling of followers to leaders.

    Raises UnconstrainedMotionError if leaders do not hold the whole body.
    """

    def __init__(
        self,
        matrix: StencilMatrix,
        symmetric: bool,
        shape: tuple[int, ...],
        watch: Watch,
        has_leaders: bool = False,
        rows: Rows = ALL,
    ) -> None:
        self._matrix, self._shape, self._watch = matrix, shape, watch
        self._has_leaders = has_leaders and matrix.at is None and matrix.held is None
        self._rows, self._symmetric = rows, symmetric
        grid = StencilGrid(matrix.code, matrix.kind, matrix.stencils, matrix.held)
        self._grids = grids_of(grid, rows)
        kind = ConjugateGradients if self._symmetric else BiconjugateGradients
        self._solver: LatticeKrylov = kind(self._grids, rows=rows)
        self.may_be_stable = not self._symmetric or self._grids.is_definite()
        """False if directions of negative curvature exist on the coarse grids."""
        self._smallest = 1.0
        self._spread: float | None = None
        self._iterations = 0

    @property
    def methods(self) -> str:
        """Names of the multigrid method and of the iteration that is preconditioned by it."""
        return f"multigrid, {self._solver.name}"

    @property
    def bound_kind(self) -> str:
        """Kind of the bound: for a symmetric matrix it is computed from the energy of the error,
        otherwise from the jumps of the iteration."""
        return "energy" if self._symmetric else "iteration"

    @property
    def iterations(self) -> int:
        """Number of iterations of all solutions and bounds."""
        return self._iterations

    def solve(
        self,
        moves: Floats,
        tolerance: float,
        invariant_state: State | None = None,
        rounding: float = 0.0,
    ) -> Floats:
        """Iterate until the estimated distance is within the tolerance. `invariant_state` is not
        used, since the whole body is held."""
        self._watch.begin("solving")
        iteration = self._iterate(self._pull(moves), lambda d: d.ahead <= tolerance)
        if iteration.jumps and not iteration.ahead <= tolerance:
            raise StagnationError
        return self._planes(iteration.x)

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """Return the solution, starting from the best combination of the fields `near`."""
        fields = [free_field_of(self._matrix, v) for v in near]
        return self._planes(self._to_share(self._pull(moves), share, fields))

    def pushed_by(self, led: Floats) -> Floats | None:
        """Return -S⁻¹ K led, the moves of followers for displacements `led` of their leaders."""
        if not self._has_leaders:
            return None
        pull, out = (
            self._solver.product(field_of(self._matrix, led)),
            self._grids.grid().field(np.float64),
        )
        negative_inverse = inverses(-self._matrix.scale.reshape(-1, 2, 2)).reshape(-1, 4)
        # Kernels are compiled only for contiguous arrays.
        inverse = np.ascontiguousarray(negative_inverse)
        kernels().scaled(self._solver.matrix, tuple(inverse[0].tolist()), inverse, pull, out)
        return self._planes(out)

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Return Sᵀ K⁻ᵀ weights, the solution with the transpose of A⁻¹ = K⁻¹ S. If K is symmetric,
        the grids of K are used, otherwise grids of Kᵀ."""
        b, out = free_field_of(self._matrix, weights), self._grids.grid().field(np.float64)
        solver = self if self._symmetric else self._transposed
        x = solver._to_share(b, share, ())
        turned = np.ascontiguousarray(self._matrix.scale[:, [0, 2, 1, 3]])
        kernels().scaled(self._solver.matrix, tuple(turned[0].tolist()), turned, x, out)
        return self._planes(out)

    @cached_property
    def _transposed(self) -> LatticeSystem:
        return LatticeSystem(transposed(self._matrix), False, self._shape, self._watch)

    def _to_share(self, b: Floats, share: float, near: Sequence[Floats]) -> Floats:
        """Return the solution of K x = b with an error of at most `share` times the largest entry
        of x."""
        self._watch.begin("solving")
        start = best_of(self._solver, near, b)

        def is_near(d: KrylovResult) -> bool:
            return d.ahead <= share * self._rows.max_norm(start + d.x)

        iteration = self._iterate(b, is_near)
        if iteration.jumps and not is_near(iteration):
            raise StagnationError
        return np.asarray(start + iteration.x)

    def slowest(self) -> SlowMode:
        """Estimate the slowest mode of the steps on the coarser grids, for a lattice within one
        process."""
        mode, softness = softest(self._grids.whole, type(self._solver))
        return SlowMode(
            self._planes(mode),
            softness * float(np.abs(self._matrix.scale[0, 0])),
        )

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Return the mismatch relative to K c, in which moves are converted to forces."""
        solver, pull = self._solver, self._solver.product(field_of(self._matrix, c))
        difference = self._pull(after) - self._pull(before) + pull
        return math.sqrt(solver.dot(difference, difference) / solver.dot(pull, pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """Return the sum of three terms: the error that a few iterations remove, a bound on the
        remaining error, and a bound on the effect of rounding. Rounding errors are assumed to be
        random."""
        remainder, length = self._tracked(self._pull(moves))
        if self._spread is None:
            self._spread = self._spread_of_rounding()
        return remainder + length + rounding * self._spread

    def _tracked(self, r: Floats) -> tuple[float, float]:
        """Iterate on K x = r; return a bound on the remaining error of x, and the size of x."""
        if self._symmetric:
            iteration: KrylovResult = self._iterate(r, lambda d: len(d.jumps) >= LOOKS_AHEAD)
            assert isinstance(iteration, Descent)
            remainder = self._farthest(iteration.residual_energy)
        else:
            iteration = self._iterate(r, lambda d: d.ahead <= NEAR * d.jumps[0])
            remainder = SAFETY * iteration.ahead if iteration.jumps else 0.0
            if not math.isfinite(remainder):
                raise StagnationError
        return remainder, math.sqrt(self._rows.max_norm((iteration.x * iteration.x).sum(axis=0)))

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Do nothing: the whole body is held."""

    def is_stable(self) -> bool:
        """Return whether the matrix has no negative eigenvalue. A symmetric matrix is regarded as
        such if conjugate gradients encounter no negative curvature, neither for the load nor for a
        random right side. For other matrices the sign of the eigenvalues nearest to 0 is
        checked."""
        v = self._rows.random(self._shape)
        if self._symmetric:
            try:
                self._iterate(self._pull(v), lambda d: d.jumps[-1] <= NEAR * d.jumps[0])
            except IndefiniteError:
                return False
            return True
        previous = v
        for _ in range(TURNS):
            iteration = self._iterate(self._pull(v), lambda d: d.ahead <= NEAR * d.jumps[0])
            previous, v = (
                v,
                self._planes(iteration.x / (self._rows.max_norm(iteration.x) or 1.0)),
            )
        return self._solver.dot(*(field_of(self._matrix, each) for each in (v, previous))) > 0.0

    def _iterate(self, r: Floats, is_done: Callable[[Any], bool]) -> KrylovResult:
        iteration: KrylovResult = self._solver.solve(r, is_done)
        self._iterations += len(iteration.jumps)
        if isinstance(iteration, Descent):
            if (
                iteration.indefinite
                or iteration.residual_energy < 0.0
                or any(turn < 0.0 for turn in iteration.turns)
            ):
                raise IndefiniteError
            if not math.isfinite(iteration.residual_energy):
                raise StagnationError
            if len(iteration.steps) > 1:
                self._smallest = min(self._smallest, iteration.smallest())
            if self._smallest <= 0.0:
                raise IndefiniteError
        return iteration

    def _farthest(self, energy: float) -> float:
        """Return a bound on all displacements, given rᵀ B r of the residual r."""
        if min(energy, self._compliance) < 0.0:
            raise IndefiniteError
        return math.sqrt(SAFETY / self._smallest * self._compliance * energy)

    def _spread_of_rounding(self) -> float:
        """Return a bound on the displacement caused by rounding errors of at most 1 in the
        moves."""
        r = self._pull(np.sign(self._rows.random(self._shape)))
        if self._symmetric:
            return self._farthest(self._solver.dot(r, self._grids.cycle(r.astype(np.float32))))
        return SAFETY * sum(self._tracked(r))

    @cached_property
    def _compliance(self) -> float:
        return compliance(self._grids)

    def _pull(self, moves: Floats) -> Floats:
        """Return K c, as a field, for a correction c with the given moves."""
        out, scale = self._grids.grid().field(np.float64), self._matrix.scale
        same = tuple(scale[0].tolist())
        kernels().scaled(self._solver.matrix, same, scale, field_of(self._matrix, moves), out)
        return out

    def _planes(self, field: Floats) -> Floats:
        """Return a field as planes of the scene."""
        return planes_of(self._matrix, field, self._shape)


FAITHFUL = 1e-3
"""Stencils that are computed by differences of moves are accepted if products with them differ from
the moves by at most this relative amount."""


def lattice_system(
    scene: Scene,
    state: State,
    step: int,
    watch: Watch,
    moves: Moves | None = None,
    rows: Rows = ALL,
) -> LatticeSystem | None:
    """Return the linear system of a scene on stencils; None if there is no such system, or if
    leaders do not hold the body.

    At a state that is not at rest the matrix is assembled by differences of compiled `moves`. If
    the lattice is distributed among processes, `rows` are the rows of this process, and the system
    is linearised at rest.
    """
    if moves and state.u.any() and moves.compile():
        matrix = differenced_matrix(scene, state, step, moves)
        rtol = DIFFERENCED
    else:
        matrix, rtol, moves = stencil_matrix(scene, state, step, rows), EXACT, None
    if matrix is None:
        return None
    matrix = matrix.within(rows.known)
    components = held_components(scene, step, rows)
    if leads_one_way(matrix, rows) or not is_held(matrix, components, rows):
        return None
    matrix, is_symmetric = balanced(constrained(matrix, components), rtol, rows)
    try:
        # Couplings of frame points to leaders are not part of the stencils.
        has_leaders = not (moves or scene.frame)
        system = LatticeSystem(matrix, is_symmetric, state.u.shape, watch, has_leaders, rows)
    except UnconstrainedMotionError:
        return None
    if not system.may_be_stable:
        if state.u.any():
            raise IndefiniteError
        return None
    if moves:
        probe = random_displacements(scene, NUDGE * scene.neighbourhood.nudge_unit)
        displaced = replace(state, u=state.u + probe)
        if not system.mismatch(probe, moves.at(state, step), moves.at(displaced, step)) <= FAITHFUL:
            return None
    return system
