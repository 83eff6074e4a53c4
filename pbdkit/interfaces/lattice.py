"""The Lattice interface: a repeat cell with a basis, and the offsets between its sites."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

from pydantic import Field

from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.vector import Vector

Index = tuple[int, int]

ORIGIN = Vector(0.0, 0.0)


@dataclass(frozen=True)
class BasisSite:
    """One site of the repeat cell.

    `at` is its place in the cell (lattice units), `index` its site index within the cell's
    period, `primitive` the same in the primitive basis, in which Chebyshev distance is counted.
    """

    at: Vector = ORIGIN
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
    rest: Vector

    @property
    def length(self) -> float:
        """|rest|, in lattice units."""
        return math.hypot(*self.rest)


@dataclass(frozen=True)
class Cell:
    """The repeat cell of a lattice.

    Sites carry integer indices (i, j). The cell repeats every `period[0]` of i along
    `vectors[0]` and every `period[1]` of j along `vectors[1]`; the site with index (i, j) has the
    basis site whose `index` is (i mod period[0], j mod period[1]), and where there is none the
    lattice has a hole. `primitive` gives each cell vector in the primitive basis.
    """

    vectors: tuple[Vector, Vector]
    sites: tuple[BasisSite, ...] = (BasisSite(),)
    period: Index = (1, 1)
    primitive: tuple[Index, Index] = ((1, 0), (0, 1))

    def offset(self, source: int, target: int, cell: Index) -> Offset:
        """The offset from sublattice `source` to `target`, `cell` repeat cells on.

        The reverse offset has exactly the negated `rest`: every operation here is odd.
        """
        a, b = self.vectors
        here, there = self.sites[source], self.sites[target]
        m, n = cell
        return Offset(
            target,
            cell,
            (
                there.index[0] - here.index[0] + m * self.period[0],
                there.index[1] - here.index[1] + n * self.period[1],
            ),
            (
                there.primitive[0] - here.primitive[0]
                + m * self.primitive[0][0] + n * self.primitive[1][0],
                there.primitive[1] - here.primitive[1]
                + m * self.primitive[0][1] + n * self.primitive[1][1],
            ),
            Vector(
                there.at.x - here.at.x + (m * a.x + n * b.x),
                there.at.y - here.at.y + (m * a.y + n * b.y),
            ),
        )  # fmt: skip

    def offsets(self, source: int, radius: float) -> list[Offset]:
        """All offsets from a site of `source` with 0 < |rest| ≤ radius, the nearest first."""
        a, b = self.vectors
        area = abs(a.x * b.y - a.y * b.x)
        spread = radius + max(math.hypot(*s.at) for s in self.sites) * 2
        # |m| of a cell that reaches within `spread`, and for each m the n: of nearly collinear
        # vectors all pairs would be too many.
        m_max, half = math.ceil(spread * math.hypot(*b) / area), spread / math.hypot(*b)
        tilt = (a.x * b.x + a.y * b.y) / (b.x * b.x + b.y * b.y)
        here = self.sites[source].at
        steps = [(t, s.at.x - here.x, s.at.y - here.y) for t, s in enumerate(self.sites)]
        found = []
        for m in range(-m_max, m_max + 1):
            for n in range(math.floor(-m * tilt - half), math.ceil(-m * tilt + half) + 1):
                x, y = m * a.x + n * b.x, m * a.y + n * b.y
                near = [t for t, dx, dy in steps if math.hypot(dx + x, dy + y) <= radius]
                found += [self.offset(source, target, (m, n)) for target in near]
        others = [offset for offset in found if offset.site != (0, 0)]
        return sorted(others, key=lambda o: (o.length, o.site))


class Lattice(Component):
    """Where sites lie: a repeat cell with one or more sites, from `origin`, in lattice units.

    To add a lattice, write `cell`. A site has an integer index (i, j); (0, 0) lies at `origin`.
    """

    origin: Pair = Field((0.0, 0.0), description="Where site (0, 0) lies (lattice units).")

    @abstractmethod
    def cell(self) -> Cell:
        """The repeat cell; see Cell for what it must tell."""
