"""Leader groups: who leads, how, and when (model.md, section 1). Selections are a closed family."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from pbdkit.experiment.motions import AnyMotion
from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.units import LENGTH, Place

Length = Annotated[float, LENGTH]
Box = Annotated[tuple[Length, Length, Length, Length], Field(strict=False)]
Numbers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(strict=False, min_length=1)]
Points = Annotated[tuple[Place, ...], Field(strict=False, min_length=1)]
Axes = Annotated[tuple[Literal["x", "y"], ...], Field(strict=False, min_length=1)]


class Selection(Strict):
    """Chooses body particles of the reference configuration, in one of five ways.

    `edge`: the outermost of every row (left, right) or column (bottom, top); `box`: [xmin, ymin,
    xmax, ymax], inclusive; `numbers`: as they are numbered; `nearest`: to each of some points;
    `region`: all that the region of that name holds.
    """

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    edge: Literal["left", "right", "bottom", "top"] | None = None
    box: Box | None = None
    numbers: Numbers | None = None
    nearest: Points | None = None
    region: str | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Selection:
        if len(self._given()) != 1:
            raise ValueError("give exactly one of edge, box, numbers, nearest, region")
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
