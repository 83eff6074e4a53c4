"""The dataset's variables: one description that the file, xarray and the JSON Schema share."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from pbdkit.experiment.schema import DIALECT
from pbdkit.interfaces import Component, Diagnostic, Remembered, Variable
from pbdkit.registry.registry import Registry
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER

CONVENTIONS = "CF-1.11"
SCHEMA_VERSION = "2"
STATUSES = ("complete", "settled", "diverged", "unconverged", "interrupted")
ATTRIBUTES = (
    "Conventions", "schema_version", "title", "pbdkit_version", "experiment", "plugins",
    "prediction", "status", "stop_reason", "created",
)  # fmt: skip
LENGTH = "lattice unit"


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
    """One variable of the dataset with its full dimensions; `coordinate` marks coordinates."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    when: When
    attributes: dict[str, Any] = field(default_factory=dict)
    coordinate: bool = False

    @property
    def grows(self) -> bool:
        """Whether it gains an entry along its first dimension as the run goes on."""
        return self.when in (When.RECORD, When.STEP)


def _described(long_name: str, units: str | None = None, **more: Any) -> dict[str, Any]:
    return {"long_name": long_name} | ({"units": units} if units else {}) | more


def base_columns() -> list[Column]:
    """What every dataset has."""
    kinds: dict[str, Any] = {
        "flag_values": np.array([LEADER, FOLLOWER, FRAME], np.int8),
        "flag_meanings": "leader follower frame",
    }
    number = "number of the particle, by site (i, then j), from 1"
    at = When.START
    return [
        Column("time", ("time",), "i8", When.RECORD, _described("step", "step"), True),
        Column("particle", ("particle",), "i8", at, _described(number), True),
        Column("number", ("particle",), "i8", at, _described(number), True),
        Column("axis", ("axis",), "str", at, _described("coordinate axis"), True),
        Column("site", ("particle", "index"), "i4", at, _described("lattice index (i, j)")),
        Column(
            "reference", ("particle", "axis"), "f8", at,
            _described("reference position X", LENGTH),
        ),
        Column(
            "position", ("time", "particle", "axis"), "f8", When.RECORD,
            _described("position x", LENGTH),
        ),
        Column(
            "kind", ("time", "particle"), "i1", When.RECORD,
            _described("role during the step, at time 0 that of step 1", **kinds),
        ),
    ]  # fmt: skip


def bond_columns() -> list[Column]:
    """The table of bonds, where fracture or a diagnostic uses it."""
    ends = "the two particles of the bond, as positions along `particle` from 0, lower first"
    return [
        Column("bond", ("bond", "end"), "i8", When.START, _described(ends), True),
        Column("shell", ("bond",), "i1", When.START, _described("shell of the bond, from 1")),
    ]


def broken_columns() -> list[Column]:
    """When each bond broke, and how far stretched, where there is fracture."""
    step = "step at which the bond broke, -1 if it has not"
    strain = "strain with which the bond broke, NaN if it has not or was broken from the start"
    return [
        Column("broken_step", ("bond",), "i4", When.END, _described(step)),
        Column("broken_strain", ("bond",), "f8", When.END, _described(strain, "1")),
    ]


def step_column() -> Column:
    """The coordinate of what is measured at every step."""
    return Column("step", ("step",), "i8", When.STEP, _described("step", "step"), True)


def leader_column() -> Column:
    """The coordinate of what is measured of each leader group."""
    meaning = "leader group, by its place among the experiment's leaders, from 0"
    return Column("leader_group", ("leader_group",), "i8", When.START, _described(meaning), True)


def optional_columns() -> list[Column]:
    """What only some datasets have, whatever their diagnostics."""
    return [*bond_columns(), *broken_columns(), step_column(), leader_column()]


def reserved_names() -> set[str]:
    """The names that nobody else can give to a variable or a dimension."""
    ours = base_columns() + optional_columns()
    return {name for column in ours for name in (column.name, *column.dims)}


def remembered_column(number: Remembered, owner: str, part_renews: bool) -> Column:
    """A number that a part remembers of each `owner`, bond or particle."""
    grows = number.changes and part_renews
    dims, when = (("time", owner), When.RECORD) if grows else ((owner,), When.START)
    attributes = _described(number.long_name, number.units)
    return Column(number.name, dims, number.dtype, when, attributes)


def own_coordinate(name: str, dtype: str) -> Column:
    """The coordinate of a dimension that a diagnostic brings along."""
    return Column(name, (name,), dtype, When.START, _described(name), True)


def when_measured(diagnostic: Diagnostic | type[Diagnostic]) -> When:
    """At what time a diagnostic is asked."""
    if diagnostic.at_end:
        return When.END
    return When.STEP if diagnostic.every_step else When.RECORD


def diagnostic_column(variable: Variable, diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """A diagnostic's variable with its leading dimension."""
    when = when_measured(diagnostic)
    dims = (*{When.STEP: ["step"], When.RECORD: ["time"]}.get(when, []), *variable.dims)
    attributes = _described(variable.long_name, variable.units, **variable.attributes)
    return Column(variable.name, dims, variable.dtype, when, attributes)


def dataset_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """The JSON Schema of datasets, in the form of ``xarray.Dataset.to_dict(data=False)``; without
    `installed`, of those of the built-in diagnostics alone."""
    base = base_columns()
    columns = base + optional_columns()
    for diagnostic in registry.spellings(Diagnostic, installed=installed):
        columns += _columns_of(diagnostic)
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
    try:
        variables = diagnostic.model_construct(type="").variables()
        columns = [diagnostic_column(v, diagnostic) for v in variables]
        json.dumps([_schema_of(column) for column in columns])
    except Exception:  # it is somebody's code, which nobody asked to run
        return []
    return columns


def _schema_of(column: Column) -> dict[str, Any]:
    attributes = {
        name: {"const": value}
        for name, value in column.attributes.items()
        if not isinstance(value, np.ndarray)
    }
    parts = {"dims": {"const": list(column.dims)}, "attrs": _object(attributes, sorted(attributes))}
    if column.dtype != "str":
        parts["dtype"] = {"const": np.dtype(column.dtype).name}
    said = f"{column.attributes['long_name']}; written {column.when.value}"
    return {"description": said} | _object(parts, ["dims", "attrs", "dtype"])


def _object(properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"type": "object", "required": required, "properties": properties}
