"""What a body is: a signed distance to an outline, and the sites that lie inside.

A site belongs to the body where the signed distance is at most 1e-9 of a lattice constant, so that
sites on the outline belong whatever the rounding (model.md, section 3).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny

from pbdkit.experiment.outlines import Disc, Dogbone, Polygon, Rectangle, Ring
from pbdkit.experiment.parts import closed_part
from pbdkit.interfaces import Component

Floats = NDArray[np.float64]
Count = Annotated[int, Field(ge=1, le=2**31)]


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
    at: Any

    @property
    def i(self) -> NDArray[np.signedinteger[Any]]:
        """The index along the first axis."""
        return self.index[0]

    @property
    def j(self) -> NDArray[np.signedinteger[Any]]:
        """The index along the second axis."""
        return self.index[1]

    @property
    def x(self) -> Floats:
        """The coordinate along the first axis."""
        return np.asarray(self.at.x)

    @property
    def y(self) -> Floats:
        """The coordinate along the second axis."""
        return np.asarray(self.at.y)


class Body(Component):
    """An outline that is filled with the sites of a lattice."""

    @abstractmethod
    def boxes(self) -> list[Box]:
        """Rectangles that hold the body together."""

    @abstractmethod
    def distance(self, at: Sites) -> Floats:
        """The signed distance to the outline, negative inside; only its sign and its value near
        zero need be right."""

    def exaggerates(self) -> bool:
        """Whether `distance` can be more than the way to the outline."""
        return False


class Grid(Body):
    """`columns` × `rows` sites from (0, 0)."""

    type: Literal["grid"] = "grid"
    columns: Count
    rows: Count

    def boxes(self) -> list[Box]:
        """Site (0, 0) to (columns - 1, rows - 1)."""
        return [Box((0, 0), (self.columns - 1, self.rows - 1), in_sites=True)]

    def distance(self, at: Sites) -> Floats:
        """-1 for its sites, 1 for others."""
        inside = (at.i >= 0) & (at.i < self.columns) & (at.j >= 0) & (at.j < self.rows)
        return np.where(inside, -1.0, 1.0)


class Union(Body):
    """All that lies in one of its parts."""

    type: Literal["union"] = "union"
    of: Bodies

    def boxes(self) -> list[Box]:
        """Those of all parts."""
        return [box for part in self.of for box in part.boxes()]

    def distance(self, at: Sites) -> Floats:
        """The smallest."""
        return reduce(np.minimum, (part.distance(at) for part in self.of))

    def exaggerates(self) -> bool:
        """Where a part does."""
        return any(part.exaggerates() for part in self.of)


class Intersection(Body):
    """All that lies in every part."""

    type: Literal["intersection"] = "intersection"
    of: Bodies

    def boxes(self) -> list[Box]:
        """A grid's own where a part is one; else what the boxes of all parts share."""
        every = [part.boxes() for part in self.of]
        grids = [boxes for boxes in every if len(boxes) == 1 and boxes[0].in_sites]
        outlines = [_hull(boxes) for boxes in every if not any(box.in_sites for box in boxes)]
        if grids or not outlines:
            return (grids or every)[0]
        low = max(box.low[0] for box in outlines), max(box.low[1] for box in outlines)
        high = min(box.high[0] for box in outlines), min(box.high[1] for box in outlines)
        return [Box(low, (max(low[0], high[0]), max(low[1], high[1])))]

    def distance(self, at: Sites) -> Floats:
        """The largest."""
        return reduce(np.maximum, (part.distance(at) for part in self.of))

    def exaggerates(self) -> bool:
        """Where a part does."""
        return any(part.exaggerates() for part in self.of)


class Difference(Body):
    """The first part less the others; sites on the outline of what is cut out stay."""

    type: Literal["difference"] = "difference"
    of: Bodies

    def boxes(self) -> list[Box]:
        """Those of the first part."""
        return self.of[0].boxes()

    def distance(self, at: Sites) -> Floats:
        """The largest of the first distance and the others' negatives."""
        first, *others = (part.distance(at) for part in self.of)
        return reduce(np.maximum, (-other for other in others), first)

    def exaggerates(self) -> bool:
        """Where a part does."""
        return any(part.exaggerates() for part in self.of)


def _hull(boxes: list[Box]) -> Box:
    """The box around some boxes."""
    low = min(b.low[0] for b in boxes), min(b.low[1] for b in boxes)
    high = max(b.high[0] for b in boxes), max(b.high[1] for b in boxes)
    return Box(low, high)


AnyBody = Annotated[
    SerializeAsAny[Body],
    closed_part(
        Body, Grid, Rectangle, Disc, Ring, Polygon, Dogbone, Union, Intersection, Difference
    ),
]
Bodies = Annotated[tuple[AnyBody, ...], Field(strict=False, min_length=1)]
for _composed in (Union, Intersection, Difference):
    _composed.model_rebuild()
