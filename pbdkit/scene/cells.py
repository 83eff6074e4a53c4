"""The cells of a lattice between neighbours, and the share of each that belongs to the body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Slot
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.places import Where

Floats = NDArray[np.float64]
Share = NDArray[np.floating[Any]] | float
Corners = tuple[Slot | None, ...]
"""The corners of a cell as slots of its first one, which is None itself; counterclockwise."""


@dataclass(frozen=True)
class Side:
    """The cell to one side of a bond: which kind it is, and the slot from the bond's start to the
    cell's first corner (None: the start itself)."""

    kind: int
    first: Slot | None


@dataclass(frozen=True)
class Tiling:
    """The cells between a site and its neighbours: quadrilaterals, or triangles of two kinds.

    `corners[s][kind]` belong to the cell whose first corner is a site of sublattice s;
    `beside[slot]` are the cells to the left and to the right of a slot.
    """

    corners: tuple[tuple[Corners, ...], ...]
    beside: dict[Slot, tuple[Side, Side]]


def tiling_of(neighbourhood: Neighbourhood) -> Tiling:
    """The cells of lattices whose sites have 8 neighbours around quadrilaterals, or 6 around
    triangles; ExperimentError for others."""
    sectors: tuple[tuple[int, int | None], ...]
    corners: tuple[tuple[Corners, ...], ...]
    around = [_ring(slots) for slots in neighbourhood.slots]
    if all(map(_is_ring_of_triangles, around)):
        corners = tuple(((None, s[0], s[1]), (None, s[1], s[2])) for s in around)
        # Sector by sector around a site: which cell lies there, and where its first corner is.
        sectors = ((0, None), (1, None), (0, 3), (1, 4), (0, 4), (1, 5))
    elif all(map(_is_ring_of_quadrilaterals, around)):
        corners = tuple(((None, s[0], s[1], s[2]),) for s in around)
        sectors = ((0, None),) * 2 + ((0, 4),) * 2 + ((0, 5),) * 2 + ((0, 6),) * 2
    else:
        raise ExperimentError(
            "the cells between these neighbours are not known: take 8 neighbours around "
            "quadrilaterals ({type: chebyshev, shells: 1}) or the 6 of the hexagonal lattice"
        )
    beside: dict[Slot, tuple[Side, Side]] = {}
    for slots in around:
        sides = [Side(kind, None if n is None else slots[n]) for kind, n in sectors]
        beside |= {slot: (sides[n], sides[n - 1]) for n, slot in enumerate(slots)}
    return Tiling(corners, beside)


def _ring(slots: tuple[Slot, ...]) -> list[Slot]:
    """The slots counterclockwise; around quadrilaterals an edge comes first."""
    ring = sorted(slots, key=lambda slot: math.atan2(slot.rest.y, slot.rest.x) % (2 * math.pi))
    turned = ring[1:] + ring[:1]
    return turned if _is_ring_of_quadrilaterals(turned) else ring


def _is_ring_of_triangles(slots: list[Slot]) -> bool:
    """Whether each neighbour is the sum of the two next to it."""
    return len(slots) == 6 and all(
        _adds_up(slots[n], slots[n - 1], slots[(n + 1) % 6]) for n in range(6)
    )


def _is_ring_of_quadrilaterals(slots: list[Slot]) -> bool:
    """Whether every second neighbour is the sum of the two next to it."""
    return len(slots) == 8 and all(
        _adds_up(slots[n], slots[n - 1], slots[(n + 1) % 8]) for n in (1, 3, 5, 7)
    )


def _adds_up(middle: Slot, one: Slot, other: Slot) -> bool:
    x, y = (a + b - m for a, b, m in zip(one.rest, other.rest, middle.rest, strict=True))
    return math.hypot(x, y) <= 1e-6 * math.hypot(*middle.rest)


@dataclass(frozen=True)
class Cells:
    """The body's cells: `share` (kind, sublattice, cell, cell) of the cell whose first corner is
    at that place of the raster, 0 to 1."""

    tiling: Tiling
    share: Floats

    def beside(self, slot: Slot, where: Where, precision: str) -> tuple[Share, Share]:
        """The shares to the left and the right of a slot; 1 where all are whole."""
        left, right = (self._seen(side, where, precision) for side in self.tiling.beside[slot])
        return left, right

    def _seen(self, side: Side, where: Where, precision: str) -> Share:
        there = where if side.first is None else where.seen_through(side.first)
        share = there.of(self.share[side.kind])
        if (share == 1.0).all():
            return 1.0
        share = share.astype(precision)
        share.flags.writeable = False
        return share
