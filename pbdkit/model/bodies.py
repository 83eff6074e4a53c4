"""Shapes of bodies, by the signed distance from an outline.

A site belongs to a body if its signed distance is at most 1e-9 lattice constants. Sites on the
outline are therefore included in spite of rounding errors (docs/model.md, section 3).
"""

from __future__ import annotations

import math
import operator
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, model_validator

from pbdkit.array_types import Floats
from pbdkit.model.validation import closed_part
from pbdkit.plugin import Component
from pbdkit.plugin.units import LENGTH, Place

if TYPE_CHECKING:
    from shapely import Geometry

Count = Annotated[int, Field(ge=1, le=2**31)]
"""Type of a number of sites along an axis."""
Positive = Annotated[float, Field(gt=0.0, le=1e100), LENGTH]
"""Type of a positive length."""
Vertices = Annotated[tuple[Place, ...], Field(strict=False, min_length=3, max_length=100_000)]
"""Type of the vertices of a polygon."""
ARC_SIDES = 45
"""Number of straight sides by which a quarter of a circle is approximated in areas."""


@dataclass(frozen=True)
class Box:
    """Bounding box of a body, in coordinates or, for a grid, in site indices."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    in_sites: bool = False


@dataclass(frozen=True)
class Sites:
    """Sites, given by arrays of the `index` (i, j) and the position `at`, which have one shape."""

    index: Sequence[NDArray[np.signedinteger[Any]]]
    at: Sequence[Floats]


class Body(Component):
    """Body that is filled with the sites of a lattice."""

    @abstractmethod
    def boxes(self) -> list[Box]:
        """Return boxes that together contain the body."""

    @abstractmethod
    def distance(self, sites: Sites) -> Floats:
        """Return the signed distance from the outline, which is negative inside.

        Far from the outline only the sign must be right.

        Parameters
        ----------
        sites
            Sites at which the distance is evaluated.
        """

    def area(self) -> Geometry | None:
        """Return the area within the outline for pictures, with polygons in place of arcs. Return
        None if the body has no outline."""
        return None

    def exaggerates(self) -> bool:
        """Return whether `distance` can exceed the distance from the outline."""
        return False


CORNER = dict.fromkeys(("centre", "center"), "`origin` is its lower left corner")
"""Hints for keys of bodies of which the position is given by the lower left corner."""


class Grid(Body):
    """Grid of `columns` × `rows` sites from site (0, 0)."""

    type: Literal["grid"] = "grid"
    columns: Count
    rows: Count

    def boxes(self) -> list[Box]:
        """Return the box from site (0, 0) to site (columns - 1, rows - 1)."""
        return [Box((0, 0), (self.columns - 1, self.rows - 1), in_sites=True)]

    def distance(self, sites: Sites) -> Floats:
        """Return -∞ at the sites of the grid and ∞ elsewhere; a grid has no outline."""
        i, j = sites.index
        inside = (i >= 0) & (i < self.columns) & (j >= 0) & (j < self.rows)
        return np.where(inside, -np.inf, np.inf)


class Rectangle(Body):
    """Rectangle `width` × `height` with the lower left corner `origin`."""

    type: Literal["rectangle"] = "rectangle"
    width: Positive
    height: Positive
    origin: Place = (0.0, 0.0)

    _elsewhere: ClassVar[Mapping[str, str]] = CORNER

    def boxes(self) -> list[Box]:
        """Return the rectangle as a box."""
        x, y = self.origin
        return [Box((x, y), (x + self.width, y + self.height))]

    def area(self) -> Geometry:
        """Return the rectangle as an area, with the corners of its box."""
        return _box(*self.boxes())

    def distance(self, sites: Sites) -> Floats:
        """Return the larger of the signed distances along x and y.

        Along each axis it is the distance from the centre minus half the length of a side.
        """
        (x, y), (left, low), w, h = sites.at, self.origin, self.width / 2, self.height / 2
        return np.asarray(np.maximum(np.abs(x - (left + w)) - w, np.abs(y - (low + h)) - h))


class Disc(Body):
    """Disc of `radius` around `centre`."""

    type: Literal["disc"] = "disc"
    radius: Positive
    centre: Place

    def boxes(self) -> list[Box]:
        """Return the square around the disc."""
        return [_square(self.centre, self.radius)]

    def area(self) -> Geometry:
        """Return the disc as a polygon with `ARC_SIDES` sides in each quarter."""
        return _disc(self.centre, self.radius)

    def distance(self, sites: Sites) -> Floats:
        """Return the distance from the centre minus the radius."""
        return _from(self.centre, sites) - self.radius


class Ring(Body):
    """Ring between the radii `inner` and `outer` around `centre`."""

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
        """Return the square around the ring."""
        return [_square(self.centre, self.outer)]

    def area(self) -> Geometry:
        """Return the outer disc without the inner one."""
        return _disc(self.centre, self.outer) - _disc(self.centre, self.inner)

    def distance(self, sites: Sites) -> Floats:
        """Return the signed distance from the nearer circle."""
        r = _from(self.centre, sites)
        return np.asarray(np.maximum(r - self.outer, self.inner - r))


class Polygon(Body):
    """Interior of a simple polygon with the `vertices` in order."""

    type: Literal["polygon"] = "polygon"
    vertices: Vertices

    @model_validator(mode="after")
    def _simple(self) -> Polygon:
        from shapely.validation import explain_validity

        if max(abs(c) for vertex in self.vertices for c in vertex) > 1e100:
            raise ValueError("a vertex lies beyond 1e100")
        outline = self.area()
        if not outline.is_valid or outline.area == 0.0:
            reason = "no area" if outline.is_valid else explain_validity(outline)
            raise ValueError(f"the polygon is not simple: {reason}")
        return self

    def area(self) -> Geometry:
        """Return the area within the vertices."""
        from shapely import Polygon as Outline

        return Outline(self.vertices)

    def boxes(self) -> list[Box]:
        """Return the box from the smallest to the largest coordinates."""
        x, y = zip(*self.vertices, strict=True)
        return [Box((min(x), min(y)), (max(x), max(y)))]

    def distance(self, sites: Sites) -> Floats:
        """Return the signed distance from the boundary, negative inside."""
        import shapely

        outline = self.area()
        shapely.prepare(outline)
        inside = shapely.contains_xy(outline, *sites.at)
        to_boundary = shapely.distance(outline.boundary, shapely.points(*sites.at))
        signed: Floats = np.where(inside, -to_boundary, to_boundary)
        return signed


class Dogbone(Body):
    """Tensile specimen along x.

    It has heads of the width `width`, a gauge of `gauge_length` × `gauge_width` in the middle, and
    fillets of `radius` R between heads and gauge. With the height h of a shoulder, at most R, a
    fillet is √(R² - (R - h)²) long; the heads have the remaining length. `origin` is the lower left
    corner of the specimen.
    """

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
                f"{self.length:g}; increase the length, or decrease the radius"
            )
        return self

    def _fillet(self) -> float:
        """Return the length of a fillet along x."""
        rise = min((self.width - self.gauge_width) / 2, self.radius)
        return math.sqrt(self.radius**2 - (self.radius - rise) ** 2)

    def boxes(self) -> list[Box]:
        """Return the box `length` × `width`."""
        x, y = self.origin
        return [Box((x, y), (x + self.length, y + self.width))]

    def area(self) -> Geometry:
        """Return the box without the parts beside the gauge, of which the corners are rounded."""
        from shapely import box

        (left, low), far = self.origin, 2 * self.width
        x, y = left + self.length / 2, low + self.width / 2
        start, end = x - self.gauge_length / 2, x + self.gauge_length / 2
        near = self.gauge_width / 2 + self.radius
        beside = (
            box(start, y + near, end, y + near + far),
            box(start, y - near - far, end, y - near),
        )
        return reduce(
            lambda area, part: area - part.buffer(self.radius, quad_segs=ARC_SIDES),
            beside,
            _box(*self.boxes()),
        )

    def distance(self, sites: Sites) -> Floats:
        """Return the distance along y from the outline, or the distance beyond the ends."""
        (x, y), (left, low) = sites.at, self.origin
        x, y = np.abs(x - (left + self.length / 2)), np.abs(y - (low + self.width / 2))
        along = np.clip(x - self.gauge_length / 2, 0.0, self.radius)
        arc = self.gauge_width / 2 + self.radius - np.sqrt(self.radius**2 - along**2)
        is_head = x - self.gauge_length / 2 >= self._fillet() * (1 - 1e-12)
        half = np.where(is_head, self.width / 2, np.minimum(arc, self.width / 2))
        distance: Floats = np.maximum(y - half, x - self.length / 2)
        return distance

    def exaggerates(self) -> bool:
        """Return True, because distances are measured along y even where fillets are steep."""
        return True


def _square(centre: Place, radius: float) -> Box:
    x, y = centre
    return Box((x - radius, y - radius), (x + radius, y + radius))


def _box(box: Box) -> Geometry:
    from shapely import box as rectangle

    return rectangle(*box.low, *box.high)


def _disc(centre: Place, radius: float) -> Geometry:
    from shapely import Point

    return Point(centre).buffer(radius, quad_segs=ARC_SIDES)


def _from(centre: Place, sites: Sites) -> Floats:
    x, y = sites.at
    distance: Floats = np.hypot(x - centre[0], y - centre[1])
    return distance


class Composed(Body):
    """Base class of bodies that are composed of others."""

    of: Bodies

    _compose: ClassVar[Callable[[Any, Any], Any]]

    def area(self) -> Geometry | None:
        """Return the composition of the areas of all parts, or None if one has no outline."""
        areas = [area for part in self.of if (area := part.area()) is not None]
        return reduce(type(self)._compose, areas) if len(areas) == len(self.of) else None

    def exaggerates(self) -> bool:
        """Return whether the distance of a part can exceed the distance from its outline."""
        return any(part.exaggerates() for part in self.of)


class Union(Composed):
    """Union of several bodies."""

    type: Literal["union"] = "union"

    _compose: ClassVar[Callable[[Any, Any], Any]] = operator.or_

    def boxes(self) -> list[Box]:
        """Return the boxes of all parts."""
        return [box for part in self.of for box in part.boxes()]

    def distance(self, sites: Sites) -> Floats:
        """Return the smallest distance."""
        return reduce(np.minimum, (part.distance(sites) for part in self.of))


class Intersection(Composed):
    """Intersection of several bodies."""

    type: Literal["intersection"] = "intersection"

    _compose: ClassVar[Callable[[Any, Any], Any]] = operator.and_

    def boxes(self) -> list[Box]:
        """Return the box of a grid if one is a part, otherwise the intersection of the boxes of all
        parts.
        """
        boxes_of_parts = [part.boxes() for part in self.of]
        grids = [boxes for boxes in boxes_of_parts if len(boxes) == 1 and boxes[0].in_sites]
        outlines = [
            _hull(boxes) for boxes in boxes_of_parts if not any(box.in_sites for box in boxes)
        ]
        if grids or not outlines:
            return (grids or boxes_of_parts)[0]
        low = np.max([box.low for box in outlines], axis=0)
        high = np.min([box.high for box in outlines], axis=0)
        return [Box(tuple(low), tuple(np.maximum(low, high)))]

    def distance(self, sites: Sites) -> Floats:
        """Return the largest distance."""
        return reduce(np.maximum, (part.distance(sites) for part in self.of))


class Difference(Composed):
    """First body without all others. Sites on the outline of the others belong to it."""

    type: Literal["difference"] = "difference"

    _compose: ClassVar[Callable[[Any, Any], Any]] = operator.sub

    def boxes(self) -> list[Box]:
        """Return the boxes of the first part."""
        return self.of[0].boxes()

    def distance(self, sites: Sites) -> Floats:
        """Return the maximum of the distance from the first part and the negative distances from
        all other parts."""
        first, *rest = (part.distance(sites) for part in self.of)
        return reduce(np.maximum, (-other for other in rest), first)


def concave_arcs(body: Body) -> Iterator[tuple[str, float]]:
    """Yield each arc of an outline at which the material surrounds the centre of the arc, as text
    such as "disc", and its radius."""
    if isinstance(body, Ring):
        yield "inner circle", body.inner
    elif isinstance(body, Dogbone):
        yield "fillet", body.radius
    elif isinstance(body, Difference):
        yield from concave_arcs(body.of[0])
        for part in body.of[1:]:
            yield from discs(part)
    elif isinstance(body, Composed):
        for part in body.of:
            yield from concave_arcs(part)


def discs(body: Body) -> Iterator[tuple[str, float]]:
    """Yield "disc" and the radius of each disc of a body, except those that it subtracts."""
    if isinstance(body, Disc):
        yield "disc", body.radius
    elif isinstance(body, Composed):
        for part in body.of[:1] if isinstance(body, Difference) else body.of:
            yield from discs(part)


def _hull(boxes: list[Box]) -> Box:
    """Return the box around several boxes."""
    low = np.min([box.low for box in boxes], axis=0)
    return Box(tuple(low), tuple(np.max([box.high for box in boxes], axis=0)))


BODIES = (Grid, Rectangle, Disc, Ring, Polygon, Dogbone, Union, Intersection, Difference)
"""Classes of the built-in bodies."""
AnyBody = Annotated[SerializeAsAny[Body], closed_part(Body, *BODIES)]
"""Type of a body in an experiment."""
Bodies = Annotated[tuple[AnyBody, ...], Field(strict=False, min_length=1)]
"""Type of the parts of a composed body."""
