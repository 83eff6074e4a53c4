"""A line for each member of a sweep; one for a single run."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.drawing.panel import Line
from pbdkit.drawing.series import OF_A_RUN
from pbdkit.results.members import TEXT, type_alone

if TYPE_CHECKING:
    import xarray


def member_dims(values: Any) -> list[str]:
    """The dimensions that are those of a sweep, or of runs put side by side."""
    return [str(dim) for dim in values.dims if dim not in OF_A_RUN]


def hues_of(values: Any) -> str:
    """What the colours of members tell apart; nothing for a single run."""
    dims = member_dims(values)
    return dims[0] if len(dims) == 1 else "member of the sweep" if dims else ""


def lines_of(dataset: xarray.Dataset, x: Any, y: Any) -> list[Line]:
    """The lines of y over x, DataArrays with one dimension of a run between them: each named by the
    parameters of its member, without what is NaN."""
    import xarray

    across, drawn = xarray.broadcast(x, y)
    dims = member_dims(drawn)
    across, drawn = (values.transpose(*dims, ...) for values in (across, drawn))
    found = []
    places = product(*(range(drawn.sizes[dim]) for dim in dims))
    for hue, place in enumerate(places):
        at, over = across.values[place], drawn.values[place]
        there = np.isfinite(at) & np.isfinite(over)
        along = dict(zip(dims, place, strict=True))
        name = ", ".join(f"{dim} {_said(dataset, dim, n)}" for dim, n in along.items())
        value = _number(dataset, dims[0], place[0]) if len(dims) == 1 else None
        if there.any():
            found.append(Line(at[there], over[there], name, hue, value))
    return found


def _said(dataset: xarray.Dataset, dim: str, place: int) -> str:
    for name in (f"{dim}{TEXT}", dim):
        if name in dataset.coords and dataset[name].dims == (dim,):
            value = dataset[name].values[place]
            return f"{value:.4g}" if isinstance(value, np.floating) else type_alone(str(value))
    return str(place)


def _number(dataset: xarray.Dataset, dim: str, place: int) -> float | None:
    """What a place stands for, where that is a number."""
    if f"{dim}{TEXT}" in dataset.coords or dim not in dataset.coords:
        return None
    value = dataset[dim].values[place]
    return float(value) if isinstance(value, (np.number, int, float)) else None
