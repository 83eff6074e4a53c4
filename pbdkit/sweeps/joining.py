"""The members' variables put together: one dataset with the parameters as dimensions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.scene.sizes import machine_memory
from pbdkit.sweeps.content import Variable, unpacked
from pbdkit.sweeps.grid import MESSAGE, STATUS, Dimension
from pbdkit.sweeps.member import Member
from pbdkit.sweeps.worker import WHOLE, Report

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
        if report.status in WHOLE:
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
    along = {n: (d.name, values) for d in grid for n, values in d.coordinates.items()}
    return xarray.Dataset(variables, along).set_coords(frame.coordinates)


class _Frame:
    """What the variables of all members come to: labels along each dimension, and which variables
    differ from member to member."""

    def __init__(self) -> None:
        self._first: dict[str, Variable] = {}
        self._labels: dict[str, dict[Any, None]] = {}
        self._sizes: dict[str, int] = {}
        self._digests: dict[str, set[bytes]] = {}
        self._holders: dict[str, int] = {}
        self._members = 0
        self.described: list[tuple[str, tuple[str, ...], dict[str, Any]]] = []

    def look(self, variables: dict[str, Variable]) -> None:
        """At the variables of one more member."""
        self._members += 1
        for name, variable in variables.items():
            self._first.setdefault(name, variable)
            self._holders[name] = self._holders.get(name, 0) + 1
            for dim, size in zip(variable.dims, variable.values.shape, strict=True):
                self._sizes[dim] = max(size, self._sizes.get(dim, 0))
            if variable.dims == (name,):
                labels = self._labels.setdefault(name, {})
                labels |= dict.fromkeys(variable.values.tolist())
            if variable.fixed:
                digest = xxhash.xxh3_128_digest(np.ascontiguousarray(variable.values).tobytes())
                own = [digest, *(_digest(variables[d]) for d in variable.dims if d in variables)]
                self._digests.setdefault(name, set()).add(b"".join(own))

    @property
    def coordinates(self) -> list[str]:
        """The names of the runs' coordinates."""
        return [name for name, variable in self._first.items() if variable.coordinate]

    def arrays(self, shape: tuple[int, ...], dims: tuple[str, ...]) -> dict[str, Array]:
        """Empty ones of each variable. Raises ExperimentError where they do not fit into memory."""
        for name, labels in self._labels.items():
            ordered = sorted(labels) if self._first[name].values.dtype.kind in "iuf" else labels
            self._labels[name] = dict.fromkeys(ordered)
            self._sizes[name] = len(labels)
        shapes = {}
        for name, variable in self._first.items():
            own = tuple(self._sizes[dim] for dim in variable.dims)
            varies = self._varies(name)
            shapes[name] = (*shape, *own) if varies else own
            filled = {FILL: _empty(variable.values.dtype)} if varies and _whole(variable) else {}
            all_dims = (*dims, *variable.dims) if varies else variable.dims
            self.described.append((name, all_dims, variable.attributes | filled))
        items = (int(np.prod(s, dtype=object)) * self._first[n].values.dtype.itemsize
                 for n, s in shapes.items())  # fmt: skip
        if (size := sum(items)) > machine_memory():
            raise ExperimentError(
                f"the dataset of all members takes {size / 2**30:.3g} GiB, more than this machine "
                "has; keep fewer variables or times, with which members run again"
            )
        arrays = {
            name: np.full(s, _empty(self._first[name].values.dtype), self._first[name].values.dtype)
            for name, s in shapes.items()
        }
        return arrays | {n: np.array(list(labels)) for n, labels in self._labels.items()}

    def place(
        self, variables: dict[str, Variable], where: tuple[int, ...], arrays: dict[str, Array]
    ) -> None:
        """Puts the variables of one member to where they belong."""
        along = {name: self._positions(name, variables) for name in self._labels}
        for name, (dims, values, *_) in variables.items():
            if name in self._labels:
                continue
            rows = [along.get(d, np.arange(n)) for d, n in zip(dims, values.shape, strict=True)]
            target = arrays[name][where] if self._varies(name) else arrays[name]
            if dims:
                target[np.ix_(*rows)] = values
            else:
                arrays[name][where if self._varies(name) else ()] = values

    def _positions(self, name: str, variables: dict[str, Variable]) -> Array:
        if name not in variables:
            return np.zeros(0, int)
        place = {label: n for n, label in enumerate(self._labels[name])}
        return np.array([place[label] for label in variables[name].values.tolist()], int)

    def _varies(self, name: str) -> bool:
        """Whether each member has values of its own; labels of a dimension are joined instead."""
        alike = len(self._digests.get(name, ())) == 1 and self._holders[name] == self._members
        return name not in self._labels and not alike


def _digest(variable: Variable) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(variable.values).tobytes())


def _whole(variable: Variable) -> bool:
    return variable.values.dtype.kind in "iu"


def _empty(dtype: np.dtype[Any]) -> Any:
    """What stands where a member has nothing."""
    if dtype.kind == "f":
        return np.nan
    if dtype.kind in "iu":
        return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return np.zeros((), dtype)[()]
