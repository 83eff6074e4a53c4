"""Bonds that break by their strain, suddenly or little by little (docs/fracture.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.components.fracture import Parting
from pbdkit.interfaces import (
    Bonds,
    BreaksAtStrain,
    Draws,
    Remembered,
    RenewsBonds,
    Slot,
    Softens,
    length,
    squared_length,
    where,
)
from pbdkit.interfaces.units import STRESS
from pbdkit.interfaces.values import Drawn

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
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        """|r + d|² > (1 + failure)² |r|²."""
        stretch = 1.0 + c.failure_strain
        return squared_length(r + d) > c.square * (stretch * stretch)

    @staticmethod
    def breaking_strain(r: Any, c: Any, p: Any) -> Any:
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
    def update(d: Any, r: Any, c: Any, p: Any) -> tuple[Any, ...]:
        """The damage, where there is more than before."""
        strain = length(r + d) * c.per_rest - 1.0
        return (softened(strain, c.onset_strain, c.failure_strain, c.damage),)

    @staticmethod
    def breaks(d: Any, r: Any, c: Any, p: Any) -> Any:
        """D = 1."""
        return c.damage >= 1.0

    @staticmethod
    def seen(d: Any, lost: Any, r: Any, c: Any, p: Any) -> Any:
        """(1 - D) d + D lost."""
        return (1.0 - c.damage) * d + c.damage * lost

    @staticmethod
    def breaking_strain(r: Any, c: Any, p: Any) -> Any:
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
