"""The cells of a lattice: polygons of neighbouring sites that tile the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any

import numpy as np

from pbdkit.interfaces.lattice import Offset
from pbdkit.interfaces.neighbour_metric import Slot
from pbdkit.interfaces.vector import Components


@dataclass(frozen=True)
class Polygon:
    """A cell: sites on one circle with no site inside it (Delaunay's; the square lattice's squares,
    the hexagonal one's triangles). It is met once for each site of sublattice `source`, as number
    `kind` of those that are.

    `corners` are the offsets from that site to all corners, itself first, counter-clockwise. The
    first corner is the lowest, of those the leftmost.
    """

    source: int
    kind: int
    corners: tuple[Offset, ...]

    @cached_property
    def rest(self) -> tuple[Components, ...]:
        """X_k - X_0 of the corners, lattice units."""
        return tuple(corner.rest for corner in self.corners)

    @cached_property
    def rectangle(self) -> tuple[float, float] | None:
        """The sides (a, b) of a rectangle along the axes."""
        if len(self.rest) != 4:
            return None
        _, right, opposite, up = self.rest
        a, b = right.x, up.y
        off = math.hypot(right.y, up.x, opposite.x - a, opposite.y - b)
        return (a, b) if off <= 1e-9 * math.hypot(a, b) else None

    @cached_property
    def is_regular(self) -> bool:
        """Whether all sides are equal, and so, on a circle, all angles."""
        sides = [math.dist(self.rest[k - 1], self.rest[k]) for k in range(len(self.rest))]
        return max(sides) - min(sides) <= 1e-9 * max(sides)


@dataclass(frozen=True)
class Side:
    """A cell beside a bond: the polygon number `kind` of the sublattice of its first corner, which
    lies at slot `first` of the bond's start (None: the start itself); the bond leads from corner
    `start` to corner `end`."""

    kind: int
    first: Slot | None
    start: int
    end: int


@dataclass(frozen=True)
class Tiling:
    """The cells of a lattice, and which of them lie beside the bonds.

    `beside[slot]` are the cells to the left and to the right of a slot, for a diagonal one cell
    twice. It is empty unless the neighbours of every site are the corners of the cells around it,
    triangles or parallelograms: 8 on the square and rectangular lattices, 6 on the hexagonal one.
    """

    polygons: tuple[Polygon, ...] = ()
    beside: dict[Slot, tuple[Side, Side]] = field(default_factory=dict)

    @cached_property
    def rectangle(self) -> tuple[float, float] | None:
        """The sides of the cells beside the bonds, where all are one rectangle along the axes."""
        sides = {polygon.rectangle for polygon in self.polygons}
        return sides.pop() if self.beside and len(sides) == 1 else None

    @cached_property
    def regular(self) -> int | None:
        """3 where the cells beside the bonds are equilateral triangles, 4 where they are squares,
        in whatever direction."""
        kinds = {len(cell.corners) if cell.is_regular else None for cell in self.polygons}
        return kinds.pop() if self.beside and len(kinds) == 1 else None

    def is_diagonal(self, slot: Slot) -> bool:
        """Whether a slot crosses a cell, which is then on both of its sides."""
        left, right = self.beside[slot]
        return left == right


def signed_area(corners: Sequence[Any]) -> Any:
    """The area of a polygon, counter-clockwise; negative where it is inside out. Elementwise."""
    pairs = [(corners[k - 1], corners[k]) for k in range(len(corners))]
    return sum(a.x * b.y - b.x * a.y for a, b in pairs) / 2


def area_share(d: Sequence[Any], r: Sequence[Any]) -> Any:
    """The signed area of a polygon whose corners have gone by d from r, over that at rest."""
    now = [a + b for a, b in zip(r, d, strict=True)]
    return signed_area(now) / signed_area(r)


def corner_share(d: Sequence[Any], r: Sequence[Any]) -> Any:
    """The smallest of the same of the triangles at its corners, each spanned by the two sides that
    meet there: all are positive exactly where a polygon is convex and the right way round."""
    triples = [(k - 1, k, (k + 1) % len(r)) for k in range(len(r))]
    shares = (area_share([d[k] for k in three], [r[k] for k in three]) for three in triples)
    return reduce(np.minimum, shares)
