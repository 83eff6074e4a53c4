"""Lattices with a basis for pbdkit, and neighbours by the number of bonds between two sites.

Both lattices are the hexagonal lattice with sites left out, and keep its site index (i, j):
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
    """What hexagonal lattices with vacancies share: the sites that are left of a rectangle."""

    a: float = Field(1.0, gt=0.0, description="Length of a bond (lattice units).")

    def _cell(self, period: tuple[int, int], kept: Sequence[tuple[int, int]]) -> Cell:
        """The rectangle of `period` sites of the hexagonal lattice, with those that are `kept`."""
        a, row = _triangle(self.a)
        columns, rows = period
        return Cell(
            vectors=(Vector(columns * a, 0.0), Vector(0.0, rows * row)),
            sites=tuple(
                BasisSite(Vector((i + j % 2 / 2) * a, j * row), (i, j), (i - j // 2, j))
                for i, j in kept
            ),
            period=period,
            primitive=((columns, 0), (-(rows // 2), rows)),
        )


class Kagome(_Vacant):
    """The kagome lattice: triangles that share their corners, four neighbours a site.

    A quarter of the hexagonal lattice is left out, every other site of every other row. Each site
    is a centre of inversion; a site has the area 2/√3 a².
    """

    type: Literal["kagome"] = "kagome"

    def cell(self) -> Cell:
        """Six sites in a rectangle of 2 a × 2√3 a."""
        return self._cell((2, 4), ((0, 0), (1, 0), (0, 1), (0, 2), (1, 2), (1, 3)))


class Honeycomb(_Vacant):
    """The honeycomb lattice: hexagons, three neighbours a site, one of the bonds along x.

    A third of the hexagonal lattice is left out, the middles of the hexagons. Sites are no centres
    of inversion; a site has the area 3√3/4 a².
    """

    type: Literal["honeycomb"] = "honeycomb"

    def cell(self) -> Cell:
        """Four sites in a rectangle of 3 a × √3 a."""
        return self._cell((3, 2), ((0, 0), (1, 0), (1, 1), (2, 1)))


class BondSteps(NeighbourMetric):
    """Shell n is everybody who is n bonds away, where bonds join the nearest sites.

    Distance alone cannot tell the neighbours of a lattice with a basis apart: on the kagome
    lattice four sites at distance 2 a lie behind a neighbour (two bonds), two across a hexagon
    (three bonds).
    """

    type: Literal["bond-steps"] = "bond-steps"
    shells: int = Field(
        1, ge=1, le=8, description="How many bonds away neighbours are at most.", examples=[2]
    )

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Breadth first over the bonds of all sublattices."""
        bonds = _nearest(cell)
        reach = self.shells * max(bond.length for own in bonds for bond in own) * (1 + 1e-9)
        known = {o.site: o for o in cell.offsets(sublattice, reach)}
        met, front = {(0, 0)}, {(0, 0): sublattice}
        shells = []
        for _ in range(self.shells):
            beyond = {
                (i + bond.site[0], j + bond.site[1]): bond.target
                for (i, j), here in front.items()
                for bond in bonds[here]
            }
            front = {site: target for site, target in beyond.items() if site not in met}
            met |= front.keys()
            shells.append([o for site, o in known.items() if site in front])
        return shells


def _nearest(cell: Cell) -> list[list[Offset]]:
    """The bonds of each sublattice: to the nearest sites of the lattice, within 1e-6 relative."""
    # A cell vector leads to a site of the same sublattice: nobody's nearest is farther away.
    radius = min(math.hypot(*vector) for vector in cell.vectors) * (1 + 1e-6)
    around = [cell.offsets(s, radius) for s in range(len(cell.sites))]
    shortest = min(own[0].length for own in around)
    return [[o for o in own if o.length <= shortest * (1 + 1e-6)] for own in around]


def _triangle(side: float) -> tuple[float, float]:
    """Side and height of the equilateral triangle, the side changed by less than 1e-13 of it.

    So rounded that a body at rest stays on the honeycomb lattice too, where no bond has an opposite
    one: the side has 48 of the 53 binary digits, so that its small multiples are exact and three
    bonds add up to zero; and the three sides have one length to the last digit, so that rules that
    weigh neighbours by their distance weigh them alike.
    """
    digits, exponent = math.frexp(side)
    whole = round(math.ldexp(digits, 48))
    sides = (math.ldexp(whole + n, exponent - 48) for n in range(16))
    return next((a, h) for a in sides for h in _heights(a))


def _heights(side: float) -> list[float]:
    """Floating-point numbers around side · √3/2 that length finds to be the height."""
    height = side * math.sqrt(3.0) / 2
    near = (height + n * math.ulp(height) for n in range(-4, 5))
    return [h for h in near if length(Vector(side / 2, h)) == side]


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """What this distribution offers."""
    return [Kagome, Honeycomb, BondSteps]
