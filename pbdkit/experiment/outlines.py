"""Bodies with an outline of their own: rectangle, disc, ring, polygon, dogbone."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pbdkit.experiment.body import Body, Box, Floats, Sites
from pbdkit.interfaces import Pair

Positive = Annotated[float, Field(gt=0.0, le=1e100)]
Vertices = Annotated[tuple[Pair, ...], Field(strict=False, min_length=3, max_length=100_000)]


class Rectangle(Body):
    """`width` × `height` from `origin`, its lower left corner."""

    type: Literal["rectangle"] = "rectangle"
    width: Positive
    height: Positive
    origin: Pair = (0.0, 0.0)

    def boxes(self) -> list[Box]:
        """Itself."""
        x, y = self.origin
        return [Box((x, y), (x + self.width, y + self.height))]

    def distance(self, at: Sites) -> Floats:
        """The larger of the distances to the middle, less half the side."""
        (x, y), w, h = self.origin, self.width / 2, self.height / 2
        return np.maximum(np.abs(at.x - (x + w)) - w, np.abs(at.y - (y + h)) - h)


class Disc(Body):
    """All within `radius` of `centre`."""

    type: Literal["disc"] = "disc"
    radius: Positive
    centre: Pair

    def boxes(self) -> list[Box]:
        """The square around it."""
        return [_square(self.centre, self.radius)]

    def distance(self, at: Sites) -> Floats:
        """The distance from the centre, less the radius."""
        return _from(self.centre, at) - self.radius


class Ring(Body):
    """All from `inner` to `outer` of `centre`."""

    type: Literal["ring"] = "ring"
    inner: Positive
    outer: Positive
    centre: Pair

    @model_validator(mode="after")
    def _in_order(self) -> Ring:
        if self.inner >= self.outer:
            raise ValueError(f"inner ({self.inner:g}) must be below outer ({self.outer:g})")
        return self

    def boxes(self) -> list[Box]:
        """The square around it."""
        return [_square(self.centre, self.outer)]

    def distance(self, at: Sites) -> Floats:
        """To the nearer of both circles."""
        r = _from(self.centre, at)
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

    def distance(self, at: Sites) -> Floats:
        """To the boundary, with the sign of containment."""
        import shapely

        outline = self._outline()
        shapely.prepare(outline)
        inside = shapely.contains_xy(outline, at.x, at.y)
        to_boundary = shapely.distance(outline.boundary, shapely.points(at.x, at.y))
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
    origin: Pair = (0.0, 0.0)

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

    def distance(self, at: Sites) -> Floats:
        """Above half the width at that x, or beyond the ends."""
        x = np.abs(at.x - (self.origin[0] + self.length / 2))
        y = np.abs(at.y - (self.origin[1] + self.width / 2))
        along = np.clip(x - self.gauge_length / 2, 0.0, self.radius)
        arc = self.gauge_width / 2 + self.radius - np.sqrt(self.radius**2 - along**2)
        past = x - self.gauge_length / 2 >= self._fillet() * (1 - 1e-12)
        half = np.where(past, self.width / 2, np.minimum(arc, self.width / 2))
        beyond: Floats = np.maximum(y - half, x - self.length / 2)
        return beyond

    def exaggerates(self) -> bool:
        """It is taken along y, across steep fillets too."""
        return True


def _square(centre: Pair, radius: float) -> Box:
    x, y = centre
    return Box((x - radius, y - radius), (x + radius, y + radius))


def _from(centre: Pair, at: Sites) -> Floats:
    distance: Floats = np.hypot(at.x - centre[0], at.y - centre[1])
    return distance
