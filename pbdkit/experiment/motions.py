"""Prescribed motions, a closed family; where leaders go, step by step (model.md, section 1)."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, SerializeAsAny, ValidationInfo, model_validator

from pbdkit.experiment.columns import MOST_ROWS, in_place_of, or_a_file
from pbdkit.experiment.measured_motion import Measured
from pbdkit.experiment.motion import Floats, Motion, Steps
from pbdkit.experiment.newton import Newton
from pbdkit.experiment.parts import brief, closed_part, fault
from pbdkit.interfaces.units import Place


class Hold(Motion):
    """Stays where it is."""

    type: Literal["hold"] = "hold"

    def offset(self, n: float, start: Floats) -> Floats:
        """None."""
        return np.zeros(start.shape[1])


class Velocity(Motion):
    """Moves by `velocity` in each of `steps` steps, then holds."""

    type: Literal["velocity"] = "velocity"
    velocity: Place
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
    displacement: Place

    def offset(self, n: float, start: Floats) -> Floats:
        """The displacement, from the first step on."""
        return np.array(self.displacement) * min(n, 1)

    def knots(self) -> tuple[int, ...]:
        """The first step."""
        return (1,)


class Tabulated(Motion):
    """Stands `displacements[k]` from its start at its step `steps[k]`; linear between, from no
    displacement at its step 0, and the last is kept."""

    steps: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=MOST_ROWS)]
    displacements: Annotated[
        tuple[Place, ...], Field(strict=False, min_length=1, max_length=MOST_ROWS)
    ]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
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


class Path(Tabulated):
    """Along `displacements`, at its steps `steps`."""

    type: Literal["path"] = "path"


class Table(Tabulated):
    """The same from a `file`, a CSV with columns step, ux, uy; its content takes its place."""

    model_config = ConfigDict(json_schema_extra=or_a_file("steps", "displacements"))

    type: Literal["table"] = "table"
    file: str | None = Field(None, exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any, info: ValidationInfo) -> Any:
        read = in_place_of(given, info, ("step", "ux", "uy"), ("steps", "displacements"))
        if read is None:
            return given
        rest, rows = read
        if rows[0] == [0.0, 0.0, 0.0]:  # where every motion starts
            del rows[0]
        if wrong := [row[0] for row in rows if row[0] < 1 or row[0] % 1]:
            text = f"{given['file']}: steps are whole numbers from 1 on, got {wrong[0]:g}"
            raise fault(f"{text}; at step 0 nothing is displaced yet", key="file")
        steps, displacements = [int(row[0]) for row in rows], [tuple(row[1:]) for row in rows]
        return rest | {"steps": steps, "displacements": displacements}


class Rotation(Motion):
    """Turns about `centre` by `angle` degrees a step, counterclockwise, for `steps` steps."""

    type: Literal["rotation"] = "rotation"
    centre: Place
    angle: Annotated[float, Field(ge=-1e6, le=1e6)]
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """(Q - 1)(start - centre), Q the rotation by angle · min(n, steps)."""
        turned = self.turned(n)
        # 1 - cos without cancellation, so that small turns keep their digits.
        less, sine = 2 * math.sin(turned / 2) ** 2, math.sin(turned)
        x, y = (np.asarray(start) - self.centre).T
        return np.stack([-less * x - sine * y, sine * x - less * y], axis=-1)

    def turned(self, n: float) -> float:
        """angle · min(n, steps)."""
        return math.radians(self.angle * min(n, self.steps))

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Oscillation(Motion):
    """Swings about its start: amplitude · sin(2πn / period), for ever."""

    type: Literal["oscillation"] = "oscillation"
    rests: ClassVar[bool] = False
    amplitude: Place
    period: Annotated[float, Field(ge=1e-6, le=1e12)]

    def offset(self, n: float, start: Floats) -> Floats:
        """amplitude · sin(2πn / period)."""
        return np.array(self.amplitude) * math.sin(2 * math.pi * n / self.period)


AnyMotion = Annotated[
    SerializeAsAny[Motion],
    closed_part(
        Motion, Hold, Velocity, Displace, Path, Rotation, Oscillation, Table, Measured, Newton
    ),
]
