"""The dataset's variables: one description that the file, xarray and the JSON Schema share."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from itertools import chain
from typing import Any

import numpy as np

from pbdkit.experiment.schema import DIALECT
from pbdkit.interfaces import Component, Diagnostic, Remembered, Variable
from pbdkit.interfaces.units import LENGTH, QUANTITIES
from pbdkit.registry.registry import Registry
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER

CONVENTIONS = "CF-1.11"
SCHEMA_VERSION = "2"
STATUSES = ("complete", "settled", "diverged", "unconverged", "interrupted")
ATTRIBUTES = (
    "Conventions", "schema_version", "title", "pbdkit_version", "experiment", "plugins",
    "prediction", "status", "stop_reason", "created",
)  # fmt: skip


Values = dict[str, Any]
"""What goes into a dataset, by the name of the variable."""


class When(Enum):
    """At what time a variable gets its values."""

    START = "once, before the first step"
    RECORD = "at every recorded step"
    STEP = "at every step"
    END = "once, after the last step"


@dataclass(frozen=True)
class Column:
    """One variable of the dataset with its full dimensions; `coordinate` marks coordinates, `more`
    are attributes besides its meaning and its units."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    when: When
    long_name: str
    units: str = ""
    coordinate: bool = False
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def grows(self) -> bool:
        """Whether it gains an entry along its first dimension as the run goes on."""
        return self.when in (When.RECORD, When.STEP)

    @property
    def attributes(self) -> dict[str, Any]:
        """All that stands with it in the dataset."""
        units = {"units": self.units} if self.units else {}
        return {"long_name": self.long_name} | units | self.more


def coordinate(
    name: str, long_name: str, dtype: str = "i8", when: When = When.START, units: str = ""
) -> Column:
    """The coordinate of a dimension."""
    return Column(name, (name,), dtype, when, long_name, units, True)


def base_columns() -> list[Column]:
    """What every dataset has."""
    kinds = np.array([LEADER, FOLLOWER, FRAME], np.int8)
    flags = {"flag_values": kinds, "flag_meanings": "leader follower frame"}
    number = "number of the particle, by site (i, then j), from 1"
    role = "role during the step, at time 0 that of step 1"
    at, each, on = When.START, "particle", When.RECORD
    return [
        coordinate("time", "step", when=on, units="step"),
        coordinate(each, number),
        Column("number", (each,), "i8", at, number, coordinate=True),
        coordinate("axis", "coordinate axis", "str"),
        Column("site", (each, "index"), "i4", at, "lattice index (i, j)"),
        Column("reference", (each, "axis"), "f8", at, "reference position X", LENGTH.lattice),
        Column("position", ("time", each, "axis"), "f8", on, "position x", LENGTH.lattice),
        Column("kind", ("time", each), "i1", on, role, more=flags),
    ]


def optional_columns() -> list[list[Column]]:
    """What only some datasets have, whatever their diagnostics: the table of bonds, when each
    broke, the coordinate of what is measured at every step, and those of leader groups, of loads
    and of obstacles."""
    bond, ends = ("bond",), "the two particles of the bond, as positions along `particle` from 0"
    step = "step at which the bond broke, -1 if it has not"
    strain = "strain with which the bond broke, NaN if it has not, was cut or broken from the start"
    group = "leader group, by its place among the experiment's leaders, from 0"
    obstacle = "obstacle, by its place among the experiment's obstacles, from 0"
    return [
        [
            Column("bond", ("bond", "end"), "i8", When.START, f"{ends}, lower first", "", True),
            Column("shell", bond, "i1", When.START, "shell of the bond, from 1"),
        ],
        [
            Column("broken_step", bond, "i4", When.END, step),
            Column("broken_strain", bond, "f8", When.END, strain, "1"),
        ],
        [coordinate("step", "step", when=When.STEP, units="step")],
        [coordinate("leader_group", group)],
        [coordinate("load", "load, by its place among the experiment's loads, from 0")],
        [coordinate("obstacle", obstacle)],
    ]


def reserved_names() -> set[str]:
    """The names that nobody else can give to a variable or a dimension."""
    ours = chain(base_columns(), *optional_columns())
    return {name for column in ours for name in (column.name, *column.dims)}


def remembered_column(number: Remembered, owner: str, part_renews: bool) -> Column:
    """A number that a part remembers of each `owner`, bond or particle."""
    grows = number.changes and part_renews
    dims, when = (("time", owner), When.RECORD) if grows else ((owner,), When.START)
    return Column(number.name, dims, number.dtype, when, number.long_name, number.units)


def when_measured(diagnostic: Diagnostic | type[Diagnostic]) -> When:
    """At what time a diagnostic is asked."""
    if diagnostic.at_end:
        return When.END
    return When.STEP if diagnostic.every_step else When.RECORD


def diagnostic_column(variable: Variable, diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """A diagnostic's variable with its leading dimension."""
    when = when_measured(diagnostic)
    dims = (*{When.STEP: ["step"], When.RECORD: ["time"]}.get(when, []), *variable.dims)
    described = variable.long_name, variable.units, False, variable.attributes
    return Column(variable.name, dims, variable.dtype, when, *described)


def dataset_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """The JSON Schema of datasets, in the form of ``xarray.Dataset.to_dict(data=False)``; without
    `installed`, of those of the built-in diagnostics alone."""
    base = base_columns()
    diagnostics = registry.spellings(Diagnostic, installed=installed)
    columns = list(chain(base, *optional_columns(), *map(_columns_of, diagnostics)))
    strings: dict[str, Any] = {name: {"type": "string"} for name in ATTRIBUTES}
    strings |= {"status": {"enum": list(STATUSES)}, "schema_version": {"const": SCHEMA_VERSION}}

    def group(coordinate: bool) -> dict[str, Any]:
        return _object(
            {c.name: _schema_of(c) for c in columns if c.coordinate == coordinate},
            [c.name for c in base if c.coordinate == coordinate],
        )

    parts = {
        "attrs": _object(strings, list(ATTRIBUTES)),
        "dims": {"type": "object", "additionalProperties": {"type": "integer"}},
        "coords": group(coordinate=True),
        "data_vars": group(coordinate=False),
    }
    return {"$schema": DIALECT, "title": "pbdkit dataset"} | _object(parts, sorted(parts))


def _columns_of(diagnostic: type[Component]) -> list[Column]:
    """The columns of a diagnostic, asked of one whose parameters are not set; where variables
    depend on parameters, or cannot be had, the schema leaves them open."""
    assert issubclass(diagnostic, Diagnostic)
    with suppress(Exception):  # it is somebody's code, which nobody asked to run
        variables = diagnostic.model_construct(type="").variables()
        columns = [diagnostic_column(v, diagnostic) for v in variables]
        json.dumps([_schema_of(column) for column in columns])
        return columns
    return []


def _schema_of(column: Column) -> dict[str, Any]:
    said = {k: v for k, v in column.attributes.items() if not isinstance(v, np.ndarray)}
    attributes = {name: {"const": value} for name, value in said.items()}
    if (quantity := QUANTITIES.get(column.units)) and quantity.youngs_modulus:
        attributes["units"] = {"enum": [column.units, quantity.unit]}
    parts = {"dims": {"const": list(column.dims)}, "attrs": _object(attributes, sorted(attributes))}
    if column.dtype != "str":
        parts["dtype"] = {"const": np.dtype(column.dtype).name}
    described = {"description": f"{column.long_name}; written {column.when.value}"}
    return described | _object(parts, ["dims", "attrs", "dtype"])


def _object(properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"type": "object", "required": required, "properties": properties}
