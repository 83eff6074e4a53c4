"""Boundary and initial conditions of an experiment: leader groups and their selections (model.md,
section 1), loads, obstacles, cuts in time, and the initial state.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from pbdkit.model.bodies import Body, Disc, Polygon, Rectangle, Ring
from pbdkit.model.motions import AnyMotion, Hold, Measured, Newton
from pbdkit.model.validation import closed_part, fault
from pbdkit.plugin import Component, Pair
from pbdkit.plugin.component import Strict
from pbdkit.plugin.fracture import Segment
from pbdkit.plugin.particles import Selection
from pbdkit.plugin.schedule import BodyForce, Course, Force, at
from pbdkit.plugin.units import LENGTH, Place


class Cut(Strict):
    """A straight cut: the bonds that cross it are broken at the beginning of step `at`, those to
    the frame too; 0 is before the first step."""

    from_: Place = Field(alias="from", description="One end of the cut.", examples=[[0.0, 4.5]])
    to: Place = Field(description="Its other end.", examples=[[5.0, 4.5]])
    at: Annotated[int, Field(ge=0, lt=2**31)] = Field(
        0, description="The step at whose beginning it is made; 0: before the first."
    )

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if self.from_ == self.to:
            raise fault("is the point that the cut comes from; move one of the two", key="to")
        return self

    @property
    def segment(self) -> Segment:
        """Its two ends."""
        return self.from_, self.to


Floats = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]
Share = Annotated[float, Field(ge=-1e100, le=1e100)]
Shares = Annotated[tuple[Share, Share], Field(strict=False)]
Shift = Annotated[tuple[Annotated[Share, LENGTH], Annotated[Share, LENGTH]], Field(strict=False)]
Gradient = Annotated[tuple[Shares, Shares], Field(strict=False)]


class Initial(Component):
    """The displacements of the body at time 0; nothing has moved before, and the frame follows."""

    at_rest: ClassVar[bool] = False
    """Whether everything starts where it rests; `displacement` is then not asked."""
    is_drawn: ClassVar[bool] = False
    """Whether it takes numbers from the generator."""

    @abstractmethod
    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """u of the body particles at X, (particle, axis), in the order of their numbers; `leads`
        marks the leaders of step 1."""


class Reference(Initial):
    """The run starts from the reference configuration."""

    type: Literal["reference"] = "reference"

    at_rest: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Zeros."""
        return np.zeros_like(X)


class Noise(Initial):
    """Every follower starts off its site by up to ±`amplitude` along each axis, uniformly, drawn
    from the experiment's seed in the order of the numbers; leaders of step 1 start on theirs."""

    type: Literal["noise"] = "noise"
    amplitude: Annotated[float, Field(ge=0.0, le=1e100), LENGTH]

    is_drawn: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Uniform in [-amplitude, amplitude)."""
        drawn = generator.uniform(-self.amplitude, self.amplitude, X.shape)
        return np.where(leads[:, None], 0.0, drawn)


class Affine(Initial):
    """The body starts deformed: u = gradient · X + shift, leaders included."""

    type: Literal["affine"] = "affine"
    gradient: Gradient
    shift: Shift = (0.0, 0.0)

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """u_a = Σ_b gradient[a][b] X_b + shift_a."""
        (xx, xy), (yx, yy) = self.gradient
        x, y = X.T
        return np.stack([xx * x + xy * y + self.shift[0], yx * x + yy * y + self.shift[1]], axis=1)


AnyInitial = Annotated[SerializeAsAny[Initial], closed_part(Initial, Reference, Noise, Affine)]


Axes = Annotated[tuple[Literal["x", "y"], ...], Field(strict=False, min_length=1)]


class Driven(Strict):
    """Common to what a motion drives from step `from` to step `until`, both included."""

    motion: AnyMotion
    from_: Annotated[int, Field(ge=1, alias="from")] = 1
    until: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.until is not None and self.until < self.from_:
            raise ValueError(f"until ({self.until}) is before from ({self.from_})")
        return self

    def leads(self, step: int) -> bool:
        """Whether it is driven during that step."""
        return self.from_ <= step and (self.until is None or step <= self.until)

    def last(self, steps: int) -> int:
        """The last step of a run of `steps` in which it is driven."""
        return steps if self.until is None else min(self.until, steps)


class LeaderGroup(Driven):
    """Particles that lead from step `from` to step `until`, both included, and follow otherwise.

    The motion counts its steps from `from` and starts where the particle then is. With `axes` the
    particles lead along these, and follow along the others. `clamped` leaders prescribe their
    directions too, which turn with the motion; others turn freely.
    """

    select: Selection
    axes: Axes | None = None
    clamped: bool = False

    @model_validator(mode="after")
    def _axes_once(self) -> Self:
        if self.axes and len({*self.axes}) < len(self.axes):
            raise ValueError(f"axes name one twice: {', '.join(self.axes)}")
        return self

    @model_serializer(mode="wrap")
    def _as_written(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Who leads along all axes says nothing of them."""
        found: dict[str, Any] = serialize(self)
        if self.axes is None:
            found.pop("axes", None)
        return found


class Load(Strict):
    """Forces on selected particles from step `from` to step `until`, both included.

    `force` is what acts on all of them together, in units of Young's modulus, thickness and lattice
    unit. Particles on a line share it by the length that falls to each, others equally.
    `body_force` acts on a unit of area, in units of Young's modulus and thickness over lattice
    unit. Each of the two may be a course in time. Followers are moved by it; leaders carry it.
    """

    select: Selection
    force: Force | None = None
    body_force: BodyForce | None = None
    from_: Annotated[int, Field(ge=1, alias="from")] = 1
    until: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _one_force(self) -> Load:
        if (self.force is None) == (self.body_force is None):
            raise ValueError("give exactly one of force, body_force")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Load:
        if self.until is not None and self.until < self.from_:
            raise ValueError(f"until ({self.until}) is before from ({self.from_})")
        return self

    def force_at(self, moment: float) -> NDArray[np.float64]:
        """(axis,): the force at a moment, in all or of a unit of area."""
        forces = [at(each, moment) for each in self.force or self.body_force or ()]
        return 0.0 + self.amplitude(moment) * np.array(forces)

    @property
    def courses(self) -> list[Course[float]]:
        """Of the forces that change while it acts."""
        forces = self.force or self.body_force or ()
        return [each for each in forces if isinstance(each, Course)]

    def amplitude(self, moment: float) -> float:
        """The share of the force that acts at the end of a step, or at a moment within it, where it
        comes and goes little by little; linear between whole steps."""
        come = min(max(moment - self.from_ + 1, 0.0), 1.0)
        gone = 0.0 if self.until is None else min(max(moment - self.until, 0.0), 1.0)
        return come - gone

    def last(self, steps: int) -> int:
        """The last step of a run of `steps` in which it acts."""
        return steps if self.until is None else min(self.until, steps)

    def changes(self) -> tuple[int, ...]:
        """The steps in which it begins and ceases to act."""
        return (self.from_,) if self.until is None else (self.from_, self.until + 1)


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
