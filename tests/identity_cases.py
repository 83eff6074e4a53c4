"""Lattices, neighbours and rules, of third parties too, that the tests of identity share."""

import math
from dataclasses import replace
from typing import Any, ClassVar, Literal

import pbdkit
from pbdkit.components.lattices import Hexagonal
from pbdkit.plugin import BasisSite, Cell, Vector

SQUARE = {"type": "square", "a": 1.0}
HEXAGONAL = {"type": "hexagonal", "a": 0.7}
RECTANGULAR = {"type": "rectangular", "a": 1.0, "b": 2.0}
CENTRED = {"type": "centred-rectangular", "a": 1.0, "b": 2.0}
NEAREST = {"type": "coordination", "shells": 1}
EIGHT = {"type": "chebyshev", "shells": 1}
BARYCENTRE = {"type": "barycentre"}
WEIGHTED = {"type": "distance-weighted"}


def oblique(angle: float) -> dict[str, Any]:
    return {"type": "oblique", "a": 1.0, "b": 1.0, "angle": angle}


def shells(number: int, metric: str = "coordination") -> dict[str, Any]:
    return {"type": metric, "shells": number}


class IndexSteps(pbdkit.NeighbourMetric):
    """The four neighbours one step along a basis vector away, however long it is."""

    type: Literal["index-steps"] = "index-steps"

    def shells_around(self, cell, sublattice):
        reach = sum(math.hypot(*v) for v in cell.vectors)
        steps = cell.offsets(sublattice, reach * (1 + 1e-9))
        return [[o for o in steps if abs(o.primitive[0]) + abs(o.primitive[1]) == 1]]


FOUR = {
    "square": NEAREST,
    "rectangular": {"type": "euclidean", "radius": 1.0, "weights": [1.0, 0.25]},
    "centred-rectangular": {"type": "euclidean", "radius": 1.0, "weights": [2.0, 0.4]},
    "oblique": {"type": "index-steps"},
}
"""The four neighbours of the paper's figure on each lattice."""


class Honeycomb(pbdkit.Lattice):
    """Two sites a cell, three neighbours each at distance 1."""

    type: Literal["honeycomb"] = "honeycomb"

    def cell(self):
        half, height = math.sqrt(3.0) / 2, 1.5
        return Cell(
            vectors=(Vector(2 * half, 0.0), Vector(half, height)),
            sites=(BasisSite(), BasisSite(Vector(0.0, 1.0), index=(1, 0), primitive=(1, 0))),
            period=(2, 1),
            primitive=((2, 0), (0, 1)),
        )


class Displaced(pbdkit.Lattice):
    """The hexagonal lattice with cells that have no site at their corners."""

    type: Literal["displaced"] = "displaced"

    def cell(self):
        cell = Hexagonal(a=1.0).cell()
        sites = [replace(site, at=site.at + Vector(0.2, 0.1)) for site in cell.sites]
        return replace(cell, sites=tuple(sites))


class Mean(pbdkit.FollowerRule):
    """Base of the rules below: the mean of the differences."""

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class Central(Mean):
    """Springs along the bonds, linear: (2/N) Σ n n·d."""

    type: Literal["central"] = "central"

    @staticmethod
    def gather(d, r, w, p):
        return (2 * pbdkit.plugin.dot(d, r) / pbdkit.plugin.squared_length(r)) * r, 1.0


class Twice(Mean):
    """u - (1 - P) u - c (1 - P)² u on the square lattice, neighbours up to two steps away."""

    type: Literal["twice"] = "twice"
    c: float

    def weights(self, slot, setting):
        steps = abs(slot.cell[0]) + abs(slot.cell[1])
        of_one = (1 + 2 * self.c) / 4 if steps == 1 else 0.0
        straight = 0 in slot.cell
        return {"share": of_one - (self.c / (16 if straight else 8) if steps == 2 else 0.0)}

    @staticmethod
    def gather(d, r, w, p):
        return w.share * d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0]


class Odd(Mean):
    """The effect of y on x is that of x on y with the other sign."""

    type: Literal["odd"] = "odd"

    @staticmethod
    def gather(d, r, w, p):
        return Vector(d.x + 0.3 * d.y, d.y - 0.3 * d.x), 1.0


class Slanted(Mean):
    """Along one diagonal x weighs more, y does not."""

    type: Literal["slanted"] = "slanted"

    @staticmethod
    def gather(d, r, w, p):
        return Vector(d.x * (1.0 + 0.5 * r.x * r.y), d.y), 1.0


class Windy(Mean):
    """The neighbour to the right weighs more."""

    type: Literal["windy"] = "windy"

    @staticmethod
    def gather(d, r, w, p):
        return (1.0 + 0.2 * r.x) * d, 1.0


class Anchored(Mean):
    """Drawn back to the place at rest."""

    type: Literal["anchored"] = "anchored"

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1] - Vector(0.1 * here.u.x, 0.0)


class Restless(Mean):
    """Moves a body at rest."""

    type: Literal["restless"] = "restless"

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1] + Vector(0.01, 0.0)


class Bent(Mean):
    """Pulls harder than it pushes."""

    type: Literal["bent"] = "bent"

    @staticmethod
    def gather(d, r, w, p):
        return Vector(pbdkit.plugin.where(d.x > 0.0, d.x, 0.5 * d.x), d.y), 1.0


class Idle(Mean):
    """Does not move particles."""

    type: Literal["idle"] = "idle"

    @staticmethod
    def apply(total, here, p):
        return 0.0 * total[0]


class Growing(Mean):
    """Goes away from its neighbours."""

    type: Literal["growing"] = "growing"

    @staticmethod
    def apply(total, here, p):
        return -total[0] / total[1]


class Sloping(Mean):
    """Weighs by the place."""

    type: Literal["sloping"] = "sloping"
    uses_reference: ClassVar[bool] = True

    @staticmethod
    def apply(total, here, p):
        return (1.0 + 0.1 * here.X.x) * total[0] / total[1]


class Failing(Mean):
    """Raises an error at each call."""

    type: Literal["failing"] = "failing"

    @staticmethod
    def gather(d, r, w, p):
        raise ValueError("no such neighbour")


class Dividing(Mean):
    """Divides nothing by nothing."""

    type: Literal["dividing"] = "dividing"

    @staticmethod
    def gather(d, r, w, p):
        return Vector(d.x * d.x / pbdkit.plugin.squared_length(d), d.y), 1.0


def subclasses(of: type) -> list[type]:
    return [kind for one in of.__subclasses__() for kind in (one, *subclasses(one))]


THIRD_PARTY = [IndexSteps, Honeycomb, Displaced, *subclasses(Mean)]


def experiment(lattice: Any, neighbours: Any, rule: Any, **parts: Any) -> dict[str, Any]:
    return {
        "name": "unknown",
        "lattice": lattice,
        "body": {"type": "grid", "columns": 9, "rows": 9},
        "neighbours": neighbours,
        "rule": {"type": rule} if isinstance(rule, str) else rule,
        "steps": 1,
    } | parts


def identity(lattice: Any, neighbours: Any, rule: Any, **parts: Any) -> Any:
    return pbdkit.identify(experiment(lattice, neighbours, rule, **parts), components=THIRD_PARTY)
