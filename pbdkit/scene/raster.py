"""Particles on padded rasters: one raster a sublattice, and the table in the order of numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Cell, Lattice, Offset, Slot, Vector
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index

EMPTY, LEADER, FOLLOWER, FRAME = -1, 0, 1, 2
CHUNK_ROWS = 65536
"""Rows of the table that are made at a time, so that temporaries stay small."""


@dataclass(frozen=True)
class Block:
    """A rectangle of repeat cells of one sublattice; `stop` is excluded."""

    sublattice: int
    start: Index
    stop: Index

    def slices(self) -> tuple[int, slice, slice]:
        """Where it lies in an array (sublattice, cell, cell)."""
        return (
            self.sublattice,
            slice(self.start[0], self.stop[0]),
            slice(self.start[1], self.stop[1]),
        )

    def seen_through(self, slot: Slot | Offset) -> Block:
        """The block of the neighbours at that slot, or of the sites at that offset."""
        (m, n), (a, b), (c, d) = slot.cell, self.start, self.stop
        return Block(slot.target, (a + m, b + n), (c + m, d + n))

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., sublattice, cell, cell) here, as a view."""
        return values[(..., *self.slices())]

    def within(self, values: NDArray[Any]) -> NDArray[Any]:
        """The values of (..., cell, cell) here, as a view."""
        return values[(..., *self.slices()[1:])]

    def rows(self, cells: int) -> list[Block]:
        """The block cut along its first axis into parts of about so many cells."""
        (a, b), (c, d) = self.start, self.stop
        step = max(1, cells // max(1, d - b))
        return [Block(self.sublattice, (i, b), (min(i + step, c), d)) for i in range(a, c, step)]


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


Where = Block | Places
"""Some particles of one sublattice."""


def slot_step(shape: tuple[int, ...], slot: Slot | Offset) -> int:
    """From a flat place of rasters to that of the neighbour at a slot."""
    source = slot.source if isinstance(slot, Slot) else slot.target
    step = slot.target - source
    for size, cells in zip(shape[1:], slot.cell, strict=True):
        step = step * size + cells
    return step


@dataclass(frozen=True)
class Raster:
    """Every particle twice over: as a row of the table, and as a place on a raster.

    `shape` is (sublattices, cells, cells), `first` the repeat cell at place (0, 0), `kind` the kind
    at each place with EMPTY where no particle is (leaders count as followers here). `sites` is the
    same by site index (i, j) from `low` on; its particles, i then j, are the rows of the table in
    the order of their numbers.
    """

    lattice: Lattice
    shape: tuple[int, int, int]
    first: Index
    kind: NDArray[np.int8]
    low: Index
    sites: NDArray[np.int8]

    @cached_property
    def count(self) -> int:
        """The number of particles, frame included."""
        return int(np.count_nonzero(self.sites != EMPTY))

    @cached_property
    def _full(self) -> bool:
        """Whether every site of the window is a particle: rows then follow from indices."""
        return self.count == self.sites.size

    @cached_property
    def _flat_sites(self) -> Indices:
        """(particle,): the place in the window of each row, where that is not the row itself."""
        return np.flatnonzero(self.sites != EMPTY)

    @property
    def table_kind(self) -> NDArray[np.int8]:
        """(particle,): FOLLOWER or FRAME."""
        flat = self.sites.ravel()
        return flat if self._full else flat[self._flat_sites]

    @property
    def body_rows(self) -> Indices:
        """The rows of leaders and followers."""
        return np.flatnonzero(self.table_kind == FOLLOWER)

    def chunks(self) -> Iterator[Indices]:
        """All rows, some at a time."""
        for begin in range(0, self.count, CHUNK_ROWS):
            yield np.arange(begin, min(begin + CHUNK_ROWS, self.count))

    def site_of(self, rows: Indices) -> NDArray[np.int64]:
        """(row, index): the site (i, j) of some rows."""
        i, j = np.divmod(rows if self._full else self._flat_sites[rows], self.sites.shape[1])
        return np.stack([i + self.low[0], j + self.low[1]], axis=1)

    def site_table(self) -> NDArray[np.int32]:
        """(particle, index): the sites (i, j) of all rows."""
        out = np.empty((self.count, 2), np.int32)
        for rows in self.chunks():
            out[rows[0] : rows[-1] + 1] = self.site_of(rows)
        return out

    def cells_of(self, rows: Indices) -> tuple[Indices, Indices, Indices]:
        """(sublattice, repeat cell, repeat cell) of some rows."""
        return cells_of_sites(self.lattice.cell(), *self.site_of(rows).T)

    def place_of(self, rows: Indices) -> Indices:
        """The flat place of some rows on the raster."""
        s, m, n = self.cells_of(rows)
        return np.ravel_multi_index((s, m - self.first[0], n - self.first[1]), self.shape)

    def rows_at(self, s: Indices, m: Indices, n: Indices) -> Indices:
        """The rows of the particles at (sublattice, raster cell, raster cell); -1 where none is."""
        cell = self.lattice.cell()
        index = np.array([site.index for site in cell.sites])
        i = (m + self.first[0]) * cell.period[0] + index[s, 0]
        j = (n + self.first[1]) * cell.period[1] + index[s, 1]
        return self.rows_of_sites(np.stack([i, j], axis=-1))

    def rows_of_sites(self, site: NDArray[Any]) -> Indices:
        """The row of the particle at each site (i, j), (entry, 2); -1 where there is none."""
        i, j = site[..., 0].astype(np.intp) - self.low[0], site[..., 1] - self.low[1]
        inside = (i >= 0) & (i < self.sites.shape[0]) & (j >= 0) & (j < self.sites.shape[1])
        rows = np.full(i.shape, -1, np.intp)
        flat = i[inside] * self.sites.shape[1] + j[inside]
        if self._full:
            rows[inside] = flat
        else:
            there = self.sites.ravel()[flat] != EMPTY
            rows[inside] = np.where(there, np.searchsorted(self._flat_sites, flat), -1)
        return rows

    def reference(self, rows: Indices | None = None) -> NDArray[np.float64]:
        """X, (particle, axis), of all particles or of some rows."""
        if rows is None:
            out = np.empty((self.count, 2))
            for some in self.chunks():
                out[some[0] : some[-1] + 1] = self.reference(some)
            return out
        offsets = positions(self.lattice.cell(), *self.cells_of(rows))
        return np.stack(offsets, axis=1) + self.lattice.origin

    def reference_planes(self, where: Where) -> Vector:
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
        out = np.empty((self.count, len(u)), u.dtype)
        if self._full:
            window = out.reshape(*self.sites.shape, len(u))
            for axis, plane in enumerate(u):
                for s, here, there in self._strides():
                    window[(*here, axis)] = plane[s][there]
            return out
        for rows in self.chunks():
            place = self.place_of(rows)
            for axis, plane in enumerate(u):
                out[rows[0] : rows[-1] + 1, axis] = plane.ravel()[place]
        return out

    def body_block(self, sublattice: int) -> Block | None:
        """The smallest block that holds the body's particles of that sublattice, if any."""
        inside = self.kind[sublattice] == FOLLOWER
        first, second = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        if not len(first):
            return None
        start = (int(first[0]), int(second[0]))
        return Block(sublattice, start, (int(first[-1]) + 1, int(second[-1]) + 1))

    def _strides(self) -> Iterator[tuple[int, tuple[slice, slice], tuple[slice, slice]]]:
        """(sublattice, its sites in the window, its cells on the raster)."""
        cell = self.lattice.cell()
        for s, site in enumerate(cell.sites):
            here, there = [], []
            for axis in (0, 1):
                period, low = cell.period[axis], self.low[axis]
                skip = (site.index[axis] - low) % period
                number = len(range(skip, self.sites.shape[axis], period))
                begin = (low + skip) // period - self.first[axis]
                here.append(slice(skip, None, period))
                there.append(slice(begin, begin + number))
            yield s, (here[0], here[1]), (there[0], there[1])


def positions(cell: Cell, s: int | Indices, m: Indices, n: Indices) -> Vector:
    """Sublattice s in the repeat cell (m, n), from site (0, 0): at + m·a + n·b."""
    a, b = cell.vectors
    at = np.array([site.at for site in cell.sites])
    return Vector(at[s, 0] + (m * a.x + n * b.x), at[s, 1] + (m * a.y + n * b.y))


def cells_of_sites(cell: Cell, i: Indices, j: Indices) -> tuple[Indices, Indices, Indices]:
    """(sublattice, repeat cell, repeat cell) of the sites (i, j); sublattice -1 at a hole."""
    p, q = cell.period
    return sublattices(cell)[i % p, j % q], i // p, j // q


def sublattices(cell: Cell) -> Indices:
    """(period, period): the sublattice of each index of the cell, -1 where it has no site."""
    found = np.full(cell.period, -1, np.intp)
    for s, site in enumerate(cell.sites):
        found[site.index] = s
    return found
