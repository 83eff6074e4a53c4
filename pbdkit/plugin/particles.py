"""Selections of body particles, as experiments write them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_serializer, model_validator

from pbdkit.plugin.component import Strict
from pbdkit.plugin.units import LENGTH, Place

Length = Annotated[float, LENGTH]
Box = Annotated[tuple[Length, Length, Length, Length], Field(strict=False)]
Numbers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(strict=False, min_length=1)]
Points = Annotated[tuple[Place, ...], Field(strict=False, min_length=1)]


class Selection(Strict):
    """Selection of body particles in the reference configuration, by one of five criteria.

    `edge`: the outermost particle of every row (left, right) or column (bottom, top); `box`: the
    particles within [xmin, ymin, xmax, ymax], inclusive; `numbers`: particle numbers; `nearest`:
    the particle nearest to each point; `region`: the particles inside a region.
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
