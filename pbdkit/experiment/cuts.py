"""Cuts in time: segments whose bonds are broken at the beginning of a step."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from pbdkit.experiment.parts import fault
from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.fracture_model import Segment
from pbdkit.interfaces.units import Place


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
