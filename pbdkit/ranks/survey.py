"""How many particles every line of sites has, found by all processes together: each counts some."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.lattice import Index
from pbdkit.scene.ground import Ground
from pbdkit.scene.others import Others, Stretch
from pbdkit.scene.places import LeftOut, hull
from pbdkit.scene.raster import EMPTY
from pbdkit.scene.sites import Lines, framed, window

SITES_AT_ONCE = 2**22
"""So many are counted at a time: what that takes does not grow with the body."""


@dataclass(frozen=True)
class Survey:
    """What all processes know of a lattice: the body's box of sites, from `low` to below `high`;
    how many particles each line of sites has, frame included, from the first on that has any; how
    many indices a repeat cell has, and how many cells neighbours reach, along the first axis; the
    cells left out at narrow voids."""

    low: Index
    high: Index
    lines: NDArray[np.int64]
    period: int
    reach: int
    layers: int
    left_out: LeftOut

    @property
    def first(self) -> int:
        """The repeat cells of the first row of the lattice, which is padding."""
        return self._start // self.period - self.reach

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """(row,): how many particles each row of repeat cells has, padding included."""
        row = (self._start + np.arange(len(self.lines))) // self.period - self.first
        rows = np.bincount(row, self.lines, row[-1] + 1 + self.reach)
        return rows.astype(np.int64)

    def stretch(self, begin: int, end: int) -> Stretch:
        """Of the rows from `begin` to below `end`."""
        first, last = self._line(begin), self._line(end)
        near, far = first - self.layers, last + self.layers
        return Stretch(
            (first, last),
            (max(self.low[0], near), *self.low[1:]),
            (min(self.high[0], far), *self.high[1:]),
            int(self.lines[: first - self._start].sum()),
            self.rows,
            self.first,
            self.left_out,
        )

    @property
    def _start(self) -> int:
        """The index i of the first line."""
        return self.low[0] - self.layers

    def _line(self, row: int) -> int:
        """The first line of sites of a row, among those with particles."""
        line = (self.first + row) * self.period
        return min(max(line, self._start), self._start + len(self.lines))


def survey(ground: Ground, others: Others, rank: int) -> Survey | None:
    """Of a body, and of its frame; None where there is no body. Each process looks at as many lines
    as the others."""
    lattice, layers = ground.experiment.lattice, ground.layers
    (first, *_), (last, *_) = low, high = window(ground.experiment.body, lattice)
    spill = layers + ground.spill
    cuts = np.linspace(first - spill, last + 1 + spill, others.size + 1).astype(int).tolist()
    across = math.prod(b - a + 1 for a, b in zip(low[1:], high[1:], strict=True))
    found = [_counted(ground, some) for some in _bands(cuts[rank : rank + 2], across)]
    every = [one for own in others.every(found) for one in own]
    boxes = [box for box, _, _ in every if box]
    if not boxes:
        return None
    lines = np.concatenate([counts for _, counts, _ in every])
    left_out = sum((cells for *_, cells in every), LeftOut())
    low, high = hull(boxes)
    begin = low[0] - layers - cuts[0]
    lines = lines[begin : high[0] + layers - cuts[0]]
    period = ground.cell.period[0]
    reach = ground.neighbourhood.reach_in_cells[0]
    return Survey(low, high, lines, period, reach, layers, left_out)


def _bands(lines: list[int], across: int) -> Iterator[Lines]:
    first, last = lines
    some = max(1, SITES_AT_ONCE // across)
    for begin in range(first, last, some):
        yield begin, min(begin + some, last)


def _counted(
    ground: Ground, lines: Lines
) -> tuple[tuple[Index, Index] | None, NDArray[np.int64], LeftOut]:
    """(box of the body, particles on each line, cells left out) of some lines."""
    first, last = lines
    counts, layers = np.zeros(last - first, np.int64), ground.layers
    filling = ground.filled((first - layers, last + layers))
    left_out = filling.left_out_on(lines)
    if not (box := filling.box):
        return None, counts, left_out
    low, kinds = framed(ground.experiment.lattice, filling.within(*box), layers)
    many = np.count_nonzero(kinds != EMPTY, axis=tuple(range(1, kinds.ndim)))
    line = np.arange(low[0], low[0] + len(many))
    own = (line >= first) & (line < last)
    counts[line[own] - first] = many[own]
    inside = [max(first, box[0][0]), min(last, box[1][0])]
    if inside[0] >= inside[1]:
        return None, counts, left_out
    return ((inside[0], *box[0][1:]), (inside[1], *box[1][1:])), counts, left_out
