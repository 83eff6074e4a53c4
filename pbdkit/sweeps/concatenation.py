"""Runs put side by side: one dataset, with what differs between them along a dimension."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.results.carried import carried
from pbdkit.results.layout import reserved_names
from pbdkit.results.older_layout import in_this_layout
from pbdkit.sweeps.grid import names_of, values_along

if TYPE_CHECKING:
    import xarray


def concat(runs: Iterable[xarray.Dataset], dim: str = "run") -> xarray.Dataset:
    """Datasets of single runs as one, along a new dimension.

    Every parameter in which their experiments differ is a coordinate along it, named as in a sweep;
    so is every attribute that differs, and ``pbdkit.rerun(whole.isel(run=0))`` works. What no run
    changes, as `reference` mostly, stands there once. All else is joined by its labels, with NaN
    where a run has nothing.

    Raises ExperimentError where there is no run, for a dataset that carries no experiment, and for
    a dimension that is taken.
    """
    import xarray

    if hasattr(runs, "data_vars"):
        raise ExperimentError("concat: expected a list of datasets, got one; write concat([a, b])")
    each = [in_this_layout(run) for run in runs]
    experiments = [carried(run, "experiment") for run in each]
    if not all(experiments) or not each:
        what = "a dataset carries no experiment" if each else "there is no run"
        raise ExperimentError(f"{what}: only runs of pbdkit can be put side by side")
    if any(dim in run.variables or dim in run.dims for run in each):
        raise ExperimentError(f"runs have a '{dim}' already; give the new dimension another name")
    how: dict[str, Any] = {"data_vars": "all", "coords": "different", "compat": "equals"}
    whole = xarray.concat(each, dim, join="outer", combine_attrs="drop_conflicts", **how)
    changed = dict(_differences(experiments))
    said = {name: [str(run.attrs.get(name, "")) for run in each] for name in _attributes(each)}
    taken = {dim, *map(str, whole.variables), *map(str, whole.dims), *said, *reserved_names()}
    names = names_of([*changed], taken)
    along: dict[str, Any] = {n: (dim, values) for n, values in said.items()}
    for path, values in changed.items():
        along[names[path]] = (dim, values_along(_numbers(values)), {"long_name": path})
    return whole.assign_coords(along)


def _differences(parts: list[Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, list[Any]]]:
    """The path of each place where parts differ, as deep as they are alike, with all values; the
    path of a `type` is that of its part."""
    if all(part == parts[0] for part in parts):
        return
    keys: Iterable[Any] = ()
    if all(isinstance(part, dict) for part in parts):
        keys = dict.fromkeys(key for part in parts for key in part)
    elif all(isinstance(part, list) and len(part) == len(parts[0]) for part in parts):
        keys = range(len(parts[0]))
    for key in keys:
        inner = [part.get(key) if isinstance(part, dict) else part[key] for part in parts]
        yield from _differences(inner, path if key == "type" else (*path, str(key)))
    if not keys:
        yield ".".join(path), parts


def _numbers(values: list[Any]) -> tuple[Any, ...]:
    """NaN for what a run does not have, where all others are numbers."""
    numbers = all(value is None or type(value) in (int, float) for value in values)
    return tuple(np.nan if value is None and numbers else value for value in values)


def _attributes(runs: list[xarray.Dataset]) -> list[str]:
    """Those that are not the same in all."""
    names = dict.fromkeys(str(name) for run in runs for name in run.attrs)
    return [name for name in names if len({str(run.attrs.get(name)) for run in runs}) > 1]
