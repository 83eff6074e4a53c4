"""Numbers that stand for whole members of a sweep: what its map can show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.pages.naming import factor_of, meaning_of, units_of
from pbdkit.pages.packing import packed
from pbdkit.results.members import STATUS
from pbdkit.sweeps.grid import MESSAGE
from pbdkit.sweeps.joining import FILL

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]


def _known(variable: xarray.DataArray) -> Array:
    """With NaN where a member has nothing."""
    values = np.asarray(variable.values, float)
    known = np.where(values == variable.attrs.get(FILL, np.nan), np.nan, values)
    return factor_of(variable) * known


def numbers(dataset: xarray.Dataset, grid: list[str]) -> Iterator[dict[str, Any]]:
    """One number a member each: of every variable that all members have, its last and its largest
    value, over particles the mean and the largest."""
    for name, variable in dataset.data_vars.items():
        if name in (STATUS, MESSAGE, "kind", "position") or not {*grid} <= {*variable.dims}:
            continue
        if variable.dtype.kind not in "biuf" or not variable.size:
            continue
        rest = [str(d) for d in variable.dims if d not in grid]
        values = _known(variable.transpose(*grid, *rest))
        values = values.reshape(-1, *values.shape[len(grid) :])
        words = f"{meaning_of(variable)}{f' ({u})' if (u := units_of(variable)) else ''}"
        if name == "broken_step":
            told = np.where(np.isnan(values).all(axis=1), np.nan, (values >= 0).sum(axis=1))
            yield {"name": "broken bonds", "values": packed(told, "f8")}
            continue
        for how, told in _told(values, rest):
            yield {"name": f"{words}: {how}" if how else words, "values": packed(told, "f8")}


def _told(values: Array, rest: list[str]) -> Iterator[tuple[str, Array]]:
    """Numbers of (member, *rest) that stand for all, and what they are."""
    if "axis" in rest:
        values = np.linalg.norm(values, axis=1 + rest.index("axis"))
        rest = [dim for dim in rest if dim != "axis"]
    over = next((dim for dim in ("time", "step") if dim in rest), None)
    if not rest:
        yield "", values
        return
    if over is None:
        over, rest, values = "time", ["time", *rest], values[:, None]
    values = np.moveaxis(values, 1 + rest.index(over), 1)
    values = values.reshape(*values.shape[:2], -1)
    several = values.shape[2] > 1
    with np.errstate(all="ignore"):
        largest = _reduced(np.fmax, values)
        mean = np.nansum(values, axis=2) / np.isfinite(values).sum(axis=2)
    yield ("largest at the end" if several else "at the end"), _last(largest)
    if several:
        yield "mean at the end", _last(mean)
    if values.shape[1] > 1:
        yield "largest of all steps", _reduced(np.fmax, largest)


def _reduced(how: np.ufunc, values: Array) -> Array:
    return np.asarray(how.reduce(values, axis=values.ndim - 1))


def _last(values: Array) -> Array:
    """The last number of each row, NaN where there is none."""
    known = np.isfinite(values)
    last = values.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    return np.asarray(values[np.arange(len(values)), last])
