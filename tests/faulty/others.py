"""Lattices, neighbour metrics, frames, fracture models and diagnostics with one fault each."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

import pbdkit
from pbdkit.plugin import (
    LENGTH,
    Anchors,
    BasisSite,
    Cell,
    FrameMap,
    Nearness,
    Variable,
    Vector,
    squared_length,
)


class Twins(pbdkit.Lattice):
    """Two sites in one place."""

    type: Literal["twins"] = "twins"

    def cell(self):
        twin = BasisSite(Vector(0.0, 0.0), index=(0, 1), primitive=(0, 1))
        return Cell(
            (Vector(1.0, 0.0), Vector(0.0, 2.0)),
            (BasisSite(), twin),
            period=(1, 2),
            primitive=((1, 0), (0, 2)),
        )


class Flat(pbdkit.Lattice):
    """Both cell vectors along x."""

    type: Literal["flat"] = "flat"

    def cell(self):
        return Cell((Vector(1.0, 0.0), Vector(2.0, 0.0)))


class Rows(pbdkit.Lattice):
    """A square lattice defined by two rows a cell; it has no fault."""

    type: Literal["rows"] = "rows"
    across: ClassVar[float] = 0.0
    primitive: ClassVar[tuple] = ((1, 0), (0, 2))

    def cell(self):
        second = BasisSite(Vector(self.across, 1.0), index=(0, 1), primitive=(0, 1))
        return Cell(
            (Vector(1.0, 0.0), Vector(0.0, 2.0)),
            (BasisSite(), second),
            period=(1, 2),
            primitive=self.primitive,
        )


class Astray(Rows):
    """The second row lies a cell farther than its index."""

    type: Literal["astray"] = "astray"
    across: ClassVar[float] = 1.0
    primitive: ClassVar[tuple] = ((1, 0), (-1, 2))


class Miscounts(Rows):
    """Upwards from the first row is another step than from the second."""

    type: Literal["miscounts"] = "miscounts"
    primitive: ClassVar[tuple] = ((1, 0), (1, 2))


class Skips(pbdkit.Lattice):
    """Every other index along x has no site."""

    type: Literal["skips"] = "skips"

    def cell(self):
        vectors = Vector(1.0, 0.0), Vector(0.0, 1.0)
        return Cell(vectors, primitive=((2, 0), (0, 1)))


class Rooted(pbdkit.Lattice):
    """A square lattice that grows with the distance of its origin."""

    type: Literal["rooted"] = "rooted"

    def cell(self):
        a = 1.0 + 1e-9 * abs(self.origin[0])
        return Cell((Vector(a, 0.0), Vector(0.0, a)))


class OneSided(pbdkit.NeighbourMetric):
    """Neighbours to the right only."""

    type: Literal["one-sided"] = "one-sided"

    def shells_around(self, cell, sublattice):
        return [[o for o in cell.offsets(sublattice, 1.5) if o.rest.x > 0.0]]


class Approximate(pbdkit.NeighbourMetric):
    """Rest offsets to ten digits."""

    type: Literal["approximate"] = "approximate"
    radius: Annotated[float, LENGTH] = Field(1.35, description="How far it sees.")

    def shells_around(self, cell, sublattice):
        shell = cell.offsets(sublattice, self.radius)
        return [[replace(o, rest=(1.0 + 1e-10) * o.rest) for o in shell]]


class Favours(pbdkit.NeighbourMetric):
    """The first sublattice sees farther within itself."""

    type: Literal["favours"] = "favours"
    radius: Annotated[float, LENGTH] = Field(1.45, description="How far it sees.")

    def shells_around(self, cell, sublattice):
        near = cell.offsets(sublattice, self.radius)
        far = [
            o for o in cell.offsets(sublattice, 1.3 * self.radius) if o.target == sublattice == 0
        ]
        return [list(dict.fromkeys([*near, *far]))]


class Contradicts(pbdkit.NeighbourMetric):
    """Chooses neighbours within one radius and re-evaluates them within another."""

    type: Literal["contradicts"] = "contradicts"

    def shells_around(self, cell, sublattice):
        return [cell.offsets(sublattice, 1.5)]

    def nearness(self):
        return Nearness(2.1, (1.0, 1.0))


class Following(pbdkit.FramePolicy):
    """The first of the nearest: what the others would be without their fault."""

    type: Literal["following"] = "following"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        point, body = frame.nearest()
        points, first = np.unique(point, return_index=True)
        return FrameMap(points, body[first], np.ones(len(points)))


class Alternates(Following):
    """Every second point follows the first of its nearest, the others the last."""

    type: Literal["alternates"] = "alternates"

    def follow(self, frame):
        point, body = frame.nearest()
        points, first = np.unique(point, return_index=True)
        last = np.append(first[1:], len(point)) - 1
        chosen = np.where(np.arange(len(points)) % 2 == 0, first, last)
        return FrameMap(points, body[chosen], np.ones(len(points)))


class ClaimsToBeLocal(Following):
    """Follows the body's first particle, wherever that is."""

    type: Literal["says-it-is-local"] = "says-it-is-local"
    has_axes: ClassVar[bool] = True

    local: ClassVar[bool] = True

    def follow(self, frame):
        first = frame.body_at(np.array([frame.low], np.int32))
        count = len(frame.site)
        return FrameMap(np.arange(count), np.repeat(first, count), np.ones(count))


class Shrinks(Following):
    """Follows by nine tenths, which ties the body to its place, and does not declare it."""

    type: Literal["shrinks"] = "shrinks"

    def follow(self, frame):
        found = super().follow(frame)
        return replace(found, weight=0.9 * found.weight)


class ClaimsToAnchor(Anchors, Following):
    """Declares that it ties the body to its place, and does not."""

    type: Literal["says-it-anchors"] = "says-it-anchors"


class WritesSites(Following):
    """Counts the sites from 1, where they lie."""

    type: Literal["writes-sites"] = "writes-sites"

    def follow(self, frame):
        frame.site[...] += 1
        return super().follow(frame)


class Strain(pbdkit.FractureModel):
    """A limit of strain: what the others would be without their fault."""

    type: Literal["strain"] = "strain"
    limit: float = Field(0.5, description="The strain at which bonds break.")

    def constants(self, slot):
        return {"square": (1.0 + self.limit) ** 2 * squared_length(slot.rest)}

    @staticmethod
    def breaks(d, r, c, p):
        return squared_length(r + d) > c.square

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


class Lopsided(Strain):
    """Breaks where the far end has moved to the right."""

    type: Literal["lopsided"] = "lopsided"

    @staticmethod
    def breaks(d, r, c, p):
        return d.x > p.limit


class Directed(Strain):
    """Has a limit for either direction of a bond."""

    type: Literal["directed"] = "directed"

    def constants(self, slot):
        return {"square": 1e3 + slot.rest.x}


class DeniesBreaking(Strain):
    """Declares that nothing breaks, and breaks bonds."""

    type: Literal["denies-breaking"] = "denies-breaking"
    can_break: ClassVar[bool] = False


class BreaksAtRest(Strain):
    """Has no strength at all, and no warning."""

    type: Literal["breaks-at-rest"] = "breaks-at-rest"
    limit: float = Field(-0.1, description="The strain at which bonds break.")


class Measures(Strain):
    """Returns a number where a boolean is required."""

    type: Literal["measures"] = "measures"

    @staticmethod
    def breaks(d, r, c, p):
        return squared_length(r + d) - c.square


class Tupled(Strain):
    """Returns a plain tuple where a vector is required."""

    type: Literal["tupled"] = "tupled"

    @staticmethod
    def fictitious(u, r, p):
        return 0.0, 0.0


class Extent(pbdkit.Diagnostic):
    """The displacement of each particle: the result of the others without their fault."""

    type: Literal["extent"] = "extent"

    def variables(self):
        return (Variable("extent", ("particle",), "displacement", "lattice unit"),)

    def measure(self, now):
        return (np.hypot(*now.displacement().T),)


class NoUnits(Extent):
    """Does not define the unit of its values."""

    type: Literal["no-units"] = "no-units"

    def variables(self):
        return (Variable("extent", ("particle",), "displacement", ""),)


class TakesOurName(Extent):
    """Calls its dimension as the dataset calls one of its own."""

    type: Literal["takes-our-name"] = "takes-our-name"

    def variables(self):
        return (Variable("extent", ("site",), "displacement", "lattice unit"),)

    def coordinates(self):
        return {"site": np.arange(3)}

    def measure(self, now):
        return (np.zeros(3),)


class OneShort(Extent):
    """Leaves the last particle out."""

    type: Literal["one-short"] = "one-short"

    def measure(self, now):
        return (super().measure(now)[0][:-1],)


class Truncates(Extent):
    """Is declared as whole numbers."""

    type: Literal["truncates"] = "truncates"

    def variables(self):
        return (Variable("extent", ("particle",), "displacement", "1", "i4"),)


class FromFirstRow(Extent):
    """Measures from whatever particle comes first."""

    type: Literal["from-first-row"] = "from-first-row"

    def measure(self, now):
        return (np.hypot(*(now.displacement() - now.displacement()[0]).T),)


class KeepsLargest(Extent):
    """Keeps the largest value of all runs."""

    type: Literal["keeps-largest"] = "keeps-largest"
    largest: ClassVar[list[float]] = [0.0]

    def measure(self, now):
        extent = super().measure(now)[0]
        self.largest[0] = max(self.largest[0], float(extent.max()))
        return (extent / self.largest[0],)
