"""Built-in fracture models.

There are five models:

- no fracture;
- a threshold on the length of bonds (section 5 of the paper);
- a limit on the strain of bonds;
- gradual damage of bonds between two strains;
- softening cells, which dissipate the same energy per crack length for every lattice constant
  (docs/fracture.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.array_types import Floats
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
    Number,
    Parameters,
    Remembered,
    RenewsBonds,
    Setting,
    Slot,
    Softens,
    SoftensCells,
    SpacingLimits,
    StartsCracked,
    UsesStiffness,
    Vector,
    length,
    squared_length,
    where,
)
from pbdkit.plugin.component import Drawn, Pair
from pbdkit.plugin.fracture_model import Segment
from pbdkit.plugin.schedule import (
    BY_NAME,
    BY_POINTS,
    PLAIN,
    TIME_DEPENDENT,
    TimeDependent,
    at,
    form_of,
    last,
)
from pbdkit.plugin.units import LENGTH, STRESS

Limit = Annotated[float, Field(gt=0.0, le=1e150), LENGTH]
"""Type of the length at which a bond breaks."""


class TimeDependentLimit(TimeDependent[Limit]):
    """Threshold that depends on time."""


LimitInTime = Annotated[
    Annotated[Limit, Tag(PLAIN)] | Annotated[TimeDependentLimit, Tag(TIME_DEPENDENT)],
    Discriminator(form_of),
]
"""Type of a threshold, constant or time-dependent."""
Thresholds = Annotated[tuple[LimitInTime, ...], Field(strict=False)]
"""Type of the thresholds, one for each shell."""

Cracks = Annotated[tuple[Annotated[Segment, Field(strict=False)], ...], Field(strict=False)]
"""Type of the cracks that exist from the start."""


class NoFracture(FractureModel):
    """No fracture: bonds never break, and the scene has no bond state."""

    type: Literal["none"] = "none"

    can_break: ClassVar[bool] = False

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return an empty dictionary."""
        return {}

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return False for every bond."""
        return False

    @staticmethod
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
        """Return a difference of zero."""
        return 0.0 * r


class Parting(StartsCracked, FractureModel):
    """Base class of the models with fictitious points at m_j + λ R or at X_k.

    A fictitious point replaces the neighbour across a broken bond. With `fictitious: cell` it lies
    at m_j + λ R. The value λ = 1 of `placement` gives the undeformed cell; λ > 1 expands the cell,
    and λ < 1 contracts it. With `fictitious: reference` the point lies at X_k. If `frame_bonds` is
    false, bonds to frame points do not break. `cracks` are segments [[x, y], [x, y]]; bonds that
    cross them are broken from the start.
    """

    placement: float = Field(
        1.0, description="λ: the fictitious point lies at m_j + λ R.", examples=[1.2]
    )
    fictitious_at: Literal["cell", "reference"] = Field(
        "cell",
        alias="fictitious",
        description="Position of the fictitious point: m_j + λ R, or X_k.",
        examples=["reference"],
    )
    frame_bonds: bool = Field(
        True, description="Allow bonds to frame points to break.", examples=[False]
    )
    cracks: Cracks = Field(
        (), description="Segments; bonds that cross them are broken from the start."
    )

    def parameters(self) -> dict[str, float]:
        """Return λ - 1, and whether fictitious points lie at the reference position."""
        return {
            "excess": self.placement - 1.0,
            "at_reference": float(self.fictitious_at == "reference"),
        }

    def breaks_frame_bonds(self) -> bool:
        """Return the value of `frame_bonds`."""
        return self.frame_bonds

    def segments(self) -> tuple[Segment, ...]:
        """Return the value of `cracks`."""
        return self.cracks

    @staticmethod
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
        """Return (λ - 1) r for a point at m_j + λ r, or -u_j for a point at X_k."""
        return where(p.at_reference, -u, p.excess * r)


class Threshold(BreaksAtStrain, Parting):
    """A bond breaks when |r + d|² > threshold², with one threshold for each shell.

    This is the model of section 5 of the paper. A fictitious point replaces the neighbour across a
    broken bond. With `fictitious: cell` it lies at m_j + λ R. The value λ = 1 of `placement` gives
    the undeformed cell; λ > 1 expands the cell, and λ < 1 contracts it. With `fictitious:
    reference` the point lies at X_k. If `frame_bonds` is false, bonds to frame points do not break.
    `cracks` are segments [[x, y], [x, y]]; bonds that cross them are broken from the start.
    """

    type: Literal["threshold"] = "threshold"
    limits: Thresholds = Field(
        alias="thresholds",
        description="Length at which bonds break, one for each shell (lattice units).",
        examples=[[1.6], [1.6, 2.4]],
    )

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Last value of the threshold of each shell."""
        return tuple(map(last, self.limits))

    @property
    def time_dependent(self) -> Mapping[str, TimeDependent[float]]:
        """Time-dependent thresholds and other parameters, by their path in the file."""
        limits = enumerate(self.limits)
        time_dependent = {
            f"thresholds.{n}": limit for n, limit in limits if isinstance(limit, TimeDependent)
        }
        return {**super().time_dependent, **time_dependent}

    def at(self, moment: float) -> Any:
        """Return the model with the thresholds at a given time."""
        thresholds = [at(limit, moment) for limit in self.limits]
        return super().at(moment).with_more(thresholds=thresholds)

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return `limit`, the squared threshold of the shell of the slot.

        If the threshold equals the rest length except for a rounding error, no bond breaks at rest.
        """
        threshold, rest = self.thresholds[slot.shell - 1], squared_length(slot.rest)
        at_rest = threshold >= math.sqrt(rest) * (1 - 1e-12)
        return {"limit": max(threshold**2, rest) if at_rest else threshold**2}

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return |r + d|² > threshold²."""
        return squared_length(r + d) > c.limit

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """Return the threshold as a strain."""
        return np.sqrt(c.limit) / length(r) - 1.0

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Return a warning for each threshold below some rest length of its shell.

        Raises
        ------
        ExperimentError
            If the number of thresholds differs from the number of shells, or a threshold is below
            every rest length of its shell.
        """
        if len(self.thresholds) != len(shells):
            raise ExperimentError(
                f"one threshold for each shell is required: there are {len(self.thresholds)} for "
                f"{len(shells)} shell(s)",
                ("thresholds",),
            )
        warnings = []
        for n, (threshold, lengths) in enumerate(zip(self.thresholds, shells, strict=True)):
            if threshold < min(lengths) * (1 - 1e-12):
                raise ExperimentError(
                    f"{threshold:g} is below the rest length {min(lengths):g} of shell {n + 1}: "
                    "every bond would break at rest; increase it",
                    ("thresholds", n),
                )
            if threshold < max(lengths) * (1 - 1e-12):
                warnings.append(
                    f"fracture.thresholds.{n}: {threshold:g} is below the largest rest length "
                    f"{max(lengths):g} of shell {n + 1}: those bonds break in the first step"
                )
        return warnings


StrainLimit = Annotated[float, Field(gt=0.0, le=1e75), STRESS]
"""Type of a strain. A value with a unit is a stress, which is divided by Young's modulus."""
Scatter = Annotated[float, Field(ge=0.0, lt=1.0)]
"""Type of the relative scatter of strengths."""
PERCENT = 1.0
"""For strains above this one, a warning suggests that the value was given in per cent."""
SCATTER = "Scatter s: strengths are multiplied by random factors, uniform in 1 ± s."
"""Description of the parameter `scatter`."""


def _drawn(bonds: Bonds, scatter: float, generator: np.random.Generator, **strains: float) -> Drawn:
    """Return the values of the strains for every bond: each strain, multiplied by a random factor
    of the bond. The result is empty if there is no scatter."""
    if not scatter:
        return {}
    factors = 1.0 + scatter * generator.uniform(-1.0, 1.0, len(bonds))
    return {name: strain * factors for name, strain in strains.items()}


def _in_percent(**strains: float) -> list[str]:
    """Return a warning, with the field, for each strain that was possibly given in per cent."""
    return [
        f"fracture.{name}: {strain:g} is a strain of {100 * strain:g} %; {strain:g} % is written "
        f"{strain / 100:g}"
        for name, strain in strains.items()
        if strain >= PERCENT
    ]


class StrainFracture(Draws, BreaksAtStrain, Parting):
    """A bond of any shell breaks when its strain |r + d| / |r| - 1 exceeds `failure`.

    Bonds under compression do not break. The failure strain of each bond is a random number from
    the uniform distribution over `failure` (1 ± `scatter`). It depends on the seed of the
    experiment.
    """

    type: Literal["strain"] = "strain"
    failure: StrainLimit = Field(
        description="Failure strain of a bond; with a unit the uniaxial stress along a bond, "
        "divided by Young's modulus.",
        examples=[0.1],
    )
    scatter: Scatter = Field(0.0, description=SCATTER, examples=[0.2])

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return `square` and, if there is no scatter, `failure_strain`.

        With scatter, `square` is |r|². Without scatter, it is (1 + failure)² |r|², and
        `failure_strain` is 0. The product is then computed once and not in every step, which avoids
        one rounding error.
        """
        rest = squared_length(slot.rest)
        if self.scatter:
            return {"square": rest}
        return {"square": (1.0 + self.failure) ** 2 * rest, "failure_strain": 0.0}

    def remembered(self) -> tuple[Remembered, ...]:
        """Declare `failure_strain` if there is scatter."""
        return (_FAILURE_STRAIN,) if self.scatter else ()

    def draw(self, owners: Bonds, generator: np.random.Generator) -> Drawn:
        """Draw one factor for each bond."""
        return _drawn(owners, self.scatter, generator, failure_strain=self.failure)

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Return a warning if the strain was possibly given in per cent."""
        return _in_percent(failure=self.failure)

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return |r + d|² > (1 + failure)² |r|²."""
        stretch = 1.0 + c.failure_strain
        return squared_length(r + d) > c.square * (stretch * stretch)

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """Return the failure strain of the bond."""
        return np.sqrt(c.square) * (1.0 + c.failure_strain) / length(r) - 1.0


class Damage(Draws, Softens, RenewsBonds, BreaksAtStrain, Parting):
    """A bond softens above the strain `onset` and breaks at the strain `failure`.

    With the strain ε of a bond, its damage is the maximum over time of D = failure / (failure -
    onset) (1 - onset / ε). This is 0 at the onset and 1 at failure. Damage is irreversible and does
    not increase under compression. In place of d the rule receives the difference (1 - D) d + D
    lost, where `lost` is the displacement of the fictitious point minus that of the particle. With
    the barycentre rule the force (1 - D) ε of the bond decreases linearly from its value at the
    onset to zero at failure.

    With `scatter` s, both strains of a bond are multiplied by the same random factor, from the
    uniform distribution over 1 ± s. It depends on the seed of the experiment.
    """

    type: Literal["damage"] = "damage"
    onset: StrainLimit = Field(
        description="Strain at which a bond begins to soften.", examples=[0.05]
    )
    failure: StrainLimit = Field(description="Strain at which a bond breaks.", examples=[0.2])
    scatter: Scatter = Field(0.0, description=SCATTER, examples=[0.2])

    @model_validator(mode="after")
    def _onset_comes_first(self) -> Self:
        if self.onset >= self.failure:
            text = (
                f"onset {self.onset:g} is not below failure {self.failure:g}: bonds would not "
                "soften; decrease the onset, or use {type: strain}, where bonds break at once"
            )
            raise PydanticCustomError("fault", "{text}", {"text": text, "key": "onset"})
        return self

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return `per_rest` = 1/|r| and, if there is no scatter, also `onset_strain` and
        `failure_strain`."""
        strains = {} if self.scatter else self._strains()
        return {"per_rest": 1.0 / length(slot.rest)} | strains

    def remembered(self) -> tuple[Remembered, ...]:
        """Declare `damage`; with scatter, declare `onset_strain` and `failure_strain` before it."""
        return (_ONSET_STRAIN, _FAILURE_STRAIN, _DAMAGE) if self.scatter else (_DAMAGE,)

    def draw(self, owners: Bonds, generator: np.random.Generator) -> Drawn:
        """Draw one factor for each bond."""
        return _drawn(owners, self.scatter, generator, **self._strains())

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Return a warning for each strain that was possibly given in per cent."""
        return _in_percent(onset=self.onset, failure=self.failure)

    def _strains(self) -> dict[str, float]:
        return {"onset_strain": self.onset, "failure_strain": self.failure}

    @staticmethod
    def update(d: Vector, r: Vector, c: Constants, p: Parameters) -> tuple[Number, ...]:
        """Return the damage, which does not decrease."""
        strain = length(r + d) * c.per_rest - 1.0
        return (softened(strain, c.onset_strain, c.failure_strain, c.damage),)

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return whether D = 1."""
        return c.damage >= 1.0

    @staticmethod
    def seen(d: Vector, lost: Vector, r: Vector, c: Constants, p: Parameters) -> Vector:
        """Return (1 - D) d + D lost."""
        return (1.0 - c.damage) * d + c.damage * lost

    @staticmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """Return the failure strain of the bond."""
        return c.failure_strain


def softened(strain: Any, onset: Any, failure: Any, damage: Any) -> Any:
    """Evaluate the linear softening law.

    Parameters
    ----------
    strain
        Strain of a bond.
    onset, failure
        Strains at which softening begins and ends.
    damage
        Damage so far.

    Returns
    -------
    Any
        D = failure / (failure - onset) (1 - onset / strain), or `damage` if that is larger. The
        force (1 - D) strain decreases linearly from the onset to 0 at failure.
    """
    softens = strain > onset
    law = failure * (strain - onset) / ((failure - onset) * where(softens, strain, 1.0))
    law = where(strain < failure, law, 1.0)
    return where(softens & (law > damage), law, damage)


_FAILURE_STRAIN = Remembered(
    "failure_strain", "strain at which the bond breaks", "1", changes=False
)
"""Declaration of the failure strain of a bond."""
_ONSET_STRAIN = Remembered("onset_strain", "strain at which the bond softens", "1", changes=False)
"""Declaration of the strain at which a bond softens."""
_DAMAGE = Remembered("damage", "damage of the bond, from 0 to 1 where it is broken", "1")
"""Declaration of the damage of a bond."""


MIN_SQUARED_COSINE = 0.25
"""Smallest squared cosine between a bond and the normal of a crack in the strain of the bond across
the crack."""
DIRECTIONS = 360
"""Number of crack directions for which the largest admissible lattice constant is computed."""
LISTED = (0, 15, 30, 45, 90)
"""Angles of crack normals for which `pbdkit check` prints the largest lattice constant."""
MAX_LINES = 9
"""Maximum number of straight parts of a softening law. The last one has the stress 0."""
LOWEST = 1.0 / 64.0
"""Ratio of stress to strength below which the law `exponential` ends in a straight line."""


class SofteningLaw(NamedTuple):
    """Ratio s of stress to strength as a function of the opening w of a crack: straight lines
    between points.

    Parameters
    ----------
    opening : (point,)
        Openings x = w f_t / G_c.
    stress : (point,)
        Ratios s, which decrease from 1 to 0. The area under the law is 1.
    """

    opening: Floats
    stress: Floats

    @classmethod
    def of(cls, points: Sequence[tuple[float, float]]) -> SofteningLaw:
        """Return the law of given shape, scaled to the strength 1 and the area 1."""
        x, s = np.array(points, float).T
        s = s / s[0]
        return cls(x / np.trapezoid(s, x), s)

    @property
    def slopes(self) -> Floats:
        """Derivatives of s with respect to x between the points."""
        return np.diff(self.stress) / np.diff(self.opening)

    @property
    def steepest(self) -> float:
        """Largest rate at which s decreases with x."""
        return float(-self.slopes.min())

    def lines(self) -> dict[str, float]:
        """Return the lines as numbers: line n begins at the opening `begin_n`, and on it s =
        stress_n + slope_n x. `end` is the opening at which s = 0, and `stretch` its ratio to that
        of the linear law."""
        lines = np.zeros((3, MAX_LINES))
        count, lines[0] = len(self.slopes), self.opening[-1]
        lines[:, :count] = (
            self.opening[:-1],
            self.stress[:-1] - self.slopes * self.opening[:-1],
            self.slopes,
        )
        numbered = {
            f"{name}_{n}": float(value)
            for name, values in zip(("begin", "stress", "slope"), lines, strict=True)
            for n, value in enumerate(values)
        }
        end = float(self.opening[-1])
        return {"lines": float(count), "end": end, "stretch": end / 2.0, **numbered}


def _exponential() -> list[tuple[float, float]]:
    """Return points of exp(-x). The deviation of each chord is the same. Below the stress `LOWEST`
    a straight line has the area of the rest."""
    stresses = np.linspace(1.0, math.sqrt(LOWEST), MAX_LINES - 1) ** 2
    openings = -np.log(stresses)
    return [*zip(openings, stresses, strict=True), (openings[-1] + 2.0, 0.0)]


LAWS = {
    "linear": SofteningLaw.of([(0.0, 1.0), (2.0, 0.0)]),
    "bilinear": SofteningLaw.of([(0.0, 1.0), (0.8, 1.0 / 3.0), (3.6, 0.0)]),
    "exponential": SofteningLaw.of(_exponential()),
}
"""Softening laws by name."""


def _softening(points: tuple[Pair, ...]) -> tuple[Pair, ...]:
    """Return the points of a softening law.

    Raises
    ------
    ValueError
        If openings do not increase from 0, or stresses do not decrease to 0.
    """
    x, s = np.array(points).T
    if x[0] != 0.0 or np.any(np.diff(x) <= 0.0):
        raise ValueError("openings should increase from 0: [[0, strength], ..., [opening, 0]]")
    if not s[0] > 0.0 or s[-1] != 0.0 or s[-2] <= 0.0 or np.any(np.diff(s) > 0.0):
        raise ValueError("stresses should decrease from the strength to 0, and be 0 once")
    return points


Points = Annotated[
    tuple[Pair, ...],
    Field(strict=False, min_length=2, max_length=MAX_LINES),
    AfterValidator(_softening),
]
"""Type of the points of a softening law."""


def _form_of_law(value: Any) -> str:
    """Return the form of a law."""
    return BY_NAME if isinstance(value, str) else BY_POINTS


Law = Annotated[
    Annotated[Literal["linear", "bilinear", "exponential"], Tag(BY_NAME)]
    | Annotated[Points, Tag(BY_POINTS)],
    Discriminator(_form_of_law),
]
"""Type of a softening law."""


class Cohesive(UsesStiffness, SoftensCells, Parting):
    """Bonds soften by the opening of a crack that crosses them.

    A bond softens once the stress across a crack at the bond exceeds `onset` times Young's modulus.
    Softening localises in a band one cell wide, which is torn when it has dissipated `energy` per
    unit length of the crack. The stress is the effective stress, that of the undamaged cell. The
    normal e of the crack is the direction of the largest principal stress at the bond when
    softening begins, and does not change any more. Only a crack perpendicular to it, with the
    normal t, can open more; the damage is then by this opening.

    The force of the bond in the cell is reduced by the damage D = 1 - σ/κ. Here κ is the strain of
    the bond across the crack as the maximum over time: (ε - ε_t (n · t)²) / (n · e)², with the
    strain ε of the bond along its unit vector n and the mean strain ε_t along the crack, plus the
    lateral contraction of the cell. σ is the stress that the softening law has at the same strain.
    For the law `linear`, D = failure / (failure - onset) (1 - onset / κ). Bonds along the crack are
    not damaged.

    The law is the stress as a function of the opening of the crack, w: `linear`; `bilinear`, with a
    kink at a third of the strength and the opening 0.8 G_c / f_t (Petersson 1981); `exponential`;
    or up to nine points [opening, stress]. Only the shape of the points matters: openings are
    scaled such that the area under the law is the fracture energy, and stresses such that the first
    is the strength.

    The opening is the cracking strain times the length of the bond across the crack, |r · e|, as in
    a crack band (Bažant and Oh 1983, Oliver 1989) with the width of each bond. The failure strain
    follows from the energy if the band does not contract along the crack. A bond is broken when D =
    1 in both cells beside it. Cracks do not close under compression.
    """

    other_names: ClassVar[Mapping[str, str]] = {"strength": "onset"}
    """Other names of parameters."""

    type: Literal["cohesive"] = "cohesive"
    placement: Annotated[float, Field(ge=1.0, le=1.0)] = Field(
        1.0, description="Always 1: broken bonds of a material exert no force."
    )
    fictitious_at: Literal["cell"] = Field(
        "cell", alias="fictitious", description="Always `cell`: broken bonds exert no force."
    )
    energy: Annotated[float, Field(gt=0.0, le=1e75), FRACTURE_ENERGY] = Field(
        description="Fracture energy G_c over Young's modulus, a length (lattice units); with a "
        "unit also G_c.",
        examples=[0.05],
    )
    onset: StrainLimit = Field(
        description="Tensile strength over Young's modulus: the largest principal stress at which "
        "a cell begins to soften. `strength` is another name of it, with a value that has a unit.",
        examples=[0.1],
    )
    law: Law = Field(
        "linear",
        description="Stress as a function of the opening of the crack: a name, or points [opening, "
        "stress], of which only the shape matters.",
        examples=["bilinear", [[0, 1], [0.8, 0.3], [3.6, 0]]],
    )

    @model_validator(mode="wrap")
    @classmethod
    def _strength_with_unit(cls, data: Any, handler: Any) -> Any:
        """Accept `strength` as another name of `onset`."""
        if isinstance(data, dict) and "strength" in data:
            text = ""
            if "onset" in data:
                text = "strength and onset are the same parameter; remove one of them"
            elif isinstance(data["strength"], (int, float)):
                text = (
                    "a strength has a unit, as in 3.9 MPa; write the number without unit, strength "
                    "/ Young's modulus, as onset"
                )
            if text:
                raise PydanticCustomError("fault", "{text}", {"text": text, "key": "strength"})
            data = {cls.other_names.get(key, key): value for key, value in data.items()}
        return handler(data)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON Schema with `strength` as another name of `onset`."""
        schema = super().__get_pydantic_json_schema__(core, handler)
        own = handler.resolve_ref_schema(schema)
        if "onset" in own.get("required", ()):
            own["required"] = [name for name in own["required"] if name != "onset"]
            own["oneOf"] = [{"required": ["onset"]}, {"required": ["strength"]}]
            own["properties"]["strength"] = own["properties"]["onset"] | {
                "title": "Strength",
                "description": "Tensile strength with its unit; another name of `onset`.",
                "examples": ["3.9 MPa"],
            }
        return schema

    @property
    def softening(self) -> SofteningLaw:
        """Return the softening law."""
        return LAWS[self.law] if isinstance(self.law, str) else SofteningLaw.of(self.law)

    def parameters(self) -> dict[str, float]:
        """Return the parameters of fictitious points, and the lines of the softening law."""
        return {**super().parameters(), **self.softening.lines()}

    def constants(self, slot: Slot) -> dict[str, float]:
        """Return the value of `onset_strain`."""
        return {"onset_strain": self.onset}

    def of_material(self, slot: Slot, rule: Calibrated, setting: Setting) -> dict[str, float]:
        """Return the constants of the softening law.

        - `release` is a length, 2 energy / onset times the stiffness along x divided by the squared
          modulus along x.
        - `along_y` and `across` are compliances divided by the compliance along x.
        - `stiff_y` and `stiff_across` are stiffnesses divided by the stiffness along x.

        Raises
        ------
        ExperimentError
            If the lattice constant is too large for the energy, so that for some direction of a
            crack the failure strain does not exceed the onset.
        """
        release, ratios = _material(rule)
        room = float(self._room(rule, setting, np.arange(DIRECTIONS) * np.pi / DIRECTIONS).min())
        if room <= 1.0:
            raise ExperimentError(
                f"{self.energy:g} is too small for this spacing: a cell stores {1.0 / room:.3g} "
                "times the elastic energy that its steepest softening can dissipate, and the crack "
                f"snaps from cell to cell; multiply the spacing by less than {room:.3g}, or set "
                f"fracture.onset below {self.onset * room**0.5:.3g} or fracture.energy above "
                f"{self.energy / room:.3g}",
                ("energy",),
            )
        names = ("along_y", "across", "stiff_y", "stiff_across")
        return {
            "release": 2.0 * self.energy * release / self.onset,
            **dict(zip(names, ratios, strict=True)),
        }

    def spacing_limits(self, rule: Calibrated, setting: Setting) -> SpacingLimits:
        """Return the largest lattice constants for cracks in some directions, and the length of the
        process zone, E G_c / f_t²."""
        angles = np.arange(DIRECTIONS) * 180.0 / DIRECTIONS
        factors = self._room(rule, setting, np.radians(angles))
        by_angle = dict(zip(angles.tolist(), factors.tolist(), strict=True))
        worst = min(by_angle, key=by_angle.__getitem__)
        return SpacingLimits(
            self.energy / self.onset**2, {angle: by_angle[angle] for angle in (*LISTED, worst)}
        )

    def _room(self, rule: Calibrated, setting: Setting, angles: Floats) -> Floats:
        """Return the largest admissible lattice constant, divided by that of the scene, for cracks
        with normals at given angles.

        With a larger lattice constant a cell would release more elastic energy than it dissipates,
        so that its strain would have to decrease along the steepest part of the law.
        """
        release, ratios = _material(rule)
        normal = Vector(np.cos(angles), np.sin(angles))
        extents = [abs(r.x * normal.x + r.y * normal.y) for r in _bonds_of_a_cell(setting)]
        size = np.max(extents, axis=0)
        flexibility, stiffness = (_along(normal, *pair) for pair in (ratios[:2], ratios[2:]))
        size = size / (flexibility * flexibility * stiffness)
        steepest = self.softening.steepest
        room: Floats = self.energy * release / (steepest * size * self.onset**2)
        return room

    def remembered(self) -> tuple[Remembered, ...]:
        """Declare the damage of each bond, and the normal of the crack, in the cells on both
        sides."""
        return _NUMBERS

    @staticmethod
    def update(  # type: ignore[override]  # models of SoftensCells receive the cells
        d: Vector, r: Vector, c: Constants, p: Parameters, left: CellStress, right: CellStress
    ) -> tuple[Number, ...]:
        """Return the damage of the bond and the normal of the crack in both cells.

        If there is a cell on one side only, both sides have its values.
        """
        before = c.damage_left, c.normal_x_left, c.normal_y_left
        of_left = _of_cell(left, *before, r, c, p)
        before = c.damage_right, c.normal_x_right, c.normal_y_right
        of_right = _of_cell(right, *before, r, c, p)
        has_left, has_right = left.share > 0.0, right.share > 0.0
        return (
            where(has_left, of_left[0], of_right[0]),
            where(has_right, of_right[0], of_left[0]),
            where(has_left, of_left[1], of_right[1]),
            where(has_right, of_right[1], of_left[1]),
            where(has_left, of_left[2], of_right[2]),
            where(has_right, of_right[2], of_left[2]),
        )

    @staticmethod
    def load(stress: CellStress, r: Vector, c: Constants, p: Parameters) -> Number:
        """Return κ divided by the onset."""
        strain, _ = _strain(stress, r, _normal(stress, r), c)
        load: Number = strain / c.onset_strain
        return load

    @staticmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return whether D = 1 in both cells."""
        return (c.damage_left >= 1.0) & (c.damage_right >= 1.0)


def _of_cell(
    stress: CellStress, damage: Any, normal_x: Any, normal_y: Any, r: Any, c: Any, p: Any
) -> Any:
    """Return the damage of a bond and the normal e of its crack, in a cell under a stress.

    The damage is that by the strain across the crack or, if this is larger, by the strain across a
    perpendicular crack that has opened more.
    """
    softens = (normal_x != 0.0) | (normal_y != 0.0)
    normal = _normal(stress, r)
    normal = Vector(where(softens, normal_x, normal.x), where(softens, normal_y, normal.y))
    strain, extent = _strain(stress, r, normal, c)
    softens = softens | ((strain > c.onset_strain) & (stress.share > 0.0))
    tangent = Vector(-normal.y, normal.x)
    second, length_of_second = _strain(stress, r, tangent, c, contracts=0.0)
    opens = second * length_of_second > strain * extent
    cracks = (normal, strain, extent), (tangent, where(opens, second, 0.0), length_of_second)
    for across, strain, extent in cracks:
        flexibility = _along(across, c.along_y, c.across)
        stiffness = _along(across, c.stiff_y, c.stiff_across)
        failure = c.release * flexibility * flexibility * stiffness * p.stretch / extent
        failure = where(softens, failure, 2.0 * p.stretch * c.onset_strain)
        damage = where(softens, _damage(strain, c.onset_strain, failure, damage, p), damage)
    return damage, where(softens, normal.x, 0.0), where(softens, normal.y, 0.0)


def _normal(stress: CellStress, r: Vector) -> Vector:
    """Return the normal of a crack that begins at a bond.

    It is the direction of the largest principal value of the mean stress of the cell and, if the
    bond is stretched more than the cell, of a tension along the bond. The tension is the difference
    of the strains over MIN_SQUARED_COSINE, as in `_strain` for a bond along the crack.
    """
    x, y, square = r.x * r.x, r.y * r.y, squared_length(r)
    more = stress.strain - _mean_strain(stress, r) / square
    more = where(more > 0.0, more, 0.0) / (MIN_SQUARED_COSINE * square)
    half = 0.5 * (stress.xx - stress.yy + more * (x - y))
    xy = stress.xy + more * r.x * r.y
    radius = np.sqrt(half * half + xy * xy)
    has_direction = radius > 0.0
    cos = where(has_direction, half / where(has_direction, radius, 1.0), 1.0)
    along_x, along_y = np.sqrt(0.5 * (1.0 + cos)), np.sqrt(0.5 * (1.0 - cos))
    return Vector(along_x, where(xy < 0.0, -along_y, along_y))


def _mean_strain(stress: CellStress, r: Vector) -> Any:
    """Return the mean strain of the cell along a bond, times |r|²."""
    x, y = r.x * r.x, r.y * r.y
    return stress.strain_xx * x + stress.strain_yy * y + 2.0 * stress.strain_xy * r.x * r.y


def _strain(
    stress: CellStress, r: Vector, normal: Vector, c: Constants, contracts: float = 1.0
) -> tuple[Any, Any]:
    """Return κ, the strain of a bond across a crack with the normal e, (ε - ε_t (n · t)²) / (n ·
    e)² + ε_σ - ε_e, and the length of the bond across the crack.

    Here ε is the strain of the bond, ε_e and ε_t are the mean strains of the cell across and along
    the crack, and ε_σ is its mean stress across the crack over Young's modulus. If the cell has no
    strain but ε_e and ε_t, κ is ε_σ. For bonds at more than 60° to e, κ is reduced by (n · e)² /
    MIN_SQUARED_COSINE, and the part of ε that the cell does not have on average by the square of
    it: in a cell that is bent, no bond along the crack softens.

    The contraction ε_σ - ε_e is multiplied by `contracts`. It is omitted for a second crack,
    because ε_t is then mostly the opening of the first one, by which the cell does not contract.
    """
    x, y = normal.x, normal.y
    xx, yy, xy = x * x, y * y, 2.0 * x * y
    across, along = r.x * x + r.y * y, r.y * x - r.x * y
    stress_across = stress.xx * xx + stress.yy * yy + stress.xy * xy
    strain_across = stress.strain_xx * xx + stress.strain_yy * yy + stress.strain_xy * xy
    strain_along = stress.strain_xx * yy + stress.strain_yy * xx - stress.strain_xy * xy
    contraction = stress_across * _along(normal, c.along_y, c.across) - strain_across
    mean, square, squared = _mean_strain(stress, r), squared_length(r), across * across
    extent = where(squared > MIN_SQUARED_COSINE * square, squared, MIN_SQUARED_COSINE * square)
    own = mean - strain_along * (along * along) + contracts * contraction * squared
    more = (stress.strain * square - mean) * (squared / extent)
    return (own + more) / extent, np.sqrt(extent)


def _damage(strain: Any, onset: Any, failure: Any, damage: Any, p: Any) -> Any:
    """Return the damage by the softening law, or the damage so far if that is larger.

    With the opening x and the strain u of an elastic cell that x = 1 adds, strain = onset s(x) + u
    x. On a line s = a + b x the stress onset s is therefore onset (a u + b strain) / (u + b onset),
    and D = 1 - onset s / strain.
    """
    if p.lines == 1.0:
        return softened(strain, onset, failure, damage)
    u = failure / p.end
    softens = strain > onset
    size = where(softens, strain, 1.0)
    law = 0.0 * size
    for begin, a, b in (
        (p.begin_0, p.stress_0, p.slope_0),
        (p.begin_1, p.stress_1, p.slope_1),
        (p.begin_2, p.stress_2, p.slope_2),
        (p.begin_3, p.stress_3, p.slope_3),
        (p.begin_4, p.stress_4, p.slope_4),
        (p.begin_5, p.stress_5, p.slope_5),
        (p.begin_6, p.stress_6, p.slope_6),
        (p.begin_7, p.stress_7, p.slope_7),
        (p.begin_8, p.stress_8, p.slope_8),
    ):
        on_line = 1.0 - onset * (a * u / size + b) / (u + b * onset)
        law = where(strain >= onset * (a + b * begin) + u * begin, on_line, law)
    return where(softens & (law > damage), law, damage)


def _along(direction: Any, along_y: Any, across: Any) -> Any:
    """Return a compliance or stiffness along a direction, divided by that along x."""
    x, y = direction.x * direction.x, direction.y * direction.y
    return x * x + along_y * y * y + across * x * y


def _material(rule: Calibrated) -> tuple[float, tuple[float, float, float, float]]:
    """Return the release factor of a material, and its anisotropy ratios.

    The release factor is the stiffness along x divided by the squared modulus along x. With the
    compliance S and the stiffness C in the plane, the ratios are S_yy / S_xx, (2 S_xy + S_shear) /
    S_xx, C_yy / C_xx and (2 C_xy + 4 C_shear) / C_xx.
    """
    material = rule.elasticity()
    assert material is not None
    xx, yy, xy, shear, *_ = material
    across = (xx * yy - xy * xy) / (yy * shear) - 2.0 * xy / yy
    ratios = xx / yy, across, yy / xx, (2.0 * xy + 4.0 * shear) / xx
    return xx / material.own_modulus(rule.through_thickness()) ** 2, ratios


def _bonds_of_a_cell(setting: Setting) -> tuple[Vector, Vector, Vector]:
    """Return the sides of a triangle, or the diagonals of a rectangle.

    For every direction, the bond of the cell with the largest extent along it is one of these.
    """
    a, b, c, *rest = setting.cells.polygons[0].rest
    if rest:
        return c - a, rest[0] - b, rest[0] - b
    return b - a, c - a, c - b


def _pair(name: str, text: str) -> tuple[Remembered, Remembered]:
    left, right = (
        Remembered(f"{name}_{side}", f"{text} on its {side}", "1") for side in ("left", "right")
    )
    return left, right


_NUMBERS = (
    *_pair("damage", "damage of the bond, from 0 to 1 where it is broken, in the cell"),
    *_pair("normal_x", "component x of the normal of the crack in the cell"),
    *_pair("normal_y", "component y of the normal of the crack in the cell"),
)
"""Declarations of the damage of a bond, and of the normal of the crack, in the cells on both
sides."""
