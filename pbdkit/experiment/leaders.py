"""Leader groups: who leads, how, and when (model.md, section 1). Selections and motions are closed
families."""

from __future__ import annotations

import math
from abc import abstractmethod
from bisect import bisect_left
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, SerializeAsAny, model_serializer, model_validator

from pbdkit.experiment.parts import brief, closed_part
from pbdkit.interfaces import Component, Pair
from pbdkit.interfaces.component import Strict

Floats = NDArray[np.floating[Any]]
Steps = Annotated[int, Field(ge=1, le=2**62)]
Box = Annotated[tuple[float, float, float, float], Field(strict=False)]
Numbers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(strict=False, min_length=1)]
Points = Annotated[tuple[Pair, ...], Field(strict=False, min_length=1)]


class Motion(Component):
    """A prescribed motion, counted from the position at which it starts."""

    rests: ClassVar[bool] = True
    """Whether the motion ends, at the last of its knots."""

    @abstractmethod
    def offset(self, n: float, start: Floats) -> Floats:
        """How far from their start the leaders stand at the end of the motion's n-th step, n ≥ 1;
        on the way to an equilibrium also between two steps, n > 0.

        `start` are the positions at which the motion found them, (particle, axis); so is what is
        returned, or (axis,) where it is the same for all.
        """

    def knots(self) -> tuple[int, ...]:
        """The steps n between which, and after which, the offset changes as one formula in n; by
        default it always does."""
        return ()

    def rests_after(self) -> int | None:
        """The step n from which on the offset stays as it is; None where it never does."""
        return max((1, *self.knots())) if self.rests else None


class Hold(Motion):
    """Stays where it is."""

    type: Literal["hold"] = "hold"

    def offset(self, n: float, start: Floats) -> Floats:
        """None."""
        return np.zeros(start.shape[1])


class Velocity(Motion):
    """Moves by `velocity` in each of `steps` steps, then holds."""

    type: Literal["velocity"] = "velocity"
    velocity: Pair
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """velocity · min(n, steps)."""
        return np.array(self.velocity) * min(n, self.steps)

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Displace(Motion):
    """Moves by `displacement` in the first step, then holds."""

    type: Literal["displace"] = "displace"
    displacement: Pair

    def offset(self, n: float, start: Floats) -> Floats:
        """The displacement, from the first step on."""
        return np.array(self.displacement) * min(n, 1)

    def knots(self) -> tuple[int, ...]:
        """The first step."""
        return (1,)


class Path(Motion):
    """Stands `displacements[k]` from its start at its step `steps[k]`; linear between, from no
    displacement at its step 0, and the last is kept."""

    type: Literal["path"] = "path"
    steps: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1)]
    displacements: Annotated[tuple[Pair, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _in_order(self) -> Path:
        if len(self.steps) != len(self.displacements):
            raise ValueError(
                f"as many displacements as steps are needed: {len(self.displacements)} given "
                f"for {len(self.steps)}"
            )
        if any(a >= b for a, b in zip(self.steps, self.steps[1:], strict=False)):
            raise ValueError(f"steps must increase, got {brief(self.steps)}")
        return self

    def offset(self, n: float, start: Floats) -> Floats:
        """Linear interpolation; beyond the last step its displacement."""
        k = min(bisect_left(self.steps, n), len(self.steps) - 1)
        begin, before = (self.steps[k - 1], self.displacements[k - 1]) if k else (0, (0.0, 0.0))
        ways = zip(before, self.displacements[k], strict=True)
        return np.array([np.interp(n, (begin, self.steps[k]), way) for way in ways])

    def knots(self) -> tuple[int, ...]:
        """Its steps."""
        return self.steps


class Rotation(Motion):
    """Turns about `centre` by `angle` degrees a step, counterclockwise, for `steps` steps."""

    type: Literal["rotation"] = "rotation"
    centre: Pair
    angle: Annotated[float, Field(ge=-1e6, le=1e6)]
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """(Q - 1)(start - centre), Q the rotation by angle · min(n, steps)."""
        turned = math.radians(self.angle * min(n, self.steps))
        # 1 - cos without cancellation, so that small turns keep their digits.
        less, sine = 2 * math.sin(turned / 2) ** 2, math.sin(turned)
        x, y = (np.asarray(start) - self.centre).T
        return np.stack([-less * x - sine * y, sine * x - less * y], axis=-1)

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Oscillation(Motion):
    """Swings about its start: amplitude · sin(2πn / period), for ever."""

    type: Literal["oscillation"] = "oscillation"
    rests: ClassVar[bool] = False
    amplitude: Pair
    period: Annotated[float, Field(ge=1e-6, le=1e12)]

    def offset(self, n: float, start: Floats) -> Floats:
        """amplitude · sin(2πn / period)."""
        return np.array(self.amplitude) * math.sin(2 * math.pi * n / self.period)


AnyMotion = Annotated[
    SerializeAsAny[Motion],
    closed_part(Motion, Hold, Velocity, Displace, Path, Rotation, Oscillation),
]


class Selection(Strict):
    """Chooses body particles of the reference configuration, in one of four ways.

    `edge`: the outermost of every row (left, right) or column (bottom, top); `box`: [xmin, ymin,
    xmax, ymax], inclusive; `numbers`: as they are numbered; `nearest`: to each of some points.
    """

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    edge: Literal["left", "right", "bottom", "top"] | None = None
    box: Box | None = None
    numbers: Numbers | None = None
    nearest: Points | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Selection:
        if len(self._given()) != 1:
            raise ValueError("give exactly one of edge, box, numbers, nearest")
        return self

    def _given(self) -> dict[str, Any]:
        names = type(self).model_fields
        return {n: getattr(self, n) for n in names if getattr(self, n) is not None}

    @model_serializer
    def _serialize(self) -> dict[str, Any]:
        return self._given()


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

    The motion counts its steps from `from` and starts where the particle then is.
    """

    select: Selection
