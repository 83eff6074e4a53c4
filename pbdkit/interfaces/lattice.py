"""The Lattice interface: a repeat cell with a basis, and the offsets between its sites."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from pydantic import Field

from pbdkit.interfaces.component import Component
from pbdkit.interfaces.units import Place
from pbdkit.interfaces.vector import Components, Vector, vector

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

    at: Components = PLANE_ORIGIN
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
    rest: Components

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

    vectors: tuple[Components, ...]
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

    def shift(self, cell: Iterable[Any]) -> Any:
        """m·a + n·b, the vector from a repeat cell to that `cell` further on; numbers or arrays."""
        steps = [n * v for n, v in zip(cell, self.vectors, strict=True)]
        return sum(steps[1:], steps[0])

    def offset(self, source: int, target: int, cell: Index) -> Offset:
        """The offset from sublattice `source` to `target`, `cell` repeat cells on.

        The reverse offset has exactly the negated `rest`: every operation here is odd.
        """
        here, there = self.sites[source], self.sites[target]
        axes = range(self.axes)
        return Offset(
            target,
            cell,
            tuple(there.index[n] - here.index[n] + cell[n] * self.period[n] for n in axes),
            self.primitive_step(source, target, cell),
            (there.at - here.at) + self.shift(cell),
        )

    def primitive_step(self, source: int, target: int, cell: Index) -> Index:
        """The same offset in the primitive basis."""
        here, there = self.sites[source].primitive, self.sites[target].primitive
        steps = zip(*self.primitive, strict=True)
        along = (sum(n * m for n, m in zip(cell, step, strict=True)) for step in steps)
        return tuple(b - a + n for a, b, n in zip(here, there, along, strict=True))

    def offsets(self, source: int, radius: float) -> list[Offset]:
        """All offsets from a site of `source` with 0 < |rest| ≤ radius, the nearest first."""
        sites = np.array([site.at for site in self.sites])
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
