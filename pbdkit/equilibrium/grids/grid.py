"""One grid of stencils, the coarser one that follows from it, and what a cycle does on it.

The functions of a coarser grid are bilinear hats; its stencils are what those of the finer one do
to them (Galerkin). Where one direction is much stiffer, only that one is made coarser.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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
from pbdkit.equilibrium.grids.stencil_matrix import OUTSIDE, OWN, inverses
from pbdkit.equilibrium.strip import coarser_size, outside

Floats = NDArray[np.floating[Any]]
PRECISION = np.float32
"""Of cycles."""
WEIGHT = 0.8
"""Of a relaxation; below 1, since the places of a row do not know of each other."""
STIFFER = 3.0
"""So many times stiffer, a direction is made coarser alone."""
NARROW = 5
"""Places across, with the ring around, at which a grid is not made narrower."""
EVERY = slice(None)


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

    def halved(self, rows: int) -> tuple[int, int]:
        """Along which axes the next grid has half the places, of a lattice of so many rows."""
        along = [np.abs(_stiffness(self.stencils[0], axis)) for axis in range(2)]
        columns = self.code.shape[1]
        if rows <= NARROW or columns <= NARROW:
            return int(rows > columns), int(columns >= rows)
        if max(along) <= STIFFER * min(along):
            return 1, 1
        return int(along[0] > along[1]), int(along[1] > along[0])

    def coarser(self, halved: tuple[int, int], known: slice = EVERY) -> Grid:
        """The next grid, as far as it is known: some of its rows."""
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
            return Grid(code, kind, stencils)
        held = coarser_held(self.kind, self.held, halved, kind)
        code, stencils, _ = with_held(code, stencils, held)
        return Grid(code, kind, stencils, held)

    def add_coarser(self, coarse: Floats, halved: tuple[int, int], x: Floats) -> None:
        """x += P coarse."""
        kernels().prolong(*self.lists[:5], coarse, halved, x)
        if self.held is not None:
            x[self.held] = 0.0

    def is_definite_alone(self) -> bool:
        """Whether the matrix is positive at each place by itself, where it is symmetric."""
        a, b, c, d = self.stencils[:, OWN].T
        return bool(((a > 0.0) & (a * d > b * c)).all())

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


class Level:
    """A grid with room for what a cycle does there, in single precision; `halved` tells along which
    axes the next one has half the places."""

    def __init__(self, grid: Grid, halved: tuple[int, int] = (0, 0)) -> None:
        self.grid, self.given, self.halved = grid, grid.given(PRECISION), halved
        self.x, self.b = grid.field(PRECISION), grid.field(PRECISION)
        self._row = np.zeros((2, grid.code.shape[1]), PRECISION)

    def down(self, b: Floats, below: Level) -> None:
        """Relaxes K x = b from zero; what is left goes to the next grid."""
        kernel, x = kernels(), self.x
        kernel.relax(self.given, b, x, self._row, PRECISION(WEIGHT), True, False)
        kernel.restrict(self.given, b, x, self.halved, below.grid.code, below.b)

    def up(self, b: Floats, coarse: Floats) -> None:
        """Adds what the next grid has found, and relaxes."""
        self.grid.add_coarser(coarse, self.halved, self.x)
        kernels().relax(self.given, b, self.x, self._row, PRECISION(WEIGHT), False, True)


class Grids(ABC):
    """A grid and ever coarser ones: ``cycle(r)`` approximates K⁻¹ r, in single precision."""

    @abstractmethod
    def __len__(self) -> int:
        """How many grids there are."""

    @abstractmethod
    def grid(self, depth: int = 0) -> Grid:
        """The finest, or one so much coarser."""

    @abstractmethod
    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """One V-cycle from zero. What it gives out is valid until the next."""

    @abstractmethod
    def is_definite(self) -> bool:
        """Whether a symmetric matrix is positive, as the coarsest grid and each place by itself
        tell."""


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
