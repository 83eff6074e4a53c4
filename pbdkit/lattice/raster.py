"""Particles on padded rasters, one raster a sublattice, in the order of their numbers; blocks and
lists of places on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import add, lt, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.plugin import Cell, Lattice, Offset, Slot
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.vector import vector

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


Box = tuple[tuple[Any, ...], tuple[Any, ...]]


@dataclass(frozen=True)
class Stretch:
    """Some `lines` of sites of a lattice, from the first to below the second; `before` particles
    are before them. What of the body is near lies from the site `low` to below `high`. `rows` are
    the particles of each row of repeat cells of the lattice, padding included, from the cells
    `first` on. `left_out` are the cells left out at narrow voids, of the whole."""

    lines: tuple[int, int]
    low: Index
    high: Index
    before: int
    rows: NDArray[np.int64]
    first: int
    left_out: LeftOut


@dataclass(frozen=True)
class RowRange:
    """The part of a lattice that one of several processes builds: a `stretch` of it, of which the
    lines of sites in `own` are its own, and those in `framed` have frame points that it needs."""

    stretch: Stretch
    own: tuple[int, int]
    framed: tuple[int, int]


EMPTY, LEADER, FOLLOWER, FRAME = -1, 0, 1, 2
NOWHERE = np.iinfo(np.int64).max
"""Beyond all site indices."""
CHUNK_ROWS = 65536
"""Rows of the table that are made at a time, so that temporaries stay small."""


@dataclass(frozen=True)
class RowLayout:
    """How many particles each row of repeat cells of a lattice has, padding included, and how many
    rows are `before` those of a raster."""

    rows: NDArray[np.int64]
    before: int

    @cached_property
    def particles(self) -> int:
        """In all."""
        return int(self.rows.sum())


@dataclass(frozen=True)
class Raster:
    """Every particle twice over: as a row of the table, and as a place on a raster.

    `shape` is (sublattices, cells, cells), `first` the repeat cell at place (0, 0), `kind` the kind
    at each place with EMPTY where no particle is (leaders count as followers here). `sites` is the
    same by site index (i, j) from `low` on; its particles, i then j, are the rows of the table in
    the order of their numbers, which count from 1 and those `before` the first row. Where it has
    some rows of a lattice alone, `extent` is that of the whole, and `row_range` what is built.
    """

    lattice: Lattice
    shape: tuple[int, ...]
    first: Index
    kind: NDArray[np.int8]
    low: Index
    sites: NDArray[np.int8]
    before: int = 0
    extent: RowLayout | None = None
    communicator: Communicator = SERIAL
    row_range: RowRange | None = None

    @cached_property
    def count(self) -> int:
        """The number of particles, frame included."""
        return int(np.count_nonzero(self.sites != EMPTY))

    @property
    def total(self) -> int:
        """The same of the whole lattice."""
        return self.extent.particles if self.extent else self.count

    @property
    def whole_shape(self) -> tuple[int, ...]:
        """The shape of the raster of the whole lattice."""
        rows = len(self.extent.rows) if self.extent else self.shape[1]
        return (self.shape[0], rows, *self.shape[2:])

    @property
    def row_counts(self) -> NDArray[np.int64]:
        """(row,): the particles in each row of repeat cells of the whole lattice."""
        if self.extent:
            return self.extent.rows
        others = (0, *range(2, self.kind.ndim))
        return np.asarray(np.count_nonzero(self.kind != EMPTY, axis=others))

    def is_own(self, lines: Indices) -> Mask:
        """Return which lines of sites are this process's own; each is that of one process."""
        low, high = self.row_range.own if self.row_range else (-NOWHERE, NOWHERE)
        return (lines >= low) & (lines < high)

    def sees_frame(self, lines: Indices) -> Mask:
        """Return on which lines of sites this process needs to know whom frame points follow."""
        low, high = self.row_range.framed if self.row_range else (-NOWHERE, NOWHERE)
        return (lines >= low) & (lines < high)

    def hull_of_all(self, boxes: Iterable[Box]) -> Box:
        """Return the smallest and the largest number along each axis, over the boxes of all
        processes."""
        return hull(box for own in self.communicator.allgather(list(boxes)) for box in own)

    @cached_property
    def _full(self) -> bool:
        """Whether every site of the window is a particle: rows then follow from indices."""
        return self.count == self.sites.size

    @cached_property
    def _flat_sites(self) -> Indices:
        """(particle,): the place in the window of each row, where that is not the row itself."""
        return np.flatnonzero(self.sites != EMPTY)

    @cached_property
    def table_kind(self) -> NDArray[np.int8]:
        """(particle,): FOLLOWER or FRAME."""
        flat = self.sites.ravel()
        return flat if self._full else flat[self._flat_sites]

    @property
    def body_rows(self) -> Indices:
        """The rows of leaders and followers."""
        return np.flatnonzero(self.table_kind == FOLLOWER)

    def body_ends(self) -> NDArray[np.float64]:
        """X, (end, axis), of the first and the last of them, without a table of all."""
        body = self.table_kind == FOLLOWER
        ends = self.reference(np.array([body.argmax(), len(body) - 1 - body[::-1].argmax()]))
        every = self.communicator.allgather(ends)
        return np.stack([every[0][0], every[-1][1]])

    def chunks(self) -> Iterator[Indices]:
        """All rows, some at a time."""
        for begin in range(0, self.count, CHUNK_ROWS):
            yield np.arange(begin, min(begin + CHUNK_ROWS, self.count))

    def site_of(self, rows: Indices) -> NDArray[np.int64]:
        """(row, index): the site (i, j) of some rows."""
        place = rows if self._full else self._flat_sites[rows]
        return np.stack(np.unravel_index(place, self.sites.shape), axis=1) + self.low

    def _of_all(self, values: Callable[[Indices], Any], columns: int, dtype: Any) -> NDArray[Any]:
        """(particle, column): what is told of some rows at a time."""
        out = np.empty((self.count, columns), dtype)
        for rows in self.chunks():
            out[rows[0] : rows[-1] + 1] = values(rows)
        return out

    def site_table(self) -> NDArray[np.int32]:
        """(particle, index): the sites (i, j) of all rows."""
        return self._of_all(self.site_of, self.sites.ndim, np.int32)

    def cells_of(self, rows: Indices) -> tuple[Indices, ...]:
        """(sublattice, repeat cell, repeat cell) of some rows."""
        return cells_of_sites(self.lattice.cell(), *self.site_of(rows).T)

    def place_of(self, rows: Indices) -> Indices:
        """The flat place of some rows on the raster."""
        s, *cells = self.cells_of(rows)
        return np.ravel_multi_index((s, *map(sub, cells, self.first)), self.shape)

    def rows_at(self, s: int | Indices, *cells: Indices) -> Indices:
        """The rows of the particles at (sublattice, raster cell, raster cell); -1 where none is."""
        cell = self.lattice.cell()
        index = np.array([site.index for site in cell.sites])
        whole = np.stack(cells, axis=-1) + self.first
        return self.rows_of_sites(whole * cell.period + index[s])

    def rows_of_sites(self, site: NDArray[Any]) -> Indices:
        """The row of the particle at each site (i, j), (entry, index); -1 where there is none."""
        place = site.astype(np.intp) - self.low
        inside = ((place >= 0) & (place < self.sites.shape)).all(axis=-1)
        rows = np.full(inside.shape, -1, np.intp)
        flat = np.ravel_multi_index(tuple(place[inside].T), self.sites.shape)
        if self._full:
            rows[inside] = flat
        else:
            there = self.sites.ravel()[flat] != EMPTY
            rows[inside] = np.where(there, np.searchsorted(self._flat_sites, flat), -1)
        return rows

    def reference(self, rows: Indices | None = None) -> NDArray[np.float64]:
        """X, (particle, axis), of all particles or of some rows."""
        if rows is None:
            return self._of_all(self.reference, self.sites.ndim, np.float64)
        offsets = positions(self.lattice.cell(), *self.cells_of(rows))
        return np.stack(offsets, axis=1) + self.lattice.origin

    def reference_planes(self, where: Where) -> Any:
        """X from the lattice's site (0, 0), a plane a component."""
        s: Any
        if isinstance(where, Places):
            s, *cells = np.unravel_index(where.place, self.shape)
        else:
            s, *cells = where.sublattice, *np.ogrid[where.slices()[1:]]
        cells = [c + first for c, first in zip(cells, self.first, strict=True)]
        return positions(self.lattice.cell(), s, *cells)

    def table(self, u: NDArray[Any]) -> NDArray[Any]:
        """(particle, axis): the values of planes u, (axis, sublattice, cell, cell), by number."""
        if not self._full:
            flat = u.reshape(len(u), -1)
            return self._of_all(lambda rows: flat.take(self.place_of(rows), 1).T, len(u), u.dtype)
        out = np.empty((*self.sites.shape, len(u)), u.dtype)
        cell = self.lattice.cell()
        for s, site in enumerate(cell.sites):
            skip = np.subtract(site.index, self.low) % cell.period
            own = out[tuple(slice(n, None, p) for n, p in zip(skip, cell.period, strict=True))]
            begin = np.add(self.low, skip) // cell.period - self.first
            there = tuple(map(slice, begin, begin + own.shape[:-1]))
            for axis, plane in enumerate(u):
                own[..., axis] = plane[s][there]
        return out.reshape(-1, len(u))

    def ends_of_lines(self, axis: int, *, last: bool) -> Indices:
        """The rows of the body's first or last particles on every line of sites along an axis."""
        body = np.moveaxis(self.sites == FOLLOWER, axis, 0)
        end = (body[::-1] if last else body).argmax(axis=0)
        end = self.low[axis] + (len(body) - 1 - end if last else end)
        if axis == 0:  # other processes have other places on these lines
            far = np.where(body.any(axis=0), -end if last else end, NOWHERE)
            far = self.communicator.smallest(far)
            some, end = far < NOWHERE, -far if last else far
        else:
            some = body.any(axis=0)
        lines = np.argwhere(some) + np.delete(self.low, axis)
        rows = self.rows_of_sites(np.insert(lines, axis, end[some], axis=1))
        return rows[rows >= 0]

    def ends_of_rows(self, sublattice: int) -> list[Indices]:
        """The repeat cells, index by index, of the body's first and last particle of a sublattice
        in every row of cells along the last axis: places rise or fall between them."""
        body = self.kind[sublattice] == FOLLOWER
        some = np.nonzero(body.any(axis=-1))
        first = body.argmax(axis=-1)[some]
        last = body.shape[-1] - 1 - body[..., ::-1].argmax(axis=-1)[some]
        cells = [*(np.tile(index, 2) for index in some), np.concatenate([first, last])]
        return [c + n for c, n in zip(cells, self.first, strict=True)]

    def body_block(self, sublattice: int) -> Block | None:
        """The smallest block that holds the body's particles of that sublattice, if any."""
        found = bounds(self.kind[sublattice] == FOLLOWER)
        return Block(sublattice, *found) if found else None


def positions(cell: Cell, s: int | Indices, *cells: Indices) -> Any:
    """Sublattice s in the repeat cell (m, n), from site (0, 0): at + m·a + n·b."""
    at = np.array([site.at for site in cell.sites])
    return vector(at[s, axis] + part for axis, part in enumerate(cell.shift(cells)))


def cells_of_sites(cell: Cell, *site: Indices) -> tuple[Indices, ...]:
    """(sublattice, repeat cell, repeat cell) of the sites (i, j); sublattice -1 at a hole."""
    within = tuple(i % p for i, p in zip(site, cell.period, strict=True))
    return sublattices(cell)[within], *(i // p for i, p in zip(site, cell.period, strict=True))


def sublattices(cell: Cell) -> Indices:
    """(period, period): the sublattice of each index of the cell, -1 where it has no site."""
    found = np.full(cell.period, -1, np.intp)
    for s, site in enumerate(cell.sites):
        found[site.index] = s
    return found
