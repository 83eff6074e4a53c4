"""Obstacles: rigid bodies that followers do not enter."""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationInfo, model_validator

from pbdkit.experiment.body import Body, Disc, Polygon, Rectangle, Ring
from pbdkit.experiment.leaders import Driven
from pbdkit.experiment.measured_motion import Measured
from pbdkit.experiment.motions import AnyMotion, Hold
from pbdkit.experiment.newton import Newton
from pbdkit.experiment.parts import closed_part, fault
from pbdkit.interfaces import Pair
from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.units import Place

NO_OBSTACLES = {
    "grid": "a grid is sites of the body's lattice and has no outline; take a rectangle",
    "dogbone": "a dogbone is no obstacle; take a polygon along its outline",
    "union": "a union is no obstacle; give each of its parts as an obstacle of its own",
    "intersection": "an intersection is no obstacle; take a polygon along its outline",
    "difference": "a difference is no obstacle; take a polygon along its outline",
}


class HalfPlane(Strict):
    """All behind the line through `point`, seen along `normal`, which points into free space."""

    point: Place
    normal: Pair

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not 1e-100 < math.hypot(*self.normal) < 1e100:
            raise ValueError("the normal has no direction: give a vector that is not [0, 0]")
        return self


class Facing(Strict):
    """A half-plane as a shape."""

    half_plane: HalfPlane


_bodies = closed_part(Body, Disc, Ring, Rectangle, Polygon)


def _shape(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, Facing):
        return value
    if isinstance(value, dict) and "half_plane" in value:
        return Facing.model_validate(value, context=info.context)
    if isinstance(value, dict) and (kind := str(value.get("type"))) in NO_OBSTACLES:
        raise fault(NO_OBSTACLES[kind], key="type")
    build: Any = _bodies.func  # pydantic's type allows for a function that is given no info
    return build(value, info)


AnyShape = Annotated[
    SerializeAsAny[Disc | Ring | Rectangle | Polygon | Facing],
    BeforeValidator(_shape, json_schema_input_type=Disc | Ring | Rectangle | Polygon | Facing),
]


class Obstacle(Driven):
    """A rigid body that is there from step `from` to step `until`, both included, and moves as its
    motion says, counted from `from` and from where the shape is given."""

    shape: AnyShape
    motion: AnyMotion = Field(default_factory=Hold)

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        if isinstance(self.motion, (Measured, Newton)):
            raise fault(
                f"an obstacle is rigid and goes as prescribed, and '{self.motion.type}' moves each "
                "particle by itself; take hold, velocity, displace, path, table, rotation or "
                "oscillation",
                key="motion",
            )
        return self
