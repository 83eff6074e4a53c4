"""The interfaces Lattice (a repeat cell with a basis) and NeighbourMetric (neighbours in shells),
and the cells of a lattice: polygons of neighbouring sites that tile the plane.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, reduce
from operator import add, mul, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.plugin.component import Component
from pbdkit.plugin.units import Place
from pbdkit.plugin.vector import Vector, vector

Index = tuple[int, ...]
"""One number an axis."""


PLANE_ORIGIN = Vector(0.0, 0.0)
NEARLY = 1e-9
"""What two ways to round may make of a length."""


@dataclass(frozen=True)
class BasisSite:
    """One site of the repeat cell.

    `at` is its place in the cell (lattice units), `index` its site index within the cell's
    period, `primitive` the same in the primitive basis, in which Chebyshev distance is counted.
    """

    at: Vector[float] = PLANE_ORIGIN
    index: Index = (0, 0)
    primitive: Index = (0, 0)


@dataclass(frozen=True)
class Offset:
    """From a site to another: which sublattice it lands on, and how far away.

    `cell` counts repeat cells, `site` and `primitive` are differences of site index (i, j) and of
    primitive index, `rest` is the vector in lattice units.
    """

    target: int
    cell: Index
    site: Index
    primitive: Index
    rest: Vector[float]

    @property
    def length(self) -> float:
        """|rest|, in lattice units."""
        return math.hypot(*self.rest)


@cache
def _of_one_site(axes: int) -> tuple[tuple[BasisSite], Index, tuple[Index, ...]]:
    """The sites, period and primitive steps of a cell with one site at its corner."""
    nowhere, every = (0,) * axes, range(axes)
    corner = BasisSite(vector(map(float, nowhere)), nowhere, nowhere)
    return (corner,), (1,) * axes, tuple(tuple(int(a == b) for b in every) for a in every)


@dataclass(frozen=True)
class Cell:
    """The repeat cell of a lattice, with as many vectors as space has axes.

    Sites carry integer indices (i, j). The cell repeats every `period[0]` of i along
    `vectors[0]`, every `period[1]` of j along `vectors[1]` and so on; the site with index (i, j)
    has the basis site whose `index` is (i mod period[0], j mod period[1]), and where there is none
    the lattice has a hole. `primitive` gives each cell vector in the primitive basis. What is left
    out is that of one site a cell, at its corner.
    """

    vectors: tuple[Vector[float], ...]
    sites: tuple[BasisSite, ...] = ()
    period: Index = ()
    primitive: tuple[Index, ...] = ()

    def __post_init__(self) -> None:
        sites, period, steps = _of_one_site(len(self.vectors))
        object.__setattr__(self, "sites", self.sites or sites)
        object.__setattr__(self, "period", self.period or period)
        object.__setattr__(self, "primitive", self.primitive or steps)

    @property
    def axes(self) -> int:
        """How many axes space has."""
        return len(self.vectors)

    @cached_property
    def basis(self) -> NDArray[np.float64]:
        """Positions of the sites in the cell, (sublattice, axis)."""
        return np.array([site.at for site in self.sites])

    @cached_property
    def sublattices(self) -> NDArray[np.intp]:
        """Sublattice of each site index within the period, -1 at a hole."""
        result = np.full(self.period, -1, np.intp)
        for sublattice, site in enumerate(self.sites):
            result[site.index] = sublattice
        return result

    def shift(self, cell: Iterable[Any]) -> Any:
        """m·a + n·b, the vector from a repeat cell to that `cell` further on; numbers or arrays."""
        steps = [n * v for n, v in zip(cell, self.vectors, strict=True)]
        return sum(steps[1:], steps[0])

    def offset(self, source: int, target: int, cell: Index) -> Offset:
        """The offset from sublattice `source` to `target`, `cell` repeat cells on.

        The reverse offset has exactly the negated `rest`: every operation here is odd.
        """
        here, there = self.sites[source], self.sites[target]
        periods = map(mul, cell, self.period)
        return Offset(
            target,
            cell,
            tuple(map(add, map(sub, there.index, here.index), periods)),
            self.primitive_step(source, target, cell),
            (there.at - here.at) + self.shift(cell),
        )

    def primitive_step(self, source: int, target: int, cell: Index) -> Index:
        """The same offset in the primitive basis."""
        here, there = self.sites[source].primitive, self.sites[target].primitive
        along = (sum(map(mul, cell, step)) for step in zip(*self.primitive, strict=True))
        return tuple(map(add, map(sub, there, here), along))

    def offsets(self, source: int, radius: float) -> list[Offset]:
        """All offsets from a site of `source` with 0 < |rest| ≤ radius, the nearest first."""
        sites = self.basis
        cells = np.array(list(self._cells_within(radius + 2 * np.linalg.norm(sites, axis=1).max())))
        rests = (cells @ np.array(self.vectors))[:, None] + (sites - sites[source])
        near = np.argwhere(np.linalg.norm(rests, axis=2) <= radius * (1 + NEARLY))
        found = [self.offset(source, t, tuple(cells[n].tolist())) for n, t in near.tolist()]
        others = [offset for offset in found if any(offset.site) and offset.length <= radius]
        return sorted(others, key=lambda o: (o.length, o.site))

    def _cells_within(self, radius: float) -> Iterator[Index]:
        """All repeat cells within a radius, and few others: axis by axis, of each the range that
        the axes before leave (Fincke and Pohst); of nearly collinear vectors all combinations would
        be too many."""
        # Columns in reverse, so that the first axis is the outermost.
        R = np.linalg.qr(np.array(self.vectors[::-1]).T, mode="r")

        def inside(fixed: Index) -> Iterator[Index]:
            left = len(R) - len(fixed)
            if not left:
                yield fixed
                return
            row = R[left - 1]
            centre = -sum(row[len(R) - 1 - n] * m for n, m in enumerate(fixed)) / row[left - 1]
            half = radius / abs(row[left - 1])
            for n in range(math.floor(centre - half), math.ceil(centre + half) + 1):
                yield from inside((*fixed, n))

        yield from inside(())


class Lattice(Component):
    """Where sites lie: a repeat cell with one or more sites, from `origin`, in lattice units.

    To add a lattice, write `cell`. A site has an integer index (i, j); (0, 0) lies at `origin`.
    """

    origin: Place = Field((0.0, 0.0), description="Where site (0, 0) lies (lattice units).")

    @abstractmethod
    def cell(self) -> Cell:
        """The repeat cell; see Cell for what it must tell."""


@dataclass(frozen=True)
class Slot:
    """One neighbour that every particle of a sublattice has, at a constant offset.

    `source` and `target` are sublattices, `cell` the step between repeat cells, `site` between
    site indices, `rest` the rest offset R = X_k - X_j (lattice units), `shell` counts from 1.
    """

    source: int
    target: int
    cell: Index
    site: Index
    rest: Vector[float]
    shell: int


@dataclass(frozen=True)
class Nearness:
    """Who is near in the current configuration: √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9)."""

    radius: float
    weights: tuple[float, ...]


class NeighbourMetric(Component):
    """Chooses the neighbours of a site on the infinite lattice, by shells.

    To add a metric, write `shells_around`. Neighbourhood is mutual: with the offset from j to k
    the offset from k to j must be chosen too, in the same shell, or the metric is refused.
    """

    @abstractmethod
    def shells_around(self, cell: Cell, sublattice: int) -> Sequence[Sequence[Offset]]:
        """The neighbours of a site of `sublattice`, the first shell first.

        Offsets come from `cell.offsets(sublattice, radius)`, which lists all within a radius.
        """

    def nearness(self) -> Nearness | None:
        """How neighbours are found anew at every step; by default they stay as they are at
        step 0, as in a solid."""
        return None


@dataclass(frozen=True)
class CellPolygon:
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
    def rest(self) -> tuple[Vector[float], ...]:
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

    polygons: tuple[CellPolygon, ...] = ()
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
