"""Variables and attributes of the dataset. The file, xarray and the JSON Schema use the same
description. This module also converts datasets of layout version 1.
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
from pbdkit.plugin.units import AREA, LENGTH, QUANTITIES
from pbdkit.scene.scene import Scene, build_scene

if TYPE_CHECKING:
    import xarray


SCHEMA_VERSION = "2"
"""Version of the layout."""
CONVENTIONS = f"pbdkit-{SCHEMA_VERSION}"
"""Conventions of the layout. Names of attributes are those of CF, but the CF conventions do not
allow units such as "lattice unit" and "step"."""
STATUSES = ("complete", "settled", "diverged", "unconverged", "separated", "interrupted")
"""Values of the attribute `status`."""
ATTRIBUTES = (
    "Conventions", "schema_version", "title", "pbdkit_version", "experiment", "plugins",
    "prediction", "status", "stop_reason", "created",
)  # fmt: skip
"""Names of the attributes of every dataset."""
INDICES = "ijk"
"""Names of the indices of a site, one for each axis of the lattice."""
PLACES = "XYZ"
"""Names of the coordinates with the components of the reference position."""
OF_BODY = np.int8(0)
"""Role of the particles of the body, which are leaders and followers."""
OF_FRAME = np.int8(1)
"""Role of frame points."""
TIMES = ("time", "step")
"""Coordinates that count steps. Their values are fractions if equilibria within steps are
recorded."""
STEP = "step"
"""Name of the coordinate of quantities that are measured at every step."""
ENDS = "their numbers, the lower one first"
"""Description of the ends of bonds."""
Values = dict[str, Any]
"""Values of a dataset, by the name of the variable."""


class When(Enum):
    """Time at which a variable is recorded."""

    START = "once, before the first step"
    RECORD = "at every recorded step"
    STEP = "at every step"
    END = "once, after the last step"


@dataclass(frozen=True)
class Column:
    """Description of one variable of the dataset with all its dimensions. `coordinate` is true for
    coordinates.

    `long_name` is short, for the axes of plots; `comment` has further explanations. `extra` are
    other attributes.
    """

    name: str
    dims: tuple[str, ...]
    dtype: str
    when: When
    long_name: str
    units: str = ""
    coordinate: bool = False
    extra: dict[str, Any] = field(default_factory=dict)
    comment: str = ""

    @property
    def grows(self) -> bool:
        """Return whether the variable has an entry for each record or step of the run."""
        return self.when in (When.RECORD, When.STEP)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the variable in the dataset."""
        texts = {"long_name": self.long_name, "units": self.units, "comment": self.comment}
        return {name: text for name, text in texts.items() if text} | self.extra


def as_step(time: Any) -> float:
    """Convert a recorded time to a whole number of steps, or to a fraction with six digits."""
    return int(time) if float(time).is_integer() else float(f"{time:.6g}")


def broken_by(broken_step: Any, step: Any) -> Any:
    """Return whether bonds are broken after a step, given the steps in which they broke, -1 for
    intact bonds."""
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
    extra: dict[str, Any] | None = None,
) -> Column:
    """Return the description of a coordinate. By default its dimension has the same name."""
    return Column(name, dims or (name,), dtype, when, long_name, units, True, extra or {}, comment)


def base_columns(axes: int = 2) -> list[Column]:
    """Return the columns of every dataset, on a lattice with `axes` axes."""
    each, on, number = ("particle",), When.RECORD, "number of the particle"
    by_site, timing = (
        "counted from 1, by site: i, then j",
        "during the step; at time 0 during step 1",
    )
    outside = "corners of cells that the outline cuts may not; stress and strain are NaN there"
    kinds = _flags({"leader": LEADER, "follower": FOLLOWER, "frame": FRAME})
    roles = _flags({"body": OF_BODY, "frame": OF_FRAME})
    return [
        coordinate("time", "time", when=on, units=STEP),
        coordinate("particle", number, comment=by_site),
        coordinate("number", number, dims=each, comment=by_site),
        *(coordinate(name, f"site index {name}", "i4", each) for name in INDICES[:axes]),
        coordinate("role", "role of the particle", "i1", each, extra=roles),
        coordinate("inside", "inside the outline", "bool", each, comment=outside),
        coordinate("axis", "axis", "str"),
        coordinate("site", "site indices", "i4", (*each, "index")),
        coordinate("reference", "reference position", "f8", (*each, "axis"), units=LENGTH.lattice),
        *(
            coordinate(name, f"reference position {name}", "f8", each, units=LENGTH.lattice)
            for name in PLACES[:axes]
        ),
        Column("position", ("time", *each, "axis"), "f8", on, "position", LENGTH.lattice),
        Column(
            "kind", ("time", *each), "i1", on, "kind of the particle", extra=kinds, comment=timing
        ),
    ]


def _flags(meanings: dict[str, Any]) -> dict[str, Any]:
    """Return the CF attributes of a variable that contains integer codes."""
    values = np.array([*meanings.values()], np.int8)
    return {"flag_values": values, "flag_meanings": " ".join(meanings)}


def optional_columns() -> list[list[Column]]:
    """Return the columns that depend on the experiment, but not on its diagnostics. These are the
    columns of the table of bonds, with the step in which each bond broke, and two kinds of
    coordinates: the coordinate of quantities that are measured at every step, and the coordinates
    of leader groups, loads, obstacles and principal values. Further columns are the quantities of
    a branch that is followed by a control: the load factor, the dissipated energy and the
    opening."""
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
        [
            Column(
                "load_factor",
                ("time",),
                "f8",
                When.RECORD,
                "load factor",
                "1",
                comment="factor of the loads and prescribed displacements of the last step",
            ),
            Column(
                "dissipated_energy",
                ("time",),
                "f8",
                When.RECORD,
                "dissipated energy",
                AREA.lattice,
                comment="in lattice units it is divided by Young's modulus and thickness",
            ),
        ],
        [Column("opening", ("time",), "f8", When.RECORD, "opening", LENGTH.lattice)],
    ]


def reserved_names() -> set[str]:
    """Return the names of variables and dimensions that diagnostics cannot use."""
    ours = chain(base_columns(len(INDICES)), *optional_columns())
    return {name for column in ours for name in (column.name, *column.dims)}


def remembered_column(number: Remembered, owner: str, part_renews: bool) -> Column:
    """Return the column of a state variable that a component declares for each `owner` (bond or
    particle)."""
    grows = number.changes and part_renews
    dims, when = (("time", owner), When.RECORD) if grows else ((owner,), When.START)
    return Column(number.name, dims, number.dtype, when, number.long_name, number.units)


def when_measured(diagnostic: Diagnostic | type[Diagnostic]) -> When:
    """Return the time at which a diagnostic is evaluated."""
    if diagnostic.at_end:
        return When.END
    return When.STEP if diagnostic.every_step else When.RECORD


def diagnostic_column(variable: Variable, diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """Return the column of a variable of a diagnostic. Its first dimension is determined by the
    time of measurement."""
    when = when_measured(diagnostic)
    dims = (*{When.STEP: ["step"], When.RECORD: ["time"]}.get(when, []), *variable.dims)
    description = variable.long_name, variable.units, False, variable.attributes
    return Column(variable.name, dims, variable.dtype, when, *description)


def own_coordinate(diagnostic: Diagnostic | type[Diagnostic]) -> Column:
    """Return the coordinate of a dimension with a length that is known only at the end."""
    name = diagnostic.own_dimension
    return coordinate(name, name.replace("_", " "), when=When.END, comment="counted from 1")


def dataset_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """Return the JSON Schema of datasets, in the form of ``xarray.Dataset.to_dict(data=False)``."""
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


def diagnostics_that_provide(names: set[str]) -> list[str]:
    """Return the built-in diagnostics that provide a variable with one of these names, or with a
    name that begins with one of them and `_`. They are returned as they are written in
    experiments."""
    prefixes = tuple(f"{name}_" for name in names if name)
    spellings = []
    for each, types in Registry().spellings(Diagnostic, installed=False).items():
        variables = [column.name for column in _columns_of(each)]
        if any(name in names or name.startswith(prefixes) for name in variables):
            fields = each.model_fields.items()  # The modulus may be given by `units`.
            required = [n for n, part in fields if part.is_required() or n == "youngs_modulus"]
            spellings.append(
                f"{{{', '.join([f'type: {types[0]}', *(f'{n}: ...' for n in required)])}}}"
            )
    return spellings


def _columns_of(diagnostic: type[Component]) -> list[Column]:
    """Return the columns of a diagnostic with unset parameters. If the variables of the diagnostic
    depend on parameters or cannot be determined, the list is empty, and the schema does not
    constrain these variables."""
    assert issubclass(diagnostic, Diagnostic)
    with suppress(Exception):  # Code of a plugin that the user has not selected must not fail here.
        variables = diagnostic.model_construct(type="").variables()
        columns = [diagnostic_column(v, diagnostic) for v in variables]
        json.dumps([_schema_of(column) for column in columns])
        return columns
    return []


def _schema_of(column: Column) -> dict[str, Any]:
    scalars = {k: v for k, v in column.attributes.items() if not isinstance(v, np.ndarray)}
    attributes = {name: {"const": value} for name, value in scalars.items()}
    if (quantity := QUANTITIES.get(column.units)) and quantity.youngs_modulus:
        attributes["units"] = {"enum": [column.units, quantity.unit]}
    parts = {"dims": {"const": list(column.dims)}, "attrs": _object(attributes, sorted(attributes))}
    if column.dtype != "str":
        name = np.dtype(column.dtype).name
        fractions = {"enum": [name, "float64"]}
        parts["dtype"] = fractions if column.name in TIMES else {"const": name}
    description = {"description": f"{column.long_name}; written {column.when.value}"}
    return description | _object(parts, ["dims", "attrs", "dtype"])


def _object(properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"type": "object", "required": required, "properties": properties}


def refuse_no_dataset(candidate: Any) -> None:
    """Raise ExperimentError if the argument is not a dataset but, for instance, a file."""
    if not hasattr(candidate, "data_vars"):
        opening = f"pbdkit.open({str(candidate)!r})" if isinstance(candidate, str | Path) else ""
        raise ExperimentError(
            f"expected a dataset of pbdkit, got an object of type {type(candidate).__name__}; "
            f"{opening or 'pbdkit.open(file)'} returns that of a file, pbdkit.run(...) a new one"
        )


def in_this_layout(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset in the current layout. Older datasets do not contain the indices and roles
    of particles and the components of their reference positions, and identify the particles of a
    bond by an index that begins at 0 instead of the particle number. In the converted dataset all
    particles of the body count as lying inside its outline.

    Diagnostics are not changed: at frame points they remain 0, although they are NaN in the current
    layout. Raises ExperimentError if the argument is not a dataset.
    """
    refuse_no_dataset(dataset)
    variables, dims = dataset.variables, {name: v.dims for name, v in dataset.variables.items()}
    new: dict[str, Any] = {}
    if dims.get("site") == ("particle", "index") and "i" not in variables:
        axes = zip(INDICES, range(dataset.sizes["index"]), strict=False)
        new |= {name: variables["site"].isel(index=n) for name, n in axes}
    if "particle" in dims.get("kind", ()) and "role" not in variables:
        frame = variables["kind"].isel(time=0, missing_dims="ignore") == FRAME
        new["role"] = frame.copy(data=np.where(frame, OF_FRAME, OF_BODY))
    role = new.get("role", variables.get("role"))
    if role is not None and "inside" not in variables:
        new["inside"] = (role.dims, role.values == OF_BODY)
    if dims.get("reference") == ("particle", "axis") and "X" not in variables:
        axes = zip(PLACES, range(dataset.sizes["axis"]), strict=False)
        new |= {name: variables["reference"].isel(axis=n) for name, n in axes}
    if dims.get("bond") == ("bond", "end"):
        new["bond_ends"] = variables["bond"] + 1
        places = {"crack_bond": variables["crack_bond"] + 1} if "crack_bond" in variables else {}
        counted = ("bond", "crack") if places else ("bond",)
        new |= places | {dim: (dim, np.arange(1, dataset.sizes[dim] + 1)) for dim in counted}
    return _described(dataset, new) if new else dataset


def _described(dataset: xarray.Dataset, new: dict[str, Any]) -> xarray.Dataset:
    """Add new variables to a dataset, and set the current attributes of all variables."""
    dataset = dataset.assign(new)
    crack = (diagnostic_column(v, CrackPath) for v in CrackPath().variables())
    layout_columns = chain(base_columns(len(INDICES)), *optional_columns(), crack)
    columns = [
        c for c in (*layout_columns, own_coordinate(CrackPath)) if c.name in dataset.variables
    ]
    for column in columns:
        if column.name in new:
            dataset[column.name] = dataset[column.name].astype(column.dtype).drop_encoding()
        dataset[column.name].attrs |= column.attributes
    return dataset.set_coords([column.name for column in columns if column.coordinate])


PRINCIPAL = "_principal"
"""Ending of the names of variables that contain both principal values of plane tensors."""


def with_principal_values(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset with a variable for each principal value: `stress_1`, the larger one, and
    `stress_2`, the smaller one, of `stress_principal`. Values are not read."""
    new: dict[str, Any] = {}
    for name, both in dataset.variables.items():
        if not str(name).endswith(PRINCIPAL) or "principal" not in both.dims:
            continue
        for k, size in enumerate(("larger", "smaller")):
            value = both.isel(principal=k)
            value.attrs |= {"long_name": f"{size} {both.attrs.get('long_name', name)}"}
            new.setdefault(f"{str(name).removesuffix(PRINCIPAL)}_{k + 1}", value)
    return dataset.assign({name: v for name, v in new.items() if name not in dataset.variables})


def json_attribute(dataset: xarray.Dataset, attribute: str) -> dict[str, Any]:
    """Return the mapping that an attribute contains as JSON. In one member of a sweep, a scalar
    coordinate replaces the attribute. The result is empty if there is neither. Raises StorageError
    if the text is damaged."""
    coordinate = dataset.coords.get(attribute)
    text = "{}" if coordinate is None or coordinate.ndim else coordinate.item()
    try:
        content = json.loads(dataset.attrs.get(attribute, text))
    except (ValueError, TypeError, RecursionError) as error:
        raise StorageError(f"its attribute '{attribute}' is damaged: {error}") from None
    if not isinstance(content, dict):
        raise StorageError(f"its attribute '{attribute}' is damaged: it is not a map of keys")
    return content


def scene_of(dataset: xarray.Dataset, what: str) -> Scene:
    """Build the scene of the run that made a dataset. `what` is the operation that needs the scene,
    for messages.

    Raises ExperimentError if the scene cannot be built, for example because a component does not
    exist any more.
    """
    refuse_retired(json_attribute(dataset, "experiment"), what)
    return build_scene(experiment_of(dataset))


def experiment_of(
    dataset: xarray.Dataset, components: Iterable[type[Component]] = ()
) -> Experiment:
    """Build the experiment of a dataset. Raises ExperimentError if the dataset contains no
    experiment, or if the experiment needs components that are not available."""
    refuse_no_dataset(dataset)
    parts = json_attribute(dataset, "experiment")
    if not parts:
        raise ExperimentError("the dataset contains no experiment: it was not written by pbdkit")
    source = Source("dataset", parts)
    try:
        return Experiment.build(source, components)
    except ExperimentError as error:
        sources = json_attribute(dataset, "plugins").get(GIVEN)
        if sources is None or components:
            raise
        raise ExperimentError(f"{error}; it was run with components=[...]: {sources}") from None


def indices_of(dataset: xarray.Dataset) -> list[str]:
    """Return the names of the lattice indices by which particles can be selected."""
    variables = dataset.variables
    return [name for name in INDICES if name in variables and variables[name].dims == ("particle",)]


MATCHINGS = ("number", "site")
"""Properties by which the particles of several datasets are matched."""


def refuse_unknown_matching(by: str) -> None:
    """Raise ExperimentError if the property is not one of MATCHINGS."""
    if by not in MATCHINGS:
        raise ExperimentError(f"by: expected 'number' or 'site', got {by!r}")


def site_keys(dataset: xarray.Dataset) -> Array:
    """Return one integer for each particle, (particle,), which is unique for its site (i, j).

    Raises ExperimentError if the dataset contains no site indices.
    """
    names = indices_of(dataset)
    if len(names) < 2:
        raise ExperimentError("the particles of a dataset have no site indices i and j")
    i, j = (dataset.variables[name].values.astype(np.int64) for name in names[:2])
    return np.asarray((i << 32) + j)


def rows_at(dataset: xarray.Dataset, index: Mapping[str, int]) -> Array:
    """Return the rows of the particles at the given lattice indices. Raises ExperimentError if
    there is no such particle, or if the name of an index is unknown."""
    names = indices_of(dataset)
    matches = np.ones(dataset.sizes.get("particle", 0), np.bool_)
    for name, value in index.items():
        if name not in names:
            raise ExperimentError(
                f"particles of this dataset are selected by {names}, not by '{name}'"
            )
        matches &= dataset.variables[name].values == value
    if not matches.any():
        place = ", ".join(f"{name}={value}" for name, value in index.items())
        raise ExperimentError(f"there is no particle at {place}")
    return np.flatnonzero(matches)


def rows_of(numbers: Array, wanted: Array) -> Array:
    """Return the rows of the particles with the wanted numbers, and -1 for numbers that do not
    occur."""
    integers = np.nan_to_num(wanted, nan=-1.0).astype(np.int64)
    last = len(numbers)
    if last and numbers[0] == 1 and numbers[-1] == last:  # Most datasets contain all particles.
        return np.where(integers <= last, integers - 1, -1)
    if not last:
        return np.full(integers.shape, -1)
    order = np.argsort(numbers)
    at = order[np.searchsorted(numbers[order], integers).clip(max=last - 1)]
    return np.where(numbers[at] == integers, at, -1)
