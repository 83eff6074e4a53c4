"""The cells around a particle, and the bonds of each: what the damage of a cell is found from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from operator import add, sub

from pbdkit.interfaces import Slot
from pbdkit.interfaces.lattice import Index
from pbdkit.interfaces.polygons import Side, Tiling

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
