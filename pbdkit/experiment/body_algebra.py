"""All bodies that an experiment can name; a closed family. Those made of others stand here."""

from __future__ import annotations

from functools import reduce
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, SerializeAsAny

from pbdkit.experiment.body import (
    Body,
    Box,
    Disc,
    Dogbone,
    Floats,
    Grid,
    Polygon,
    Rectangle,
    Ring,
    Sites,
)
from pbdkit.experiment.parts import closed_part


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
