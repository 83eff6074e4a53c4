"""Some particles of one sublattice of a raster: a rectangle of cells, or flat places."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import add, lt, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Offset, Slot
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def distinct(numbers: NDArray[np.integer[Any]]) -> Indices:
    """Those that occur, from 0 on, sorted: np.unique loads numpy.ma, a tenth of a small `check`."""
    ordered = np.sort(numbers).astype(np.intp, copy=False)
    return ordered[np.diff(ordered, prepend=-1) > 0]


@dataclass(frozen=True)
class LeftOut:
    """Cells left out because they would connect two sides of a void: their `count`, and the site of
    the first corner of the `first` of them, in the order of sites."""

    count: int = 0
    first: Index | None = None

    @classmethod
    def of(cls, sites: Indices) -> LeftOut:
        """Those with some first corners, (cell, axis)."""
        return cls(len(sites), min(map(tuple, sites.tolist()), default=None))

    def __add__(self, other: LeftOut) -> LeftOut:
        """All of both."""
        first = min((one.first for one in (self, other) if one.first), default=None)
        return LeftOut(self.count + other.count, first)


@dataclass(frozen=True)
class Block:
    """A rectangle of repeat cells of one sublattice; `stop` is excluded."""

    sublattice: int
    start: Index
    stop: Index

    def slices(self) -> tuple[Any, ...]:
        """Where it lies in an array (sublattice, cell, cell)."""
        return (self.sublattice, *map(slice, self.start, self.stop))

    def seen_through(self, slot: Slot | Offset) -> Block:
        """The block of the neighbours at that slot, or of the sites at that offset."""
        start, stop = (tuple(map(add, end, slot.cell)) for end in (self.start, self.stop))
        return Block(slot.target, start, stop)

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., sublattice, cell, cell) here, as a view."""
        return values[(..., *self.slices())]

    def within(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., cell, cell) here, as a view."""
        return values[(..., *self.slices()[1:])]

    def rows(self, cells: int) -> list[Block]:
        """The block cut along its first axis into parts of about so many cells."""
        (first, *start), (last, *stop) = self.start, self.stop
        step = max(1, cells // max(1, math.prod(map(sub, stop, start))))
        return [
            Block(self.sublattice, (i, *start), (min(i + step, last), *stop))
            for i in range(first, last, step)
        ]


@dataclass(frozen=True)
class Places:
    """Some particles of one sublattice by their flat place on rasters of a shape; they can be asked
    as a Block can."""

    shape: tuple[int, ...]
    place: Indices

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., sublattice, cell, cell) here."""
        flat = values.reshape(*values.shape[: values.ndim - len(self.shape)], -1)
        found: NDArray[Any] = flat[..., self.place]
        return found

    def within(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., cell, cell) here."""
        flat = values.reshape(*values.shape[: values.ndim - len(self.shape) + 1], -1)
        found: NDArray[Any] = flat[..., self.place % math.prod(self.shape[1:])]
        return found

    def seen_through(self, slot: Slot | Offset) -> Places:
        """The neighbours at that slot; `step` away."""
        return Places(self.shape, self.place + slot_step(self.shape, slot))


def bounds(mask: Mask) -> tuple[Index, Index] | None:
    """(start, stop) of the smallest rectangle around all that is true; None where nothing is."""
    axes = range(mask.ndim)
    some = [np.flatnonzero(mask.any(axis=tuple({*axes} - {axis}))) for axis in axes]
    if not len(some[0]):
        return None
    return tuple(int(n[0]) for n in some), tuple(int(n[-1]) + 1 for n in some)


def hull(boxes: Iterable[tuple[Sequence[Any], Sequence[Any]]]) -> tuple[Any, Any]:
    """The smallest and the largest number along each axis over some (low, high), as tuples."""
    low, high = zip(*boxes, strict=True)
    return tuple(map(min, zip(*low, strict=True))), tuple(map(max, zip(*high, strict=True)))


def common(one: Block, other: Block) -> Block | None:
    """The places of one sublattice that two blocks share, if any."""
    start = tuple(map(max, one.start, other.start))
    stop = tuple(map(min, one.stop, other.stop))
    return Block(one.sublattice, start, stop) if all(map(lt, start, stop)) else None


Where = Block | Places
"""Some particles of one sublattice."""


def slot_step(shape: tuple[int, ...], slot: Slot | Offset) -> int:
    """From a flat place of rasters to that of the neighbour at a slot."""
    source = slot.source if isinstance(slot, Slot) else slot.target
    step = slot.target - source
    for size, cells in zip(shape[1:], slot.cell, strict=True):
        step = step * size + cells
    return step
