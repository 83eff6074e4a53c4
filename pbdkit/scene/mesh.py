"""The cells of a lattice: polygons of neighbouring sites that tile the plane, and their places."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Cell, Components, Offset, Slot, Vector
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.places import Block
from pbdkit.scene.raster import FOLLOWER, Raster

CELLS_AT_ONCE = 65536
"""So many are looked at together, so that temporaries stay small."""


@dataclass(frozen=True)
class MeshCell:
    """A polygon of sites on one circle with no site inside it (Delaunay's; the square lattice's
    squares, the hexagonal one's triangles). It is met once for each site of sublattice `source`.

    `corners` are the offsets from that site to all corners, itself first, counter-clockwise.
    """

    source: int
    corners: tuple[Offset | Slot, ...]

    @cached_property
    def rest(self) -> tuple[Components, ...]:
        """X_k - X_0 of the corners, lattice units."""
        return tuple(corner.rest for corner in self.corners)

    def bonds(self, neighbourhood: Neighbourhood) -> list[tuple[int, Slot]]:
        """The bonds between corners: the number of the corner where one starts, and its slot."""
        found = []
        for k, a in enumerate(self.corners):
            ahead = {(b.target, b.cell[0] - a.cell[0], b.cell[1] - a.cell[1])
                     for b in self.corners[k + 1 :]}  # fmt: skip
            own = neighbourhood.slots[a.target]
            found += [(k, slot) for slot in own if (slot.target, *slot.cell) in ahead]
        return found


@dataclass(frozen=True)
class Patch:
    """The cells of one shape on a rectangle of the raster: `corners[k]` is the block of their k-th
    corners, `whole` tells of which all corners are particles of the body."""

    cell: MeshCell
    corners: tuple[Block, ...]
    whole: NDArray[np.bool_]

    def differences(self, u: NDArray[Any]) -> tuple[Vector, ...]:
        """u_k - u_0 of the corners, from planes u, (axis, sublattice, cell, cell)."""
        corners = [u[(slice(None), *block.slices())] for block in self.corners]
        return tuple(Vector(*(plane - corners[0])) for plane in corners)

    def rows(self, raster: Raster, place: int) -> Indices:
        """The rows of the corners of the cell at a flat place of the patch."""
        m, n = np.unravel_index(place, self.whole.shape)
        s = np.array([block.sublattice for block in self.corners])
        start = np.array([block.start for block in self.corners])
        return raster.rows_at(s, start[:, 0] + m, start[:, 1] + n)


def lattice_cells(cell: Cell) -> tuple[MeshCell, ...]:
    """The polygons of a lattice, each once a repeat cell."""
    found = []
    for source in range(len(cell.sites)):
        itself = cell.offset(source, source, (0, 0))
        around = cell.offsets(source, _reach(cell))
        for polygon in _around_the_origin(np.array([offset.rest for offset in around])):
            corners = [around[k] for k in polygon]
            # It is met from each of its corners: kept is the one with the smallest site index.
            if min(corner.site for corner in corners) > (0, 0):
                found.append(MeshCell(source, (itself, *corners)))
    return tuple(found)


def patches(raster: Raster, cells: tuple[MeshCell, ...]) -> Iterator[Patch]:
    """All places where cells can be, some at a time."""
    for cell in cells:
        block = _within(raster, cell)
        for part in block.rows(CELLS_AT_ONCE) if block else ():
            corners = tuple(part.seen_through(corner) for corner in cell.corners)
            inside = [raster.kind[corner.slices()] == FOLLOWER for corner in corners]
            yield Patch(cell, corners, np.logical_and.reduce(inside))


def body_cells(raster: Raster) -> tuple[Patch, ...]:
    """The places with cells whose corners are all of the body."""
    return tuple(p for p in patches(raster, lattice_cells(raster.lattice.cell())) if p.whole.any())


def _within(raster: Raster, cell: MeshCell) -> Block | None:
    """The block of first corners in the body whose other corners lie on the raster."""
    block = raster.body_block(cell.source)
    if not block:
        return None
    bounds = []
    for axis in (0, 1):
        steps = [corner.cell[axis] for corner in cell.corners]
        begin = max(block.start[axis], -min(steps))
        bounds.append((begin, min(block.stop[axis], raster.shape[1 + axis] - max(steps))))
    (i, k), (j, n) = bounds
    return Block(cell.source, (i, j), (k, n)) if i < k and j < n else None


def _reach(cell: Cell) -> float:
    """No side and no diagonal is longer: twice the radius of the largest circle without a site is
    at most the sum of two cell vectors, made short by Gauss's reduction."""
    a, b = (np.array(v) for v in cell.vectors)
    while True:
        if a @ a > b @ b:
            a, b = b, a
        shorter = b - round(float(a @ b) / float(a @ a)) * a
        if shorter @ shorter >= b @ b:
            return (math.hypot(*a) + math.hypot(*b)) * (1 + 1e-6)
        b = shorter


def _around_the_origin(x: NDArray[np.float64]) -> Iterator[list[int]]:
    """The polygons that meet in the origin, each by its other corners among x, counter-clockwise;
    x are the sites around it, the nearest first: that one is always a corner.

    On the left of a side (0, p) lies the polygon whose corners q see the side under the largest
    angle, of cotangent q·(q - p) / p×q.
    """
    side = 0
    for _ in range(len(x)):
        p = x[side]
        turn = p[0] * x[:, 1] - p[1] * x[:, 0]
        left = turn > 1e-12 * math.hypot(*p) * np.hypot(*x.T)
        cotangent = np.where(left, (x * (x - p)).sum(axis=1) / np.where(left, turn, 1.0), np.inf)
        least = cotangent.min()
        (circle,) = np.nonzero(cotangent <= least + 1e-9 * (1.0 + abs(least)))
        ahead = sorted(circle.tolist(), key=lambda k: math.atan2(turn[k], float(x[k] @ p)))
        yield [side, *ahead]
        side = ahead[-1]
        if side == 0:
            return
