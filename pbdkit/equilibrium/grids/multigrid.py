"""Multigrid on a lattice: ever coarser grids of stencils, and one V-cycle over them.

The functions of a coarser grid are bilinear hats; its stencils are what those of the finer one do
to them (Galerkin). Where one direction is much stiffer, only that one is made coarser.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.grid_functions import kernels
from pbdkit.equilibrium.grids.held_components import (
    Held,
    coarser_held,
    with_held,
    without_held,
)
from pbdkit.equilibrium.grids.stencil_matrix import OWN, StencilMatrix, inverses

Floats = NDArray[np.floating[Any]]
COARSEST = 200
"""Unknowns below which a grid is solved with its inverse."""
WEIGHT = 0.8
"""Of a relaxation; below 1, since the places of a row do not know of each other."""
STIFFER = 3.0
"""So many times stiffer, a direction is made coarser alone."""
NARROW = 5
"""Places across, with the ring around, at which a grid is not made narrower."""
TURNS = 30
"""Of the inverse iteration on the coarsest grid."""
SINGULAR = 1e-12
"""One part of what the inverse of the coarsest grid may magnify; a body that is not held gives way
without end."""


class FloatingError(Exception):
    """Something of the body is not held."""


class Grid:
    """One grid: its `code` and `kind` as of StencilMatrix, its `stencils`, and what kernels are
    given of them in a precision. Corrections do not reach `held` components."""

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
        """The grid as kernels take it."""
        middle = self._inverses
        same = tuple(tuple(map(precision, row)) for row in self.stencils[0].reshape(3, 12))
        own, inverse = (np.ascontiguousarray(v, precision) for v in (self.stencils, middle))
        return kernels().Grid(*self.lists, same, own, tuple(map(precision, middle[0])), inverse)

    @cached_property
    def _inverses(self) -> Floats:
        return inverses(self.stencils[:, OWN].reshape(-1, 2, 2)).reshape(-1, 4)

    def field(self, precision: type[np.floating[Any]]) -> Floats:
        """Room for one number an axis and place."""
        return np.zeros((2, *self.code.shape), precision)

    def halved(self) -> tuple[int, int]:
        """Along which axes the next grid has half the places."""
        along = [np.abs(_stiffness(self.stencils[0], axis)) for axis in range(2)]
        rows, columns = self.code.shape
        if rows <= NARROW or columns <= NARROW:
            return int(rows > columns), int(columns >= rows)
        if max(along) <= STIFFER * min(along):
            return 1, 1
        return int(along[0] > along[1]), int(along[1] > along[0])

    def coarser(self, halved: tuple[int, int]) -> Grid:
        """The next grid."""
        shape = [
            (n - 2) // 2 + 3 if half else n for n, half in zip(self.code.shape, halved, strict=True)
        ]
        kind, code = np.zeros(shape, np.int8), np.zeros(shape, np.int32)
        kernels().coarse_kinds(self.kind, halved, kind)
        count = kernels().coarse_codes(self.code, kind, halved, code)
        stencils, fine = np.zeros((count + 1, *self.stencils.shape[1:])), self.stencils
        if self.held is not None:
            fine = without_held(self.code, fine, self.held)
        kernels().galerkin(self.code, fine, code, halved, stencils)
        stencils[0] = _coarse_stencil(self.stencils[:1], halved)
        if self.held is None:
            return Grid(code, kind, stencils)
        held = coarser_held(self.kind, self.held, halved, kind)
        code, stencils, _ = with_held(code, stencils, held)
        return Grid(code, kind, stencils, held)

    def add_coarser(self, coarse: Floats, halved: tuple[int, int], x: Floats) -> None:
        """x += P coarse."""
        kernels().prolong(*self.lists[:5], coarse, halved, x)
        if self.held is not None:
            x[self.held] = 0.0

    def matrix(self) -> tuple[tuple[NDArray[np.intp], ...], Floats]:
        """Where the unknowns are, and the matrix, dense."""
        at = np.nonzero(self.code >= 0)
        number = np.full(self.code.shape, -1)
        number[at] = np.arange(len(at[0]))
        K = np.zeros((len(at[0]), 2, len(at[0]), 2))
        blocks = self.stencils[self.code[at]].reshape(-1, 9, 2, 2)
        for s in range(9):
            there = number[at[0] + s // 3 - 1, at[1] + s % 3 - 1]
            some = np.flatnonzero(there >= 0)
            K[some, :, there[some], :] += blocks[some, s]
        return at, K.reshape(2 * len(at[0]), -1)


def _stiffness(stencil: Floats, axis: int) -> float:
    """What a wave along an axis meets."""
    c = np.moveaxis(stencil.reshape(3, 3, 2, 2), axis, 0)
    sides: Floats = c[0].sum(axis=0) + c[2].sum(axis=0)
    return float(np.trace(sides))


def _coarse_stencil(stencils: Floats, halved: tuple[int, int]) -> Floats:
    """What one stencil everywhere makes of itself."""
    coarse = np.full((7, 7), -1, np.int32)
    coarse[3, 3] = 1
    found: Floats = np.zeros((2, *stencils.shape[1:]))
    kernels().galerkin(np.zeros((12, 12), np.int32), stencils, coarse, halved, found)
    return np.asarray(found[1])


class Multigrid:
    """The grids of a matrix: ``cycle(r)`` approximates K⁻¹ r, in single precision.

    Raises FloatingError where leaders leave a motion of the body free.
    """

    precision = np.float32

    def __init__(self, matrix: StencilMatrix) -> None:
        grid = Grid(matrix.code, matrix.kind, matrix.stencils, matrix.held)
        self._levels = [_Level(grid, self.precision)]
        while grid.unknowns > COARSEST:
            halved = grid.halved()
            grid = grid.coarser(halved)
            self._levels[-1].halved = halved
            self._levels.append(_Level(grid, self.precision))
        self._at, K = grid.matrix()
        try:
            inverse = np.linalg.inv(K)
        except np.linalg.LinAlgError:
            raise FloatingError from None
        if not np.abs(inverse).max() * np.abs(K).max() * SINGULAR < 1.0:
            raise FloatingError
        self._coarsest = K
        self._inverse, self._gives_way = inverse.astype(self.precision), inverse.diagonal()

    def is_definite(self) -> bool:
        """Whether a symmetric matrix is positive, as the coarsest grid and each place by itself
        tell: one that is not there is not on the finest either."""
        a, b, c, d = self.grid().stencils[:, OWN].T
        K = (self._coarsest + self._coarsest.T) / 2.0
        alone = (a > 0.0) & (a * d > b * c)
        return bool(alone.all()) and bool(np.linalg.eigvalsh(K)[0] > 0.0)

    def __len__(self) -> int:
        """How many grids there are."""
        return len(self._levels)

    def grid(self, depth: int = 0) -> Grid:
        """The finest, or one so much coarser."""
        return self._levels[depth].grid

    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """One V-cycle from zero. What it gives out is valid until the next."""
        return self._cycled(depth, r)

    @property
    def softest(self) -> tuple[int, tuple[int, int], float]:
        """Of the coarsest grid the axis and place that gives way most to a unit load, and how
        far."""
        n = int(self._gives_way.argmax())
        i, j = (int(index[n // 2]) for index in self._at)
        return n % 2, (i, j), float(self._gives_way[n])

    def softest_field(self) -> Floats:
        """On the coarsest grid: what gives way most to forces like itself."""
        mode = np.random.default_rng(0).random(len(self._inverse))
        for _ in range(TURNS):
            mode = self._inverse @ (mode / np.abs(mode).max())
        found = self._levels[-1].grid.field(self.precision)
        found[:, self._at[0], self._at[1]] = mode.reshape(-1, 2).T
        return found

    def finer_field(self, depth: int, field: Floats) -> Floats:
        """A field of a grid on the one before it."""
        above = self._levels[depth - 1]
        found = above.grid.field(self.precision)
        coarse = field.astype(self.precision, copy=False)
        above.grid.add_coarser(coarse, above.halved, found)
        return found

    def finer_place(self, depth: int, place: tuple[int, int]) -> tuple[int, int]:
        """Where a place of a grid lies on the one before it."""
        halved = self._levels[depth - 1].halved
        i, j = (2 * n - 1 if half else n for n, half in zip(place, halved, strict=True))
        return i, j

    def _cycled(self, depth: int, b: Floats) -> Floats:
        level, kernel = self._levels[depth], kernels()
        if depth == len(self._levels) - 1:
            found = self._inverse @ b[:, self._at[0], self._at[1]].T.ravel()
            level.x[:, self._at[0], self._at[1]] = found.reshape(-1, 2).T
            return level.x
        weight, below = self.precision(WEIGHT), self._levels[depth + 1]
        kernel.relax(level.given, b, level.x, level.row, weight, True, False)
        kernel.restrict(level.given, b, level.x, level.halved, below.grid.code, below.b)
        coarse = self._cycled(depth + 1, below.b)
        level.grid.add_coarser(coarse, level.halved, level.x)
        kernel.relax(level.given, b, level.x, level.row, weight, False, True)
        return level.x


class _Level:
    """A grid with room for what a cycle does there."""

    halved = 0, 0

    def __init__(self, grid: Grid, precision: type[np.floating[Any]]) -> None:
        self.grid, self.given = grid, grid.given(precision)
        self.x, self.b = grid.field(precision), grid.field(precision)
        self.row = np.zeros((2, grid.code.shape[1]), precision)
