"""What changes in time and belongs to no particle, as curves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.pages.naming import factor_of, meaning_of, units_of
from pbdkit.pages.packing import packed
from pbdkit.results.physical import TWIN_OF

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
MOST_POINTS, MOST_SERIES = 1200, 12
AGAINST = {"nominal_stress": "nominal_strain", "load_resultant": "load_displacement"}
"""What is drawn over something else than time as well."""


@dataclass(frozen=True)
class Curve:
    """Lines over one axis: `x`, the `steps` of its points and the values of each series are
    packed."""

    title: str
    steps: dict[str, Any]
    x: dict[str, Any]
    x_label: str
    y_label: str
    series: list[dict[str, Any]]


def curves(dataset: xarray.Dataset, points: int = MOST_POINTS) -> list[dict[str, Any]]:
    """Of every variable over time, or over every step, and a few small dimensions; and of the
    pairs AGAINST; with so many points at most."""
    names = _names(dataset)
    found = [_over_time(dataset, name, points) for name in names]
    found += [_against(dataset, y, x, points) for y, x in AGAINST.items() if {x, y} <= {*names}]
    return [asdict(curve) for curve in found]


def fewer_points(dataset: xarray.Dataset) -> list[str]:
    """A sentence where curves show fewer points than were recorded."""
    longest = max((dataset.sizes.get(dim, 0) for dim in ("time", "step")), default=0)
    every = _every(longest, MOST_POINTS)
    return [] if every == 1 else [f"Curves show one point in {every} of up to {longest}."]


def _names(dataset: xarray.Dataset) -> list[str]:
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if len({"time", "step"} & {*variable.dims}) == 1
        and not {"particle", "bond"} & {*variable.dims}
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and math.prod(n for d, n in variable.sizes.items() if d not in ("time", "step"))
        <= MOST_SERIES
        and variable.size
    ]


def _every(count: int, points: int) -> int:
    return max(1, math.ceil(count / points))


def _over_time(dataset: xarray.Dataset, name: str, points: int) -> Curve:
    variable = dataset[name]
    along = "time" if "time" in variable.dims else "step"
    rows = slice(None, None, _every(variable.sizes[along], points))
    steps = dataset[along].values
    series = [
        {"name": label, "values": packed(values[rows], "f8")}
        for label, values in _lines(dataset, name, along)
    ]
    at = packed(steps[rows], "f8")
    return Curve(meaning_of(variable), at, at, "step", units_of(variable), series)


def _lines(dataset: xarray.Dataset, name: str, along: str) -> Iterator[tuple[str, Array]]:
    """The values of each place along the other dimensions, with what it is called."""
    variable = dataset[name].transpose(..., along)
    others = [str(dim) for dim in variable.dims[:-1]]
    values = factor_of(variable) * np.asarray(variable.values, float)
    for place in product(*(range(variable.sizes[dim]) for dim in others)):
        words = [_word(dataset, dim, n) for dim, n in zip(others, place, strict=True)]
        yield ", ".join(words), values[place]


def _word(dataset: xarray.Dataset, dim: str, n: int) -> str:
    label = dataset[dim].values[n] if dim in dataset.variables else n
    return str(label) if dim == "axis" else f"{dim.replace('_', ' ')} {label}"


def _against(dataset: xarray.Dataset, y: str, x: str, points: int) -> Curve:
    """One over the other: of several pairs the one that goes farthest, as a chart has one axis."""
    pairs = list(zip(_lines(dataset, x, "time"), _lines(dataset, y, "time"), strict=True))
    (label, across), (_, up) = max(pairs, key=lambda pair: float(np.nanmax(np.abs(pair[1][1]))))
    rows = slice(None, None, _every(len(across), points))
    titles, units = [meaning_of(dataset[n]) for n in (y, x)], [units_of(dataset[n]) for n in (y, x)]
    return Curve(
        title=" over ".join(titles),
        steps=packed(dataset["time"].values[rows], "f8"),
        x=packed(across[rows], "f8"),
        x_label=f"{titles[1]} ({units[1]})" if units[1] else titles[1],
        y_label=units[0],
        series=[{"name": label, "values": packed(up[rows], "f8")}],
    )
