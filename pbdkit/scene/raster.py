"""Particles on padded rasters: one raster a sublattice, and the table in the order of numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Cell, Lattice, Slot, Vector
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index

EMPTY, LEADER, FOLLOWER, FRAME = -1, 0, 1, 2


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

    def seen_through(self, slot: Slot) -> Block:
        """The block of the neighbours at that slot."""
        (m, n), (a, b), (c, d) = slot.cell, self.start, self.stop
        return Block(slot.target, (a + m, b + n), (c + m, d + n))

    def rows(self, cells: int) -> list[Block]:
        """The block cut along its first axis into parts of about so many cells."""
        (a, b), (c, d) = self.start, self.stop
        step = max(1, cells // max(1, d - b))
        return [Block(self.sublattice, (i, b), (min(i + step, c), d)) for i in range(a, c, step)]


@dataclass(frozen=True)
class Raster:
    """Every particle twice over: as a row of the table, and as a place on a raster.

    `shape` is (sublattices, cells, cells), `first` the repeat cell at place (0, 0), `kind` the
    kind at each place with EMPTY where no particle is (leaders count as followers here). Table
    columns have a row a particle in the order of the numbers: `site` its index (i, j), `place`
    its flat index on the raster.
    """

    lattice: Lattice
    shape: tuple[int, int, int]
    first: Index
    kind: NDArray[np.int8]
    site: NDArray[np.int32]
    place: Indices

    @property
    def count(self) -> int:
        """The number of particles, frame included."""
        return len(self.place)

    @cached_property
    def table_kind(self) -> NDArray[np.int8]:
        """(particle,): FOLLOWER or FRAME."""
        return self.kind.ravel()[self.place]

    @cached_property
    def row_at(self) -> Indices:
        """(flat place,): the row of the particle there, -1 where there is none."""
        rows = np.full(self.kind.size, -1, np.intp)
        rows[self.place] = np.arange(self.count)
        return rows

    @cached_property
    def body_rows(self) -> Indices:
        """The rows of leaders and followers."""
        return np.flatnonzero(self.table_kind == FOLLOWER)

    def cells(self, rows: Indices | None = None) -> tuple[Indices, Indices, Indices]:
        """(sublattice, repeat cell, repeat cell) of all particles or of some rows."""
        place = self.place if rows is None else self.place[rows]
        s, m, n = np.unravel_index(place, self.shape)
        return s, m + self.first[0], n + self.first[1]

    def reference(self, rows: Indices | None = None) -> NDArray[np.float64]:
        """X, (particle, axis), of all particles or of some rows."""
        offsets = positions(self.lattice.cell(), *self.cells(rows))
        return np.stack(offsets, axis=1) + self.lattice.origin

    def reference_planes(self, block: Block) -> Vector:
        """X from the lattice's site (0, 0) on a block, a plane a component."""
        m = np.arange(block.start[0], block.stop[0])[:, None] + self.first[0]
        n = np.arange(block.start[1], block.stop[1])[None, :] + self.first[1]
        return positions(self.lattice.cell(), block.sublattice, m, n)

    def body_row_at_site(self, site: NDArray[np.int32]) -> Indices:
        """The row of the body particle at each site (i, j), (entry, 2); -1 where there is none."""
        cell = self.lattice.cell()
        i, j = site[:, 0].astype(np.intp), site[:, 1].astype(np.intp)
        s = _sublattices(cell)[i % cell.period[0], j % cell.period[1]]
        m, n = i // cell.period[0] - self.first[0], j // cell.period[1] - self.first[1]
        inside = (s >= 0) & (m >= 0) & (m < self.shape[1]) & (n >= 0) & (n < self.shape[2])
        rows = np.full(len(site), -1, np.intp)
        place = np.ravel_multi_index((s[inside], m[inside], n[inside]), self.shape)
        rows[inside] = np.where(self.kind.ravel()[place] == FOLLOWER, self.row_at[place], -1)
        return rows

    def body_block(self, sublattice: int) -> Block | None:
        """The smallest block that holds the body's particles of that sublattice, if any."""
        inside = self.kind[sublattice] == FOLLOWER
        first, second = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        if not len(first):
            return None
        start = (int(first[0]), int(second[0]))
        return Block(sublattice, start, (int(first[-1]) + 1, int(second[-1]) + 1))


def positions(cell: Cell, s: int | Indices, m: Indices, n: Indices) -> Vector:
    """Sublattice s in the repeat cell (m, n), from site (0, 0): at + m·a + n·b."""
    a, b = cell.vectors
    at = np.array([site.at for site in cell.sites])
    return Vector(at[s, 0] + (m * a.x + n * b.x), at[s, 1] + (m * a.y + n * b.y))


def build_raster(
    lattice: Lattice,
    body: NDArray[np.bool_],
    origin: Index,
    layers: int,
    reach_in_cells: Index,
) -> Raster:
    """The raster of a body and its frame.

    `body` tells which sites of a window are wanted, `origin` is the site index of its first;
    the frame takes every other site within `layers` of index distance of the body.
    """
    cell = lattice.cell()
    wanted = np.pad(body, layers)
    low = (origin[0] - layers, origin[1] - layers)
    wanted &= existing(cell, low, wanted.shape)
    window = _dilated(wanted, layers) & existing(cell, low, wanted.shape)
    i, j = np.nonzero(window)
    kinds = np.where(wanted[i, j], FOLLOWER, FRAME).astype(np.int8)
    i, j = i + low[0], j + low[1]
    s = _sublattices(cell)[i % cell.period[0], j % cell.period[1]]
    m, n = i // cell.period[0], j // cell.period[1]
    first = (int(m.min()) - reach_in_cells[0], int(n.min()) - reach_in_cells[1])
    shape = (
        len(cell.sites),
        int(m.max()) + reach_in_cells[0] + 1 - first[0],
        int(n.max()) + reach_in_cells[1] + 1 - first[1],
    )
    place = np.ravel_multi_index((s, m - first[0], n - first[1]), shape)
    kind = np.full(shape, EMPTY, np.int8)
    kind.ravel()[place] = kinds
    site = np.stack([i, j], axis=1).astype(np.int32)
    return Raster(lattice, shape, first, kind, site, place)


def _sublattices(cell: Cell) -> Indices:
    """(period, period): the sublattice of each index of the cell, -1 where it has no site."""
    found = np.full(cell.period, -1, np.intp)
    for s, site in enumerate(cell.sites):
        found[site.index] = s
    return found


def positions_of_sites(lattice: Lattice, i: Indices, j: Indices) -> Vector:
    """X of the sites (i, j), a component each; meaningless where the lattice has a hole."""
    cell = lattice.cell()
    p, q = cell.period
    x, y = positions(cell, _sublattices(cell)[i % p, j % q], i // p, j // q)
    return Vector(x + lattice.origin[0], y + lattice.origin[1])


def existing(cell: Cell, low: Index, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which sites of a window of indices, from `low` on, the lattice has."""
    i, j = np.arange(low[0], low[0] + shape[0]), np.arange(low[1], low[1] + shape[1])
    sublattices = _sublattices(cell) >= 0
    return sublattices[np.ix_(i % cell.period[0], j % cell.period[1])]


def _dilated(mask: NDArray[np.bool_], layers: int) -> NDArray[np.bool_]:
    """Every place within `layers` of a true one, along either axis or both."""
    for axis in (0, 1):
        grown = mask.copy()
        for k in range(1, layers + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(k, None), slice(None, -k)
            grown[tuple(ahead)] |= mask[tuple(behind)]
            grown[tuple(behind)] |= mask[tuple(ahead)]
        mask = grown
    return mask
