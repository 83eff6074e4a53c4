"""Lattices with a basis for pbdkit, and neighbours by the number of bonds between two sites.

Both lattices are hexagonal lattices with vacant sites, with the site index (i, j) of the
hexagonal lattice:
x = a (i + 1/2 if j is odd), y = j a √3/2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from pbdkit.plugin import (
    BasisSite,
    Cell,
    Component,
    Lattice,
    NeighbourMetric,
    Offset,
    Vector,
    hookimpl,
    length,
)

pbdkit_api = 1


class _Vacant(Lattice):
    """Hexagonal lattice with vacant sites."""

    a: float = Field(1.0, gt=0.0, description="Length of a bond (lattice units).")

    def _cell(self, period: tuple[int, int], occupied: Sequence[tuple[int, int]]) -> Cell:
        """Return the repeat cell of `period` hexagonal sites of which some are occupied."""
        a, row = _triangle(self.a)
        columns, rows = period
        return Cell(
            vectors=(Vector(columns * a, 0.0), Vector(0.0, rows * row)),
            sites=tuple(
                BasisSite(Vector((i + j % 2 / 2) * a, j * row), (i, j), (i - j // 2, j))
                for i, j in occupied
            ),
            period=period,
            primitive=((columns, 0), (-(rows // 2), rows)),
        )


class Kagome(_Vacant):
    """Kagome lattice: triangles that share their corners, with four neighbours per site.

    A quarter of the hexagonal sites is vacant, every other site of every other row. Each site is a
    centre of inversion; the area per site is 2/√3 a².
    """

    type: Literal["kagome"] = "kagome"

    def cell(self) -> Cell:
        """Return the repeat cell: six sites in a rectangle of 2 a × 2√3 a."""
        return self._cell((2, 4), ((0, 0), (1, 0), (0, 1), (0, 2), (1, 2), (1, 3)))


class Honeycomb(_Vacant):
    """Honeycomb lattice: hexagons, with three neighbours per site and one bond along x.

    A third of the hexagonal sites is vacant, the centres of the hexagons. Sites are not centres of
    inversion; the area per site is 3√3/4 a².
    """

    type: Literal["honeycomb"] = "honeycomb"

    def cell(self) -> Cell:
        """Return the repeat cell: four sites in a rectangle of 3 a × √3 a."""
        return self._cell((3, 2), ((0, 0), (1, 0), (1, 1), (2, 1)))


class BondSteps(NeighbourMetric):
    """Shells by the number of bonds to a site, where bonds connect nearest sites.

    Distance does not distinguish all neighbours of a lattice with a basis: on the kagome lattice
    four sites at distance 2 a lie behind a neighbour (two bonds), two across a hexagon (three
    bonds).
    """

    type: Literal["bond-steps"] = "bond-steps"
    shells: int = Field(
        1, ge=1, le=8, description="Largest number of bonds between neighbours.", examples=[2]
    )

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Return the neighbours of a site by the number of bonds, by breadth-first search."""
        bonds = _nearest(cell)
        reach = self.shells * max(bond.length for around in bonds for bond in around) * (1 + 1e-9)
        offsets = {o.site: o for o in cell.offsets(sublattice, reach)}
        visited, front = {(0, 0)}, {(0, 0): sublattice}
        shells = []
        for _ in range(self.shells):
            adjacent = {
                (i + bond.site[0], j + bond.site[1]): bond.target
                for (i, j), source in front.items()
                for bond in bonds[source]
            }
            front = {site: target for site, target in adjacent.items() if site not in visited}
            visited |= front.keys()
            shells.append([o for site, o in offsets.items() if site in front])
        return shells


def _nearest(cell: Cell) -> list[list[Offset]]:
    """Return the bonds of each sublattice to the nearest sites, within 1e-6 relative."""
    # A cell vector connects sites of one sublattice, so the nearest site is not farther away.
    radius = min(math.hypot(*vector) for vector in cell.vectors) * (1 + 1e-6)
    around = [cell.offsets(s, radius) for s in range(len(cell.sites))]
    shortest = min(offsets[0].length for offsets in around)
    return [[o for o in offsets if o.length <= shortest * (1 + 1e-6)] for offsets in around]


def _triangle(side: float) -> tuple[float, float]:
    """Return side and height of the equilateral triangle; the side changes by less than 1e-13.

    The rounding keeps a body at rest exactly at rest on the honeycomb lattice too, where no bond
    has an opposite one. The side has 48 of the 53 binary digits, so that its small multiples are
    exact and three bonds sum to zero. The three sides have equal lengths to the last digit, so that
    rules with weights by distance weight them equally.
    """
    digits, exponent = math.frexp(side)
    whole = round(math.ldexp(digits, 48))
    sides = (math.ldexp(whole + n, exponent - 48) for n in range(16))
    return next((a, h) for a in sides for h in _heights(a))


def _heights(side: float) -> list[float]:
    """Return the numbers next to side · √3/2 for which the computed length of a side is exact."""
    height = side * math.sqrt(3.0) / 2
    near = (height + n * math.ulp(height) for n in range(-4, 5))
    return [h for h in near if length(Vector(side / 2, h)) == side]


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """Return the components of this distribution."""
    return [Kagome, Honeycomb, BondSteps]
