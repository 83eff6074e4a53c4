"""Bonds that never break, and bonds that break beyond a length (model.md, section 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import (
    BreaksAtStrain,
    FractureModel,
    Slot,
    StartsCracked,
    length,
    squared_length,
    where,
)
from pbdkit.interfaces.course import COURSE, PLAIN, Course, at, form_of, last
from pbdkit.interfaces.fracture_model import Segment
from pbdkit.interfaces.units import LENGTH

Limit = Annotated[float, Field(gt=0.0, le=1e150), LENGTH]


class LimitCourse(Course[Limit]):
    """Of a threshold."""


LimitInTime = Annotated[
    Annotated[Limit, Tag(PLAIN)] | Annotated[LimitCourse, Tag(COURSE)], Discriminator(form_of)
]
Thresholds = Annotated[tuple[LimitInTime, ...], Field(strict=False)]

Cracks = Annotated[tuple[Annotated[Segment, Field(strict=False)], ...], Field(strict=False)]


class NoFracture(FractureModel):
    """Nothing breaks; the scene has no bond state."""

    type: Literal["none"] = "none"

    can_break: ClassVar[bool] = False

    def constants(self, slot: Slot) -> dict[str, float]:
        """None."""
        return {}

    @staticmethod
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        """Never."""
        return False

    @staticmethod
    def fictitious(u: Any, r: Any, p: Any) -> Any:
        """The undeformed cell."""
        return 0.0 * r


class Parting(StartsCracked, FractureModel):
    """What models share whose fictitious points stand at m_j + λ R or at X_k.

    The fictitious point that takes the lost neighbour's place stands at m_j + λ R
    (`fictitious: cell`, `placement` λ: 1 recovers the undeformed cell, above it loosens, below it
    contracts) or at X_k (`fictitious: reference`). `frame_bonds: false` spares the bonds to the
    frame. `cracks` are segments [[x, y], [x, y]]; the bonds that cross them are broken from the
    start.
    """

    placement: float = Field(
        1.0, description="λ: the fictitious point stands at m_j + λ R.", examples=[1.2]
    )
    fictitious_at: Literal["cell", "reference"] = Field(
        "cell",
        alias="fictitious",
        description="Where the fictitious point stands: at m_j + λ R, or at X_k.",
        examples=["reference"],
    )
    frame_bonds: bool = Field(
        True, description="Whether bonds to frame points break too.", examples=[False]
    )
    cracks: Cracks = Field((), description="Segments whose bonds are broken from the start.")

    def parameters(self) -> dict[str, float]:
        """λ - 1, and whether the reference position counts."""
        return {
            "excess": self.placement - 1.0,
            "at_reference": float(self.fictitious_at == "reference"),
        }

    def breaks_frame_bonds(self) -> bool:
        """As `frame_bonds` says."""
        return self.frame_bonds

    def segments(self) -> tuple[Segment, ...]:
        """The `cracks`."""
        return self.cracks

    @staticmethod
    def fictitious(u: Any, r: Any, p: Any) -> Any:
        """(λ - 1) r: the point at m_j + λ r; or -u_j: the point at X_k."""
        return where(p.at_reference, -u, p.excess * r)


class Threshold(BreaksAtStrain, Parting):
    """A bond breaks when |r + d|² > threshold², one threshold a shell (the paper's section 5).

    The fictitious point that takes the lost neighbour's place stands at m_j + λ R
    (`fictitious: cell`, `placement` λ: 1 recovers the undeformed cell, above it loosens, below it
    contracts) or at X_k (`fictitious: reference`). `frame_bonds: false` spares the bonds to the
    frame. `cracks` are segments [[x, y], [x, y]]; the bonds that cross them are broken from the
    start.
    """

    type: Literal["threshold"] = "threshold"
    asked_thresholds: Thresholds = Field(
        alias="thresholds",
        description="The length at which bonds break, one a shell (lattice units).",
        examples=[[1.6], [1.6, 2.4]],
    )

    @property
    def thresholds(self) -> tuple[float, ...]:
        """One a shell, in the end."""
        return tuple(map(last, self.asked_thresholds))

    @property
    def courses(self) -> Mapping[str, Course[float]]:
        """Those of thresholds by the number of the shell, from 0 as a file's places are."""
        limits = enumerate(self.asked_thresholds)
        own = {f"thresholds.{n}": limit for n, limit in limits if isinstance(limit, Course)}
        return {**super().courses, **own}

    def at(self, moment: float) -> Any:
        """With the thresholds of a moment."""
        now = [at(limit, moment) for limit in self.asked_thresholds]
        return super().at(moment).with_more(thresholds=now)

    def constants(self, slot: Slot) -> dict[str, float]:
        """The squared threshold of the slot's shell, `limit`.

        A threshold that equals the rest length up to rounding breaks nothing at rest.
        """
        threshold, rest = self.thresholds[slot.shell - 1], squared_length(slot.rest)
        at_rest = threshold >= math.sqrt(rest) * (1 - 1e-12)
        return {"limit": max(threshold**2, rest) if at_rest else threshold**2}

    @staticmethod
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        """|r + d|² > threshold²."""
        return squared_length(r + d) > c.limit

    @staticmethod
    def breaking_strain(r: Any, c: Any, p: Any) -> Any:
        """The threshold as a strain."""
        return np.sqrt(c.limit) / length(r) - 1.0

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Refuses a wrong number of thresholds, and thresholds below every rest length."""
        if len(self.thresholds) != len(shells):
            raise ExperimentError(
                f"one threshold a shell is needed: {len(self.thresholds)} given for "
                f"{len(shells)} shell(s)",
                ("thresholds",),
            )
        warnings = []
        for n, (threshold, lengths) in enumerate(zip(self.thresholds, shells, strict=True)):
            if threshold < min(lengths) * (1 - 1e-12):
                raise ExperimentError(
                    f"{threshold:g} is below the rest length {min(lengths):g} of shell {n + 1}: "
                    "every bond would break at rest; raise it",
                    ("thresholds", n),
                )
            if threshold < max(lengths) * (1 - 1e-12):
                warnings.append(
                    f"fracture.thresholds.{n}: {threshold:g} is below the largest rest length "
                    f"{max(lengths):g} of shell {n + 1}: those bonds break in the first step"
                )
        return warnings
