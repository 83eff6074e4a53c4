"""Combine the results of runs, or of the members of a sweep, into one dataset with the parameters
as dimensions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.io.layout import carried, in_this_layout, reserved_names
from pbdkit.io.members import STATUS
from pbdkit.memory import machine_memory
from pbdkit.sweeps.specification import MESSAGE, Dimension, Member, names_of, values_along
from pbdkit.sweeps.worker import KEPT, MemberReport, MemberVariable, unpacked

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


Array = NDArray[Any]
Reports = Callable[[str], MemberReport]
FILL = "fill_value"
"""The attribute that says what stands in whole numbers where a member has none."""


def joined(grid: list[Dimension], members: Iterable[Member], report_of: Reports) -> xarray.Dataset:
    """The dataset without attributes. Values stand where their time, their number and the other
    labels of their dimensions say; elsewhere is NaN, or the fill value.

    What is known before the first step of a run, and the same in all, stands there once. Raises
    ExperimentError where the dataset does not fit into memory.
    """
    import xarray

    shape, dims = tuple(len(d.settings) for d in grid), tuple(d.name for d in grid)
    status, message = np.full(shape, "", object), np.full(shape, "", object)
    frame, whole = _Frame(), []
    for member in members:
        report = report_of(member.job.key)
        status[member.place], message[member.place] = report.status, report.message
        if report.status in KEPT:
            frame.look(unpacked(report.content))
            whole.append(member)
    arrays = frame.arrays(shape, dims)
    for member in whole:
        frame.place(unpacked(report_of(member.job.key).content), member.place, arrays)
    variables: dict[str, Any] = {
        STATUS: (dims, status.astype(str), {"long_name": "how the member ended"}),
        MESSAGE: (dims, message.astype(str), {"long_name": "why it failed, or what it warned of"}),
    }
    variables |= {name: (ds, arrays[name], attributes) for name, ds, attributes in frame.described}
    along = {n: (d.name, *one) for d in grid for n, one in d.coordinates.items()}
    return xarray.Dataset(variables, along).set_coords(frame.coordinates)


class _Frame:
    """What the variables of all members come to: labels along each dimension, and which variables
    differ from member to member."""

    def __init__(self) -> None:
        self._first: dict[str, MemberVariable] = {}
        self._dtypes: dict[str, np.dtype[Any]] = {}
        self._labels: dict[str, dict[Any, int]] = {}
        self._sizes: dict[str, int] = {}
        self._seen: dict[str, list[bytes]] = {}
        self._members = 0
        self.described: list[tuple[str, tuple[str, ...], dict[str, Any]]] = []

    def look(self, variables: dict[str, MemberVariable]) -> None:
        """At the variables of one more member. Raises ExperimentError where one of them has other
        dimensions than in another member."""
        self._members += 1
        for name, variable in variables.items():
            first, kind = self._first.setdefault(name, variable), variable.values.dtype
            for key in [k for k in first.attributes if not _alike(k, first, variable)]:
                del first.attributes[key]  # it does not hold of all
            if variable.dims != first.dims:
                raise ExperimentError(
                    f"'{name}' has the dimensions {variable.dims} in some members and {first.dims} "
                    "in others, and cannot be joined; list others in keep.variables"
                )
            self._dtypes[name] = np.promote_types(kind, self._dtypes.get(name, kind))
            for dim, size in zip(variable.dims, variable.values.shape, strict=True):
                self._sizes[dim] = max(size, self._sizes.get(dim, 0))
            if variable.dims == (name,):
                self._labels.setdefault(name, {}).update(dict.fromkeys(variable.values.tolist(), 0))
            if variable.fixed:
                along = (variables[dim] for dim in variable.dims if dim in variables)
                said = b"".join(map(_digest, (variable, *along)))
                self._seen.setdefault(name, []).append(said)

    @property
    def coordinates(self) -> list[str]:
        """The names of the runs' coordinates."""
        return [name for name, variable in self._first.items() if variable.coordinate]

    def arrays(self, shape: tuple[int, ...], dims: tuple[str, ...]) -> dict[str, Array]:
        """Empty ones of each variable, and the labels. Raises ExperimentError where they do not fit
        into memory."""
        for name, found in self._labels.items():
            ordered = sorted(found) if self._dtypes[name].kind in "iuf" else found
            self._labels[name] = {label: n for n, label in enumerate(ordered)}
            self._sizes[name] = len(found)
        shapes: dict[str, tuple[int, ...]] = {}
        for name, variable in self._first.items():
            varies, kind = self._varies(name), self._dtypes[name]
            own = tuple(self._sizes[dim] for dim in variable.dims)
            shapes[name] = (*shape, *own) if varies else own
            filled = {FILL: _empty(kind)} if varies and kind.kind in "iu" else {}
            named = (*dims, *variable.dims) if varies else variable.dims
            self.described.append((name, named, variable.attributes | filled))
        size = sum(prod(one) * self._dtypes[name].itemsize for name, one in shapes.items())
        if size > machine_memory():
            raise ExperimentError(
                f"the dataset of all members takes {size / 2**30:.3g} GiB, more than this machine "
                "has; keep fewer variables or times, with which members run again"
            )
        kinds = self._dtypes
        arrays = {n: np.full(one, _empty(kinds[n]), kinds[n]) for n, one in shapes.items()}
        return arrays | {name: np.array(list(found)) for name, found in self._labels.items()}

    def place(
        self, variables: dict[str, MemberVariable], where: tuple[int, ...], arrays: dict[str, Array]
    ) -> None:
        """Puts the variables of one member to where they belong."""
        along = {
            name: np.array([found[label] for label in variables[name].values.tolist()], int)
            for name, found in self._labels.items()
            if name in variables
        }
        for name, (dims, values, *_) in variables.items():
            if name not in self._labels:
                at: Any = (*where, ...) if self._varies(name) else ...  # a view, in any case
                rows = [along.get(d, np.arange(n)) for d, n in zip(dims, values.shape, strict=True)]
                arrays[name][at][np.ix_(*rows) if dims else ...] = values

    def _varies(self, name: str) -> bool:
        """Whether each member has values of its own; labels of a dimension are joined instead."""
        seen = self._seen.get(name, [])
        alike = len(set(seen)) == 1 and len(seen) == self._members
        return name not in self._labels and not alike


def _alike(said: str, one: MemberVariable, other: MemberVariable) -> bool:
    return said in other.attributes and np.array_equal(one.attributes[said], other.attributes[said])


def _digest(variable: MemberVariable) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(variable.values).tobytes())


def _empty(dtype: np.dtype[Any]) -> Any:
    """What stands where a member has nothing."""
    if dtype.kind == "f":
        return np.nan
    if dtype.kind in "iu":
        return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return np.zeros((), dtype)[()]
