"""Fracture with energy: cracks that take as much of it on every lattice (docs/fracture.md)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pbdkit.components.fracture import Parting
from pbdkit.components.strain_fracture import StrainLimit, softened
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import (
    FRACTURE_ENERGY,
    Calibrated,
    CellStress,
    Components,
    KnowsStiffness,
    Remembered,
    Setting,
    Slot,
    SoftensCells,
    Vector,
    squared_length,
    where,
)

CROSSED = 0.09
"""The least square of the cosine between a bond and the normal of a crack that crosses it."""
DIRECTIONS = 360
"""So many directions are looked at for the crack that the spacing suits least."""


class Cohesive(KnowsStiffness, SoftensCells, Parting):
    """A cell softens from the principal stress `onset` times its Young's modulus on, in a band one
    cell wide, and is torn where the band has taken up `energy` for each unit of the crack's length.

    The stress is that which the cell would have without damage. Where its largest principal value
    reaches the onset, the direction of that is the normal e of the cell's crack, for good. Bonds of
    the cell that cross the crack, |n · e| > 0.3, lose their pull in the cell by the largest stress
    κ over Young's modulus since: D = failure / (failure - onset) (1 - onset / κ); the others do
    not. The failure strain is such that a band of cells which a straight crack crosses, and which
    does not contract along it, takes up the energy: its width is that of the cell along e (Bažant
    and Oh 1983, Oliver 1989). A bond is broken where D is 1 in all cells beside it. Cracks do not
    close under pressure.
    """

    type: Literal["cohesive"] = "cohesive"
    placement: Annotated[float, Field(ge=1.0, le=1.0)] = Field(
        1.0, description="Lost bonds of a material exert nothing: 1."
    )
    fictitious_at: Literal["cell"] = Field(
        "cell", alias="fictitious", description="As `placement`: `cell`."
    )
    energy: Annotated[float, Field(gt=0.0, le=1e75), FRACTURE_ENERGY] = Field(
        description="G_c over Young's modulus: a length (lattice units); with a unit also G_c.",
        examples=[0.05],
    )
    onset: StrainLimit = Field(
        description="The tensile strength over Young's modulus: the largest principal stress over "
        "it at which a cell begins to soften.",
        examples=[0.1],
    )

    def constants(self, slot: Slot) -> dict[str, float]:
        """`onset_strain`."""
        return {"onset_strain": self.onset}

    def of_material(self, slot: Slot, rule: Calibrated, setting: Setting) -> dict[str, float]:
        """`release`, 2 energy / onset times the stiffness along x over the squared modulus along x,
        a length; the compliances `along_y` and `across` over that along x, and the stiffnesses
        `stiff_y` and `stiff_across`; and the bonds of a cell, `x0` to `y2`.

        ExperimentError where the failure strain of some crack is not above the onset, since the
        spacing is too large for so little energy.
        """
        release, ratios = _material(rule)
        bonds = _bonds_of_a_cell(setting)
        angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
        cos, sin = np.cos(2 * angles), np.sin(2 * angles)
        size = np.sqrt(np.max([_projection(r, cos, sin) for r in bonds], axis=0))
        flexibility, stiffness = (_along(cos, sin, *pair) for pair in (ratios[:2], ratios[2:]))
        size = float((size / (flexibility * flexibility * stiffness)).max())
        room = 2.0 * self.energy * release / (size * self.onset**2)
        if np.any(room <= 1.0):
            raise ExperimentError(
                f"{self.energy:g} is too little for this spacing: a cell would have to be torn "
                f"{1.0 / room:.3g} times before its onset, and the crack snaps from cell to cell; "
                f"make the spacing smaller than {room:.3g} of what it is, or set fracture.onset "
                f"below {self.onset * room**0.5:.3g} or fracture.energy above "
                f"{self.energy / room:.3g}",
                ("energy",),
            )
        cell = {f"x{n}": float(r.x) for n, r in enumerate(bonds)}
        cell |= {f"y{n}": float(r.y) for n, r in enumerate(bonds)}
        known = dict(zip(("along_y", "across", "stiff_y", "stiff_across"), ratios, strict=True))
        return {"release": 2.0 * self.energy * release / self.onset, **known, **cell}

    def remembered(self) -> tuple[Remembered, ...]:
        """`damage_left` and `damage_right`, and the strains at which the cells are torn, negative
        where the crack of a cell does not cross the bond."""
        return _NUMBERS

    @staticmethod
    def update(  # type: ignore[override]  # SoftensCells: it is given the cells
        d: Any, r: Any, c: Any, p: Any, left: CellStress, right: CellStress
    ) -> tuple[Any, ...]:
        """Those of both cells; where there is one alone they are the same."""
        here, fails = _of_cell(left, c.damage_left, c.failure_left, r, c)
        there, parts = _of_cell(right, c.damage_right, c.failure_right, r, c)
        on_left, on_right = left.share > 0.0, right.share > 0.0
        return (
            where(on_left, here, there),
            where(on_right, there, here),
            where(on_left, fails, parts),
            where(on_right, parts, fails),
        )

    @staticmethod
    def load(stress: CellStress, c: Any, p: Any) -> Any:
        """κ over the onset."""
        largest, cos, sin = _principal(stress)
        return largest * _along(cos, sin, c.along_y, c.across) / c.onset_strain

    @staticmethod
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        """D = 1 on both sides."""
        return (c.damage_left >= 1.0) & (c.damage_right >= 1.0)


def _of_cell(stress: CellStress, damage: Any, failure: Any, r: Any, c: Any) -> Any:
    """The damage of a bond in a cell under a stress, and the failure strain, from those before."""
    largest, cos, sin = _principal(stress)
    flexibility = _along(cos, sin, c.along_y, c.across)
    strain = largest * flexibility
    size = _projection(Vector(c.x0, c.y0), cos, sin)
    other = _projection(Vector(c.x1, c.y1), cos, sin)
    size = where(other > size, other, size)
    other = _projection(Vector(c.x2, c.y2), cos, sin)
    size = np.sqrt(where(other > size, other, size))
    stiffness = _along(cos, sin, c.stiff_y, c.stiff_across)
    fails = c.release * flexibility * flexibility * stiffness / size
    crossed = _projection(r, cos, sin) > CROSSED * squared_length(r)
    begins = (failure == 0.0) & (strain > c.onset_strain) & (stress.share > 0.0)
    failure = where(begins, where(crossed, fails, -fails), failure)
    crosses = failure > 0.0
    law = softened(strain, c.onset_strain, where(crosses, failure, 2.0 * c.onset_strain), damage)
    return where(crosses, law, damage), failure


def _principal(stress: CellStress) -> Any:
    """The largest principal stress, and cosine and sine of twice the angle of its direction."""
    mean, half = 0.5 * (stress.xx + stress.yy), 0.5 * (stress.xx - stress.yy)
    radius = np.sqrt(half * half + stress.xy * stress.xy)
    some = radius > 0.0
    size = where(some, radius, 1.0)
    return mean + radius, where(some, half / size, 1.0), where(some, stress.xy / size, 0.0)


def _projection(r: Any, cos: Any, sin: Any) -> Any:
    """(r · e)² along the direction of which twice the angle has this cosine and sine."""
    x, y = r.x * r.x, r.y * r.y
    return 0.5 * (x + y + cos * (x - y)) + sin * r.x * r.y


def _along(cos: Any, sin: Any, along_y: Any, across: Any) -> Any:
    """A compliance or a stiffness along that direction, over that along x."""
    x, y = 0.5 * (1.0 + cos), 0.5 * (1.0 - cos)
    return x * x + along_y * y * y + across * 0.25 * sin * sin


def _material(rule: Calibrated) -> tuple[float, tuple[float, float, float, float]]:
    """Of a rule's material the stiffness along x over the squared modulus along x; and S_yy and
    2 S_xy + S_shear over S_xx, C_yy and 2 C_xy + 4 C_shear over C_xx, in its plane."""
    material = rule.elasticity()
    assert material is not None
    xx, yy, xy, shear, *_ = material
    across = (xx * yy - xy * xy) / (yy * shear) - 2.0 * xy / yy
    ratios = xx / yy, across, yy / xx, (2.0 * xy + 4.0 * shear) / xx
    return xx / material.own_modulus(rule.through_thickness()) ** 2, ratios


def _bonds_of_a_cell(setting: Setting) -> tuple[Components, Components, Components]:
    """Those that are longest in some direction: the sides of a triangle, the diagonals of a
    rectangle."""
    origin, one, other, *more = setting.cells.polygons[0].rest
    if more:
        return other - origin, more[0] - one, more[0] - one
    return one - origin, other - origin, other - one


def _pair(name: str, text: str) -> tuple[Remembered, Remembered]:
    sides = ("left", "right")
    one, other = (Remembered(f"{name}_{side}", f"{text} on its {side}", "1") for side in sides)
    return one, other


_NUMBERS = (
    *_pair("damage", "damage of the bond, from 0 to 1 where it is broken, in the cell"),
    *_pair("failure", "strain at which a crack tears the cell, negative along the bond,"),
)
