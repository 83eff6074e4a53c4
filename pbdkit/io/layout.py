"""Variables and attributes of the dataset: one description shared by the file, xarray and the JSON
Schema, the provenance in attributes, and the conversion of datasets of layout version 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Array
from pbdkit.components.diagnostics import CrackPath
from pbdkit.errors import ExperimentError, StorageError
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.model.schema import DIALECT
from pbdkit.plugin import Component, Diagnostic, Remembered, Variable
from pbdkit.plugin.discovery import refuse_retired
from pbdkit.plugin.registry import GIVEN, Registry
from pbdkit.plugin.units import LENGTH, QUANTITIES
from pbdkit.scene.scene import Scene, build_scene

if TYPE_CHECKING:
    import xarray


CONVENTIONS = "CF-1.11"
SCHEMA_VERSION = "2"
STATUSES = ("complete", "settled", "diverged", "unconverged", "separated", "interrupted")
ATTRIBUTES = (
    "Conventions", "schema_version", "title", "pbdkit_version", "experiment", "plugins",
    "prediction", "status", "stop_reason", "created",
)  # fmt: skip
INDICES = "ijk"
"""The names of a site's indices, one for each axis of the lattice."""
OF_BODY, OF_FRAME = np.int8(0), np.int8(1)
"""The roles of particles: leaders and followers are body, at every step."""
TIMES = ("time", "step")
"""Coordinates that count steps: fractions of them too where increments of load are recorded."""
STEP, ENDS = "step", "their numbers, the lower one first"
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
    """One variable of the dataset with its full dimensions; `coordinate` marks coordinates.

    `long_name` is short, as it stands at the axes of plots; `comment` says the rest. `more` are
    other attributes.
    """

    name: str
    dims: tuple[str, ...]
    dtype: str
    when: When
    long_name: str
    units: str = ""
    coordinate: bool = False
    more: dict[str, Any] = field(default_factory=dict)
    comment: str = ""

    @property
    def grows(self) -> bool:
        """Whether it gains an entry along its first dimension as the run goes on."""
        return self.when in (When.RECORD, When.STEP)

    @property
    def attributes(self) -> dict[str, Any]:
        """All that stands with it in the dataset."""
        said = {"long_name": self.long_name, "units": self.units, "comment": self.comment}
        return {name: text for name, text in said.items() if text} | self.more


def as_step(time: Any) -> float:
    """A recorded time as it is written: a whole number of steps, or a fraction with six digits."""
    return int(time) if float(time).is_integer() else float(f"{time:.6g}")


def broken_by(broken_step: Any, step: Any) -> Any:
    """Whether bonds that broke in these steps, -1 where they did not, are broken after a step."""
    return (broken_step >= 0) & (broken_step <= step)


def coordinate(
    name: str,
    long_name: str,
    dtype: str = "i8",
    dims: tuple[str, ...] = (),
    *,
    when: When = When.START,
    units: str = "",
    comment: str = "",
    more: dict[str, Any] | None = None,
) -> Column:
    """A coordinate; that of the dimension with its name unless other dimensions are given."""
    return Column(name, dims or (name,), dtype, when, long_name, units, True, more or {}, comment)


def base_columns(axes: int = 2) -> list[Column]:
    """What every dataset has, on a lattice with so many axes."""
    each, on, number = ("particle",), When.RECORD, "number of the particle"
    by_site, now = "counted from 1, by site: i, then j", "during the step; at time 0 during step 1"
    beyond = "corners of cells that the outline cuts may not; stress and strain are NaN there"
    kinds = _flags({"leader": LEADER, "follower": FOLLOWER, "frame": FRAME})
    roles = _flags({"body": OF_BODY, "frame": OF_FRAME})
    return [
        coordinate("time", "time", when=on, units=STEP),
        coordinate("particle", number, comment=by_site),
        coordinate("number", number, dims=each, comment=by_site),
        *(coordinate(name, f"site index {name}", "i4", each) for name in INDICES[:axes]),
        coordinate("role", "role of the particle", "i1", each, more=roles),
        coordinate("inside", "whether it lies inside the outline", "bool", each, comment=beyond),
        coordinate("axis", "axis", "str"),
        coordinate("site", "site indices", "i4", (*each, "index")),
        coordinate("reference", "reference position", "f8", (*each, "axis"), units=LENGTH.lattice),
        Column("position", ("time", *each, "axis"), "f8", on, "position", LENGTH.lattice),
        Column("kind", ("time", *each), "i1", on, "kind of the particle", more=kinds, comment=now),
    ]


def _flags(meanings: dict[str, Any]) -> dict[str, Any]:
    """The attributes of a variable whose values stand for words."""
    values = np.array([*meanings.values()], np.int8)
    return {"flag_values": values, "flag_meanings": " ".join(meanings)}


def optional_columns() -> list[list[Column]]:
    """What only some datasets have, whatever their diagnostics: the table of bonds, when each
    broke, the coordinate of what is measured at every step, and those of leader groups, of loads,
    of obstacles and of principal values."""
    bond, by_ends = ("bond",), "counted from 1, by its ends"
    whole = "-1 where it has not broken"
    no_strain = "NaN where it has not broken, was cut, or was broken from the start"
    place = "counted from 0, by its place in the experiment"
    return [
        [
            coordinate("bond", "number of the bond", "i4", comment=by_ends),
            coordinate("bond_ends", "particles of the bond", "i4", ("bond", "end"), comment=ENDS),
            coordinate("shell", "shell of the bond", "i1", bond, comment="counted from 1"),
        ],
        [
            Column("broken_step", bond, "i4", When.END, "time of breaking", STEP, comment=whole),
            Column(
                "broken_strain", bond, "f8", When.END, "strain at breaking", "1", comment=no_strain
            ),
        ],
        [coordinate("step", "time", when=When.STEP, units=STEP)],
        [coordinate("leader_group", "leader group", comment=place)],
        [coordinate("load", "load", comment=place)],
        [coordinate("obstacle", "obstacle", comment=place)],
        [coordinate("principal", "principal value", comment="1 the larger one, 2 the smaller one")],
    ]


def reserved_names() -> set[str]:
    """The names that nobody else can give to a variable or a dimension."""
    ours = chain(base_columns(len(INDICES)), *optional_columns())
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


def own_coordinate(diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """That of the dimension whose length a diagnostic knows at the end only."""
    name = diagnostic.own_dimension
    return coordinate(name, name.replace("_", " "), when=When.END, comment="counted from 1")


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


def makers_of(names: set[str]) -> list[str]:
    """Return the built-in diagnostics that make a variable of one of these names, or whose name
    begins with one and `_`, as an experiment names them."""
    begins = tuple(f"{name}_" for name in names if name)
    found = []
    for each, types in Registry().spellings(Diagnostic, installed=False).items():
        made = [column.name for column in _columns_of(each)]
        if any(name in names or name.startswith(begins) for name in made):
            fields = each.model_fields.items()  # the modulus may come from `units`
            needed = [n for n, part in fields if part.is_required() or n == "youngs_modulus"]
            found.append(f"{{{', '.join([f'type: {types[0]}', *(f'{n}: ...' for n in needed)])}}}")
    return found


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
        name = np.dtype(column.dtype).name
        fractions = {"enum": [name, "float64"]}
        parts["dtype"] = fractions if column.name in TIMES else {"const": name}
    described = {"description": f"{column.long_name}; written {column.when.value}"}
    return described | _object(parts, ["dims", "attrs", "dtype"])


def _object(properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"type": "object", "required": required, "properties": properties}


def refuse_no_dataset(given: Any) -> None:
    """Raise ExperimentError where a file, or anything else, is given in place of a dataset."""
    if not hasattr(given, "data_vars"):
        opening = f"pbdkit.open({str(given)!r})" if isinstance(given, str | Path) else ""
        raise ExperimentError(
            f"expected a dataset of pbdkit, got an object of type {type(given).__name__}; "
            f"{opening or 'pbdkit.open(file)'} returns that of a file, pbdkit.run(...) a new one"
        )


def in_this_layout(dataset: xarray.Dataset) -> xarray.Dataset:
    """The dataset itself, or an older one with the names of now: indices and roles of particles,
    and bonds by number, which were places from 0; all of the body counts as inside its outline.

    What was measured stays as it was: frame points hold 0 in what is NaN there now. Raises
    ExperimentError for what is no dataset.
    """
    refuse_no_dataset(dataset)
    found, dims = dataset.variables, {name: v.dims for name, v in dataset.variables.items()}
    new: dict[str, Any] = {}
    if dims.get("site") == ("particle", "index") and "i" not in found:
        axes = zip(INDICES, range(dataset.sizes["index"]), strict=False)
        new |= {name: found["site"].isel(index=n) for name, n in axes}
    if "particle" in dims.get("kind", ()) and "role" not in found:
        frame = found["kind"].isel(time=0, missing_dims="ignore") == FRAME
        new["role"] = frame.copy(data=np.where(frame, OF_FRAME, OF_BODY))
    role = new.get("role", found.get("role"))
    if role is not None and "inside" not in found:
        new["inside"] = (role.dims, role.values == OF_BODY)
    if dims.get("bond") == ("bond", "end"):
        new["bond_ends"] = found["bond"] + 1
        places = {"crack_bond": found["crack_bond"] + 1} if "crack_bond" in found else {}
        counted = ("bond", "crack") if places else ("bond",)
        new |= places | {dim: (dim, np.arange(1, dataset.sizes[dim] + 1)) for dim in counted}
    return _described(dataset, new) if new else dataset


def _described(dataset: xarray.Dataset, new: dict[str, Any]) -> xarray.Dataset:
    """The dataset with what is new, all of it labelled as now."""
    dataset = dataset.assign(new)
    crack = (diagnostic_column(v, CrackPath) for v in CrackPath().variables())
    ours = chain(base_columns(len(INDICES)), *optional_columns(), crack)
    known = [c for c in (*ours, own_coordinate(CrackPath)) if c.name in dataset.variables]
    for column in known:
        if column.name in new:
            dataset[column.name] = dataset[column.name].astype(column.dtype).drop_encoding()
        dataset[column.name].attrs |= column.attributes
    return dataset.set_coords([column.name for column in known if column.coordinate])


def carried(dataset: xarray.Dataset, attribute: str) -> dict[str, Any]:
    """The map in an attribute, or in the coordinate that it is for one run of several; empty where
    there is neither. Raises StorageError where it is damaged."""
    beside = dataset.coords.get(attribute)
    text = "{}" if beside is None or beside.ndim else beside.item()
    try:
        found = json.loads(dataset.attrs.get(attribute, text))
    except (ValueError, TypeError, RecursionError) as error:
        raise StorageError(f"its attribute '{attribute}' is damaged: {error}") from None
    if not isinstance(found, dict):
        raise StorageError(f"its attribute '{attribute}' is damaged: it holds no map of keys")
    return found


def scene_of(dataset: xarray.Dataset, what: str) -> Scene:
    """Build the scene of the run that made a dataset, which `what` needs.

    Raises ExperimentError where it cannot be built, as where a component of it is retired.
    """
    refuse_retired(carried(dataset, "experiment"), what)
    return build_scene(experiment_of(dataset))


def experiment_of(
    dataset: xarray.Dataset, components: Iterable[type[Component]] = ()
) -> Experiment:
    """The experiment that a dataset carries. Raises ExperimentError where there is none, or where
    it wants components that are not there."""
    refuse_no_dataset(dataset)
    parts = carried(dataset, "experiment")
    if not parts:
        raise ExperimentError("the dataset carries no experiment: pbdkit did not make it")
    source = Source("dataset", parts)
    try:
        return Experiment.build(source, components)
    except ExperimentError as error:
        given = carried(dataset, "plugins").get(GIVEN)
        if given is None or components:
            raise
        raise ExperimentError(f"{error}; it was run with components=[...]: {given}") from None


def indices_of(dataset: xarray.Dataset) -> list[str]:
    """Those that particles are found by."""
    found = dataset.variables
    return [name for name in INDICES if name in found and found[name].dims == ("particle",)]


def rows_at(dataset: xarray.Dataset, index: Mapping[str, int]) -> Array:
    """The rows of the particles whose sites have these indices. Raises ExperimentError where there
    is none, and for what is no index."""
    known = indices_of(dataset)
    here = np.ones(dataset.sizes.get("particle", 0), np.bool_)
    for name, value in index.items():
        if name not in known:
            raise ExperimentError(f"particles here are found by {known}, not by '{name}'")
        here &= dataset.variables[name].values == value
    if not here.any():
        place = ", ".join(f"{name}={value}" for name, value in index.items())
        raise ExperimentError(f"there is no particle at {place}")
    return np.flatnonzero(here)


def rows_of(numbers: Array, given: Array) -> Array:
    """Where particles of those numbers are; -1 where they are not."""
    wanted = np.nan_to_num(given, nan=-1.0).astype(np.int64)
    last = len(numbers)
    if last and numbers[0] == 1 and numbers[-1] == last:  # all of them, as in most datasets
        return np.where(wanted <= last, wanted - 1, -1)
    if not last:
        return np.full(wanted.shape, -1)
    order = np.argsort(numbers)
    at = order[np.searchsorted(numbers[order], wanted).clip(max=last - 1)]
    return np.where(numbers[at] == wanted, at, -1)
