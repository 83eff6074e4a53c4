"""The cells of a lattice on the raster, and for each bond the cells around a particle that
determine its damage.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, permutations
from operator import add, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.raster import FOLLOWER, Block, Floats, Mask, Raster, Where
from pbdkit.plugin import Cell, Offset, Slot, Vector
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.lattice import CellPolygon, Index, Side, Tiling

Slots = tuple[tuple[Slot, ...], ...]
Step = tuple[int, int, Index]
Share = NDArray[np.floating[Any]] | float
CELLS_AT_ONCE = 65536
"""So many are looked at together, so that temporaries stay small."""
LEVEL = 1e-9
"""Corners whose heights differ by less than this share of their distance lie level."""


@lru_cache(maxsize=32)
def tiling_of(cell: Cell, slots: Slots) -> Tiling:
    """The polygons of a lattice, each once a repeat cell, and those beside its slots; none but
    in the plane."""
    if len(cell.vectors) != 2:
        return Tiling()
    polygons = tuple(found for s, own in enumerate(slots) for found in _polygons(cell, s, own))
    return Tiling(polygons, _beside(polygons, slots))


@dataclass(frozen=True)
class Patch:
    """The cells of one shape on a rectangle of the raster: `corners[k]` is the block of their k-th
    corners, `whole` tells of which all corners are particles of the body."""

    polygon: CellPolygon
    corners: tuple[Block, ...]
    whole: Mask

    def differences(self, u: NDArray[Any]) -> tuple[Vector, ...]:
        """u_k - u_0 of the corners, from planes u, (axis, sublattice, cell, cell)."""
        corners = [u[(slice(None), *block.slices())] for block in self.corners]
        return tuple(Vector(*(plane - corners[0])) for plane in corners)

    def bonds(self, slots: Slots) -> list[tuple[Block, Slot]]:
        """The bonds between corners: the block where they start, and their slot."""
        corners, found = self.polygon.corners, []
        for k, a in enumerate(corners):
            ahead = {_step(a, b) for b in corners[k + 1 :]}
            own = [s for s in slots[a.target] if (s.source, s.target, s.cell) in ahead]
            found += [(self.corners[k], slot) for slot in own]
        return found

    def rows(self, raster: Raster, place: int) -> Indices:
        """The rows of the corners of the cell at a flat place of the patch."""
        s = np.array([block.sublattice for block in self.corners])
        start = np.array([block.start for block in self.corners])
        return raster.rows_at(s, *np.add(start, np.unravel_index(place, self.whole.shape)).T)


def patches(raster: Raster, tiling: Tiling) -> tuple[Patch, ...]:
    """The places with cells whose corners are all of the body, some at a time."""
    found = []
    for polygon in tiling.polygons:
        block = _within(raster, polygon)
        for part in _bands(raster, block) if block else ():
            corners = tuple(part.seen_through(corner) for corner in polygon.corners)
            inside = [raster.kind[corner.slices()] == FOLLOWER for corner in corners]
            patch = Patch(polygon, corners, np.logical_and.reduce(inside))
            found += [patch] if patch.whole.any() else []
    return tuple(found)


def _bands(raster: Raster, block: Block) -> Iterator[Block]:
    """A block cut at rows that are the same whatever part of the lattice a raster holds: the order
    of sums at a particle depends on where it is cut."""
    (first, *start), (last, *stop) = block.start, block.stop
    step = max(1, CELLS_AT_ONCE // math.prod(raster.shape[2:]))
    cuts = [row for row in range(first + 1, last) if (raster.first[0] + row) % step == 0]
    for low, high in pairwise([first, *cuts, last]):
        yield Block(block.sublattice, (low, *start), (high, *stop))


@dataclass(frozen=True)
class WeighedCells:
    """The body's cells, weighed: `share` (kind, sublattice, cell, cell) of the cell whose first
    corner is at that place of the raster, 0 to 1, None where all are whole; `weight` is the same
    times its stiffness over that of the rule. Cells whose stiffness is no multiple of that have the
    weight 0, and in `mixed` their share of each of some stiffnesses, whose `weights` by slot are
    those of the rule for it. `phase` tells materials apart by a number, -1 where a cell is of
    several; None where there is one. `names` are the components of those stiffnesses, one each."""

    tiling: Tiling
    share: Floats | None
    weight: Floats
    mixed: tuple[Floats, ...] = ()
    weights: tuple[dict[Slot, Any], ...] = ()
    phase: NDArray[np.int64] | None = None
    names: tuple[str, ...] = ()

    def of(self, patch: Patch) -> Floats | float:
        """The shares of the cells of a patch."""
        if self.share is None:
            return 1.0
        return patch.corners[0].of(self.share[patch.polygon.kind])

    def beside(
        self, slot: Slot, where: Where, precision: str, shares: Floats | None = None
    ) -> tuple[Share, Share]:
        """The weights, or other `shares`, of the cells to the left and the right of a slot; 1 where
        all are."""
        of = self.weight if shares is None else shares
        left, right = (_seen(of, side, where, precision) for side in self.tiling.beside[slot])
        return left, right


def _seen(shares: Floats, side: Side, where: Where, precision: str) -> Share:
    """Of the cell on one side of a slot."""
    there = where if side.first is None else where.seen_through(side.first)
    share = there.of(shares[side.kind])
    if (share == 1.0).all():
        return 1.0
    share = share.astype(precision)
    share.flags.writeable = False
    return share


def whole_cells(raster: Raster, tiling: Tiling) -> WeighedCells:
    """The cells whose corners are all of the body, each with a share of 1."""
    share = np.zeros((1 + max(polygon.kind for polygon in tiling.polygons), *raster.shape))
    for patch in patches(raster, tiling):
        patch.corners[0].of(share[patch.polygon.kind])[...] = patch.whole
    return WeighedCells(tiling, share, share)


def _within(raster: Raster, polygon: CellPolygon) -> Block | None:
    """The block of first corners in the body whose other corners lie on the raster."""
    block = raster.body_block(polygon.source)
    if not block:
        return None
    steps = np.array([corner.cell for corner in polygon.corners])
    start = np.maximum(block.start, -steps.min(axis=0))
    stop = np.minimum(block.stop, raster.shape[1:] - steps.max(axis=0))
    there = Block(polygon.source, tuple(start.tolist()), tuple(stop.tolist()))
    return there if (start < stop).all() else None


def _polygons(cell: Cell, source: int, slots: tuple[Slot, ...]) -> Iterator[CellPolygon]:
    """Those whose first corner is of sublattice `source`, counter-clockwise; corners that are
    neighbours lie where the slots say, to the last bit."""
    exact = {(slot.target, slot.cell): slot.rest for slot in slots}
    around = [replace(offset, rest=exact.get((offset.target, offset.cell), offset.rest))
              for offset in cell.offsets(source, _reach(cell))]  # fmt: skip
    found = []
    for places in _around_the_origin(np.array([offset.rest for offset in around])):
        others = tuple(around[k] for k in places)
        # It is met from each of its corners: kept is the first.
        if all(_is_ahead(offset.rest) for offset in others):
            found.append((cell.offset(source, source, (0, 0)), *others))
    found.sort(key=lambda corners: math.atan2(*corners[1].rest[::-1]))
    return (CellPolygon(source, kind, corners) for kind, corners in enumerate(found))


def _is_ahead(r: Vector[float]) -> bool:
    level = abs(r.y) <= LEVEL * math.hypot(*r)
    return bool(r.x > 0.0 if level else r.y > 0.0)


def _beside(polygons: tuple[CellPolygon, ...], slots: Slots) -> dict[Slot, tuple[Side, Side]]:
    """The cells beside every slot, where the neighbours are the corners of simple cells."""
    slot_of = {(slot.source, slot.target, slot.cell): slot for own in slots for slot in own}
    left: dict[Step, Side] = {}
    right: dict[Step, Side] = {}
    for polygon in polygons:
        corners = polygon.corners
        for start, end in permutations(range(len(corners)), 2):
            side = Side(polygon.kind, slot_of.get(_step(corners[start], corners[0])), start, end)
            step, ahead = _step(corners[start], corners[end]), (end - start) % len(corners)
            left |= {step: side} if ahead < len(corners) - 1 else {}
            right |= {step: side} if ahead > 1 else {}
    fits = left.keys() == right.keys() == slot_of.keys()
    if not (fits and all(map(_is_simple, polygons))):
        return {}
    return {slot: (left[step], right[step]) for step, slot in slot_of.items()}


def _step(here: Offset, there: Offset) -> Step:
    """(sublattice, sublattice, repeat cells) from one corner of a polygon to another."""
    return here.target, there.target, tuple(map(sub, there.cell, here.cell))


def _is_simple(polygon: CellPolygon) -> bool:
    """Whether it is a triangle or a parallelogram, whose triangles around the middle are equal."""
    r = polygon.rest
    if len(r) != 4:
        return len(r) == 3
    return math.dist(r[2], (r[1].x + r[3].x, r[1].y + r[3].y)) <= 1e-6 * math.hypot(*r[2])


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


def _around_the_origin(x: Floats) -> Iterator[list[int]]:
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


Key = tuple[int, int, Index]
"""A cell around a particle: its kind, and the sublattice and repeat cell of its first corner."""


@dataclass(frozen=True)
class CellBond:
    """A bond of a cell around a particle: the `plane` on which it is kept, along `slot`, at the
    neighbour `home` (None: the particle itself); and whether the cell lies to its left and to its
    right, that of a diagonal on both sides."""

    plane: int
    slot: Slot
    home: Slot | None
    on_left: bool
    on_right: bool

    @property
    def side(self) -> int:
        """0 where the cell lies to its left, 1 where to its right alone."""
        return 0 if self.on_left else 1


@dataclass(frozen=True)
class CellsAround:
    """The bonds of the cells around the particles of one sublattice, and by slot the numbers of
    the cells to its left and right."""

    cells: tuple[tuple[CellBond, ...], ...]
    beside: dict[Slot, tuple[int, int]]


def cells_around(
    tiling: Tiling, slots: Sequence[Sequence[Slot]], planes: Sequence[Slot]
) -> tuple[CellsAround, ...]:
    """Those of every sublattice, with the slots along which bonds are kept, one a plane; none where
    neighbours are not the corners of the cells."""
    return tuple(_around(tiling, own, planes) for own in slots) if tiling.beside else ()


def _around(tiling: Tiling, own: Sequence[Slot], planes: Sequence[Slot]) -> CellsAround:
    numbers: dict[Key, int] = {}
    beside = {}
    for slot in own:
        keys = (_key(slot.source, (0,) * len(slot.cell), side) for side in tiling.beside[slot])
        left, right = (numbers.setdefault(key, len(numbers)) for key in keys)
        beside[slot] = left, right
    return CellsAround(tuple(_bonds(tiling, own, planes, key) for key in numbers), beside)


def _key(start: int, at: Index, side: Side) -> Key:
    """Of a cell beside a bond that starts on a sublattice in a repeat cell."""
    if side.first is None:
        return side.kind, start, at
    return side.kind, side.first.target, tuple(map(add, at, side.first.cell))


def _bonds(
    tiling: Tiling, own: Sequence[Slot], planes: Sequence[Slot], key: Key
) -> tuple[CellBond, ...]:
    kind, source, first = key
    polygon = next(p for p in tiling.polygons if (p.source, p.kind) == (source, kind))
    corners = [(c.target, tuple(map(add, first, c.cell))) for c in polygon.corners]
    neighbours = {(slot.target, slot.cell): slot for slot in own}
    found = []
    for plane, slot in enumerate(planes):
        for (a, start), (b, end) in permutations(corners, 2):
            if (slot.source, slot.target, slot.cell) == (a, b, tuple(map(sub, end, start))):
                left, right = (_key(a, start, side) == key for side in tiling.beside[slot])
                found.append(CellBond(plane, slot, neighbours.get((a, start)), left, right))
    return tuple(found)
