"""Fields over the cells of a body as pixels, for however many cells, with numpy alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.outline import CutCells

Array = NDArray[Any]
SAMPLES = 2_000_000
"""So many are taken at a time."""
MOST = 60_000_000
"""So many in all: where a body folds over itself again and again, fewer than there are pixels."""


@dataclass(frozen=True)
class Grid:
    """The pixels of a picture: `box` (left, right, bottom, top) and how many `across` and `up`."""

    box: tuple[float, float, float, float]
    across: int
    up: int

    def places(self, position: Array) -> Array:
        """Positions, (..., 2), in pixels from the lower left corner."""
        left, right, bottom, top = self.box
        scale = np.array([self.across / (right - left), self.up / (top - bottom)], np.float32)
        return np.asarray((position - np.array([left, bottom])).astype(np.float32) * scale)

    def mean(self, corners: Array, values: Array, cut: Cut | None = None) -> Array:
        """The values of cells, (up, across), between those at their corners, (cell, 4), in pixels
        (cell, 4, 2); NaN where no cell is, or what is `cut` off, and the mean where several are. No
        pixel within a cell is missed: samples lie no further apart than pixels are wide."""
        sums, counts = np.zeros(self.across * self.up), np.zeros(self.across * self.up)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(corners[cells], weights, _kept(cut, cells, middles))
            sampled = (values[cells] @ weights.T).ravel()[inside]
            sums += np.bincount(pixels, sampled, len(sums))
            counts += np.bincount(pixels, minlength=len(sums))
        with np.errstate(invalid="ignore"):
            return (sums / counts).reshape(self.up, self.across)

    def latest(self, corners: Array, values: Array, cut: Cut | None = None) -> Array:
        """The same of values that cannot be averaged: that of the nearest corner; of several in a
        pixel the largest."""
        found = np.full(self.across * self.up, -np.inf)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(corners[cells], weights, _kept(cut, cells, middles))
            nearest = values[cells][:, weights.argmax(axis=1)].ravel()[inside]
            np.maximum.at(found, pixels, nearest)
        found[np.isinf(found)] = np.nan
        return found.reshape(self.up, self.across)

    def _pixels(self, corners: Array, weights: Array, kept: Array | None) -> tuple[Array, Array]:
        """In which pixel each sample lies, and which samples lie in any; of those `kept`."""
        x, y = ((corners[..., axis] @ weights.T).ravel() for axis in (0, 1))
        there = (x >= 0) & (x < self.across) & (y >= 0) & (y < self.up)
        inside = np.flatnonzero(there if kept is None else there & kept)
        return y[inside].astype(np.int64) * self.across + x[inside].astype(np.int64), inside


@dataclass(frozen=True)
class Cut:
    """What an outline cuts off some cells: `row` (cell,) is the row of each in the cells that are
    cut, -1 where it is not."""

    cells: CutCells
    row: Array


def _kept(cut: Cut | None, cells: Array, middles: Array) -> Array | None:
    """Which samples of some cells are not cut off, (cell and sample,); None where all are."""
    rows = cut.row[cells] if cut else np.empty(0, int)
    some = np.flatnonzero(rows >= 0)
    if cut is None or not len(some):
        return None
    kept = np.ones((len(cells), len(middles) ** 2), bool)
    kept[some] = ~cut.cells.beyond(rows[some], middles).reshape(len(some), -1)
    return kept.ravel()


def _weights(middles: Array) -> Array:
    """What corners weigh in each sample, (sample, 4), at some places along both sides."""
    u, v = (part.ravel() for part in np.meshgrid(middles, middles))
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)


def _groups(corners: Array) -> Iterator[tuple[Array, Array]]:
    """Cells, by their rows, that take as many samples, and where these lie along both sides, as
    shares."""
    each = [corners[:, k] for k in range(4)]  # by columns: many times as fast as along an axis
    extent = np.maximum(*(np.maximum.reduce(each) - np.minimum.reduce(each)).T)
    finest = np.maximum(np.ceil(extent), 1.0)
    finest = np.maximum(finest * min(1.0, math.sqrt(MOST / max(1.0, (finest**2).sum()))), 1.0)
    # Rounded up to a power of the square root of two: few groups, and not many more samples.
    levels = np.ceil(2 * np.log2(finest) - 1e-6).astype(int)
    for level in np.unique(levels):
        count = math.ceil(2 ** (level / 2))
        middles = (np.arange(count, dtype=np.float32) + 0.5) / count
        cells = np.flatnonzero(levels == level)
        many = max(1, SAMPLES // count**2)
        for start in range(0, len(cells), many):
            yield cells[start : start + many], middles
