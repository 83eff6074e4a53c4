"""Bodies: a signed distance to an outline, and the sites inside; the family of shapes with an
outline of their own and of those made of others.

A site belongs to the body where the signed distance is at most 1e-9 of a lattice constant, so that
sites on the outline belong whatever the rounding (model.md, section 3).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, model_validator

from pbdkit.model.validation import closed_part
from pbdkit.plugin import Component
from pbdkit.plugin.units import LENGTH, Place

Floats = NDArray[np.float64]
Count = Annotated[int, Field(ge=1, le=2**31)]
Positive = Annotated[float, Field(gt=0.0, le=1e100), LENGTH]
Vertices = Annotated[tuple[Place, ...], Field(strict=False, min_length=3, max_length=100_000)]


@dataclass(frozen=True)
class Box:
    """The rectangle around a body: in coordinates, or in site indices for a grid."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    in_sites: bool = False


@dataclass(frozen=True)
class Sites:
    """Sites by `index` (i, j) and by the place where they lie, `at`; arrays of one shape."""

    index: Sequence[NDArray[np.signedinteger[Any]]]
    at: Sequence[Floats]


class Body(Component):
    """An outline that is filled with the sites of a lattice."""

    @abstractmethod
    def boxes(self) -> list[Box]:
        """Rectangles that hold the body together."""

    @abstractmethod
    def distance(self, sites: Sites) -> Floats:
        """The signed distance to the outline, negative inside; only its sign and its value near
        zero need be right."""

    def exaggerates(self) -> bool:
        """Whether `distance` can be more than the way to the outline."""
        return False


CORNER = dict.fromkeys(("centre", "center"), "`origin` is its lower left corner")


class Grid(Body):
    """`columns` × `rows` sites from (0, 0)."""

    type: Literal["grid"] = "grid"
    columns: Count
    rows: Count

    def boxes(self) -> list[Box]:
        """Site (0, 0) to (columns - 1, rows - 1)."""
        return [Box((0, 0), (self.columns - 1, self.rows - 1), in_sites=True)]

    def distance(self, sites: Sites) -> Floats:
        """-∞ for its sites, ∞ for others: it has no outline, near which rounding would decide."""
        i, j = sites.index
        inside = (i >= 0) & (i < self.columns) & (j >= 0) & (j < self.rows)
        return np.where(inside, -np.inf, np.inf)


class Rectangle(Body):
    """`width` × `height` from `origin`, its lower left corner."""

    type: Literal["rectangle"] = "rectangle"
    width: Positive
    height: Positive
    origin: Place = (0.0, 0.0)

    _elsewhere: ClassVar[Mapping[str, str]] = CORNER

    def boxes(self) -> list[Box]:
        """Itself."""
        x, y = self.origin
        return [Box((x, y), (x + self.width, y + self.height))]

    def distance(self, sites: Sites) -> Floats:
        """The larger of the distances to the middle, less half the side."""
        (x, y), (left, low), w, h = sites.at, self.origin, self.width / 2, self.height / 2
        return np.maximum(np.abs(x - (left + w)) - w, np.abs(y - (low + h)) - h)


class Disc(Body):
    """All within `radius` of `centre`."""

    type: Literal["disc"] = "disc"
    radius: Positive
    centre: Place

    def boxes(self) -> list[Box]:
        """The square around it."""
        return [_square(self.centre, self.radius)]

    def distance(self, sites: Sites) -> Floats:
        """The distance from the centre, less the radius."""
        return _from(self.centre, sites) - self.radius


class Ring(Body):
    """All from `inner` to `outer` of `centre`."""

    type: Literal["ring"] = "ring"
    inner: Positive
    outer: Positive
    centre: Place

    @model_validator(mode="after")
    def _in_order(self) -> Ring:
        if self.inner >= self.outer:
            raise ValueError(f"inner ({self.inner:g}) must be below outer ({self.outer:g})")
        return self

    def boxes(self) -> list[Box]:
        """The square around it."""
        return [_square(self.centre, self.outer)]

    def distance(self, sites: Sites) -> Floats:
        """To the nearer of both circles."""
        r = _from(self.centre, sites)
        return np.maximum(r - self.outer, self.inner - r)


class Polygon(Body):
    """The inside of a simple polygon, given by its `vertices` in order."""

    type: Literal["polygon"] = "polygon"
    vertices: Vertices

    @model_validator(mode="after")
    def _simple(self) -> Polygon:
        from shapely.validation import explain_validity

        if max(abs(c) for vertex in self.vertices for c in vertex) > 1e100:
            raise ValueError("a vertex lies beyond 1e100")
        outline = self._outline()
        if not outline.is_valid or outline.area == 0.0:
            reason = "no area" if outline.is_valid else explain_validity(outline)
            raise ValueError(f"the polygon is not simple: {reason}")
        return self

    def _outline(self) -> Any:
        from shapely import Polygon as Outline

        return Outline(self.vertices)

    def boxes(self) -> list[Box]:
        """From the smallest to the largest coordinates."""
        x, y = zip(*self.vertices, strict=True)
        return [Box((min(x), min(y)), (max(x), max(y)))]

    def distance(self, sites: Sites) -> Floats:
        """To the boundary, with the sign of containment."""
        import shapely

        outline = self._outline()
        shapely.prepare(outline)
        inside = shapely.contains_xy(outline, *sites.at)
        to_boundary = shapely.distance(outline.boundary, shapely.points(*sites.at))
        signed: Floats = np.where(inside, -to_boundary, to_boundary)
        return signed


class Dogbone(Body):
    """A tensile specimen along x: heads of `width`, a gauge of `gauge_length` × `gauge_width` in
    the middle, and fillets of `radius` between them. `origin` is the lower left corner."""

    type: Literal["dogbone"] = "dogbone"
    length: Positive
    width: Positive
    gauge_length: Positive
    gauge_width: Positive
    radius: Positive
    origin: Place = (0.0, 0.0)

    _elsewhere: ClassVar[Mapping[str, str]] = CORNER

    @model_validator(mode="after")
    def _fits(self) -> Dogbone:
        if self.gauge_width >= self.width:
            raise ValueError("gauge_width must be below width")
        if self.gauge_length + 2 * self._fillet() > self.length:
            raise ValueError(
                f"gauge_length and two fillets of {self._fillet():g} exceed the length "
                f"{self.length:g}: lengthen it, or make the radius smaller"
            )
        return self

    def _fillet(self) -> float:
        """The length along x over which the width grows from the gauge's to the heads'."""
        rise = min((self.width - self.gauge_width) / 2, self.radius)
        return math.sqrt(self.radius**2 - (self.radius - rise) ** 2)

    def boxes(self) -> list[Box]:
        """`length` × `width`."""
        x, y = self.origin
        return [Box((x, y), (x + self.length, y + self.width))]

    def distance(self, sites: Sites) -> Floats:
        """Above half the width at that x, or beyond the ends."""
        (x, y), (left, low) = sites.at, self.origin
        x, y = np.abs(x - (left + self.length / 2)), np.abs(y - (low + self.width / 2))
        along = np.clip(x - self.gauge_length / 2, 0.0, self.radius)
        arc = self.gauge_width / 2 + self.radius - np.sqrt(self.radius**2 - along**2)
        past = x - self.gauge_length / 2 >= self._fillet() * (1 - 1e-12)
        half = np.where(past, self.width / 2, np.minimum(arc, self.width / 2))
        beyond: Floats = np.maximum(y - half, x - self.length / 2)
        return beyond

    def exaggerates(self) -> bool:
        """It is taken along y, across steep fillets too."""
        return True


def _square(centre: Place, radius: float) -> Box:
    x, y = centre
    return Box((x - radius, y - radius), (x + radius, y + radius))


def _from(centre: Place, sites: Sites) -> Floats:
    x, y = sites.at
    distance: Floats = np.hypot(x - centre[0], y - centre[1])
    return distance


class Composed(Body):
    """Common to the bodies that are made of others."""

    of: Bodies

    def exaggerates(self) -> bool:
        """Where a part does."""
        return any(part.exaggerates() for part in self.of)


class Union(Composed):
    """All that lies in one of its parts."""

    type: Literal["union"] = "union"

    def boxes(self) -> list[Box]:
        """Those of all parts."""
        return [box for part in self.of for box in part.boxes()]

    def distance(self, sites: Sites) -> Floats:
        """The smallest."""
        return reduce(np.minimum, (part.distance(sites) for part in self.of))


class Intersection(Composed):
    """All that lies in every part."""

    type: Literal["intersection"] = "intersection"

    def boxes(self) -> list[Box]:
        """A grid's own where a part is one; else what the boxes of all parts share."""
        every = [part.boxes() for part in self.of]
        grids = [boxes for boxes in every if len(boxes) == 1 and boxes[0].in_sites]
        outlines = [_hull(boxes) for boxes in every if not any(box.in_sites for box in boxes)]
        if grids or not outlines:
            return (grids or every)[0]
        low = np.max([box.low for box in outlines], axis=0)
        high = np.min([box.high for box in outlines], axis=0)
        return [Box(tuple(low), tuple(np.maximum(low, high)))]

    def distance(self, sites: Sites) -> Floats:
        """The largest."""
        return reduce(np.maximum, (part.distance(sites) for part in self.of))


class Difference(Composed):
    """The first part less the others; sites on the outline of what is cut out stay."""

    type: Literal["difference"] = "difference"

    def boxes(self) -> list[Box]:
        """Those of the first part."""
        return self.of[0].boxes()

    def distance(self, sites: Sites) -> Floats:
        """The largest of the first distance and the others' negatives."""
        first, *others = (part.distance(sites) for part in self.of)
        return reduce(np.maximum, (-other for other in others), first)


def _hull(boxes: list[Box]) -> Box:
    """The box around some boxes."""
    low = np.min([box.low for box in boxes], axis=0)
    return Box(tuple(low), tuple(np.max([box.high for box in boxes], axis=0)))


BODIES = (Grid, Rectangle, Disc, Ring, Polygon, Dogbone, Union, Intersection, Difference)
AnyBody = Annotated[SerializeAsAny[Body], closed_part(Body, *BODIES)]
Bodies = Annotated[tuple[AnyBody, ...], Field(strict=False, min_length=1)]
