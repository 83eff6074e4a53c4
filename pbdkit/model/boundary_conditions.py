"""Boundary and initial conditions of an experiment.

Leader groups and their selections (model.md, section 1), loads, obstacles, cuts, and the initial
state.
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

from pbdkit.array_types import Floats
from pbdkit.model.bodies import Body, Disc, Polygon, Rectangle, Ring
from pbdkit.model.motions import AnyMotion, Hold, Measured, Newton
from pbdkit.model.validation import closed_part, fault
from pbdkit.plugin import Component, Pair
from pbdkit.plugin.component import Strict
from pbdkit.plugin.fracture_model import Segment
from pbdkit.plugin.operation import Selection
from pbdkit.plugin.schedule import BodyForce, Force, TimeDependent, at
from pbdkit.plugin.units import LENGTH, Place


class Cut(Strict):
    """Straight cut: bonds that cross it are broken at the beginning of step `at`.

    Bonds to frame points are included. `at: 0` is before the first step.
    """

    from_: Place = Field(alias="from", description="One end of the cut.", examples=[[0.0, 4.5]])
    to: Place = Field(description="Other end of the cut.", examples=[[5.0, 4.5]])
    at: Annotated[int, Field(ge=0, lt=2**31)] = Field(
        0, description="Step at the beginning of which the cut is made; 0 is before the first step."
    )

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if self.from_ == self.to:
            raise fault("both ends of the cut are the same point; move one of them", key="to")
        return self

    @property
    def segment(self) -> Segment:
        """End points of the cut."""
        return self.from_, self.to


Flags = NDArray[np.bool_]
"""Type of arrays of truth values."""
Share = Annotated[float, Field(ge=-1e100, le=1e100)]
"""Type of a component of a displacement gradient."""
Shares = Annotated[tuple[Share, Share], Field(strict=False)]
"""Type of a row of a displacement gradient."""
Shift = Annotated[tuple[Annotated[Share, LENGTH], Annotated[Share, LENGTH]], Field(strict=False)]
"""Type of a displacement."""
Gradient = Annotated[tuple[Shares, Shares], Field(strict=False)]
"""Type of a displacement gradient."""


class Initial(Component):
    """Initial displacements of the body at time 0.

    Initial velocities are zero, and frame points follow the body.
    """

    at_rest: ClassVar[bool] = False
    """True if the body starts at rest in the reference configuration."""
    is_drawn: ClassVar[bool] = False
    """True if the displacements are random."""

    @abstractmethod
    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Return the initial displacements of the body particles.

        Parameters
        ----------
        X
            Reference positions in the order of the particle numbers, (particle, axis).
        leads
            Mask of the leaders of step 1, (particle,).
        generator
            Random number generator.

        Returns
        -------
        NDArray
            Displacements, (particle, axis).
        """


class Reference(Initial):
    """The run starts from the reference configuration."""

    type: Literal["reference"] = "reference"

    at_rest: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Return zero displacements, (particle, axis)."""
        return np.zeros_like(X)


class Noise(Initial):
    """Followers start with a random displacement within ±`amplitude` along each axis.

    Displacements are uniform, drawn from the seed of the experiment in the order of the particle
    numbers. Leaders of step 1 start at their sites.
    """

    type: Literal["noise"] = "noise"
    amplitude: Annotated[float, Field(ge=0.0, le=1e100), LENGTH]

    is_drawn: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Return random displacements, uniform in [-amplitude, amplitude)."""
        drawn = generator.uniform(-self.amplitude, self.amplitude, X.shape)
        return np.where(leads[:, None], 0.0, drawn)


class Affine(Initial):
    """The body, including leaders, starts with the deformation u = gradient · X + shift."""

    type: Literal["affine"] = "affine"
    gradient: Gradient
    shift: Shift = (0.0, 0.0)

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Return u_a = Σ_b gradient[a][b] X_b + shift_a."""
        (xx, xy), (yx, yy) = self.gradient
        x, y = X.T
        return np.stack([xx * x + xy * y + self.shift[0], yx * x + yy * y + self.shift[1]], axis=1)


AnyInitial = Annotated[SerializeAsAny[Initial], closed_part(Initial, Reference, Noise, Affine)]
"""Type of the initial state in an experiment."""


Axes = Annotated[tuple[Literal["x", "y"], ...], Field(strict=False, min_length=1)]
"""Type of a list of axes."""


class Driven(Strict):
    """Base class of leader groups and obstacles.

    They have a motion from step `from` to step `until`, both included.
    """

    motion: AnyMotion
    from_: Annotated[int, Field(ge=1, alias="from")] = 1
    until: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.until is not None and self.until < self.from_:
            raise ValueError(f"until ({self.until}) is before from ({self.from_})")
        return self

    def leads(self, step: int) -> bool:
        """Return whether the motion is active during a step."""
        return self.from_ <= step and (self.until is None or step <= self.until)

    def last(self, steps: int) -> int:
        """Return the last step of a run of `steps` in which the motion is active."""
        return steps if self.until is None else min(self.until, steps)

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the first step after `step` in which the motion changes, or infinity.

        It changes in the step in which it begins or ends. A motion that is not `precomputable`,
        such as that by Newton's law, changes in every step.
        """
        last = math.inf if self.until is None else self.until
        if step < self.from_:
            return self.from_
        if step > last:
            return math.inf
        rests = self.motion.rests_after()
        is_moving = rests is None or step - self.from_ + 1 < rests
        if is_moving and (isinstance(self.motion, Newton) or not precomputable):
            return step + 1
        return last + 1

    def events(self, steps: int) -> list[int]:
        """Return the steps of a run in which the motion begins or comes to rest, and the first step
        in which the motion no longer acts."""
        first, last = self.from_, self.last(steps)
        if first > steps:
            return []
        rests = self.motion.rests_after() or 0
        return [first, min(last, first - 1 + rests), *([last + 1] if last < steps else [])]


class LeaderGroup(Driven):
    """Particles that are leaders from step `from` to step `until`, both included.

    In all other steps they are followers. The steps of the motion are counted from `from`, and it
    starts at the current positions of the particles. With `axes`, the motion is prescribed along
    these axes only; along all others the particles are followers. Leaders that are `clamped` have
    prescribed directions, which rotate with the motion. Otherwise directions are free.
    """

    select: Selection
    axes: Axes | None = None
    clamped: bool = False

    @model_validator(mode="after")
    def _axes_once(self) -> Self:
        if self.axes and len({*self.axes}) < len(self.axes):
            raise ValueError(f"axes has an axis twice: {', '.join(self.axes)}; list each once")
        return self

    @model_serializer(mode="wrap")
    def _as_written(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `axes` from the serialised group if it prescribes the motion along all axes."""
        result: dict[str, Any] = serialize(self)
        if self.axes is None:
            result.pop("axes", None)
        return result


class Load(Strict):
    """Forces on selected particles from step `from` to step `until`, both included.

    `force` is the total force; its unit is Young's modulus times thickness times lattice unit. It
    is distributed to particles on a line by tributary length, and to other particles equally.
    `body_force` is a force per area; its unit is Young's modulus times thickness divided by lattice
    unit. Either can be time-dependent. Loads move followers only; on leaders they change the
    reaction.
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
        """Return the total force, or the force per area, at a time in steps, (axis,)."""
        forces = [at(component, moment) for component in self.force or self.body_force or ()]
        return 0.0 + self.amplitude(moment) * np.array(forces)

    @property
    def time_dependent(self) -> list[TimeDependent[float]]:
        """Time-dependent components of the force."""
        forces = self.force or self.body_force or ()
        return [component for component in forces if isinstance(component, TimeDependent)]

    def amplitude(self, moment: float) -> float:
        """Return the fraction of the force that acts at the end of a step, or within it.

        It is linear in time within the steps in which the load begins and ends.
        """
        start = min(max(moment - self.from_ + 1, 0.0), 1.0)
        end = 0.0 if self.until is None else min(max(moment - self.until, 0.0), 1.0)
        return start - end

    def last(self, steps: int) -> int:
        """Return the last step of a run of `steps` in which the load acts."""
        return steps if self.until is None else min(self.until, steps)

    def changes(self) -> tuple[int, ...]:
        """Return the steps in which the load begins and ceases to act."""
        return (self.from_,) if self.until is None else (self.from_, self.until + 1)


NO_OBSTACLES = {
    "grid": "a grid has no outline and cannot be an obstacle; use a rectangle",
    "dogbone": "a dogbone cannot be an obstacle; use a polygon along its outline",
    "union": "a union cannot be an obstacle; use one obstacle for each part",
    "intersection": "an intersection cannot be an obstacle; use a polygon along its outline",
    "difference": "a difference cannot be an obstacle; use a polygon along its outline",
}
"""Messages about shapes that cannot be obstacles, by type."""


class HalfPlane(Strict):
    """Half-plane behind the line through `point` with the `normal`, which points outward."""

    point: Place
    normal: Pair

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not 1e-100 < math.hypot(*self.normal) < 1e100:
            raise ValueError("the normal has no direction; give a vector other than [0, 0]")
        return self


class Facing(Strict):
    """Half-plane as the shape of an obstacle."""

    half_plane: HalfPlane


_bodies = closed_part(Body, Disc, Ring, Rectangle, Polygon)


def _shape(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, Facing):
        return value
    if isinstance(value, dict) and "half_plane" in value:
        return Facing.model_validate(value, context=info.context)
    if isinstance(value, dict) and (kind := str(value.get("type"))) in NO_OBSTACLES:
        raise fault(NO_OBSTACLES[kind], key="type")
    build: Any = _bodies.func  # pydantic's type includes functions without `info`.
    return build(value, info)


AnyShape = Annotated[
    SerializeAsAny[Disc | Ring | Rectangle | Polygon | Facing],
    BeforeValidator(_shape, json_schema_input_type=Disc | Ring | Rectangle | Polygon | Facing),
]
"""Type of the shape of an obstacle."""


class Obstacle(Driven):
    """Rigid obstacle that exists from step `from` to step `until`, both included.

    The steps of its motion are counted from `from`, and the motion starts at the position of the
    shape.
    """

    shape: AnyShape
    motion: AnyMotion = Field(default_factory=Hold)

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        if isinstance(self.motion, (Measured, Newton)):
            raise fault(
                f"an obstacle is rigid, but '{self.motion.type}' moves each particle individually; "
                "use hold, velocity, displace, path, table, rotation or oscillation",
                key="motion",
            )
        return self
