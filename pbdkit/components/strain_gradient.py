"""The elastic rule with an internal length."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field

from pbdkit.components.elasticity import Elastic, IsotropicElastic, mean_move
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import AppliesTwice, Here, Setting, Vector


class StrainGradient(AppliesTwice, IsotropicElastic):
    """Elasticity with an internal length l: the elastic move z, less c = l²/D times the elastic
    move that is made of z.

    D is the diffusion of longitudinal waves in a move, 2h²/(5 - 3ν') on the square lattice and
    h²/(3 - ν') on the hexagonal one. Along an axis it is u'' - l² u'''' = 0; the length of shear
    waves is √((1 - ν')/2) l. Where leaders hold an edge they hold the slope too. For cells of equal
    sides, with the natural frame. Stable with a relaxation below 2/(λ + cλ²) where the elastic
    rule's bound is 2/λ: mostly very small, so that solver: {type: equilibrium} serves it best.
    """

    type: Literal["strain-gradient"] = "strain-gradient"
    length: Annotated[float, Field(ge=0.0, le=1e6)] = Field(
        description="The internal length l (lattice units).", examples=[0.5]
    )

    def inner(self) -> Elastic:
        """The elastic rule."""
        return Elastic(poisson_ratio=self.poisson_ratio, plane=self.plane)

    def parameters(self, setting: Setting) -> dict[str, float]:
        """The modulus and c."""
        parameters = super().parameters(setting)
        sides = setting.cells.rectangle
        if sides and not math.isclose(*sides):
            raise ExperimentError(
                f"'{self.type}' works on cells of equal sides, and these are {sides[0]:g} by "
                f"{sides[1]:g}; take a square or a hexagonal lattice"
            )
        weights = [(slot.rest.x, self.weights(slot, setting)["xx"]) for slot in setting.slots[0]]
        diffusion = sum(w * x * x for x, w in weights) / sum(w for _, w in weights) / 2
        return parameters | {"c": self.length**2 / diffusion}

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Any:
        """z - c (Σ W)⁻¹ Σ W (z_k - z_j)."""
        return here.u - p.c * mean_move(total)

    @staticmethod
    def force(total: Any, here: Here, p: Any) -> Any:
        """Modulus · (Σ W z_j - c Σ W (z_k - z_j))."""
        pull, xx, xy, yy = total
        x, y = here.u
        return p.modulus * (Vector(xx * x + xy * y, xy * x + yy * y) - p.c * pull)
