"""Fracture for pbdkit with strengths that differ from bond to bond, after Weibull."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.plugin import (
    Bonds,
    BreaksAtStrain,
    Component,
    Draws,
    FractureModel,
    Remembered,
    Slot,
    Vector,
    hookimpl,
    length,
)

pbdkit_api = 1


class Weibull(Draws, BreaksAtStrain, FractureModel):
    """A bond breaks when its strain |r + d| / |r| - 1 exceeds a strength of its own.

    Strengths are drawn once, by the experiment's seed, so that a bond bears the strain ε with
    probability exp(-(ε / scale)^modulus). A large modulus means little scatter. The lost neighbour
    stands in the undeformed cell from then on. W. Weibull, J. Appl. Mech. 18 (1951) 293.
    """

    type: Literal["weibull"] = "weibull"
    scale: float = Field(
        0.1, gt=0.0, le=1e75, description="The strain that a share 1/e of the bonds bear."
    )
    modulus: float = Field(
        8.0,
        ge=0.1,
        le=1000.0,
        description="Weibull's modulus: the larger, the more alike the bonds.",
        examples=[2.0],
    )
    frame_bonds: bool = Field(
        True, description="Whether bonds to frame points break too.", examples=[False]
    )

    def breaks_frame_bonds(self) -> bool:
        """As `frame_bonds` says."""
        return self.frame_bonds

    def constants(self, slot: Slot) -> dict[str, float]:
        """The rest length."""
        return {"rest": length(slot.rest)}

    def remembered(self) -> tuple[Remembered, ...]:
        """The strength of each bond, which stays."""
        return (Remembered("strength", "strain at which the bond breaks", "1", changes=False),)

    def draw(self, owners: Bonds, generator: np.random.Generator) -> dict[str, NDArray[Any]]:
        """scale · E^(1/modulus), E exponentially distributed with mean 1."""
        return {"strength": self.scale * generator.weibull(self.modulus, len(owners))}

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Any, p: Any) -> Any:
        """|r + d| > |r| (1 + strength)."""
        return length(r + d) > c.rest + c.rest * c.strength

    @staticmethod
    def breaking_strain(r: Vector, c: Any, p: Any) -> Any:
        """The strength, for `pbdkit explain`."""
        return c.strength

    @staticmethod
    def fictitious(u: Vector, r: Vector, p: Any) -> Vector:
        """The undeformed cell."""
        return 0.0 * r


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """What this distribution offers."""
    return [Weibull]
