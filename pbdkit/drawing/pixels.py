"""Fields over the cells of a body as pixels, for however many cells, with numpy alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

    def mean(self, corners: Array, values: Array) -> Array:
        """The values of cells, (up, across), between those at their corners, (cell, 4), in pixels
        (cell, 4, 2); NaN where no cell is, and the mean where several are. No pixel within a cell
        is missed: samples lie no further apart than pixels are wide."""
        sums, counts = np.zeros(self.across * self.up), np.zeros(self.across * self.up)
        for cells, weights in _groups(corners):
            pixels, inside = self._pixels(corners[cells], weights)
            sampled = (values[cells] @ weights.T).ravel()[inside]
            sums += np.bincount(pixels, sampled, len(sums))
            counts += np.bincount(pixels, minlength=len(sums))
        with np.errstate(invalid="ignore"):
            return (sums / counts).reshape(self.up, self.across)

    def latest(self, corners: Array, values: Array) -> Array:
        """The same of values that cannot be averaged: that of the nearest corner; of several in a
        pixel the largest."""
        found = np.full(self.across * self.up, -np.inf)
        for cells, weights in _groups(corners):
            pixels, inside = self._pixels(corners[cells], weights)
            nearest = values[cells][:, weights.argmax(axis=1)].ravel()[inside]
            np.maximum.at(found, pixels, nearest)
        found[np.isinf(found)] = np.nan
        return found.reshape(self.up, self.across)

    def _pixels(self, corners: Array, weights: Array) -> tuple[Array, Array]:
        """In which pixel each sample lies, and which samples lie in any."""
        x, y = ((corners[..., axis] @ weights.T).ravel() for axis in (0, 1))
        inside = np.flatnonzero((x >= 0) & (x < self.across) & (y >= 0) & (y < self.up))
        return y[inside].astype(np.int64) * self.across + x[inside].astype(np.int64), inside


def _groups(corners: Array) -> Iterator[tuple[Array, Array]]:
    """Cells, by their rows, that take as many samples, with what corners weigh in each sample,
    (sample, 4)."""
    each = [corners[:, k] for k in range(4)]  # by columns: many times as fast as along an axis
    extent = np.maximum(*(np.maximum.reduce(each) - np.minimum.reduce(each)).T)
    finest = np.maximum(np.ceil(extent), 1.0)
    finest = np.maximum(finest * min(1.0, math.sqrt(MOST / max(1.0, (finest**2).sum()))), 1.0)
    # Rounded up to a power of the square root of two: few groups, and not many more samples.
    levels = np.ceil(2 * np.log2(finest) - 1e-6).astype(int)
    for level in np.unique(levels):
        count = math.ceil(2 ** (level / 2))
        middle = (np.arange(count, dtype=np.float32) + 0.5) / count
        u, v = (part.ravel() for part in np.meshgrid(middle, middle))
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
        cells = np.flatnonzero(levels == level)
        many = max(1, SAMPLES // count**2)
        for start in range(0, len(cells), many):
            yield cells[start : start + many], weights
