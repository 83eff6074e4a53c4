"""Results in mm, MPa and N beside the lattice's own, where the experiment has `units`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.io.layout import Column, Values
from pbdkit.plugin import Diagnostic, Variable
from pbdkit.plugin.units import LENGTH, QUANTITIES, Quantity, Units, given_by_units

if TYPE_CHECKING:
    import xarray


IN_MM = f"_{LENGTH.unit}"
OF_GIVEN = {"youngs_modulus": "stress unit", "thickness": "thickness unit"}
"""What the units are called in which these are given as plain numbers."""
UNITS, FACTOR, TWIN_OF = "physical_units", "physical_factor", "physical_of"
"""The attributes of a variable in lattice units: times the factor it is in those units; and of what
stands beside a variable, its name."""


class Physical:
    """What `units` makes of a dataset; nothing where there are none.

    Stresses, forces and energies, which no lattice has without a modulus, are in MPa, N and mJ, and
    say what they are counted in on the lattice. All else keeps its values, and says its scale;
    lengths but the positions, the bulk of a file, stand there in mm too.
    """

    def __init__(self, units: Units | None) -> None:
        self._units = units

    def scaled(self, diagnostic: Diagnostic) -> Iterator[tuple[Variable, float]]:
        """The variables of a diagnostic, and by what their values are to be multiplied."""
        for variable in diagnostic.variables():
            quantity = QUANTITIES.get(variable.units)
            if quantity and quantity.youngs_modulus and self._gave(diagnostic, quantity):
                assert self._units is not None
                own: dict[str, Any] = {"lattice_units": quantity.lattice}
                for name, unit in OF_GIVEN.items():
                    own["lattice_units"] = own["lattice_units"].replace(unit, name)
                own["lattice_factor"] = 1.0 / self._units.scale(quantity)
                attributes = variable.attributes | own
                factor = (self._units.value("length") or 1.0) ** quantity.length
                yield replace(variable, units=quantity.unit, attributes=attributes), factor
            else:
                yield variable, 1.0

    def _gave(self, diagnostic: Diagnostic, quantity: Quantity) -> bool:
        """Whether the diagnostic's modulus, and thickness where it counts, are those of `units`."""
        if self._units is None or self._units.lacks(quantity):
            return False
        taken = [n for n in ("youngs_modulus", "thickness") if getattr(quantity, n)]
        return {*taken} <= {*given_by_units(diagnostic)} and all(
            math.isclose(getattr(diagnostic, n), self._units.value(n) or 0.0) for n in taken
        )

    def columns(self, columns: Iterable[Column]) -> list[Column]:
        """The same with a word on their units, their scales, and what stands beside them. Raises
        PluginError where a name is taken."""
        found = list(map(_explained, columns))
        if self._units is None:
            return found
        scale, names = self._units.value("length") or 1.0, {column.name for column in found}
        for n, column in enumerate(found):
            quantity = QUANTITIES.get(column.units)
            if quantity is None or quantity.youngs_modulus:
                continue
            said = {UNITS: quantity.unit, FACTOR: scale**quantity.length}
            found[n] = replace(column, more=column.more | said)
            if quantity is LENGTH and column.name != "position":
                twin = f"{column.name}{IN_MM}"
                if twin in names:
                    raise PluginError(
                        f"the variable '{twin}' stands where '{column.name}' in {LENGTH.unit} does;"
                        " give it another name"
                    )
                more = column.more | {TWIN_OF: column.name}
                found.append(replace(column, name=twin, units=LENGTH.unit, more=more))
        return found


def _explained(column: Column) -> Column:
    """A column that says of which given number its units are."""
    given = [
        f"{unit}: that of {n} as it is given"
        for n, unit in OF_GIVEN.items()
        if unit in column.units
    ]
    return replace(column, comment="; ".join(given)) if given else column


class Twins:
    """What stands beside the variables of a dataset with these columns."""

    def __init__(self, columns: list[Column]) -> None:
        factors = {c.name: c.more[FACTOR] for c in columns if FACTOR in c.more}
        of = {c.more[TWIN_OF]: c.name for c in columns if TWIN_OF in c.more}
        self._of = {name: (twin, factors[name]) for name, twin in of.items()}

    def beside(self, values: Values) -> Values:
        """The values, and theirs."""
        wanted = {self._of[name]: value for name, value in values.items() if name in self._of}
        return values | {name: np.asarray(v) * factor for (name, factor), v in wanted.items()}


def in_physical_units(dataset: xarray.Dataset) -> xarray.Dataset:
    """The dataset with every variable that says its scale in those units, by its own name."""
    found = dataset.drop_vars([n for n, v in dataset.variables.items() if TWIN_OF in v.attrs])
    for name, variable in found.variables.items():
        said: dict[Any, Any] = dict(variable.attrs)
        if UNITS in said and FACTOR in said:
            factor = float(said.pop(FACTOR))
            said |= {"units": said.pop(UNITS), "lattice_units": said["units"]}
            said["lattice_factor"] = 1.0 / factor
            found[name] = (variable.dims, variable.values * factor, said)
    return found.set_coords([name for name in dataset.coords if name in found.variables])
