"""Units of the lattice, and numbers that can have a unit."""

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
"""Pattern of a number."""
WORD = r"[^\W\d]+(?:(?:\*\*|\^)-?[0-9]|[²³])?"
"""Pattern of a unit with an exponent."""
TEXT = re.compile(rf"\s*({NUMBER})\s*([^\W\d].*?)\s*", re.DOTALL)
"""Pattern of a number with a unit."""
UNIT = re.compile(rf"{WORD}(?:(?:\s*[*/]\s*|\s+){WORD}){{0,5}}")
"""Pattern of a unit: products and quotients with small exponents.
"""
PATTERN = r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*[A-Za-zµμ°Å].*$"
"""Pattern of a number with a unit in a JSON Schema."""
MAX_TEXT = 60
"""Maximum number of characters of a number with a unit."""
RELATIVE_REMEDY = (
    "; or write youngs_modulus: 1: stresses are then divided by Young's modulus, and forces by "
    "Young's modulus and the thickness"
)
"""Remedy for a missing Young's modulus in experiments without `units`."""
COMMON = {
    "mm": ("mm", "cm", "m", "km", "um", "nm", "inch"),
    "MPa": ("Pa", "kPa", "MPa", "GPa", "N/mm^2"),
    "N": ("N", "kN", "MN", "mN"),
    "mJ": ("mJ", "J", "kJ", "N*mm"),
}
"""Units that messages suggest in place of misspelt ones, by the unit of the quantity."""


@dataclass(frozen=True)
class Quantity:
    """Number in lattice units that can have a unit if the experiment has `units`.

    It annotates a parameter: ``a: Annotated[float, Field(gt=0.0), LENGTH]``. With the length L of
    the lattice, Young's modulus E and the thickness t, its unit is L^length · E^youngs_modulus ·
    t^thickness.

    Parameters
    ----------
    meaning : str
        Name of the quantity in messages.
    lattice : str
        Unit in datasets. In it "stress unit" denotes the unit of Young's modulus, and "thickness
        unit" the unit of the thickness.
    unit : str
        Unit in terms of mm and MPa.
    length, youngs_modulus, thickness : float
        Exponents.
    also : Quantity, optional
        Second quantity that is accepted. For example, a fracture energy can also be given as a
        length, which is the energy divided by Young's modulus.
    """

    meaning: str
    lattice: str
    unit: str
    length: float = 0
    youngs_modulus: int = 0
    thickness: int = 0
    also: Quantity | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.with_info_before_validator_function(self.number, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return number_or_text(handler(schema))

    @property
    def unit_of_numbers(self) -> str:
        """Unit of numbers that are given without a unit. They are divided by Young's modulus and
        the thickness, so that a stress is a strain."""
        return next((q.lattice for q in (LENGTH, PER_LENGTH, AREA) if q.length == self.length), "1")

    def number(self, value: Any, info: ValidationInfo) -> Any:
        """Return a number in lattice units. Values without unit are not changed.

        Parameters
        ----------
        value : object
            Number, or text with a unit.
        info : pydantic.ValidationInfo
            Context of the validation, with the units of the experiment.

        Returns
        -------
        object
            Number in lattice units, or the value.
        """
        if not isinstance(value, str) or not TEXT.fullmatch(value):
            return value
        quantity = self.also if self.also and _is_of(value, self.also.unit) else self
        number = magnitude(value, quantity.unit, quantity.meaning)
        return number / _units(value, info).scale(quantity)


LENGTH = Quantity("length", "lattice unit", "mm", length=1)
"""Quantity of a length, in lattice units or mm."""
PER_LENGTH = Quantity("number per length", "1 / lattice unit", "1/mm", length=-1)
"""Quantity of an inverse length."""
AREA = Quantity("area", "lattice unit^2", "mm^2", length=2)
"""Quantity of an area, in lattice units squared or mm²."""
STRESS = Quantity("stress", "stress unit", "MPa", youngs_modulus=1)
"""Quantity of a stress, in MPa."""
FORCE = Quantity(
    "force", "stress unit * thickness unit * lattice unit", "N",
    length=1, youngs_modulus=1, thickness=1,
)  # fmt: skip
"""Quantity of a force, in N."""
ENERGY = Quantity(
    "energy", "stress unit * thickness unit * lattice unit^2", "mJ",
    length=2, youngs_modulus=1, thickness=1,
)  # fmt: skip
"""Quantity of an energy, in mJ."""
FRACTURE_ENERGY = Quantity(
    "fracture energy", "stress unit * lattice unit", "N/mm",
    length=1, youngs_modulus=1, also=LENGTH,
)  # fmt: skip
"""Quantity of an energy per area, in N/mm. Divided by Young's modulus it is a length."""
STRESS_INTENSITY = Quantity(
    "stress intensity factor", "stress unit * lattice unit^0.5", "MPa*mm^0.5",
    length=0.5, youngs_modulus=1,
)  # fmt: skip
"""Quantity of a stress intensity factor, in MPa √mm."""
BODY_FORCE = Quantity(
    "force per area", "stress unit * thickness unit / lattice unit", "N/mm^2",
    length=-1, youngs_modulus=1, thickness=1,
)  # fmt: skip
"""Quantity of a force per area, in N/mm²."""
QUANTITIES = {
    q.lattice: q
    for q in (LENGTH, AREA, STRESS, FORCE, ENERGY, FRACTURE_ENERGY, STRESS_INTENSITY, BODY_FORCE)
}
"""Quantities by their unit in datasets."""

Place = Annotated[tuple[Annotated[float, LENGTH], Annotated[float, LENGTH]], Field(strict=False)]
"""Type of a position, (x, y)."""


def _positive(unit: str, meaning: str) -> BeforeValidator:
    """Return a validator of text for a positive quantity."""

    def look(value: Any) -> Any:
        if not isinstance(value, str) or not TEXT.fullmatch(value):
            raise _fault(f"expected a {meaning} with its unit, as in 1 {unit}, got {value!r:.50}")
        if not 0.0 < (number := magnitude(value, unit, meaning)) < math.inf:
            raise _fault(f"should be greater than 0 and finite, got {number:g} {unit}")
        return value

    return BeforeValidator(look)


class Units(Strict):
    """Units of the lattice: the lattice unit of length, Young's modulus, and the thickness of the
    body.

    Numbers without a unit in the experiment are in lattice units; lengths can be given with a unit.
    Results are also in mm, MPa and N. Units are read with pint (extra `units`).
    """

    length: Annotated[str, _positive("mm", "length")] = Field(
        description="Lattice unit of length.", examples=["0.25 mm"]
    )
    youngs_modulus: Annotated[str, _positive("MPa", "stress")] | None = Field(
        None, description="Young's modulus, for stresses and forces.", examples=["206 GPa"]
    )
    thickness: Annotated[str, _positive("mm", "length")] | None = Field(
        None, description="Thickness of the body, for forces.", examples=["3.05 mm"]
    )

    def value(self, name: str) -> float | None:
        """Return the length, modulus or thickness in mm or MPa; None if it is not given."""
        text = getattr(self, name)
        unit, meaning = ("MPa", "stress") if name == "youngs_modulus" else ("mm", "length")
        return None if text is None else magnitude(text, unit, meaning)

    @property
    def length_mm(self) -> float:
        """Lattice unit in mm."""
        return magnitude(self.length, LENGTH.unit, LENGTH.meaning)

    def missing_entries(self, quantity: Quantity) -> list[str]:
        """Return the entries of `units` that a quantity needs but that are missing."""
        return [n for n in type(self).model_fields if getattr(quantity, n) and not getattr(self, n)]

    def scale(self, quantity: Quantity) -> float:
        """Return the factor that converts a quantity from lattice units to its unit of mm and MPa.

        Raises
        ------
        PydanticCustomError
            If an entry of `units` is missing.
        """
        if missing := self.missing_entries(quantity):
            raise _fault(f"a {quantity.meaning} requires units.{missing[0]}, which is missing")
        powers = {name: getattr(quantity, name) for name in type(self).model_fields}
        scale: float = math.prod(
            (self.value(n) or 0.0) ** power for n, power in powers.items() if power
        )
        return scale


class Scales(Strict):
    """The part `units` of an experiment, which is validated before all other parts."""

    units: Units | None = None


@dataclass(frozen=True)
class FromUnits:
    """Parameter of diagnostics that `units` can replace: `youngs_modulus` in MPa, `thickness` in
    mm.

    A parameter that is not given has the value in `units` or, without `units`, the value
    `otherwise`. If neither exists, the parameter is required. The default of the field is `unset`.
    """

    name: str
    otherwise: float | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.with_info_before_validator_function(self._resolve, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return number_or_text(handler(schema))

    def _resolve(self, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, str) and TEXT.fullmatch(value):
            unit = ("MPa", "stress") if self.name == "youngs_modulus" else ("mm", "length")
            _units(value, info)
            return magnitude(value, *unit)
        if value is not None:
            return value
        units: Units | None = (info.context or {}).get("units")
        number = self.otherwise if units is None else units.value(self.name)
        if number is None:
            is_free = units is None and self.name == "youngs_modulus"
            remedy = RELATIVE_REMEDY if is_free else ""
            raise _fault(f"is missing; give it here, or as units.{self.name}{remedy}")
        return number


def unset() -> Any:
    """Return None, the default of parameters that `units` can replace."""
    return None


def is_needed(field: FieldInfo) -> bool:
    """Return whether a parameter is required if the experiment has no `units`."""
    annotations = (m for m in field.metadata if isinstance(m, FromUnits))
    return field.is_required() or any(m.otherwise is None for m in annotations)


def in_lengths(units: Units | None) -> tuple[float, str]:
    """Return the factor that converts lattice units to mm, and the name "mm".

    Without `units`, return 1 and "lattice units".
    """
    return (units.length_mm, LENGTH.unit) if units else (1.0, f"{LENGTH.lattice}s")


def given_by_units(part: Component) -> list[str]:
    """Return the parameters of a component that `units` can replace."""
    fields = type(part).model_fields.items()
    return [n for n, field in fields if any(isinstance(m, FromUnits) for m in field.metadata)]


def of_one_material(part: Component, info: ValidationInfo) -> Component:
    """Return the component if its modulus and thickness agree with `units`.

    Raises
    ------
    PydanticCustomError
        If they differ.
    """
    units: Units | None = (info.context or {}).get("units")
    for name in given_by_units(part) if units else ():
        expected, value = units.value(name) if units else None, getattr(part, name)
        if expected is not None and not math.isclose(expected, value):
            text = f"{value:g} differs from {expected:g} of units.{name}; remove it here"
            raise PydanticCustomError("clash", "{text}", {"text": text, "key": name})
    return part


def magnitude(text: str, unit: str, meaning: str) -> float:
    """Return the number that is written in a text with a unit, converted to `unit`.

    Raises
    ------
    PydanticCustomError
        If the text is not a number with a suitable unit. Also if its unit is not `unit` itself and
        pint is not installed.
    """
    match = TEXT.fullmatch(text)
    number, name = match.groups() if match else (text, "")
    if len(text) > MAX_TEXT or not UNIT.fullmatch(name):
        raise _fault(f"{text[:MAX_TEXT]!r} is not a number with a unit, as in 1 {unit}")
    if name == unit:
        return float(number)
    pint, registry = _registry()
    try:
        return float(registry.Quantity(float(number), registry.parse_units(name)).m_as(unit))
    except pint.UndefinedUnitError:
        near = did_you_mean(name, COMMON.get(unit, (unit,))) or f"; write for instance {unit}"
        raise _fault(f"'{text}': there is no unit '{name}'{near}") from None
    except (pint.PintError, ArithmeticError, ValueError):
        hint = f"write for instance {unit}"
        with suppress(pint.PintError, ArithmeticError, ValueError):
            if registry.parse_units(f"({name}) * s").is_compatible_with(unit):
                hint = (
                    "steps have no duration; write the change in one step, without the unit of "
                    f"time, as in 0.01 {unit}"
                )
        article = "an" if meaning[:1] in "aeiou" else "a"
        raise _fault(f"'{text}' is not {article} {meaning}; {hint}") from None


def is_unit(name: str) -> bool:
    """Return whether a text is the name of a unit. Without pint it is unknown, and False."""
    if not UNIT.fullmatch(name):
        return False
    try:
        pint, registry = _registry()
    except PydanticCustomError:
        return False
    try:
        registry.parse_units(name)
    except (pint.PintError, ArithmeticError, ValueError):
        return False
    return True


def number_with_unit(text: str) -> tuple[float, str]:
    """Return the number and the unit of a text.

    Raises
    ------
    ValueError
        If the text is not a number with a unit.
    """
    match = TEXT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a number with a unit")
    return float(match.group(1)), match.group(2)


def is_stress_or_force(unit: str) -> bool:
    """Return whether numbers with a unit are divided by Young's modulus in lattice units. Lengths,
    areas and numbers per length are not."""
    return not any(_is_of(f"1 {unit}", q.unit) for q in (LENGTH, AREA, PER_LENGTH))


def _is_of(text: str, unit: str) -> bool:
    """Return whether a text is a number with a unit of the same dimension as `unit`."""
    try:
        magnitude(text, unit, "")
    except PydanticCustomError:
        return False
    return True


@cache
def _registry() -> Any:
    """Return pint and its registry of units, imported on first use."""
    try:
        import pint
    except ImportError:
        raise _fault("units are read with pint: pip install 'pbdkit[units]'") from None
    return pint, pint.UnitRegistry()


def _units(text: str, info: ValidationInfo) -> Units:
    units: Units | None = (info.context or {}).get("units")
    if units is None:
        raise _fault(
            f"'{text[:MAX_TEXT]}' has a unit, but the lattice unit is not defined; add for "
            "instance units: {length: 0.25 mm}, or write a number of lattice units"
        )
    return units


def number_or_text(number: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a number, or of text with a unit."""
    return {"anyOf": [number, {"type": "string", "pattern": PATTERN}]}


def _fault(text: str) -> PydanticCustomError:
    return PydanticCustomError("units", "{text}", {"text": text})
