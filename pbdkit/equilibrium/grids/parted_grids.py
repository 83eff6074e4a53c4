"""Multigrid over processes: each has some rows of the finer grids, all have the coarser ones.

With so many rows around its own that a cycle goes down and up without those of others: what is
right of a field shrinks by some rows a grid. They meet once a cycle where it begins, and once where
what is left comes together on the first grid that all have.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.grid import Grid, Grids, Level
from pbdkit.equilibrium.grids.multigrid import COARSEST, Multigrid
from pbdkit.equilibrium.rows import Rows
from pbdkit.equilibrium.strip import Strip

Array = NDArray[Any]
Floats = NDArray[np.floating[Any]]
SMALL = 100 * COARSEST
"""Unknowns of a grid that is not worth sharing: more than four times those of the coarsest, so that
all processes have two grids at least where any is parted."""


class PartedGrids(Grids):
    """Of a grid that each process has a strip of. Raises FloatingError where leaders leave a motion
    of the body free."""

    def __init__(self, grid: Grid, rows: Rows, strip: Strip) -> None:
        self._rows = rows
        self._levels, self._strips = [Level(grid)], [strip]
        while self._strips[-1].depth and self._unknowns() > SMALL:
            level, strip = self._levels[-1], self._strips[-1]
            level.halved = level.grid.halved(strip.count)
            strip = strip.coarser(level.halved[0])
            self._strips.append(strip)
            self._levels.append(Level(level.grid.coarser(level.halved, strip.known)))
        self.whole = Multigrid(self._joined())
        """The grids that all processes have."""

    def _unknowns(self) -> int:
        own, code = self._strips[-1].own, self._levels[-1].grid.code
        return int(2 * sum(self._rows.every(int(np.count_nonzero(code[own] >= 0)))))

    def _joined(self) -> Grid:
        """The coarsest of the parted grids, with the rows of all."""
        grid, own = self._levels[-1].grid, self._strips[-1].own
        code = grid.code[own]
        used, number = np.unique(code, return_inverse=True)
        some = used > 0
        stencils = self._rows.every(grid.stencils[used[some]])
        before = sum(map(len, stencils[: self._rows.rank]))
        renumbered = np.where(some, before + np.cumsum(some), used).astype(code.dtype)
        held = None if grid.held is None else self._together(grid.held[:, own], 1)
        return Grid(
            self._together(renumbered[number].reshape(code.shape), 0),
            self._together(grid.kind[own], 0),
            np.concatenate([grid.stencils[:1], *stencils]),
            held,
        )

    def _together(self, own: Array, axis: int) -> Array:
        return np.concatenate(self._rows.every(own), axis)

    def __len__(self) -> int:
        """With those that all have."""
        return len(self._levels) - 1 + len(self.whole)

    def grid(self, depth: int = 0) -> Grid:
        """A parted one."""
        return self._levels[depth].grid

    def is_definite(self) -> bool:
        """In all processes."""
        alone = self._levels[0].grid.is_definite_alone()
        return not self._rows.any(not alone) and self.whole.is_definite()

    def cycle(self, r: Floats, depth: int = 0) -> Floats:
        """From the finest grid; renews the halo of r. What comes out is right in own rows and in
        the one before and after them."""
        assert depth == 0
        self._rows.meet(r)
        given = [r, *(level.b for level in self._levels[1:])]
        for b, (level, below) in zip(given, pairwise(self._levels), strict=False):
            level.down(b, below)
        strip = self._strips[-1]
        found = self.whole.cycle(self._together(given[-1][:, strip.own], 1))
        low, rows = strip.low, given[-1].shape[1]
        x = np.ascontiguousarray(found[:, low : low + rows])
        for level, b in zip(self._levels[-2::-1], given[-2::-1], strict=True):
            level.up(b, x)
            x = level.x
        return x


def grids_of(grid: Grid, rows: Rows) -> Multigrid | PartedGrids:
    """Those of the finest."""
    return PartedGrids(grid, rows, rows.strip) if rows.strip else Multigrid(grid)
