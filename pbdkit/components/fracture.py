"""Built-in fracture models: none, a threshold on length (model.md, section 6), a threshold on
strain with or without gradual damage, and cohesive bonds that dissipate a given energy per crack
area on every lattice (docs/fracture.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.errors import ExperimentError
from pbdkit.plugin import (
    FRACTURE_ENERGY,
    Bonds,
    BreaksAtStrain,
    Calibrated,
    CellStress,
    Condition,
    Constants,
    Draws,
    FractureModel,
    KnowsStiffness,
    Number,
    Parameters,
    Remembered,
    RenewsBonds,
    Setting,
    Slot,
    Softens,
    SoftensCells,
    StartsCracked,
    Vector,
    length,
    squared_length,
    where,
)
from pbdkit.plugin.component import Drawn
from pbdkit.plugin.fracture import Segment
from pbdkit.plugin.schedule import COURSE, PLAIN, Course, at, form_of, last
from pbdkit.plugin.units import LENGTH, STRESS

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
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Never."""
        return False

    @staticmethod
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
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
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
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
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """|r + d|² > threshold²."""
        return squared_length(r + d) > c.limit

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
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


StrainLimit = Annotated[float, Field(gt=0.0, le=1e75), STRESS]
"""A strain; with a unit a stress, which is divided by Young's modulus."""
Scatter = Annotated[float, Field(ge=0.0, lt=1.0)]
PERCENT = 1.0
"""Strains from which on it is likely that per cent are meant."""
SCATTER = "s: strengths are drawn from 1 ± s, uniformly, by the seed."


def _drawn(bonds: Bonds, scatter: float, generator: np.random.Generator, **strains: float) -> Drawn:
    """Each strain times one number a bond, by name; nothing where there is no scatter."""
    if not scatter:
        return {}
    factors = 1.0 + scatter * generator.uniform(-1.0, 1.0, len(bonds))
    return {name: strain * factors for name, strain in strains.items()}


def _in_percent(**strains: float) -> list[str]:
    """A warning for each strain, by its field, that is so large that it may be in per cent."""
    return [
        f"fracture.{name}: {strain:g} is a strain of {100 * strain:g} %; {strain:g} % is written "
        f"{strain / 100:g}"
        for name, strain in strains.items()
        if strain >= PERCENT
    ]


class StrainFracture(Draws, BreaksAtStrain, Parting):
    """A bond breaks when its strain |r + d| / |r| - 1 exceeds `failure`, whatever its shell; bonds
    that are pressed together never break.

    With `scatter` s the failure strain of each bond is drawn from `failure` (1 ± s), uniformly, by
    the experiment's seed.
    """

    type: Literal["strain"] = "strain"
    failure: StrainLimit = Field(
        description="The strain above which a bond breaks, or the stress where it is uniaxial, "
        "along a bond, over Young's modulus.",
        examples=[0.1],
    )
    scatter: Scatter = Field(0.0, description=SCATTER, examples=[0.2])

    def constants(self, slot: Slot) -> dict[str, float]:
        """`square` = |r|² and the `failure_strain` of the bond, remembered where it is scattered;
        or, where all are alike, (1 + failure)² |r|² and 0, one multiplication less to round."""
        rest = squared_length(slot.rest)
        if self.scatter:
            return {"square": rest}
        return {"square": (1.0 + self.failure) ** 2 * rest, "failure_strain": 0.0}

    def remembered(self) -> tuple[Remembered, ...]:
        """`failure_strain` where it is not the same for all."""
        return (_FAILURE_STRAIN,) if self.scatter else ()

    def draw(self, owners: Bonds, generator: np.random.Generator) -> Drawn:
        """One number a bond."""
        return _drawn(owners, self.scatter, generator, failure_strain=self.failure)

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """A warning where the strain may be in per cent."""
        return _in_percent(failure=self.failure)

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """|r + d|² > (1 + failure)² |r|²."""
        stretch = 1.0 + c.failure_strain
        return squared_length(r + d) > c.square * (stretch * stretch)

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """The failure strain of the bond."""
        return np.sqrt(c.square) * (1.0 + c.failure_strain) / length(r) - 1.0


class Damage(Draws, Softens, RenewsBonds, BreaksAtStrain, Parting):
    """A bond softens from strain `onset` on and is broken at strain `failure`.

    Its damage is the largest so far of D = failure / (failure - onset) (1 - onset / ε), from 0 at
    the onset to 1 at failure; it never heals, and compression does none. The rule sees the bond as
    (1 - D) d + D lost, lost being the difference to the fictitious point: under the barycentre
    the bond's pull (1 - D) ε falls along a straight line from the onset to zero at failure.

    With `scatter` s both strains of each bond are multiplied by one number, drawn from 1 ± s,
    uniformly, by the experiment's seed.
    """

    type: Literal["damage"] = "damage"
    onset: StrainLimit = Field(
        description="The strain at which a bond begins to soften.", examples=[0.05]
    )
    failure: StrainLimit = Field(description="The strain at which it is broken.", examples=[0.2])
    scatter: Scatter = Field(0.0, description=SCATTER, examples=[0.2])

    @model_validator(mode="after")
    def _onset_comes_first(self) -> Self:
        if self.onset >= self.failure:
            text = (
                f"onset {self.onset:g} is not below failure {self.failure:g}: nothing softens; "
                "lower it, or take {type: strain}, which breaks at once"
            )
            raise PydanticCustomError("fault", "{text}", {"text": text, "key": "onset"})
        return self

    def constants(self, slot: Slot) -> dict[str, float]:
        """`per_rest` = 1/|r|; `onset_strain` and `failure_strain` unless each bond has its own."""
        own = {} if self.scatter else self._strains()
        return {"per_rest": 1.0 / length(slot.rest)} | own

    def remembered(self) -> tuple[Remembered, ...]:
        """`damage`, after `onset_strain` and `failure_strain` where they are scattered."""
        return (_ONSET_STRAIN, _FAILURE_STRAIN, _DAMAGE) if self.scatter else (_DAMAGE,)

    def draw(self, owners: Bonds, generator: np.random.Generator) -> Drawn:
        """One number a bond."""
        return _drawn(owners, self.scatter, generator, **self._strains())

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """A warning where strains may be in per cent."""
        return _in_percent(onset=self.onset, failure=self.failure)

    def _strains(self) -> dict[str, float]:
        return {"onset_strain": self.onset, "failure_strain": self.failure}

    @staticmethod
    def update(d: Vector, r: Vector, c: Constants, p: Parameters) -> tuple[Number, ...]:
        """The damage, where there is more than before."""
        strain = length(r + d) * c.per_rest - 1.0
        return (softened(strain, c.onset_strain, c.failure_strain, c.damage),)

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """D = 1."""
        return c.damage >= 1.0

    @staticmethod
    def seen(d: Vector, lost: Vector, r: Vector, c: Constants, p: Parameters) -> Vector:
        """(1 - D) d + D lost."""
        return (1.0 - c.damage) * d + c.damage * lost

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """The failure strain of the bond."""
        return c.failure_strain


def softened(strain: Any, onset: Any, failure: Any, damage: Any) -> Any:
    """D = failure / (failure - onset) (1 - onset / strain), where it is more than the damage
    before: the pull (1 - D) strain falls along a straight line from the onset to 0 at failure."""
    softens = strain > onset
    law = failure * (strain - onset) / ((failure - onset) * where(softens, strain, 1.0))
    law = where(strain < failure, law, 1.0)
    return where(softens & (law > damage), law, damage)


_FAILURE_STRAIN = Remembered(
    "failure_strain", "strain at which the bond breaks", "1", changes=False
)
_ONSET_STRAIN = Remembered("onset_strain", "strain at which the bond softens", "1", changes=False)
_DAMAGE = Remembered("damage", "damage of the bond, from 0 to 1 where it is broken", "1")


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
        d: Vector, r: Vector, c: Constants, p: Parameters, left: CellStress, right: CellStress
    ) -> tuple[Number, ...]:
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
    def load(stress: CellStress, c: Constants, p: Parameters) -> Number:
        """κ over the onset."""
        largest, cos, sin = _principal(stress)
        return largest * _along(cos, sin, c.along_y, c.across) / c.onset_strain

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
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


def _principal(stress: CellStress) -> tuple[Number, Number, Number]:
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


def _along(cos: Number, sin: Number, along_y: Number, across: Number) -> Number:
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


def _bonds_of_a_cell(setting: Setting) -> tuple[Vector, Vector, Vector]:
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
