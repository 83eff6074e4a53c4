"""Units: what the lattice's own units are outside, and which numbers can be written with one."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError, core_schema

from pbdkit.errors import did_you_mean
from pbdkit.plugin.component import Component, Strict

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?+"
WORD = r"[^\W\d]+(?:(?:\*\*|\^)-?[0-9]|[²³])?"
TEXT = re.compile(rf"\s*({NUMBER})\s*([^\W\d].*?)\s*", re.DOTALL)
"""A number and what follows it; of units only words, products and quotients are taken, with small
exponents, as a tower of exponents could take for ever."""
UNIT = re.compile(rf"{WORD}(?:(?:\s*[*/]\s*|\s+){WORD}){{0,5}}")
PATTERN = r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*[A-Za-zµμ°Å].*$"
LONGEST = 60
COMMON = {
    "mm": ("mm", "cm", "m", "km", "um", "nm", "inch"),
    "MPa": ("Pa", "kPa", "MPa", "GPa", "N/mm^2"),
    "N": ("N", "kN", "MN", "mN"),
    "mJ": ("mJ", "J", "kJ", "N*mm"),
}
"""Units that are suggested for misspelt ones, by the unit of the quantity."""


@dataclass(frozen=True)
class Quantity:
    """A number that is counted in lattice units, and can be written with a unit where the
    experiment has `units`.

    It annotates a parameter: ``a: Annotated[float, Field(gt=0.0), LENGTH]``. `lattice` is what it
    is counted in, as variables of the dataset say it: of the lattice's length L, Young's modulus E
    and thickness t, L^length · E^youngs_modulus · t^thickness; `unit` is the same of mm and MPa.
    A stress unit is the one in which Young's modulus is given, a thickness unit that of thickness.
    `also` is what the number may be written as besides, as a fracture energy that has been divided
    by Young's modulus, a length.
    """

    meaning: str
    lattice: str
    unit: str
    length: int = 0
    youngs_modulus: int = 0
    thickness: int = 0
    also: Quantity | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.with_info_before_validator_function(self.number, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return or_text(handler(schema))

    def number(self, value: Any, info: ValidationInfo) -> Any:
        """The number of lattice units; what is no number with a unit stays as it is."""
        if not isinstance(value, str) or not TEXT.fullmatch(value):
            return value
        quantity = self.also if self.also and _is_of(value, self.also.unit) else self
        found = magnitude(value, quantity.unit, quantity.meaning)
        return found / _units(value, info).scale(quantity)


LENGTH = Quantity("length", "lattice unit", "mm", length=1)
PER_LENGTH = Quantity("number per length", "1 / lattice unit", "1/mm", length=-1)
AREA = Quantity("area", "lattice unit^2", "mm^2", length=2)
STRESS = Quantity("stress", "stress unit", "MPa", youngs_modulus=1)
FORCE = Quantity(
    "force", "stress unit * thickness unit * lattice unit", "N",
    length=1, youngs_modulus=1, thickness=1,
)  # fmt: skip
ENERGY = Quantity(
    "energy", "stress unit * thickness unit * lattice unit^2", "mJ",
    length=2, youngs_modulus=1, thickness=1,
)  # fmt: skip
FRACTURE_ENERGY = Quantity(
    "fracture energy", "stress unit * lattice unit", "N/mm",
    length=1, youngs_modulus=1, also=LENGTH,
)  # fmt: skip
"""Energy a unit of area; over Young's modulus a length."""
BODY_FORCE = Quantity(
    "force per area", "stress unit * thickness unit / lattice unit", "N/mm^2",
    length=-1, youngs_modulus=1, thickness=1,
)  # fmt: skip
QUANTITIES = {q.lattice: q for q in (LENGTH, AREA, STRESS, FORCE, ENERGY, BODY_FORCE)}
"""By what they are counted in."""

Place = Annotated[tuple[Annotated[float, LENGTH], Annotated[float, LENGTH]], Field(strict=False)]
"""Two lengths, (x, y)."""


def _positive(unit: str, meaning: str) -> BeforeValidator:
    """A text that stands for a positive quantity."""

    def look(value: Any) -> Any:
        if not isinstance(value, str) or not TEXT.fullmatch(value):
            raise _fault(f"expected a {meaning} with its unit, as in 1 {unit}, got {value!r:.50}")
        if not 0.0 < (found := magnitude(value, unit, meaning)) < math.inf:
            raise _fault(f"should be greater than 0 and finite, got {found:g} {unit}")
        return value

    return BeforeValidator(look)


class Units(Strict):
    """What the lattice's own units are: a lattice unit of length, Young's modulus, the thickness of
    the body. Numbers in the experiment stay in lattice units; lengths may be written with a unit.

    Results carry mm, MPa and N. Read with pint (the extra `units`).
    """

    length: Annotated[str, _positive("mm", "length")] = Field(
        description="A lattice unit of length.", examples=["0.25 mm"]
    )
    youngs_modulus: Annotated[str, _positive("MPa", "stress")] | None = Field(
        None, description="Young's modulus; needed for stresses and forces.", examples=["206 GPa"]
    )
    thickness: Annotated[str, _positive("mm", "length")] | None = Field(
        None, description="Of the body, out of its plane; needed for forces.", examples=["3.05 mm"]
    )

    def value(self, name: str) -> float | None:
        """One of them in mm or MPa; None where it is not given."""
        text = getattr(self, name)
        unit, meaning = ("MPa", "stress") if name == "youngs_modulus" else ("mm", "length")
        return None if text is None else magnitude(text, unit, meaning)

    @property
    def length_mm(self) -> float:
        """A lattice unit in mm."""
        return magnitude(self.length, LENGTH.unit, LENGTH.meaning)

    def lacks(self, quantity: Quantity) -> list[str]:
        """What the quantity would need besides."""
        return [n for n in type(self).model_fields if getattr(quantity, n) and not getattr(self, n)]

    def scale(self, quantity: Quantity) -> float:
        """What 1 of the lattice's is in the quantity's unit. Raises PydanticCustomError where a
        part of `units` is missing."""
        if lacking := self.lacks(quantity):
            raise _fault(f"a {quantity.meaning} needs units.{lacking[0]}, which is missing")
        powers = {name: getattr(quantity, name) for name in type(self).model_fields}
        scale: float = math.prod(
            (self.value(n) or 0.0) ** power for n, power in powers.items() if power
        )
        return scale


class Scales(Strict):
    """Where an experiment's `units` are looked at before the rest of it, which is read by them."""

    units: Units | None = None


@dataclass(frozen=True)
class FromUnits:
    """Annotates a parameter of diagnostics that `units` gives: `youngs_modulus` in MPa, `thickness`
    in mm. Where neither says it, it is `otherwise`, or missing. The field's default is `unset`."""

    name: str
    otherwise: float | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.with_info_before_validator_function(self._given, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return or_text(handler(schema))

    def _given(self, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, str) and TEXT.fullmatch(value):
            unit = ("MPa", "stress") if self.name == "youngs_modulus" else ("mm", "length")
            _units(value, info)
            return magnitude(value, *unit)
        if value is not None:
            return value
        units: Units | None = (info.context or {}).get("units")
        found = self.otherwise if units is None else units.value(self.name)
        if found is None:
            raise _fault(f"is missing; give it here, or as units.{self.name}")
        return found


def unset() -> Any:
    """The default of what `units` may give."""
    return None


def is_needed(field: FieldInfo) -> bool:
    """Whether a parameter must be given where there are no `units`."""
    given = (m for m in field.metadata if isinstance(m, FromUnits))
    return field.is_required() or any(m.otherwise is None for m in given)


def in_lengths(units: Units | None) -> tuple[float, str]:
    """What a lattice unit is in mm and that unit; without units 1 and lattice units."""
    return (units.length_mm, LENGTH.unit) if units else (1.0, f"{LENGTH.lattice}s")


def given_by_units(part: Component) -> list[str]:
    """The parameters of a part that `units` gives."""
    fields = type(part).model_fields.items()
    return [n for n, field in fields if any(isinstance(m, FromUnits) for m in field.metadata)]


def of_one_material(part: Component, info: ValidationInfo) -> Component:
    """The part; PydanticCustomError where `units` says another modulus or thickness than it does
    itself: which of them holds nobody could tell."""
    units: Units | None = (info.context or {}).get("units")
    for name in given_by_units(part) if units else ():
        said, own = units.value(name) if units else None, getattr(part, name)
        if said is not None and not math.isclose(said, own):
            text = f"{own:g} is not the {said:g} of units.{name}; leave it out here"
            raise PydanticCustomError("clash", "{text}", {"text": text, "key": name})
    return part


def magnitude(text: str, unit: str, meaning: str) -> float:
    """The number of that unit. Raises PydanticCustomError for what is none, and, where another unit
    is given, without pint."""
    found = TEXT.fullmatch(text)
    number, given = found.groups() if found else (text, "")
    if len(text) > LONGEST or not UNIT.fullmatch(given):
        raise _fault(f"{text[:LONGEST]!r} is no number with a unit, as in 1 {unit}")
    if given == unit:
        return float(number)
    pint, registry = _registry()
    try:
        return float(registry.Quantity(float(number), registry.parse_units(given)).m_as(unit))
    except pint.UndefinedUnitError:
        near = did_you_mean(given, COMMON.get(unit, (unit,))) or f"; write for instance {unit}"
        raise _fault(f"'{text}': there is no unit '{given}'{near}") from None
    except (pint.PintError, ArithmeticError, ValueError):
        told = f"write for instance {unit}"
        with suppress(pint.PintError, ArithmeticError, ValueError):
            if registry.parse_units(f"({given}) * s").is_compatible_with(unit):
                told = (
                    "the steps of a run have no duration: write what changes in one step, without "
                    f"the time, as in 0.01 {unit}"
                )
        raise _fault(f"'{text}' is no {meaning}; {told}") from None


def _is_of(text: str, unit: str) -> bool:
    """Whether a text is a number with a unit of the same dimension."""
    try:
        magnitude(text, unit, "")
    except PydanticCustomError:
        return False
    return True


@cache
def _registry() -> Any:
    """pint and its units; nothing of it is there where no experiment has units."""
    try:
        import pint
    except ImportError:
        raise _fault("units are read with pint: pip install 'pbdkit[units]'") from None
    return pint, pint.UnitRegistry()


def _units(text: str, info: ValidationInfo) -> Units:
    units: Units | None = (info.context or {}).get("units")
    if units is None:
        raise _fault(
            f"'{text[:LONGEST]}' names a unit, and nothing says what a lattice unit is: add for "
            "instance units: {length: 0.25 mm}, or write a number of lattice units"
        )
    return units


def or_text(number: dict[str, Any]) -> dict[str, Any]:
    """The JSON Schema of a number, or of a text with a unit."""
    return {"anyOf": [number, {"type": "string", "pattern": PATTERN}]}


def _fault(text: str) -> PydanticCustomError:
    return PydanticCustomError("units", "{text}", {"text": text})
