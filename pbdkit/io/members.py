"""Selection of one member of a sweep in its dataset, by the parameters of the member."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.io.layout import json_attribute
from pbdkit.model.reading import Source, with_value

if TYPE_CHECKING:
    import xarray

SWEEP = "sweep"
"""Attribute that identifies datasets of sweeps."""
STATUS = "status"
"""Variable with the status of each member."""
TEXT = "_text"
"""Suffix of the name of a coordinate that contains the values of a parameter as text. It is used if
the coordinate of the dimension itself contains only their numbers."""
PARAMETER = "parameter"
"""Attribute of a coordinate that contains the path of its parameter in the experiment."""
FILL = "fill_value"
"""Name of the attribute with the value that replaces missing integers."""
MAX_SHOWN = 6
"""Maximum number of values in messages."""


def type_alone(text: str) -> str:
    """Return the type of a component that is given as JSON without parameters. Any other text is
    returned unchanged."""
    with suppress(ValueError, RecursionError):
        part = json.loads(text)
        if isinstance(part, dict) and part.keys() == {"type"}:
            return str(part["type"])
    return text


def member(dataset: xarray.Dataset, choice: Mapping[str, Any]) -> xarray.Dataset:
    """Return the part of a sweep in which parameters have the chosen values.

    If every parameter is given, the result is a single member. It then has the experiment of this
    member as an attribute, and its title contains the choice. Its dimensions are those of a single
    run, without the particles, bonds and other objects that only other members have.

    Parameters
    ----------
    dataset : xarray.Dataset
        The dataset of a sweep.
    choice : mapping
        Values by the names of parameters. A value is a number, a text with a number and its unit,
        or text such as the `type` of a part.

    Raises
    ------
    ExperimentError
        If the dataset is the result of a single run, if a name is not the name of a parameter, or
        if no member has the value.
    """
    if SWEEP not in dataset.attrs:
        raise ExperimentError(
            f"{', '.join(choice)}: cannot be selected, since this is the result of one run; omit it"
        )
    indices: dict[str, int] = {}
    for name, value in choice.items():
        dim, row = _place(dataset, name, value)
        if indices.setdefault(dim, row) != row:
            raise ExperimentError(
                f"{name}={value}: no member has this value together with the other ones"
            )
    selection = dataset.isel(indices)
    words = ", ".join(f"{name}={value}" for name, value in choice.items())
    title = f"{dataset.attrs.get('title', 'sweep')}, {words}"
    selection = selection.assign_attrs(title=title) if choice else selection
    return selection if selection[STATUS].ndim else with_experiment(selection)


def choices(dataset: xarray.Dataset) -> str:
    """Return the parameters and their values as text: ``steel: 1, 2, 3; rule: barycentre``."""
    parts = []
    for dim in map(str, dataset[STATUS].dims):
        words = [_word(value) for value in _labels(dataset, dim)[:MAX_SHOWN]]
        ellipsis = ", ..." if dataset.sizes[dim] > MAX_SHOWN else ""
        parts.append(f"{dim}: {', '.join(words)}{ellipsis}{_after_space(unit_of(dataset, dim))}")
    return "; ".join(parts)


def _labels(dataset: xarray.Dataset, name: str) -> NDArray[Any]:
    """Return the labels along a dimension. These are the values of the coordinate with texts if
    there is one, otherwise those of the coordinate of the dimension, or else the indices."""
    for label in (f"{name}{TEXT}", name):
        if label in dataset.coords:
            return np.asarray(dataset[label].values)
    return np.arange(dataset.sizes[name])


def unit_of(dataset: xarray.Dataset, name: str) -> str:
    """Return the unit of the labels along a dimension; empty if there is none."""
    units = str(dataset[name].attrs.get("units", "1")) if name in dataset.coords else "1"
    has_unit = units != "1" and f"{name}{TEXT}" not in dataset.coords
    return units if has_unit else ""


def _after_space(unit: str) -> str:
    return f" {unit}" if unit else ""


def _word(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else type_alone(str(value))


def _place(dataset: xarray.Dataset, name: str, value: Any) -> tuple[str, int]:
    """Return the dimension of a parameter, and the index of the value along it."""
    grid = [str(dim) for dim in dataset[STATUS].dims]
    coordinates = {str(n): str(c.dims[0]) for n, c in dataset.coords.items() if c.ndim == 1}
    dims = {dim: dim for dim in grid} | {n: dim for n, dim in coordinates.items() if dim in grid}
    if name not in dims:
        hint = did_you_mean(name, dims)
        raise ExperimentError(
            f"{name}: is not a parameter of this sweep{hint} ({choices(dataset)})"
        )
    labels = _labels(dataset, name)
    number = _in_unit_of(dataset, name, value)
    rows = [row for row, label in enumerate(labels.tolist()) if _is_alike(label, number)]
    if not rows:
        near = ", ".join(map(_word, labels.tolist()[:MAX_SHOWN]))
        near += _after_space(unit_of(dataset, name))
        raise ExperimentError(f"{name}={value}: no member has this value; there are {near}")
    return dims[name], rows[0]


def _in_unit_of(dataset: xarray.Dataset, name: str, value: Any) -> Any:
    """Convert a text with a unit to a number in the unit of a parameter. Return any other value
    unchanged."""
    unit = unit_of(dataset, name)
    if not unit or not isinstance(value, str) or not value[-1:].isalpha():
        return value
    from pydantic_core import PydanticCustomError

    from pbdkit.plugin.units import QUANTITIES, Scales, magnitude

    experiment = json_attribute(dataset, SWEEP).get("experiment") or {}
    scales = Scales.model_validate({"units": experiment.get("units")}).units
    quantity = QUANTITIES.get(unit)
    try:
        if quantity is None or scales is None:
            return magnitude(value, unit, f"value in {unit}")
        return magnitude(value, quantity.unit, quantity.meaning) / scales.scale(quantity)
    except PydanticCustomError as error:
        raise ExperimentError(f"{name}={value}: {error.message()}") from None


def _is_alike(label: Any, value: Any) -> bool:
    if isinstance(label, str):
        return str(value) in (label, type_alone(label))
    with suppress(TypeError, ValueError):
        return bool(np.isclose(float(value), float(label), rtol=1e-6, atol=0.0))
    return False


def with_experiment(selection: xarray.Dataset) -> xarray.Dataset:
    """Return a member with its experiment. Times that only other members reached are removed."""
    from pbdkit.model.experiment import Experiment  # This import loads pydantic.

    source = Source(data=json_attribute(selection, SWEEP).get("experiment"))
    for name, coordinate in selection.coords.items():
        path = coordinate.attrs.get(PARAMETER)
        if path is None or coordinate.ndim or f"{name}{TEXT}" in selection.coords:
            continue
        value, units = coordinate.item(), str(coordinate.attrs.get("units", "1"))
        if isinstance(value, str):
            with suppress(ValueError):
                value = json.loads(value)
        written = f"{value!r} {units}" if units != "1" and "unit" not in units else value
        source = with_value(source, str(path), written, str(name), Experiment.defaults())
    growing = [
        n for n, v in selection.data_vars.items() if "time" in v.dims and v.dtype.kind == "f"
    ]
    run = selection.dropna("time", how="all", subset=growing) if growing else selection.copy()
    run = _without_padding(run)
    attributes = {name: value for name, value in selection.attrs.items() if name != SWEEP}
    run.attrs = attributes | {"experiment": json.dumps(source.data)}
    return run


def _without_padding(run: xarray.Dataset) -> xarray.Dataset:
    """Return a member without the labels of dimensions at which every variable is missing, because
    only other members have them. A member without a result is returned unchanged."""
    rows = {}
    for dim in {str(dim) for dim in run.dims} - {"time"}:
        present, has_evidence = np.zeros(run.sizes[dim], bool), False
        variables = [v for name, v in run.variables.items() if dim in v.dims and name != dim]
        for variable in sorted(variables, key=lambda v: v.size):
            if variable.dtype.kind not in "iuf" or present.all():
                continue
            values, has_evidence = np.moveaxis(variable.values, variable.dims.index(dim), 0), True
            is_float = values.dtype.kind == "f"
            exists = ~np.isnan(values) if is_float else values != variable.attrs.get(FILL)
            present |= exists.reshape(len(values), -1).any(axis=1)
        if has_evidence and not present.all():
            rows[dim] = np.flatnonzero(present)
    has_result = "particle" not in rows or len(rows["particle"])
    return run.isel(rows) if has_result else run
