"""Geometric multigrid on the stencils of a lattice, in one process or several.

The basis functions of a coarser grid are bilinear hats; its stencils are Galerkin products. If one
direction is much stiffer than the other, only that direction is coarsened.

If there are several processes, each stores a strip of rows of the finer grids, and all rows of the
coarser grids. The halo of a strip is so wide that a cycle can be computed on the finer grids
without communication. The processes therefore communicate only twice in a cycle: at its beginning,
and when the residuals are gathered on the finest grid that is not distributed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Array, Floats
from pbdkit.equilibrium.stencil_matrix import (
    OUTSIDE,
    OWN,
    Held,
    coarser_held,
    inverses,
    kernels,
    with_held,
    without_held,
)
from pbdkit.equilibrium.system import Rows, Strip, coarser_size, outside

PRECISION = np.float32
"""Floating-point type of cycles."""
WEIGHT = 0.8
"""Relaxation factor. It is below 1 because all places of a row are relaxed simultaneously."""
STIFFNESS_RATIO = 3.0
"""Ratio of the stiffnesses along the two axes above which only the stiffer direction is
coarsened."""
MIN_PLACES = 5
"""Number of places along an axis, including the ring of empty places, up to which a grid is not
coarsened along that axis."""
EVERY = slice(None)
"""Slice of all rows."""


class StencilGrid:
    """One grid: its `code` and `kind` as in StencilMatrix, its `stencils`, and the lists of runs
    and lone places that kernels use. Corrections do not change the `held` components."""

    def __init__(
        self,
        code: NDArray[np.int32],
        kind: NDArray[np.int8],
        stencils: Floats,
        held: Held | None = None,
    ) -> None:
        self.code, self.kind, self.stencils, self.held = code, kind, stencils, held
        rows = len(code) + 1
        first, lone = np.empty(rows, np.int64), np.empty(rows, np.int64)
        none = np.empty(0, np.int32)
        run_count, lone_count = kernels().runs(code, first, none, none, lone, none, none)
        begin, end = (np.empty(run_count, np.int32) for _ in range(2))
        place, which = (np.empty(lone_count, np.int32) for _ in range(2))
        kernels().runs(code, first, begin, end, lone, place, which)
        self.lists = first, begin, end, lone, place, which
        self.unknowns = 2 * (int((end - begin).sum()) + lone_count)

    def given(self, precision: type[np.floating[Any]]) -> Any:
        """Return the grid as an argument of kernels, with numbers of the given precision."""
        middle = self._inverses
        same = tuple(tuple(map(precision, row)) for row in self.stencils[0].reshape(3, 12))
        stencils, inverse = (np.ascontiguousarray(v, precision) for v in (self.stencils, middle))
        return kernels().Grid(
            *self.lists, same, stencils, tuple(map(precision, middle[0])), inverse
        )

    @cached_property
    def _inverses(self) -> Floats:
        return inverses(self.stencils[:, OWN].reshape(-1, 2, 2)).reshape(-1, 4)

    def field(self, precision: type[np.floating[Any]]) -> Floats:
        """Return zeros, one number for each axis and place."""
        return np.zeros((2, *self.code.shape), precision)

    def halved(self, rows: int) -> tuple[int, int]:
        """Return the axes along which the next coarser grid has half the places. `rows` is the
        number of rows of the whole grid."""
        along = [np.abs(_stiffness(self.stencils[0], axis)) for axis in range(2)]
        columns = self.code.shape[1]
        if rows <= MIN_PLACES or columns <= MIN_PLACES:
            return int(rows > columns), int(columns >= rows)
        if max(along) <= STIFFNESS_RATIO * min(along):
            return 1, 1
        return int(along[0] > along[1]), int(along[1] > along[0])

    def coarser(self, halved: tuple[int, int], known: slice = EVERY) -> StencilGrid:
        """Return the next coarser grid. Its places outside the rows `known` are empty."""
        shape = [
            coarser_size(n) if half else n for n, half in zip(self.code.shape, halved, strict=True)
        ]
        kind, code = np.zeros(shape, np.int8), np.zeros(shape, np.int32)
        kernels().coarse_kinds(self.kind, halved, kind)
        count = kernels().coarse_codes(self.code, kind, halved, code)
        for rows in outside(known, shape[0]):
            kind[rows], code[rows] = OUTSIDE, -1
        stencils, fine = np.zeros((count + 1, *self.stencils.shape[1:])), self.stencils
        if self.held is not None:
            fine = without_held(self.code, fine, self.held)
        kernels().galerkin(self.code, fine, code, halved, stencils)
        stencils[0] = _coarse_stencil(self.stencils[:1], halved)
        if self.held is None:
            return StencilGrid(code, kind, stencils)
        coarse_held = coarser_held(self.kind, self.held, halved, kind)
        code, stencils, _ = with_held(code, stencils, coarse_held)
        return StencilGrid(code, kind, stencils, coarse_held)

    def add_coarser(self, coarse: Floats, halved: tuple[int, int], x: Floats) -> None:
        """Add P coarse to x."""
        kernels().prolong(*self.lists[:5], coarse, halved, x)
        if self.held is not None:
            x[self.held] = 0.0

    def is_definite_alone(self) -> bool:
        """Return whether the diagonal blocks of all places are positive definite, for a symmetric
        matrix."""
        a, b, c, d = self.stencils[:, OWN].T
        return bool(((a > 0.0) & (a * d > b * c)).all())

    def matrix(self) -> tuple[tuple[NDArray[np.intp], ...], Floats]:
        """Return the places of the unknowns and the dense matrix."""
        at = np.nonzero(self.code >= 0)
        number = np.full(self.code.shape, -1)
        number[at] = np.arange(len(at[0]))
        K = np.zeros((len(at[0]), 2, len(at[0]), 2))
        blocks = self.stencils[self.code[at]].reshape(-1, 9, 2, 2)
        for s in range(9):
            neighbours = number[at[0] + s // 3 - 1, at[1] + s % 3 - 1]
            present = np.flatnonzero(neighbours >= 0)
            K[present, :, neighbours[present], :] += blocks[present, s]
        return at, K.reshape(2 * len(at[0]), -1)


class GridLevel:
    """One grid with the arrays of a cycle, in single precision. `halved` are the axes along which
    the next coarser grid has half the places."""

    def __init__(self, grid: StencilGrid, halved: tuple[int, int] = (0, 0)) -> None:
        self.grid, self.given, self.halved = grid, grid.given(PRECISION), halved
        self.x, self.b = grid.field(PRECISION), grid.field(PRECISION)

    def down(self, b: Floats, below: GridLevel) -> None:
        """Relax K x = b from zero, and restrict the residual to the next grid."""
        kernel, x = kernels(), self.x
        kernel.relax(self.given, b, x, PRECISION(WEIGHT), True, False)
        kernel.restrict(self.given, b, x, self.halved, below.grid.code, below.b)

    def up(self, b: Floats, coarse: Floats) -> None:
        """Add the correction of the next grid, and relax."""
        self.grid.add_coarser(coarse, self.halved, self.x)
        kernels().relax(self.given, b, self.x, PRECISION(WEIGHT), False, True)


class Grids(ABC):
    """Hierarchy of grids: ``cycle(r)`` approximates K⁻¹ r in single precision."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of grids."""

    @abstractmethod
    def grid(self, depth: int = 0) -> StencilGrid:
        """Return the grid at a depth, 0 for the finest."""

    @abstractmethod
    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """Return one V-cycle from zero. The array is overwritten by the next cycle."""

    @abstractmethod
    def is_definite(self) -> bool:
        """Return whether a symmetric matrix is positive definite on the coarsest grid and in each
        diagonal block."""


def _stiffness(stencil: Floats, axis: int) -> float:
    """Return the stiffness against a wave along an axis."""
    c = np.moveaxis(stencil.reshape(3, 3, 2, 2), axis, 0)
    sides: Floats = c[0].sum(axis=0) + c[2].sum(axis=0)
    return float(np.trace(sides))


def _coarse_stencil(stencils: Floats, halved: tuple[int, int]) -> Floats:
    """Return the coarse stencil of a uniform stencil."""
    coarse = np.full((7, 7), -1, np.int32)
    coarse[3, 3] = 1
    stencil: Floats = np.zeros((2, *stencils.shape[1:]))
    kernels().galerkin(np.zeros((12, 12), np.int32), stencils, coarse, halved, stencil)
    return np.asarray(stencil[1])


COARSEST = 200
"""Number of unknowns below which a grid is solved by its inverse."""
TURNS = 30
"""Number of inverse iterations on the coarsest grid."""
SINGULAR = 1e-12
"""Reciprocal condition number of the coarsest grid below which the body counts as not held."""


class UnconstrainedMotionError(Exception):
    """A motion of the body is not constrained by leaders."""


class Multigrid(Grids):
    """Hierarchy of grids in one process.

    Raises UnconstrainedMotionError if a motion of the body is not constrained by leaders.
    """

    def __init__(self, grid: StencilGrid) -> None:
        self._levels = [GridLevel(grid)]
        while grid.unknowns > COARSEST:
            halved = self._levels[-1].halved = grid.halved(len(grid.code))
            grid = grid.coarser(halved)
            self._levels.append(GridLevel(grid))
        self._at, K = grid.matrix()
        try:
            inverse = np.linalg.inv(K)
        except np.linalg.LinAlgError:
            raise UnconstrainedMotionError from None
        if not np.abs(inverse).max() * np.abs(K).max() * SINGULAR < 1.0:
            raise UnconstrainedMotionError
        self._coarsest = K
        self._inverse, self._gives_way = inverse.astype(PRECISION), inverse.diagonal()

    def is_definite(self) -> bool:
        """Return whether a symmetric matrix is positive definite on the coarsest grid and in each
        diagonal block. If it is not positive definite there, it is not positive definite on the
        finest grid either."""
        K = (self._coarsest + self._coarsest.T) / 2.0
        return self.grid().is_definite_alone() and bool(np.linalg.eigvalsh(K)[0] > 0.0)

    def __len__(self) -> int:
        """Return the number of grids, including the coarsest."""
        return len(self._levels)

    def grid(self, depth: int = 0) -> StencilGrid:
        """Return the grid at a depth, 0 for the finest."""
        return self._levels[depth].grid

    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """Return the result of one V-cycle that begins on the grid at a depth."""
        level = self._levels[depth]
        if depth == len(self._levels) - 1:
            x = self._inverse @ r[:, self._at[0], self._at[1]].T.ravel()
            level.x[:, self._at[0], self._at[1]] = x.reshape(-1, 2).T
            return level.x
        below = self._levels[depth + 1]
        level.down(r, below)
        level.up(r, self.cycle(below.b, depth + 1))
        return level.x

    @property
    def whole(self) -> Multigrid:
        """The hierarchy of grids that are not distributed; in one process these are all grids."""
        return self

    @property
    def softest(self) -> tuple[int, tuple[int, int], float]:
        """Return axis, place and displacement of the most compliant unknown of the coarsest grid
        under a unit load."""
        n = int(self._gives_way.argmax())
        i, j = (int(index[n // 2]) for index in self._at)
        return n % 2, (i, j), float(self._gives_way[n])

    def softest_field(self) -> Floats:
        """Return the softest mode of the coarsest grid, by inverse iteration."""
        mode = np.random.default_rng(0).random(len(self._inverse))
        for _ in range(TURNS):
            mode = self._inverse @ (mode / np.abs(mode).max())
        field = self._levels[-1].grid.field(PRECISION)
        field[:, self._at[0], self._at[1]] = mode.reshape(-1, 2).T
        return field

    def finer_field(self, depth: int, field: Floats) -> Floats:
        """Return a field of one grid, interpolated to the next finer one."""
        above = self._levels[depth - 1]
        fine = above.grid.field(PRECISION)
        coarse = field.astype(PRECISION, copy=False)
        above.grid.add_coarser(coarse, above.halved, fine)
        return fine

    def finer_place(self, depth: int, place: tuple[int, int]) -> tuple[int, int]:
        """Return the place of the next finer grid at which a place of one grid lies."""
        halved = self._levels[depth - 1].halved
        i, j = (2 * n - 1 if half else n for n, half in zip(place, halved, strict=True))
        return i, j


SMALL = 100 * COARSEST
"""Number of unknowns below which a grid is not distributed. It is more than four times the number
of unknowns of the coarsest grid, so that at least two grids are not distributed."""


class PartedGrids(Grids):
    """Hierarchy of grids for several processes, each of which stores a strip of the finer grids.

    Raises UnconstrainedMotionError if a motion of the body is not constrained by leaders.
    """

    def __init__(self, grid: StencilGrid, rows: Rows, strip: Strip) -> None:
        self._rows = rows
        self._levels, self._strips = [GridLevel(grid)], [strip]
        while self._strips[-1].depth and self._unknowns() > SMALL:
            level, strip = self._levels[-1], self._strips[-1]
            level.halved = level.grid.halved(strip.count)
            strip = strip.coarser(level.halved[0])
            self._strips.append(strip)
            self._levels.append(GridLevel(level.grid.coarser(level.halved, strip.known)))
        self.whole = Multigrid(self._joined())
        """Grids of which every process stores all rows."""

    def _unknowns(self) -> int:
        rows, code = self._strips[-1].own, self._levels[-1].grid.code
        return 2 * int(self._rows.communicator.sum(int(np.count_nonzero(code[rows] >= 0))))

    def _joined(self) -> StencilGrid:
        """Gather the coarsest of the distributed grids."""
        grid, rows = self._levels[-1].grid, self._strips[-1].own
        code = grid.code[rows]
        used, number = np.unique(code, return_inverse=True)
        is_irregular = used > 0
        stencils = self._rows.communicator.allgather(grid.stencils[used[is_irregular]])
        offset = sum(map(len, stencils[: self._rows.communicator.rank]))
        renumbered = np.where(is_irregular, offset + np.cumsum(is_irregular), used).astype(
            code.dtype
        )
        joined_held = None if grid.held is None else self._together(grid.held[:, rows], 1)
        return StencilGrid(
            self._together(renumbered[number].reshape(code.shape), 0),
            self._together(grid.kind[rows], 0),
            np.concatenate([grid.stencils[:1], *stencils]),
            joined_held,
        )

    def _together(self, values: Array, axis: int) -> Array:
        return np.concatenate(self._rows.communicator.allgather(values), axis)

    def __len__(self) -> int:
        """Return the number of grids, including those that every process has."""
        return len(self._levels) - 1 + len(self.whole)

    def grid(self, depth: int = 0) -> StencilGrid:
        """Return a distributed grid."""
        return self._levels[depth].grid

    def is_definite(self) -> bool:
        """Return whether the matrix is definite in all processes."""
        alone = self._levels[0].grid.is_definite_alone()
        return not self._rows.communicator.any(not alone) and self.whole.is_definite()

    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """Return the result of one V-cycle that begins on the finest grid, after updating the halo
        of r. The result is valid in the rows of the process and in the adjacent rows."""
        assert depth == 0
        self._rows.exchange_halo(r)
        right_sides = [r, *(level.b for level in self._levels[1:])]
        for b, (level, below) in zip(right_sides, pairwise(self._levels), strict=False):
            level.down(b, below)
        strip = self._strips[-1]
        coarse = self.whole.cycle(self._together(right_sides[-1][:, strip.own], 1))
        low, rows = strip.low, right_sides[-1].shape[1]
        x = np.ascontiguousarray(coarse[:, low : low + rows])
        for level, b in zip(self._levels[-2::-1], right_sides[-2::-1], strict=True):
            level.up(b, x)
            x = level.x
        return x


def grids_of(grid: StencilGrid, rows: Rows) -> Multigrid | PartedGrids:
    """Return the hierarchy of grids with `grid` as the finest."""
    return PartedGrids(grid, rows, rows.strip) if rows.strip else Multigrid(grid)
