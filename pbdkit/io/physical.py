"""Conversion of results to physical units (mm, MPa, N) for experiments with `units`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.io.layout import STEP, Column, Values
from pbdkit.plugin import Diagnostic, Variable
from pbdkit.plugin.units import ENERGY, LENGTH, QUANTITIES, Quantity, Units, given_by_units

if TYPE_CHECKING:
    import xarray


IN_MM = f"_{LENGTH.unit}"
"""Suffix of the names of variables in mm."""
OF_GIVEN = {"youngs_modulus": "stress unit", "thickness": "thickness unit"}
"""Names of the units of these quantities if the quantities are given as plain numbers."""
UNITS = "physical_units"
"""Attribute of a variable in lattice units that contains its physical unit."""
FACTOR = "physical_factor"
"""Attribute of a variable in lattice units that contains the factor for conversion to the physical
unit."""
TWIN_OF = "physical_of"
"""Attribute of a converted copy that contains the name of the original variable."""


DIVIDED = {"dissipated_energy": ENERGY}
"""Quantities of the variables that are divided by Young's modulus and the thickness."""


class Physical:
    """Physical units of the variables of a dataset. Without `units` all methods leave variables
    unchanged.

    Stresses, forces and energies are stored in MPa, N and mJ, because they need a modulus;
    attributes contain their lattice units. All other variables keep their values in lattice units,
    with the conversion factor as an attribute. Lengths are stored in mm, too, except positions,
    which are too large.
    """

    def __init__(self, units: Units | None) -> None:
        self._units = units

    def scaled(self, diagnostic: Diagnostic) -> Iterator[tuple[Variable, float]]:
        """Generate the variables of a diagnostic, and for each the factor by which its values are
        multiplied."""
        for variable in diagnostic.variables():
            quantity = QUANTITIES.get(variable.units)
            if quantity and quantity.youngs_modulus and self._defines_units(diagnostic, quantity):
                assert self._units is not None
                lattice: dict[str, Any] = {"lattice_units": quantity.lattice}
                for name, unit in OF_GIVEN.items():
                    lattice["lattice_units"] = lattice["lattice_units"].replace(unit, name)
                lattice["lattice_factor"] = 1.0 / self._units.scale(quantity)
                attributes = variable.attributes | lattice
                factor = (self._units.value("length") or 1.0) ** quantity.length
                yield replace(variable, units=quantity.unit, attributes=attributes), factor
            else:
                yield variable, 1.0

    def _defines_units(self, diagnostic: Diagnostic, quantity: Quantity) -> bool:
        """Return whether the diagnostic's modulus and, if it is needed, its thickness are the same
        as in `units`."""
        if self._units is None or self._units.missing_entries(quantity):
            return False
        fields = [n for n in ("youngs_modulus", "thickness") if getattr(quantity, n)]
        return {*fields} <= {*given_by_units(diagnostic)} and all(
            math.isclose(getattr(diagnostic, n), self._units.value(n) or 0.0) for n in fields
        )

    def columns(self, columns: Iterable[Column]) -> list[Column]:
        """Return the columns with their scales and with comments on units, and the columns of the
        copies in mm. Raises PluginError if a name is already used."""
        entries = list(map(_with_comment, columns))
        if self._units is None:
            return entries
        scale, names = self._units.value("length") or 1.0, {column.name for column in entries}
        for n, column in enumerate(entries):
            quantity = QUANTITIES.get(column.units)
            if quantity is None or quantity.youngs_modulus:
                continue
            scales = {UNITS: quantity.unit, FACTOR: scale**quantity.length}
            whole = DIVIDED.get(column.name, quantity)
            if whole is not quantity and not self._units.missing_entries(whole):
                scales = {UNITS: whole.unit, FACTOR: self._units.scale(whole)}
            entries[n] = replace(column, extra=column.extra | scales)
            if quantity is LENGTH and column.name != "position":
                twin = f"{column.name}{IN_MM}"
                if twin in names:
                    raise PluginError(
                        f"the variable '{twin}' has the name of '{column.name}' in "
                        f"{LENGTH.unit}; rename it"
                    )
                attributes = column.extra | {TWIN_OF: column.name}
                entries.append(replace(column, name=twin, units=LENGTH.unit, extra=attributes))
        return entries


def _with_comment(column: Column) -> Column:
    """Add the quantities that define the units of a column to its comment."""
    notes = [
        f"{unit}: that of {n} as it is given"
        for n, unit in OF_GIVEN.items()
        if unit in column.units
    ]
    return replace(column, comment="; ".join(notes)) if notes else column


class ConvertedCopies:
    """The converted copies of the variables of a dataset."""

    def __init__(self, columns: list[Column]) -> None:
        factors = {c.name: c.extra[FACTOR] for c in columns if FACTOR in c.extra}
        of = {c.extra[TWIN_OF]: c.name for c in columns if TWIN_OF in c.extra}
        self._of = {name: (twin, factors[name]) for name, twin in of.items()}

    def add_to(self, values: Values) -> Values:
        """Return the values together with the converted copies."""
        if not self._of:
            return values
        lengths = {self._of[name]: value for name, value in values.items() if name in self._of}
        return values | {name: np.asarray(v) * factor for (name, factor), v in lengths.items()}


def in_physical_units(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset in physical units: every variable with a scale is converted and keeps its
    name. If there is such a variable, steps are dimensionless, so that all units are those of
    UDUNITS."""
    converted = dataset.drop_vars([n for n, v in dataset.variables.items() if TWIN_OF in v.attrs])
    is_physical = any(UNITS in variable.attrs for variable in converted.variables.values())
    for name, variable in converted.variables.items():
        attributes: dict[Any, Any] = dict(variable.attrs)
        if is_physical and attributes.get("units") == STEP:
            converted[name].attrs |= {"units": "1", "lattice_units": STEP}
        if UNITS in attributes and FACTOR in attributes:
            factor = float(attributes.pop(FACTOR))
            attributes |= {"units": attributes.pop(UNITS), "lattice_units": attributes["units"]}
            attributes["lattice_factor"] = 1.0 / factor
            converted[name] = (variable.dims, variable.values * factor, attributes)
    return converted.set_coords([name for name in dataset.coords if name in converted.variables])
