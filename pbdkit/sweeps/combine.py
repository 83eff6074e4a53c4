"""Combine the results of runs, or of the members of a sweep, into one dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import prod
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xxhash

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError
from pbdkit.io.layout import (
    in_this_layout,
    indices_of,
    json_attribute,
    refuse_unknown_matching,
    reserved_names,
)
from pbdkit.io.members import FILL, STATUS
from pbdkit.memory import machine_memory
from pbdkit.sweeps.specification import MESSAGE, Dimension, Member, names_of, values_along
from pbdkit.sweeps.worker import STORED_STATUSES, MemberReport, MemberVariable, unpacked

if TYPE_CHECKING:
    import xarray


def concat(
    runs: Iterable[xarray.Dataset],
    dim: str = "run",
    *,
    by: Literal["number", "site"] = "number",
) -> xarray.Dataset:
    """Combine datasets of single runs along a new dimension.

    Parameters
    ----------
    runs : iterable of xarray.Dataset
        Results of single runs.
    dim : str
        Name of the new dimension.
    by : {"number", "site"}
        Align particles by number, or by site indices (i, j), for bodies of different shape. With
        "site" the dataset contains every site of any run, counted by `particle`; `number` is that
        in each run, and variables of bonds are omitted, because bonds are numbered by particles.

    Returns
    -------
    xarray.Dataset
        All runs along the dimension `dim`. Each parameter in which the experiments differ is a
        coordinate along this dimension, with the same name as in a sweep. Each attribute that
        differs is a coordinate too, so that a single run can be repeated, as by
        ``pbdkit.rerun(whole.isel(run=0))``. Variables that do not change during a run, usually
        `reference`, are included once if all runs have the same values. All other variables are
        aligned by their labels, with NaN for missing values.

    Raises
    ------
    ExperimentError
        If there are no runs, if a dataset has no experiment or, with "site", no site indices, or
        if `dim` is the name of a variable or a dimension of a dataset.

    Examples
    --------
    >>> runs = [
    ...     pbdkit.run("paper/a", settings={"steps": 20, "seed": seed}, progress=False)
    ...     for seed in (1, 2)
    ... ]
    >>> pbdkit.concat(runs).sizes["run"]
    2
    """
    import xarray

    if hasattr(runs, "data_vars"):
        raise ExperimentError("concat: expected a list of datasets, got one; write concat([a, b])")
    datasets = [in_this_layout(run) for run in runs]
    experiments = [json_attribute(run, "experiment") for run in datasets]
    if not all(experiments) or not datasets:
        fault = "a dataset has no experiment" if datasets else "there are no runs"
        raise ExperimentError(f"{fault}: only results of pbdkit can be combined")
    if any(dim in run.variables or dim in run.dims for run in datasets):
        raise ExperimentError(f"the runs have a variable or dimension '{dim}'; choose another name")
    refuse_unknown_matching(by)
    if by == "site":
        datasets = [_by_site(run) for run in datasets]
    options: dict[str, Any] = {"data_vars": "all", "coords": "different", "compat": "equals"}
    combined = xarray.concat(datasets, dim, join="outer", combine_attrs="drop_conflicts", **options)
    if by == "site":
        combined = _numbered(_shared(combined, dim, datasets[0]))
    parameters = dict(_differences(experiments))
    attributes = {
        name: [str(run.attrs.get(name, "")) for run in datasets] for name in _attributes(datasets)
    }
    reserved = {
        dim,
        *map(str, combined.variables),
        *map(str, combined.dims),
        *attributes,
        *reserved_names(),
    }
    names = names_of([*parameters], reserved)
    coordinates: dict[str, Any] = {n: (dim, values) for n, values in attributes.items()}
    for path, values in parameters.items():
        coordinates[names[path]] = (dim, values_along(_numbers(values)), {"long_name": path})
    return combined.assign_coords(coordinates)


def _by_site(run: xarray.Dataset) -> xarray.Dataset:
    """Return a dataset without bonds, with particles indexed by their sites."""
    if len(indices_of(run)) < 2:
        raise ExperimentError("the particles of a dataset have no site indices i and j")
    plain = run.drop_dims(["bond", "crack"], errors="ignore").drop_vars("particle")
    return plain.set_index(particle=["i", "j"])


def _shared(combined: xarray.Dataset, dim: str, run: xarray.Dataset) -> xarray.Dataset:
    """Store coordinates of particles once if they are equal in all runs that have the particle."""
    shared = {}
    for name, variable in combined.coords.items():
        if {dim, "particle"} <= {*variable.dims} and variable.dtype.kind == "f":
            least, largest = variable.min(dim), variable.max(dim)
            if (least == largest).all():
                shared[name] = largest.variable.astype(run[name].dtype)
                shared[name].attrs = run[name].attrs
    return combined.assign_coords(shared)


def _numbered(combined: xarray.Dataset) -> xarray.Dataset:
    """Replace the index of sites by the number of the particle."""
    numbers = np.arange(1, combined.sizes["particle"] + 1)
    return combined.reset_index("particle").assign_coords(particle=numbers)


def _differences(parts: list[Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, list[Any]]]:
    """Yield the path of each difference between parts, with the value in every part.

    Parts are compared recursively as far as their structures agree. If the types of a part differ,
    the path is that of the part.
    """
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
    """Replace missing values by NaN if all other values are numbers."""
    are_numbers = all(value is None or type(value) in (int, float) for value in values)
    return tuple(np.nan if value is None and are_numbers else value for value in values)


def _attributes(runs: list[xarray.Dataset]) -> list[str]:
    """Return the names of attributes that differ between runs."""
    names = dict.fromkeys(str(name) for run in runs for name in run.attrs)
    return [name for name in names if len({str(run.attrs.get(name)) for run in runs}) > 1]


Reports = Callable[[str], MemberReport]


def combine_members(
    grid: list[Dimension], members: Iterable[Member], report_of: Reports
) -> xarray.Dataset:
    """Combine the results of members into a dataset without attributes.

    Values are aligned by time, particle number and the labels of all other dimensions. Missing
    values are NaN; missing integers are the fill value. Variables that have their values before the
    first step and are equal in all members are included once.

    Raises
    ------
    ExperimentError
        If the dataset does not fit into memory.
    """
    import xarray

    shape, dims = tuple(len(d.settings) for d in grid), tuple(d.name for d in grid)
    status, message = np.full(shape, "", object), np.full(shape, "", object)
    frame, complete = _Layout(), []
    for member in members:
        report = report_of(member.job.key)
        status[member.place], message[member.place] = report.status, report.message
        if report.status in STORED_STATUSES:
            frame.look(unpacked(report.content))
            complete.append(member)
    arrays = frame.arrays(shape, dims)
    for member in complete:
        frame.place(unpacked(report_of(member.job.key).content), member.place, arrays)
    variables: dict[str, Any] = {
        STATUS: (dims, status.astype(str), {"long_name": "status of the member"}),
        MESSAGE: (dims, message.astype(str), {"long_name": "error or warnings of the member"}),
    }
    variables |= {name: (ds, arrays[name], attributes) for name, ds, attributes in frame.described}
    coordinates = {
        n: (d.name, *coordinate) for d in grid for n, coordinate in d.coordinates.items()
    }
    return xarray.Dataset(variables, coordinates).set_coords(frame.coordinates)


class _Layout:
    """Layout of the variables of all members.

    It contains the labels of each dimension, and the variables that differ between members.
    """

    def __init__(self) -> None:
        self._first: dict[str, MemberVariable] = {}
        self._dtypes: dict[str, np.dtype[Any]] = {}
        self._labels: dict[str, dict[Any, int]] = {}
        self._sizes: dict[str, int] = {}
        self._digests: dict[str, list[bytes]] = {}
        self._members = 0
        self.described: list[tuple[str, tuple[str, ...], dict[str, Any]]] = []

    def look(self, variables: dict[str, MemberVariable]) -> None:
        """Include the variables of another member.

        Raises
        ------
        ExperimentError
            If a variable has other dimensions than in another member.
        """
        self._members += 1
        for name, variable in variables.items():
            first, dtype = self._first.setdefault(name, variable), variable.values.dtype
            for key in [
                attribute
                for attribute in first.attributes
                if not _same_attribute(attribute, first, variable)
            ]:
                del first.attributes[key]  # The attribute is not the same in all members.
            if variable.dims != first.dims:
                raise ExperimentError(
                    f"'{name}' has the dimensions {variable.dims} in some members and {first.dims} "
                    "in others, and cannot be combined; list other variables in keep.variables"
                )
            self._dtypes[name] = np.promote_types(dtype, self._dtypes.get(name, dtype))
            for dim, size in zip(variable.dims, variable.values.shape, strict=True):
                self._sizes[dim] = max(size, self._sizes.get(dim, 0))
            if variable.dims == (name,):
                self._labels.setdefault(name, {}).update(dict.fromkeys(variable.values.tolist(), 0))
            if variable.fixed:
                labels = (variables[dim] for dim in variable.dims if dim in variables)
                digest = b"".join(map(_digest, (variable, *labels)))
                self._digests.setdefault(name, []).append(digest)

    @property
    def coordinates(self) -> list[str]:
        """Return the names of the variables that are coordinates."""
        return [name for name, variable in self._first.items() if variable.coordinate]

    def arrays(self, shape: tuple[int, ...], dims: tuple[str, ...]) -> dict[str, Array]:
        """Return an array of missing values for each variable, and the labels of its dimensions.

        Raises
        ------
        ExperimentError
            If the arrays do not fit into memory.
        """
        for name, labels in self._labels.items():
            ordered = sorted(labels) if self._dtypes[name].kind in "iuf" else labels
            self._labels[name] = {label: n for n, label in enumerate(ordered)}
            self._sizes[name] = len(labels)
        shapes: dict[str, tuple[int, ...]] = {}
        for name, variable in self._first.items():
            varies, dtype = self._varies(name), self._dtypes[name]
            inner = tuple(self._sizes[dim] for dim in variable.dims)
            shapes[name] = (*shape, *inner) if varies else inner
            fill = {FILL: _empty(dtype)} if varies and dtype.kind in "iu" else {}
            all_dims = (*dims, *variable.dims) if varies else variable.dims
            self.described.append((name, all_dims, variable.attributes | fill))
        size = sum(
            prod(array_shape) * self._dtypes[name].itemsize for name, array_shape in shapes.items()
        )
        if size > machine_memory():
            raise ExperimentError(
                f"the dataset of all members takes {size / 2**30:.3g} GiB, more than the "
                "memory of this machine; keep fewer variables or times (members then run again)"
            )
        kinds = self._dtypes
        arrays = {
            n: np.full(array_shape, _empty(kinds[n]), kinds[n]) for n, array_shape in shapes.items()
        }
        return arrays | {name: np.array(list(labels)) for name, labels in self._labels.items()}

    def place(
        self, variables: dict[str, MemberVariable], where: tuple[int, ...], arrays: dict[str, Array]
    ) -> None:
        """Copy the variables of one member to their places."""
        rows_of = {
            name: np.array([numbers[label] for label in variables[name].values.tolist()], int)
            for name, numbers in self._labels.items()
            if name in variables
        }
        for name, (dims, values, *_) in variables.items():
            if name not in self._labels:
                # The index has an ellipsis, so that the result is always a view.
                target: Any = (*where, ...) if self._varies(name) else ...
                rows = [
                    rows_of.get(dim, np.arange(n))
                    for dim, n in zip(dims, values.shape, strict=True)
                ]
                arrays[name][target][np.ix_(*rows) if dims else ...] = values

    def _varies(self, name: str) -> bool:
        """Return whether members have separate values of a variable.

        Labels of a dimension are merged and have no separate values.
        """
        digests = self._digests.get(name, [])
        is_constant = len(set(digests)) == 1 and len(digests) == self._members
        return name not in self._labels and not is_constant


def _same_attribute(name: str, first: MemberVariable, other: MemberVariable) -> bool:
    return name in other.attributes and np.array_equal(
        first.attributes[name], other.attributes[name]
    )


def _digest(variable: MemberVariable) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(variable.values).tobytes())


def _empty(dtype: np.dtype[Any]) -> Any:
    """Return the value of missing entries."""
    if dtype.kind == "f":
        return np.nan
    if dtype.kind in "iu":
        return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return np.zeros((), dtype)[()]
