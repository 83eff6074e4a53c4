"""The members' variables put together: one dataset with the parameters as dimensions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.resources.memory import machine_memory
from pbdkit.results.members import STATUS
from pbdkit.sweeps.content import Variable, unpacked
from pbdkit.sweeps.grid import MESSAGE, Dimension
from pbdkit.sweeps.member import Member
from pbdkit.sweeps.worker import KEPT, Report

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
Reports = Callable[[str], Report]
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
        self._first: dict[str, Variable] = {}
        self._dtypes: dict[str, np.dtype[Any]] = {}
        self._labels: dict[str, dict[Any, int]] = {}
        self._sizes: dict[str, int] = {}
        self._seen: dict[str, list[bytes]] = {}
        self._members = 0
        self.described: list[tuple[str, tuple[str, ...], dict[str, Any]]] = []

    def look(self, variables: dict[str, Variable]) -> None:
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
        self, variables: dict[str, Variable], where: tuple[int, ...], arrays: dict[str, Array]
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


def _alike(said: str, one: Variable, other: Variable) -> bool:
    return said in other.attributes and np.array_equal(one.attributes[said], other.attributes[said])


def _digest(variable: Variable) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(variable.values).tobytes())


def _empty(dtype: np.dtype[Any]) -> Any:
    """What stands where a member has nothing."""
    if dtype.kind == "f":
        return np.nan
    if dtype.kind in "iu":
        return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return np.zeros((), dtype)[()]
