"""Multigrid on a lattice: ever coarser grids of stencils, and one V-cycle over them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.grid import PRECISION, Grid, Grids, Level

Floats = NDArray[np.floating[Any]]
COARSEST = 200
"""Unknowns below which a grid is solved with its inverse."""
TURNS = 30
"""Of the inverse iteration on the coarsest grid."""
SINGULAR = 1e-12
"""One part of what the inverse of the coarsest grid may magnify; a body that is not held gives way
without end."""


class FloatingError(Exception):
    """Something of the body is not held."""


class Multigrid(Grids):
    """All of a grid and ever coarser ones, in this process.

    Raises FloatingError where leaders leave a motion of the body free.
    """

    def __init__(self, grid: Grid) -> None:
        self._levels = [Level(grid)]
        while grid.unknowns > COARSEST:
            halved = self._levels[-1].halved = grid.halved(len(grid.code))
            grid = grid.coarser(halved)
            self._levels.append(Level(grid))
        self._at, K = grid.matrix()
        try:
            inverse = np.linalg.inv(K)
        except np.linalg.LinAlgError:
            raise FloatingError from None
        if not np.abs(inverse).max() * np.abs(K).max() * SINGULAR < 1.0:
            raise FloatingError
        self._coarsest = K
        self._inverse, self._gives_way = inverse.astype(PRECISION), inverse.diagonal()

    def is_definite(self) -> bool:
        """Whether a symmetric matrix is positive, as the coarsest grid and each place by itself
        tell: one that is not there is not on the finest either."""
        K = (self._coarsest + self._coarsest.T) / 2.0
        return self.grid().is_definite_alone() and bool(np.linalg.eigvalsh(K)[0] > 0.0)

    def __len__(self) -> int:
        """With the coarsest."""
        return len(self._levels)

    def grid(self, depth: int = 0) -> Grid:
        """The finest, or one so much coarser."""
        return self._levels[depth].grid

    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """On all grids from there on."""
        level = self._levels[depth]
        if depth == len(self._levels) - 1:
            found = self._inverse @ r[:, self._at[0], self._at[1]].T.ravel()
            level.x[:, self._at[0], self._at[1]] = found.reshape(-1, 2).T
            return level.x
        below = self._levels[depth + 1]
        level.down(r, below)
        level.up(r, self.cycle(below.b, depth + 1))
        return level.x

    @property
    def whole(self) -> Multigrid:
        """All of them."""
        return self

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
        found = self._levels[-1].grid.field(PRECISION)
        found[:, self._at[0], self._at[1]] = mode.reshape(-1, 2).T
        return found

    def finer_field(self, depth: int, field: Floats) -> Floats:
        """A field of a grid on the one before it."""
        above = self._levels[depth - 1]
        found = above.grid.field(PRECISION)
        coarse = field.astype(PRECISION, copy=False)
        above.grid.add_coarser(coarse, above.halved, found)
        return found

    def finer_place(self, depth: int, place: tuple[int, int]) -> tuple[int, int]:
        """Where a place of a grid lies on the one before it."""
        halved = self._levels[depth - 1].halved
        i, j = (2 * n - 1 if half else n for n, half in zip(place, halved, strict=True))
        return i, j
