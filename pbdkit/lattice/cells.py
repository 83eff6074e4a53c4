"""Cells of a lattice on the raster. The cells around each particle are also determined, because
damage of bonds is stored by cell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, permutations
from operator import add, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.lattice.raster import FOLLOWER, Block, Raster, Restriction, Where
from pbdkit.plugin import Cell, Offset, Slot, Vector
from pbdkit.plugin.lattice import CellPolygon, Index, Side, Tiling

Slots = tuple[tuple[Slot, ...], ...]
"""Type of the slots, by sublattice."""
Step = tuple[int, int, Index]
"""Type of a step between sites: source sublattice, target sublattice, repeat cells."""
Share = NDArray[np.floating[Any]] | float
"""Type of area fractions of cells; a single number if all are equal."""
CELLS_AT_ONCE = 65536
"""Number of cells processed together, which bounds the size of temporaries."""
LEVEL = 1e-9
"""Two corners count as equally high if their heights differ by at most this relative amount."""


@lru_cache(maxsize=32)
def tiling_of(cell: Cell, slots: Slots) -> Tiling:
    """Compute the polygons of a plane lattice, each of them once in a repeat cell, and find the
    polygons on both sides of each slot.

    Returns
    -------
    Tiling
        Empty for a lattice in space.
    """
    if len(cell.vectors) != 2:
        return Tiling()
    sources = enumerate(slots)
    polygons = tuple(polygon for s, ends in sources for polygon in _polygons(cell, s, ends))
    return Tiling(polygons, _beside(polygons, slots))


@dataclass(frozen=True)
class Patch:
    """Cells of one shape on a rectangle of the raster.

    Parameters
    ----------
    polygon
        Shape of the cells.
    corners
        Block for each corner of the polygon. Block k contains the k-th corners of all cells.
    whole
        Mask of the cells with all corners in the body, (cell, cell).
    """

    polygon: CellPolygon
    corners: tuple[Block, ...]
    whole: Mask

    def differences(self, u: NDArray[Any]) -> tuple[Vector, ...]:
        """Return the differences u_k - u_0 between the displacements of corner k and corner 0. `u`
        is (axis, sublattice, cell, cell).
        """
        corners = [u[(slice(None), *block.slices())] for block in self.corners]
        return tuple(Vector(*(plane - corners[0])) for plane in corners)

    def bonds(self, slots: Slots) -> list[tuple[Block, Slot]]:
        """Return the bonds between corners. Those along a slot are returned as the slot and the
        block of places at which they start."""
        corners, bonds = self.polygon.corners, []
        for k, a in enumerate(corners):
            steps = {_step(a, b) for b in corners[k + 1 :]}
            ends = [s for s in slots[a.target] if (s.source, s.target, s.cell) in steps]
            bonds += [(self.corners[k], slot) for slot in ends]
        return bonds

    def rows(self, raster: Raster, place: int) -> Indices:
        """Return, for the corners of one cell, their rows in the particle table. `place` is the
        flat place of the cell in the patch."""
        s = np.array([block.sublattice for block in self.corners])
        start = np.array([block.start for block in self.corners])
        return raster.rows_at(s, *np.add(start, np.unravel_index(place, self.whole.shape)).T)


def patches(raster: Raster, tiling: Tiling) -> tuple[Patch, ...]:
    """Divide the cells with all corners in the body into patches."""
    result = []
    for polygon in tiling.polygons:
        block = _within(raster, polygon)
        for part in _bands(raster, block) if block else ():
            corners = tuple(part.seen_through(corner) for corner in polygon.corners)
            inside = [raster.kind[corner.slices()] == FOLLOWER for corner in corners]
            patch = Patch(polygon, corners, np.logical_and.reduce(inside))
            result += [patch] if patch.whole.any() else []
    return tuple(result)


def _bands(raster: Raster, block: Block) -> Iterator[Block]:
    """Divide a block into bands of rows.

    The cuts are the same whether a raster holds the whole lattice or a part of it. This is
    necessary because the order in which contributions to a particle are added depends on the cuts.
    """
    (first, *start), (last, *stop) = block.start, block.stop
    step = max(1, CELLS_AT_ONCE // math.prod(raster.shape[2:]))
    cuts = [row for row in range(first + 1, last) if (raster.first[0] + row) % step == 0]
    for low, high in pairwise([first, *cuts, last]):
        yield Block(block.sublattice, (low, *start), (high, *stop))


@dataclass(frozen=True)
class WeighedCells:
    """Cells of the body with their weights.

    Parameters
    ----------
    tiling
        Cells of the lattice.
    share
        Area fraction of each cell inside the outline, from 0 to 1, stored at the place of the first
        corner of the cell. The shape is (kind, sublattice, cell, cell). The array is None if all
        cells are whole.
    weight
        Area fraction of each cell, times the ratio of the stiffness of the cell to the stiffness of
        the rule; 0 for the cells in `mixed`.
    mixed
        Area fractions of the cells with a stiffness that is not proportional to that of the rule,
        one array for each stiffness.
    weights
        Weights of the rule by slot, for each stiffness of `mixed`.
    phase
        Number of the material of each cell, and -1 for a cell that contains several materials. None
        if there is only one material.
    names
        For each array of `mixed`, the name of the component of the elastic stiffness.
    """

    tiling: Tiling
    share: Floats | None
    weight: Floats
    mixed: tuple[Floats, ...] = ()
    weights: tuple[dict[Slot, Any], ...] = ()
    phase: NDArray[np.int64] | None = None
    names: tuple[str, ...] = ()

    def restrict(self, to: Restriction) -> WeighedCells:
        """Return the cells restricted to some rows."""
        share = None if self.share is None else to.cut(self.share)
        is_shared = share is not None and self.weight is self.share
        return replace(
            self,
            share=share,
            weight=share if share is not None and is_shared else to.cut(self.weight),
            mixed=tuple(map(to.cut, self.mixed)),
            phase=None if self.phase is None else to.cut(self.phase),
        )

    def of(self, patch: Patch) -> Floats | float:
        """Return the area fractions of the cells of a patch."""
        if self.share is None:
            return 1.0
        return patch.corners[0].of(self.share[patch.polygon.kind])

    def beside(
        self, slot: Slot, where: Where, precision: str, shares: Floats | None = None
    ) -> tuple[Share, Share]:
        """Return the weights of the cells to the left and right of a slot.

        Parameters
        ----------
        slot
            The bond.
        where
            Particles at which the bond starts.
        precision
            Floating-point type of the result.
        shares
            Area fractions that are used in place of the weights.

        Returns
        -------
        tuple
            Weights on the left and on the right. If all weights on a side are 1, the number 1 is
            returned for it.
        """
        return self.beside_each([slot], where, precision, shares)[0]

    def beside_each(
        self, slots: Iterable[Slot], where: Where, precision: str, shares: Floats | None = None
    ) -> list[tuple[Share, Share]]:
        """Return the weights to the left and right of several slots. If the cells beside two of the
        slots are the same, they are returned as the same array."""
        values = self.weight if shares is None else shares
        sides = [side for slot in slots for side in self.tiling.beside[slot]]
        cells = {(side.kind, side.first): side for side in sides}
        weights = {key: _seen(values, side, where, precision) for key, side in cells.items()}
        shares_beside = [weights[side.kind, side.first] for side in sides]
        return list(zip(shares_beside[::2], shares_beside[1::2], strict=True))


def _seen(shares: Floats, side: Side, where: Where, precision: str) -> Share:
    """Return the area fractions of the cells on one side of a slot."""
    first_corners = where if side.first is None else where.seen_through(side.first)
    share = first_corners.of(shares[side.kind])
    if (share == 1.0).all():
        return 1.0
    share = share.astype(precision)
    share.flags.writeable = False
    return share


def whole_cells(raster: Raster, tiling: Tiling) -> WeighedCells:
    """Return the cells with all corners in the body, each with an area fraction of 1."""
    share = np.zeros((1 + max(polygon.kind for polygon in tiling.polygons), *raster.shape))
    for patch in patches(raster, tiling):
        patch.corners[0].of(share[patch.polygon.kind])[...] = patch.whole
    return WeighedCells(tiling, share, share)


def _within(raster: Raster, polygon: CellPolygon) -> Block | None:
    """Return the block of places in the body at which the first corner of a cell can lie, so that
    all other corners lie on the raster."""
    block = raster.body_block(polygon.source)
    if not block:
        return None
    steps = np.array([corner.cell for corner in polygon.corners])
    start = np.maximum(block.start, -steps.min(axis=0))
    stop = np.minimum(block.stop, raster.shape[1:] - steps.max(axis=0))
    inner = Block(polygon.source, tuple(start.tolist()), tuple(stop.tolist()))
    return inner if (start < stop).all() else None


def _polygons(cell: Cell, source: int, slots: tuple[Slot, ...]) -> Iterator[CellPolygon]:
    """Return the polygons with the first corner of sublattice `source`, counterclockwise.

    If two corners are neighbours, their distance vector is exactly the rest offset of the slot.
    """
    exact = {(slot.target, slot.cell): slot.rest for slot in slots}
    around = [replace(offset, rest=exact.get((offset.target, offset.cell), offset.rest))
              for offset in cell.offsets(source, _reach(cell))]  # fmt: skip
    polygons = []
    for places in _around_the_origin(np.array([offset.rest for offset in around])):
        corners = tuple(around[k] for k in places)
        # Each polygon occurs once for each of its corners; only one occurrence is used.
        if all(_is_ahead(offset.rest) for offset in corners):
            polygons.append((cell.offset(source, source, (0, 0)), *corners))
    polygons.sort(key=lambda polygon: math.atan2(*polygon[1].rest[::-1]))
    return (CellPolygon(source, kind, polygon) for kind, polygon in enumerate(polygons))


def _is_ahead(r: Vector[float]) -> bool:
    level = abs(r.y) <= LEVEL * math.hypot(*r)
    return bool(r.x > 0.0 if level else r.y > 0.0)


def _beside(polygons: tuple[CellPolygon, ...], slots: Slots) -> dict[Slot, tuple[Side, Side]]:
    """Return the cells beside every slot. The result is empty unless all neighbours of a particle
    are corners of its cells, and all cells are triangles or parallelograms."""
    all_slots = (slot for ends in slots for slot in ends)
    slot_of = {(slot.source, slot.target, slot.cell): slot for slot in all_slots}
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


def _step(start: Offset, end: Offset) -> Step:
    """Return the step from one corner of a polygon to another."""
    return start.target, end.target, tuple(map(sub, end.cell, start.cell))


def _is_simple(polygon: CellPolygon) -> bool:
    """Return whether the polygon is a triangle or a parallelogram."""
    r = polygon.rest
    if len(r) != 4:
        return len(r) == 3
    return math.dist(r[2], (r[1].x + r[3].x, r[1].y + r[3].y)) <= 1e-6 * math.hypot(*r[2])


def _reach(cell: Cell) -> float:
    """Return an upper bound on the length of sides and diagonals of polygons.

    Twice the radius of the largest empty circle is at most the sum of the lengths of two cell
    vectors, reduced by Gauss's algorithm.
    """
    a, b = (np.array(v) for v in cell.vectors)
    while True:
        if a @ a > b @ b:
            a, b = b, a
        shorter = b - round(float(a @ b) / float(a @ a)) * a
        if shorter @ shorter >= b @ b:
            return (math.hypot(*a) + math.hypot(*b)) * (1 + 1e-6)
        b = shorter


def _around_the_origin(x: Floats) -> Iterator[list[int]]:
    """Generate the polygons that meet at the origin, counterclockwise. A polygon is given by its
    corners other than the origin, which are among x.

    x are the surrounding sites, sorted by distance; the nearest site is always a corner. The
    polygons are those of the Delaunay tessellation. Consider a side from 0 to p, and the sites q to
    the left of it. The side is seen from q under an angle with the cotangent q·(q - p) / p×q. The
    corners of the polygon to the left of the side are the sites q with the largest angle.
    """
    side = 0
    for _ in range(len(x)):
        p = x[side]
        turn = p[0] * x[:, 1] - p[1] * x[:, 0]
        on_left = turn > 1e-12 * math.hypot(*p) * np.hypot(*x.T)
        cotangent = np.where(
            on_left, (x * (x - p)).sum(axis=1) / np.where(on_left, turn, 1.0), np.inf
        )
        smallest = cotangent.min()
        (circle,) = np.nonzero(cotangent <= smallest + 1e-9 * (1.0 + abs(smallest)))
        ahead = sorted(circle.tolist(), key=lambda k: math.atan2(turn[k], float(x[k] @ p)))
        yield [side, *ahead]
        side = ahead[-1]
        if side == 0:
            return


Key = tuple[int, int, Index]
"""Key of a cell around a particle: its kind, and the sublattice and repeat cell of its first
corner.
"""


@dataclass(frozen=True)
class CellBond:
    """Bond of a cell around a particle.

    Parameters
    ----------
    plane
        Index of the plane that stores the bond.
    slot
        Slot of the plane.
    owner
        Slot from the particle to the neighbour at which the bond is stored; None if the bond is
        stored at the particle itself.
    on_left, on_right
        Whether the cell lies to the left, or to the right, of the bond; both are true if the bond
        is a diagonal of the cell.
    """

    plane: int
    slot: Slot
    owner: Slot | None
    on_left: bool
    on_right: bool

    @property
    def side(self) -> int:
        """Side of the bond on which the cell lies: 0 for left or for both sides, 1 for right."""
        return 0 if self.on_left else 1


@dataclass(frozen=True)
class CellsAround:
    """Bonds of the cells around the particles of a sublattice.

    `cells` contains the bonds of each cell, and `beside` contains for each slot the indices of the
    cells to its left and right.
    """

    cells: tuple[tuple[CellBond, ...], ...]
    beside: dict[Slot, tuple[int, int]]


def cells_around(
    tiling: Tiling, slots: Sequence[Sequence[Slot]], planes: Sequence[Slot]
) -> tuple[CellsAround, ...]:
    """Return the cells around the particles of every sublattice.

    Parameters
    ----------
    tiling
        Cells of the lattice.
    slots
        Slots of every sublattice.
    planes
        Slots along which bonds are stored, one for each plane.

    Returns
    -------
    tuple
        One entry for each sublattice. The result is empty unless all neighbours of a particle are
        corners of its cells.
    """
    return tuple(_around(tiling, ends, planes) for ends in slots) if tiling.beside else ()


def _around(tiling: Tiling, slots: Sequence[Slot], planes: Sequence[Slot]) -> CellsAround:
    numbers: dict[Key, int] = {}
    sides = {}
    for slot in slots:
        keys = (_key(slot.source, (0,) * len(slot.cell), side) for side in tiling.beside[slot])
        left_cell, right_cell = (numbers.setdefault(key, len(numbers)) for key in keys)
        sides[slot] = left_cell, right_cell
    return CellsAround(tuple(_bonds(tiling, slots, planes, key) for key in numbers), sides)


def _key(start: int, at: Index, side: Side) -> Key:
    """Return the key of a cell beside a bond that starts on a sublattice in a repeat cell."""
    if side.first is None:
        return side.kind, start, at
    return side.kind, side.first.target, tuple(map(add, at, side.first.cell))


def _bonds(
    tiling: Tiling, slots: Sequence[Slot], planes: Sequence[Slot], key: Key
) -> tuple[CellBond, ...]:
    kind, source, first = key
    polygon = next(p for p in tiling.polygons if (p.source, p.kind) == (source, kind))
    corners = [(c.target, tuple(map(add, first, c.cell))) for c in polygon.corners]
    neighbours = {(slot.target, slot.cell): slot for slot in slots}
    bonds = []
    for plane, slot in enumerate(planes):
        for (a, start), (b, end) in permutations(corners, 2):
            if (slot.source, slot.target, slot.cell) == (a, b, tuple(map(sub, end, start))):
                on_left, on_right = (_key(a, start, side) == key for side in tiling.beside[slot])
                owner = neighbours.get((a, start))
                bonds.append(CellBond(plane, slot, owner, on_left, on_right))
    return tuple(bonds)
