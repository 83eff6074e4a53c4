"""The dataset's variables: one description that the file, xarray and the schema share."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from pbdkit.interfaces import Diagnostic, Remembered, Variable
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER

CONVENTIONS = "CF-1.11"
SCHEMA_VERSION = "2"
STATUSES = ("complete", "settled", "diverged", "unconverged", "interrupted")
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


def reserved_names() -> set[str]:
    """The names that nobody else can give to a variable or a dimension."""
    ours = [*base_columns(), *bond_columns(), *broken_columns(), step_column(), leader_column()]
    return {name for column in ours for name in (column.name, *column.dims)}


def remembered_column(number: Remembered, owner: str, part_renews: bool) -> Column:
    """A number that a part remembers of each `owner`, bond or particle."""
    grows = number.changes and part_renews
    dims, when = (("time", owner), When.RECORD) if grows else ((owner,), When.START)
    attributes = _described(number.long_name, number.units)
    return Column(number.name, dims, number.dtype, when, attributes)


def step_column() -> Column:
    """The coordinate of what is measured at every step."""
    return Column("step", ("step",), "i8", When.STEP, _described("step", "step"), True)


def leader_column() -> Column:
    """The coordinate of what is measured of each leader group."""
    meaning = "leader group, by its place among the experiment's leaders, from 0"
    return Column("leader_group", ("leader_group",), "i8", When.START, _described(meaning), True)


def own_coordinate(name: str, dtype: str) -> Column:
    """The coordinate of a dimension that a diagnostic brings along."""
    return Column(name, (name,), dtype, When.START, _described(name), True)


def diagnostic_column(variable: Variable, diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """A diagnostic's variable with its leading dimension."""
    leading, when = ("step", When.STEP) if diagnostic.every_step else ("time", When.RECORD)
    dims = (leading, *variable.dims)
    if diagnostic.at_end:
        dims, when = variable.dims, When.END
    attributes = _described(variable.long_name, variable.units, **variable.attributes)
    return Column(variable.name, dims, variable.dtype, when, attributes)
