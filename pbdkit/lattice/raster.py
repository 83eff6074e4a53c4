"""Particles on padded rasters, one raster for each sublattice. A block is a rectangle of places on
a raster; lists of places are supported too.

The rows of the particle table have the order of the particle numbers.
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

from pbdkit.array_types import Array, Indices, Mask
from pbdkit.communicator import SERIAL, Communicator
from pbdkit.plugin import Cell, Lattice, Offset, Slot
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.vector import Vector, vector


def distinct(numbers: NDArray[np.integer[Any]]) -> Indices:
    """Return the distinct values of an array of nonnegative integers, sorted.

    numpy.unique is not used, because it imports numpy.ma. This would take a tenth of the time of
    `pbdkit check` for a small experiment.
    """
    ordered = np.sort(numbers).astype(np.intp, copy=False)
    return ordered[np.diff(ordered, prepend=-1) > 0]


@dataclass(frozen=True)
class OmittedCells:
    """Cells omitted because they would connect two sides of a void.

    Parameters
    ----------
    count
        Number of cells.
    first
        Site of the first corner of the first cell, in the order of sites.
    """

    count: int = 0
    first: Index | None = None

    @classmethod
    def of(cls, sites: Indices) -> OmittedCells:
        """Count omitted cells, given the sites of their first corners in an array of shape (cell,
        axis)."""
        return cls(len(sites), min(map(tuple, sites.tolist()), default=None))

    def __add__(self, other: OmittedCells) -> OmittedCells:
        """Add the numbers of cells, and take the smaller one of the two first sites."""
        sites = [cells.first for cells in (self, other) if cells.first]
        return OmittedCells(self.count + other.count, min(sites, default=None))


@dataclass(frozen=True)
class Block:
    """Rectangle of repeat cells of one sublattice, from `start` to `stop`, which is excluded."""

    sublattice: int
    start: Index
    stop: Index

    def slices(self) -> tuple[Any, ...]:
        """Return the index of the block in an array (sublattice, cell, cell)."""
        return self._index[1:]

    @cached_property
    def _index(self) -> tuple[Any, ...]:
        """Index of the block in an array of shape (..., sublattice, cell, cell)."""
        return (..., self.sublattice, *map(slice, self.start, self.stop))

    @cached_property
    def _index_within(self) -> tuple[Any, ...]:
        """Index of the block in an array of shape (..., cell, cell)."""
        return (..., *map(slice, self.start, self.stop))

    def seen_through(self, slot: Slot | Offset) -> Block:
        """Return the block that contains, for each particle of this block, its neighbour along a
        slot or the site at an offset from it."""
        start, stop = (tuple(map(add, end, slot.cell)) for end in (self.start, self.stop))
        return Block(slot.target, start, stop)

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return a view of the values on the block, given an array of shape (..., sublattice, cell,
        cell)."""
        view: NDArray[Any] = values[self._index]
        return view

    def within(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return a view of the values on the block, given an array of shape (..., cell, cell)."""
        view: NDArray[Any] = values[self._index_within]
        return view

    def rows(self, cells: int) -> list[Block]:
        """Divide the block along its first axis into parts of about `cells` cells."""
        (first, *start), (last, *stop) = self.start, self.stop
        step = max(1, cells // max(1, math.prod(map(sub, stop, start))))
        return [
            Block(self.sublattice, (i, *start), (min(i + step, last), *stop))
            for i in range(first, last, step)
        ]


@dataclass(frozen=True)
class Places:
    """Particles of one sublattice, given by their flat places on rasters of the given shape.

    Has the methods of Block.
    """

    shape: tuple[int, ...]
    place: Indices

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values at the places, given an array of shape (..., sublattice, cell,
        cell)."""
        flat = values.reshape(*values.shape[: values.ndim - len(self.shape)], -1)
        result: NDArray[Any] = flat[..., self.place]
        return result

    def within(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values at the places, given an array of shape (..., cell, cell)."""
        flat = values.reshape(*values.shape[: values.ndim - len(self.shape) + 1], -1)
        result: NDArray[Any] = flat[..., self.place % math.prod(self.shape[1:])]
        return result

    def seen_through(self, slot: Slot | Offset) -> Places:
        """Return, for each of the places, the place of its neighbour along a slot or of the site at
        an offset from it."""
        return Places(self.shape, self.place + slot_step(self.shape, slot))


def bounds(mask: Mask) -> tuple[Index, Index] | None:
    """Return (start, stop) of the smallest rectangle around all true entries, or None if there is
    none.
    """
    axes = range(mask.ndim)
    indices = [np.flatnonzero(mask.any(axis=tuple({*axes} - {axis}))) for axis in axes]
    if not len(indices[0]):
        return None
    return tuple(int(n[0]) for n in indices), tuple(int(n[-1]) + 1 for n in indices)


def hull(boxes: Iterable[tuple[Sequence[Any], Sequence[Any]]]) -> tuple[Any, Any]:
    """Return, as tuples, the smallest `low` and the largest `high` along each axis over several
    boxes (low, high).
    """
    low, high = zip(*boxes, strict=True)
    return tuple(map(min, zip(*low, strict=True))), tuple(map(max, zip(*high, strict=True)))


def common(block: Block, other: Block) -> Block | None:
    """Return the intersection of two blocks of one sublattice, or None if it is empty."""
    start = tuple(map(max, block.start, other.start))
    stop = tuple(map(min, block.stop, other.stop))
    return Block(block.sublattice, start, stop) if all(map(lt, start, stop)) else None


Where = Block | Places
"""Type of a set of particles of one sublattice."""


def slot_step(shape: tuple[int, ...], slot: Slot | Offset) -> int:
    """Return the index offset from a particle to its neighbour along a slot, on flattened
    rasters."""
    source = slot.source if isinstance(slot, Slot) else slot.target
    step = slot.target - source
    for size, cells in zip(shape[1:], slot.cell, strict=True):
        step = step * size + cells
    return step


Box = tuple[tuple[Any, ...], tuple[Any, ...]]
"""Type of a box, (low, high)."""


@dataclass(frozen=True)
class Stretch:
    """Range of lines of sites of a lattice that a process builds.

    Parameters
    ----------
    lines
        First line of the range, and the line after the last one.
    low, high
        Range of site indices, `high` excluded, that contains the particles of the body on these
        lines and near them.
    particle_offset
        Number of particles before the range.
    rows
        Number of particles of each row of repeat cells of the whole lattice, padding included.
    first
        Repeat cell of the first of these rows.
    left_out
        Cells of the whole lattice that are omitted at narrow voids.
    """

    lines: tuple[int, int]
    low: Index
    high: Index
    particle_offset: int
    rows: NDArray[np.int64]
    first: int
    left_out: OmittedCells


@dataclass(frozen=True)
class RowRange:
    """Part of a lattice that one of several processes builds.

    Parameters
    ----------
    stretch
        Range of lines of sites.
    own
        Range of the lines that belong to this process.
    framed
        Range of lines of sites. For the frame points on these lines, this process determines the
        body particles that they follow.
    """

    stretch: Stretch
    own: tuple[int, int]
    framed: tuple[int, int]


EMPTY = -1
"""Kind of a place without a particle."""
LEADER = 0
"""Kind of a leader."""
FOLLOWER = 1
"""Kind of a follower."""
FRAME = 2
"""Kind of a frame point."""
NOWHERE = np.iinfo(np.int64).max
"""Site index larger than any that occurs."""
CHUNK_ROWS = 65536
"""Number of table rows that are processed together. It limits the size of temporary arrays."""


@dataclass(frozen=True)
class RowLayout:
    """Size of the whole lattice, for a raster that holds a part of it.

    Parameters
    ----------
    rows
        Number of particles of each row of repeat cells, padding included.
    row_offset
        Number of rows of the lattice before the first row of the raster.
    """

    rows: NDArray[np.int64]
    row_offset: int

    @cached_property
    def particles(self) -> int:
        """Number of particles of the whole lattice."""
        return int(self.rows.sum())


@dataclass(frozen=True)
class Raster:
    """Particles of a lattice, as rows of a table and as places on a raster.

    Parameters
    ----------
    lattice
        The lattice.
    shape
        Shape of the raster, (sublattices, cells, cells).
    first
        Repeat cell at place (0, 0).
    kind
        Kind at each place: EMPTY, FOLLOWER or FRAME. Leaders count as followers.
    low
        Site index (i, j) of the first entry of `sites`.
    sites
        Kind by site index. The rows of the table are the particles, ordered by i, then j.
    particle_offset
        Number of particles of the whole lattice before the first row. Row k has the number
        `particle_offset` + k + 1.
    extent
        Size of the whole lattice if the raster holds a part of it.
    communicator
        Processes that hold the other parts.
    row_range
        Part of the lattice that this process builds; None for the whole lattice.
    """

    lattice: Lattice
    shape: tuple[int, ...]
    first: Index
    kind: NDArray[np.int8]
    low: Index
    sites: NDArray[np.int8]
    particle_offset: int = 0
    extent: RowLayout | None = None
    communicator: Communicator = SERIAL
    row_range: RowRange | None = None

    @cached_property
    def cell(self) -> Cell:
        """Repeat cell of the lattice."""
        return self.lattice.cell()

    @cached_property
    def count(self) -> int:
        """Number of particles, including those of the frame."""
        return int(np.count_nonzero(self.sites != EMPTY))

    @property
    def total(self) -> int:
        """Number of particles of the whole lattice, including those of the frame."""
        return self.extent.particles if self.extent else self.count

    @property
    def whole_shape(self) -> tuple[int, ...]:
        """Shape of the raster of the whole lattice."""
        rows = len(self.extent.rows) if self.extent else self.shape[1]
        return (self.shape[0], rows, *self.shape[2:])

    @property
    def row_counts(self) -> NDArray[np.int64]:
        """Number of particles in each row of repeat cells of the whole lattice, (row,)."""
        if self.extent:
            return self.extent.rows
        axes = (0, *range(2, self.kind.ndim))
        return np.asarray(np.count_nonzero(self.kind != EMPTY, axis=axes))

    def is_own(self, lines: Indices) -> Mask:
        """Return a mask of the lines of sites that belong to this process; each line belongs to one
        process."""
        low, high = self.row_range.own if self.row_range else (-NOWHERE, NOWHERE)
        return (lines >= low) & (lines < high)

    def sees_frame(self, lines: Indices) -> Mask:
        """Return a mask of lines. For the frame points on these lines, this process determines the
        body particles that they follow."""
        low, high = self.row_range.framed if self.row_range else (-NOWHERE, NOWHERE)
        return (lines >= low) & (lines < high)

    def hull_of_all(self, boxes: Iterable[Box]) -> Box:
        """Return the smallest and the largest coordinate along each axis over the boxes of all
        processes."""
        return hull(box for part in self.communicator.allgather(list(boxes)) for box in part)

    def body_box(self) -> tuple[Vector[float], Vector[float]]:
        """Return the lower and the upper corner of the bounding box of the body, relative to site
        (0, 0) of the lattice."""
        ends = (self.ends_of_rows(s) for s in range(self.shape[0]))
        at = [positions(self.cell, s, *cells) for s, cells in enumerate(ends)]
        lower, upper = self.hull_of_all(
            (tuple(x.min() for x in x_ends), tuple(x.max() for x in x_ends))
            for x_ends in at
            if x_ends[0].size
        )
        return vector(map(float, lower)), vector(map(float, upper))

    @cached_property
    def _full(self) -> bool:
        """True if every site of the window is a particle, so that the row of a particle can be
        computed from its site index."""
        return self.count == self.sites.size

    @cached_property
    def _flat_sites(self) -> Indices:
        """Place in the window of the particle in each row, (particle,). It is used if the window
        contains sites that are not particles."""
        return np.flatnonzero(self.sites != EMPTY)

    @cached_property
    def table_kind(self) -> NDArray[np.int8]:
        """Kind of each particle, FOLLOWER or FRAME, (particle,)."""
        flat = self.sites.ravel()
        return flat if self._full else flat[self._flat_sites]

    @property
    def body_rows(self) -> Indices:
        """Rows of leaders and followers."""
        return np.flatnonzero(self.table_kind == FOLLOWER)

    def body_ends(self) -> NDArray[np.float64]:
        """Return X of the first and the last particle of the body, (end, axis)."""
        body = self.table_kind == FOLLOWER
        ends = self.reference(np.array([body.argmax(), len(body) - 1 - body[::-1].argmax()]))
        parts = self.communicator.allgather(ends)
        return np.stack([parts[0][0], parts[-1][1]])

    def chunks(self) -> Iterator[Indices]:
        """Generate all rows in chunks."""
        for begin in range(0, self.count, CHUNK_ROWS):
            yield np.arange(begin, min(begin + CHUNK_ROWS, self.count))

    def site_of(self, rows: Indices) -> NDArray[np.int64]:
        """Return the sites (i, j) of rows, (row, index)."""
        return np.stack(self._site_indices(rows), axis=1)

    def _site_indices(self, rows: Indices) -> list[Indices]:
        """Return i and j of the sites of rows."""
        place = rows if self._full else self._flat_sites[rows]
        return list(map(add, np.unravel_index(place, self.sites.shape), self.low))

    def _of_all(self, values: Callable[[Indices], Any], columns: int, dtype: Any) -> NDArray[Any]:
        """Evaluate a function of rows chunk by chunk, and write the results into an array
        (particle, column)."""
        out = np.empty((self.count, columns), dtype)
        for rows in self.chunks():
            out[rows[0] : rows[-1] + 1] = values(rows)
        return out

    def site_table(self) -> NDArray[np.int32]:
        """Return the sites (i, j) of all rows, (particle, index)."""
        return self._of_all(self.site_of, self.sites.ndim, np.int32)

    def cells_of(self, rows: Indices) -> tuple[Indices, ...]:
        """Return sublattice and repeat cell of rows."""
        return cells_of_sites(self.cell, *self._site_indices(rows))

    def place_of(self, rows: Indices) -> Indices:
        """Return the flat places of rows on the raster."""
        s, *cells = self.cells_of(rows)
        return np.ravel_multi_index((s, *map(sub, cells, self.first)), self.shape)

    def rows_at(self, s: int | Indices, *cells: Indices) -> Indices:
        """Return the rows of the particles at (sublattice, raster cell, raster cell); -1 if there
        is none.
        """
        cell = self.cell
        index = np.array([site.index for site in cell.sites])
        whole = np.stack(cells, axis=-1) + self.first
        return self.rows_of_sites(whole * cell.period + index[s])

    def rows_of_sites(self, site: NDArray[Any]) -> Indices:
        """Return the row of the particle at each site; -1 if there is none. The sites are an array
        of shape (entry, index)."""
        place = site.astype(np.intp) - self.low
        inside = ((place >= 0) & (place < self.sites.shape)).all(axis=-1)
        rows = np.full(inside.shape, -1, np.intp)
        flat = np.ravel_multi_index(tuple(place[inside].T), self.sites.shape)
        if self._full:
            rows[inside] = flat
        else:
            occupied = self.sites.ravel()[flat] != EMPTY
            rows[inside] = np.where(occupied, np.searchsorted(self._flat_sites, flat), -1)
        return rows

    def reference(self, rows: Indices | None = None) -> NDArray[np.float64]:
        """Return X of all particles or of the given rows, (particle, axis)."""
        if rows is None:
            return self._of_all(self.reference, self.sites.ndim, np.float64)
        offsets = positions(self.cell, *self.cells_of(rows))
        return np.stack(offsets, axis=1) + self.lattice.origin

    def reference_planes(self, where: Where) -> Any:
        """Return X relative to site (0, 0) of the lattice, as one array for each component."""
        s: Any
        if isinstance(where, Places):
            s, *cells = np.unravel_index(where.place, self.shape)
        else:
            s, *cells = where.sublattice, *np.ogrid[where.slices()[1:]]
        cells = [c + first for c, first in zip(cells, self.first, strict=True)]
        return positions(self.cell, s, *cells)

    def table(self, u: NDArray[Any]) -> NDArray[Any]:
        """Convert values on rasters, in an array of shape (axis, sublattice, cell, cell), to a
        table of shape (particle, axis)."""
        if not self._full:
            flat = u.reshape(len(u), -1)
            return self._of_all(lambda rows: flat.take(self.place_of(rows), 1).T, len(u), u.dtype)
        out = np.empty((*self.sites.shape, len(u)), u.dtype)
        cell = self.cell
        for s, site in enumerate(cell.sites):
            skip = np.subtract(site.index, self.low) % cell.period
            target = out[tuple(slice(n, None, p) for n, p in zip(skip, cell.period, strict=True))]
            begin = np.add(self.low, skip) // cell.period - self.first
            source = tuple(map(slice, begin, begin + target.shape[:-1]))
            for axis, plane in enumerate(u):
                target[..., axis] = plane[s][source]
        return out.reshape(-1, len(u))

    def ends_of_lines(self, axis: int, *, last: bool) -> Indices:
        """Return the rows of the first or last particles of the body on every line of sites along
        an axis.
        """
        body = np.moveaxis(self.sites == FOLLOWER, axis, 0)
        end = (body[::-1] if last else body).argmax(axis=0)
        end = self.low[axis] + (len(body) - 1 - end if last else end)
        if axis == 0:  # Lines along this axis extend over several processes.
            far = np.where(body.any(axis=0), -end if last else end, NOWHERE)
            far = self.communicator.smallest(far)
            occupied, end = far < NOWHERE, -far if last else far
        else:
            occupied = body.any(axis=0)
        first = [*self.low[:axis], *self.low[axis + 1 :]]
        sites = list(map(add, np.nonzero(occupied), first))
        sites.insert(axis, end[occupied])
        rows = self.rows_of_sites(np.stack(sites, axis=1))
        return rows[rows >= 0]

    def ends_of_rows(self, sublattice: int) -> list[Indices]:
        """Return, for every row of cells, the repeat cells of the first and of the last particle of
        the body in it.

        Only particles of one sublattice are considered. There is one array for each index. Rows are
        parallel to the last axis, along which positions are monotonic.
        """
        body = self.kind[sublattice] == FOLLOWER
        rows = np.nonzero(body.any(axis=-1))
        first = body.argmax(axis=-1)[rows]
        last = body.shape[-1] - 1 - body[..., ::-1].argmax(axis=-1)[rows]
        cells = [*(np.tile(index, 2) for index in rows), np.concatenate([first, last])]
        return [c + n for c, n in zip(cells, self.first, strict=True)]

    def body_block(self, sublattice: int) -> Block | None:
        """Return the smallest block with all particles of the body of a sublattice, or None."""
        ends = bounds(self.kind[sublattice] == FOLLOWER)
        return Block(sublattice, *ends) if ends else None


@dataclass(frozen=True)
class Restriction:
    """Rows of repeat cells of a raster, stored as a separate raster. This is the part of a lattice
    that a process computes.

    Features of a scene have a method `restrict`, which returns the part of the feature in these
    rows.

    Parameters
    ----------
    whole
        The raster.
    part
        The raster of the rows.
    low
        First row, in the whole raster.
    present, moving
        Rows that contain particles, and rows in which every particle has all its neighbours in the
        part. Both are ranges (first, last + 1) in the whole raster.
    """

    whole: Raster
    part: Raster
    low: int
    present: tuple[int, int]
    moving: tuple[int, int]

    def is_between(self, place: Indices, rows: tuple[int, int]) -> Mask:
        """Return a mask that is true for those flat places of the whole raster that lie in the
        given rows."""
        row = np.unravel_index(place, self.whole.shape)[1]
        return np.asarray((row >= rows[0]) & (row < rows[1]))

    def is_present(self, place: Indices) -> Mask:
        """Return a mask that is true for those flat places of the whole raster that lie in the
        part."""
        return self.is_between(place, self.present)

    def is_moving(self, place: Indices) -> Mask:
        """Return a mask that is true for those flat places of the whole raster that have all
        neighbours in the part."""
        return self.is_between(place, self.moving)

    def places(self, place: Indices) -> Indices:
        """Convert flat places of the whole raster to flat places of the raster of the part."""
        s, row, *rest = np.unravel_index(place, self.whole.shape)
        return np.ravel_multi_index((s, row - self.low, *rest), self.part.shape)

    def rows(self, rows: Indices) -> Indices:
        """Convert rows in the particle table of the whole raster to rows in the table of the
        part."""
        return rows - self.part.particle_offset + self.whole.particle_offset

    def cut(self, planes: Array) -> Array:
        """Return a copy of those rows of an array that belong to the part. The last axes of the
        array are the axes of the raster's cells."""
        axes = len(self.whole.shape) - 1
        return row_view(planes, axes, slice(self.low, self.low + self.part.shape[1])).copy()


def row_view(array: Array, axes: int, rows: slice) -> Array:
    """Return a view of some rows of an array. The last `axes` axes of the array are the axes of the
    raster's cells."""
    return array[(*(slice(None),) * (array.ndim - axes), rows)]


def positions(cell: Cell, s: int | Indices, *cells: Indices) -> Any:
    """Return the positions of the particles of sublattice s in repeat cells (m, n), relative to
    site (0, 0). With the basis position p and the cell vectors a and b they are p + m·a + n·b.
    """
    return vector(cell.basis[s, axis] + part for axis, part in enumerate(cell.shift(cells)))


def cells_of_sites(cell: Cell, *site: Indices) -> tuple[Indices, ...]:
    """Return the sublattice and the repeat cell of the sites (i, j). The sublattice is -1 for an
    index without a site."""
    remainder = tuple(i % p for i, p in zip(site, cell.period, strict=True))
    return cell.sublattices[remainder], *(i // p for i, p in zip(site, cell.period, strict=True))
