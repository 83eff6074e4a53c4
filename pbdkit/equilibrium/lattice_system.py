"""The linear system of an equilibrium solved on the stencils of its lattice.

The error e of a state solves K e = r. Some iterations find most of it; for the rest conjugate
gradients know its energy, rᵀ B r / λ at most, with the cycle B and the smallest eigenvalue λ of
B K, of which they have seen enough to estimate it. A place moves by √(g · energy) at most, where g
is its compliance, extrapolated from coarse grids. That is an estimate, not a proof: λ is halved.

The slowest mode of the steps follows by inverse iteration: what remains of v ← A⁻¹ v fades last.
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
    Found,
    LatticeKrylov,
    best_of,
)
from pbdkit.equilibrium.multigrid import (
    FloatingError,
    Multigrid,
    PartedGrids,
    StencilGrid,
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
    StuckError,
    System,
    random_displacements,
)
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

ENOUGH = 8
"""Iterations that tell how far a place gives way."""


def compliance(grids: Multigrid | PartedGrids) -> float:
    """How far a place gives way to a unit load at most: as on the coarsest grid, and on each finer
    one by so much more as on the first of them."""
    coarse, last = grids.whole, len(grids) - 1
    axis, place, found = coarse.softest
    if last == 0:
        return found
    depth = len(coarse) - 2
    grid, (i, j) = coarse.grid(depth), coarse.finer_place(depth + 1, place)
    b = grid.field(np.float64)
    if i >= b.shape[1] or j >= b.shape[2] or grid.code[i, j] < 0:
        return found * (last + 1)
    b[axis, i, j] = 1.0
    x = ConjugateGradients(coarse, depth).solve(b, lambda d: len(d.steps) >= ENOUGH).x
    return found + max(0.0, float(x[axis, i, j]) - found) * last


def field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """What planes are there."""
    if matrix.at is None:
        return planes.reshape(2, *matrix.code.shape)
    out = np.zeros((2, *matrix.code.shape))
    out.reshape(2, -1)[:, matrix.at] = planes.reshape(2, -1)[:, matrix.place]
    return out


def free_field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """The same of who is free alone."""
    return np.where(matrix.code >= 0, field_of(matrix, planes), 0.0)


def planes_of(matrix: StencilMatrix, field: Floats, shape: tuple[int, ...]) -> Floats:
    """What a field is on the scene's raster, of a shape."""
    if matrix.at is None:
        return field.reshape(shape)
    planes = np.zeros(shape)
    planes.reshape(2, -1)[:, matrix.place] = field.reshape(2, -1)[:, matrix.at]
    return planes


MOST_TURNS, TURN = 32, 3
"""Of inverse iteration on a coarser grid, and iterations in each turn."""


@dataclass(frozen=True)
class SlowMode:
    """A mode of the steps, planes, and its slowness 1 / (1 - λ), λ its eigenvalue."""

    planes: Floats
    slowness: float

    def improved(self, system: System, accuracy: float) -> SlowMode:
        """After a turn, solved to an accuracy relative to where it leads."""
        force = self.planes / np.abs(self.planes).max()
        found = system.solve(force, accuracy * self.slowness)
        return SlowMode(found, float((found * found).sum() / (found * force).sum()))


def softest(grids: Multigrid, krylov: type[LatticeKrylov]) -> tuple[Floats, float]:
    """Of K⁻¹ about the largest eigenvalue and its field on the finest grid, up to some factor: by
    inverse iteration on ever finer grids, but for the two finest."""
    mode, softness = grids.softest_field(), 1.0
    for depth in range(len(grids) - 1, 0, -1):
        solver, finer = krylov(grids, depth), grids.grid().unknowns / grids.grid(depth).unknowns
        for _ in range(min(4 ** (depth - 1) // 2, MOST_TURNS)):
            force = mode.astype(float) / np.abs(mode).max()
            mode = solver.solve(force.copy(), lambda d: len(d.jumps) >= TURN).x
            softness = finer * float((mode * mode).sum() / (mode * force).sum())
        mode = grids.finer_field(depth, mode)
    return mode.astype(float), softness


LOOKS_AHEAD = 2
"""Iterations that a bound takes."""
SAFETY = 2.0
"""By what λ is divided."""
NEAR = 0.01
"""The share of the first jump at which an iteration has found most of an error."""
TURNS = 6
"""Of inverse iteration."""


class LatticeSystem(System):
    """The system by multigrid; `has_leaders` says whether rows of the matrix have what leaders do
    to followers too. Raises FloatingError where leaders do not hold all of the body."""

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
        """Not where coarse ways already lead downhill."""
        self._smallest = 1.0
        self._spread: float | None = None
        self._iterations = 0

    @property
    def methods(self) -> str:
        """Multigrid and an iteration around it."""
        return f"multigrid, {self._solver.name}"

    @property
    def how(self) -> str:
        """By energy where there is one."""
        return "energy" if self._symmetric else "iteration"

    @property
    def iterations(self) -> int:
        """Of all solutions and bounds together."""
        return self._iterations

    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """Until the jumps of the iteration say that no more than the tolerance is left. Nothing is
        owed: all is held."""
        self._watch.begin("solving")
        found = self._found(self._pull(moves), lambda d: d.ahead <= tolerance)
        if found.jumps and not found.ahead <= tolerance:
            raise StuckError
        return self._planes(found.x)

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """From the combination of those `near` that is best."""
        begun = [free_field_of(self._matrix, v) for v in near]
        return self._planes(self._to_share(self._pull(moves), share, begun))

    def pushed_by(self, led: Floats) -> Floats | None:
        """-S⁻¹ K led."""
        if not self._has_leaders:
            return None
        pull, out = (
            self._solver.product(field_of(self._matrix, led)),
            self._grids.grid().field(np.float64),
        )
        own = inverses(-self._matrix.scale.reshape(-1, 2, 2)).reshape(-1, 4)
        inverse = np.ascontiguousarray(own)  # kernels are compiled for such alone
        kernels().scaled(self._solver.matrix, tuple(inverse[0].tolist()), inverse, pull, out)
        return self._planes(out)

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """A⁻¹ = K⁻¹ S, and Sᵀ K⁻ᵀ its transpose: by the same grids where K is symmetric, else by
        those of its transpose."""
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
        """x with K x = b to a share of its largest number."""
        self._watch.begin("solving")
        start = best_of(self._solver, near, b)

        def is_near(d: Found) -> bool:
            return d.ahead <= share * self._rows.max_norm(start + d.x)

        found = self._found(b, is_near)
        if found.jumps and not is_near(found):
            raise StuckError
        return np.asarray(start + found.x)

    def slowest(self) -> SlowMode:
        """Roughly the mode of the steps that fades most slowly, by the coarser grids; of a lattice
        that this process has whole."""
        mode, softness = softest(self._grids.whole, type(self._solver))
        return SlowMode(
            self._planes(mode),
            softness * float(np.abs(self._matrix.scale[0, 0])),
        )

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Of forces."""
        solver, pull = self._solver, self._solver.product(field_of(self._matrix, c))
        left = self._pull(after) - self._pull(before) + pull
        return math.sqrt(solver.dot(left, left) / solver.dot(pull, pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """The error that some turns find, and the bound on what they leave; rounding counts as
        random."""
        found, way = self._tracked(self._pull(moves))
        if self._spread is None:
            self._spread = self._spread_of_rounding()
        return way + found + rounding * self._spread

    def _tracked(self, r: Floats) -> tuple[float, float]:
        """How far x with K x = r may still be from what some turns find, and how far that is."""
        if self._symmetric:
            found: Found = self._found(r, lambda d: len(d.jumps) >= LOOKS_AHEAD)
            assert isinstance(found, Descent)
            left = self._farthest(found.left)
        else:
            found = self._found(r, lambda d: d.ahead <= NEAR * d.jumps[0])
            left = SAFETY * found.ahead if found.jumps else 0.0
            if not math.isfinite(left):
                raise StuckError
        return left, math.sqrt(self._rows.max_norm((found.x * found.x).sum(axis=0)))

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """All is held."""

    def is_stable(self) -> bool:
        """Conjugate gradients see a negative eigenvalue, from the load and from a random one. Where
        the matrix is not symmetric, those nearest to 0 are looked at."""
        v = self._rows.random(self._shape)
        if self._symmetric:
            try:
                self._found(self._pull(v), lambda d: d.jumps[-1] <= NEAR * d.jumps[0])
            except IndefiniteError:
                return False
            return True
        before = v
        for _ in range(TURNS):
            found = self._found(self._pull(v), lambda d: d.ahead <= NEAR * d.jumps[0])
            before, v = (
                v,
                self._planes(found.x / (self._rows.max_norm(found.x) or 1.0)),
            )
        return self._solver.dot(*(field_of(self._matrix, each) for each in (v, before))) > 0.0

    def _found(self, r: Floats, done: Callable[[Any], bool]) -> Found:
        found: Found = self._solver.solve(r, done)
        self._iterations += len(found.jumps)
        if isinstance(found, Descent):
            if found.indefinite or found.left < 0.0 or any(turn < 0.0 for turn in found.turns):
                raise IndefiniteError
            if not math.isfinite(found.left):
                raise StuckError
            if len(found.steps) > 1:
                self._smallest = min(self._smallest, found.smallest())
            if self._smallest <= 0.0:
                raise IndefiniteError
        return found

    def _farthest(self, left: float) -> float:
        """How far any place moves by what has this rᵀ B r."""
        if min(left, self._compliance) < 0.0:
            raise IndefiniteError
        return math.sqrt(SAFETY / self._smallest * self._compliance * left)

    def _spread_of_rounding(self) -> float:
        """How far rounding of moves by up to 1 takes a place."""
        r = self._pull(np.sign(self._rows.random(self._shape)))
        if self._symmetric:
            return self._farthest(self._solver.dot(r, self._grids.cycle(r.astype(np.float32))))
        return SAFETY * sum(self._tracked(r))

    @cached_property
    def _compliance(self) -> float:
        return compliance(self._grids)

    def _pull(self, moves: Floats) -> Floats:
        """What K c equals, on the grid."""
        out, scale = self._grids.grid().field(np.float64), self._matrix.scale
        same = tuple(scale[0].tolist())
        kernels().scaled(self._solver.matrix, same, scale, field_of(self._matrix, moves), out)
        return out

    def _planes(self, field: Floats) -> Floats:
        """On the scene's raster."""
        return planes_of(self._matrix, field, self._shape)


FAITHFUL = 1e-3
"""The share of what all moves at once are by which stencils from differences may be off."""


def lattice_system(
    scene: Scene,
    state: State,
    step: int,
    watch: Watch,
    moves: Moves | None = None,
    rows: Rows = ALL,
) -> LatticeSystem | None:
    """The system of a scene, by the moves of its followers where these are compiled and the state
    is not at rest; None where it has no such form, or leaders do not hold the body. A scene of
    which each process has some `rows` has it at rest, without such moves."""
    if moves and moves.is_compiled and state.u.any():
        matrix = differenced_matrix(scene, state, step, moves)
        alike = DIFFERENCED
    else:
        matrix, alike, moves = stencil_matrix(scene, state, step, rows), EXACT, None
    if matrix is None:
        return None
    matrix = matrix.within(rows.known)
    held = held_components(scene, step, rows)
    if leads_one_way(matrix, rows) or not is_held(matrix, held, rows):
        return None
    known = balanced(constrained(matrix, held), alike, rows)
    try:
        # What frame points show of leaders is not among the stencils.
        system = LatticeSystem(*known, state.u.shape, watch, not (moves or scene.frame), rows)
    except FloatingError:
        return None
    if not system.may_be_stable:
        if state.u.any():
            raise IndefiniteError
        return None
    if moves:
        put = random_displacements(scene, NUDGE * scene.neighbourhood.nudge_unit)
        there = replace(state, u=state.u + put)
        if not system.mismatch(put, moves.at(state, step), moves.at(there, step)) <= FAITHFUL:
            return None
    return system
