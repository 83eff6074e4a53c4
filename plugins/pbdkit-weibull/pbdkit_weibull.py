"""Fracture model for pbdkit with random strengths of bonds after Weibull."""

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
    """A bond breaks when its strain |r + d| / |r| - 1 exceeds the strength of the bond.

    Strengths are drawn once, with the seed of the experiment. The probability that a bond survives
    the strain ε is exp(-(ε / scale)^modulus), so that a large modulus means little scatter. The
    fictitious point of a broken bond lies at the corner of the undeformed cell.

    References
    ----------
    W. Weibull, A statistical distribution function of wide applicability, J. Appl. Mech. 18 (1951)
    293-297.
    """

    type: Literal["weibull"] = "weibull"
    scale: float = Field(
        0.1, gt=0.0, le=1e75, description="Strain that a fraction 1/e of the bonds survives."
    )
    modulus: float = Field(
        8.0,
        ge=0.1,
        le=1000.0,
        description="Weibull modulus; scatter decreases with it.",
        examples=[2.0],
    )
    frame_bonds: bool = Field(
        True, description="Whether bonds to frame points can break.", examples=[False]
    )

    def breaks_frame_bonds(self) -> bool:
        """Return whether bonds to frame points can break."""
        return self.frame_bonds

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return the rest length."""
        return {"rest": length(slot.rest)}

    def remembered(self) -> tuple[Remembered, ...]:
        """Declare the constant strength of each bond."""
        return (Remembered("strength", "strain at which the bond breaks", "1", changes=False),)

    def draw(self, owners: Bonds, generator: np.random.Generator) -> dict[str, NDArray[Any]]:
        """Draw scale · E^(1/modulus), with E exponentially distributed of mean 1."""
        return {"strength": self.scale * generator.weibull(self.modulus, len(owners))}

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Any, p: Any) -> Any:
        """Return whether |r + d| > |r| (1 + strength)."""
        return length(r + d) > c.rest + c.rest * c.strength

    @staticmethod
    def breaking_strain(r: Vector, c: Any, p: Any) -> Any:
        """Return the strength, for `pbdkit explain`."""
        return c.strength

    @staticmethod
    def fictitious(u: Vector, r: Vector, p: Any) -> Vector:
        """Return the displacement difference at the fictitious point, zero."""
        return 0.0 * r


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """Return the components of this distribution."""
    return [Weibull]
