"""The five plane Bravais lattices (figure 1 of the paper)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from pbdkit.plugin import BasisSite, Cell, Lattice, Vector
from pbdkit.plugin.units import LENGTH

Spacing = Annotated[float, Field(ge=1e-100, le=1e100), LENGTH]
"""Type of a lattice constant. The bounds keep squared lengths finite."""

A = Field(description="Distance of the sites along a row (lattice units).", examples=[1.0])
"""Field of the lattice constant along a row."""
B = Field(description="Length of the second edge of the rectangle (lattice units).", examples=[1.3])
"""Field of the second edge of a rectangular cell."""


class Square(Lattice):
    """Square lattice with sites at (i·a, j·a)."""

    type: Literal["square"] = "square"
    a: Spacing = A

    def cell(self) -> Cell:
        """Return a cell with one site."""
        return Cell((Vector(self.a, 0.0), Vector(0.0, self.a)))


class Rectangular(Lattice):
    """Rectangular lattice with sites at (i·a, j·b)."""

    type: Literal["rectangular"] = "rectangular"
    a: Spacing = A
    b: Spacing = B

    def cell(self) -> Cell:
        """Return a cell with one site."""
        return Cell((Vector(self.a, 0.0), Vector(0.0, self.b)))


class Oblique(Lattice):
    """Oblique lattice with sites at i·(a, 0) + j·b·(cos angle, sin angle), the angle in degrees."""

    type: Literal["oblique"] = "oblique"
    a: Spacing = A
    b: Spacing = Field(
        description="Distance of the sites along the slanted line (lattice units).", examples=[0.9]
    )
    angle: Annotated[float, Field(gt=0.0, lt=180.0)] = Field(
        description="Angle between row and slanted line (degrees).", examples=[65.0]
    )

    def cell(self) -> Cell:
        """Return a cell with one site."""
        angle = math.radians(self.angle)
        slanted = Vector(self.b * math.cos(angle), self.b * math.sin(angle))
        return Cell((Vector(self.a, 0.0), slanted))


class CentredRectangular(Lattice):
    """Centred rectangular lattice: rows at the distance b/2, every second one shifted by a/2."""

    type: Literal["centred-rectangular"] = "centred-rectangular"
    a: Spacing = A
    b: Spacing = B

    def cell(self) -> Cell:
        """Return a rectangular cell a × b with a second site in its centre."""
        return _rows(self.a, self.b)


class Hexagonal(Lattice):
    """Hexagonal lattice: rows at the distance a·√3/2, every second one shifted by a/2.

    Each site has six neighbours at the distance a.
    """

    type: Literal["hexagonal"] = "hexagonal"
    a: Spacing = A

    def cell(self) -> Cell:
        """Return a rectangular cell a × a√3 with a second site in its centre."""
        return _rows(self.a, self.a * math.sqrt(3.0))


def _rows(a: float, b: float) -> Cell:
    # The primitive basis is along the row and along the slanted line of sites: p = i - floor(j/2),
    # q = j.
    return Cell(
        vectors=(Vector(a, 0.0), Vector(0.0, b)),
        sites=(BasisSite(), BasisSite(Vector(a / 2, b / 2), index=(0, 1), primitive=(0, 1))),
        period=(1, 2),
        primitive=((1, 0), (-1, 2)),
    )
