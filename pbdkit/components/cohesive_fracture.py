"""Fracture with energy: cracks that take as much of it on every lattice (docs/fracture.md)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pbdkit.components.strain_fracture import DAMAGE, Softening, StrainLimit
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import LENGTH, KnowsStiffness, Remembered, Setting, Slot, Vector, length


class Cohesive(KnowsStiffness, Softening):
    """A bond softens from strain `onset` on, as under `damage`, and is broken at the strain at
    which the bonds across a crack have taken up `energy` for each unit of its length.

    A bond of length l and stiffness k takes up ½ k l² onset · failure. It is to take up c/l: on
    the square lattice a crack along an axis then takes as much as one along a diagonal, and none
    takes less. So failure = 2c/(k l³ onset), c = energy · A / min_n Σ_k |r_k · n| / l_k over the
    bonds k of a site, each once, with the area A of a site: inversely as the spacing.
    """

    type: Literal["cohesive"] = "cohesive"
    placement: Annotated[float, Field(ge=1.0, le=1.0)] = Field(
        1.0, description="Lost bonds of a material exert nothing: 1."
    )
    fictitious_at: Literal["cell"] = Field(
        "cell", alias="fictitious", description="As `placement`: `cell`."
    )
    energy: Annotated[float, Field(gt=0.0, le=1e75), LENGTH] = Field(
        description="G_c over Young's modulus: a length (lattice units).", examples=[0.05]
    )
    onset: StrainLimit = Field(
        description="The strain at which a bond begins to soften; where stress is uniaxial, along "
        "a bond, the strength over Young's modulus.",
        examples=[0.1],
    )

    def constants(self, slot: Slot) -> dict[str, float]:
        """`per_rest` = 1/|r| and `onset_strain`."""
        return {"per_rest": 1.0 / length(slot.rest), "onset_strain": self.onset}

    def of_material(
        self, slot: Slot, stiffness: Mapping[Slot, float], setting: Setting
    ) -> dict[str, float]:
        """`failure_strain`; ExperimentError where it is not above the onset, since the spacing is
        too large for so little energy, and where bonds are not stiff along themselves."""
        if stiffness[slot] <= 0.0:
            raise ExperimentError(
                f"'{self.type}' works on bonds that pull along themselves, and one along "
                f"{tuple(slot.rest)} has the stiffness {stiffness[slot]:.3g}; take 'springs' or "
                "'elastic'"
            )
        least = min(_share(s, setting) / (k * length(s.rest) ** 2) for s, k in stiffness.items())
        room = 2.0 * self.energy * least / self.onset**2
        if np.any(room <= 1.0):
            raise ExperimentError(
                f"{self.energy:g} is too little for this spacing: a bond would have to break "
                f"{1.0 / room:.3g} times before its onset, and the crack snaps from bond to bond; "
                f"make the spacing smaller than {room:.3g} of what it is, or set fracture.onset "
                f"below {self.onset * room**0.5:.3g} or fracture.energy above "
                f"{self.energy / room:.3g}",
                ("energy",),
            )
        strain = (
            2.0 * _share(slot, setting) / (stiffness[slot] * length(slot.rest) ** 2 * self.onset)
        )
        return {"failure_strain": self.energy * strain}

    def remembered(self) -> tuple[Remembered, ...]:
        """`damage`."""
        return (DAMAGE,)


def _share(slot: Slot, setting: Setting) -> float:
    """Of the energy of a unit of crack, what a bond takes up: an area per length."""
    across = _across(tuple(s.rest for s in setting.slots[slot.source]))
    a, b = setting.cell.vectors
    area = abs(a.x * b.y - a.y * b.x) / len(setting.cell.sites)
    return float(area / (across * length(slot.rest)))


@cache
def _across(rests: tuple[Vector, ...]) -> float:
    """min_n Σ_k |r_k · n| / l_k: every bond is met from both ends, and the least is found along one
    of them. Kept, since it is asked for bond by bond where materials differ."""
    sizes = (
        sum(abs(r.x * n.y - r.y * n.x) / (length(r) * length(n)) for r in rests) for n in rests
    )
    return float(min(sizes)) / 2
