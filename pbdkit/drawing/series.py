"""Variables by name as curves want them: components, one place, one number a step, and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.drawing.labels import in_its_units
from pbdkit.drawing.quantity import axes_of, component_of, makers_of_missing
from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.results.layout import OF_BODY

if TYPE_CHECKING:
    import xarray

BLOCK_BYTES = 2**25
"""About so much is in memory at a time of what is summed."""
SUMMED = ("pe1", "pe1_intact", "contact")
"""What adds up over particles; of all else the mean is taken."""
CHOSEN_BY = {"leader_group": "group", "load": "load", "obstacle": "obstacle"}
"""The dimensions of which one place is taken, and the arguments that say which."""
OF_A_RUN = {"time", "step", "crack", "particle", "bond", "axis", "tracked", "end", *CHOSEN_BY}
"""The dimensions of one run; others are those of a sweep."""


def variable(dataset: xarray.Dataset, name: str) -> xarray.DataArray:
    """A variable, or of `u_x` the component of `u`; nothing is read yet.

    Raises ExperimentError where there is none of that name.
    """
    if not isinstance(name, str):
        raise ExperimentError(f"expected the name of a variable, such as 'pe1', got {name!r}")
    (whole, component), axes = component_of(dataset, name), axes_of(dataset)
    if whole not in dataset.variables:
        raise ExperimentError(_unknown(dataset, name, axes))
    if component is None:
        return dataset[whole]
    found = dataset[whole].isel(axis=component)
    meaning = f"{found.attrs.get('long_name', whole)}, {axes[component]} component"
    return found.assign_attrs(long_name=meaning)


def _unknown(dataset: xarray.Dataset, name: str, axes: list[str]) -> str:
    known: list[str] = []
    for each, values in dataset.data_vars.items():
        if values.dtype.kind in "biuf":
            parts = [f"{each}_{axis}" for axis in axes] if "axis" in values.dims else [str(each)]
            known += parts
    if makers := makers_of_missing(dataset, name):
        return (
            f"'{name}' was not recorded: add {' or '.join(makers)} to `diagnostics`, and run again"
        )
    near = did_you_mean(name, known) or ";"
    return f"there is no variable '{name}'{near} what there is: {', '.join(known)}"


def scalar(dataset: xarray.Dataset, name: str, chosen: Mapping[str, int | None]) -> Any:
    """A DataArray along time, and along the dimensions of a sweep: of particles and bonds their sum
    or mean, of leader groups, loads and obstacles the `chosen` one, in the units that the variable
    says.

    Raises ExperimentError for what is no number a step.
    """
    found = variable(dataset, name)
    if "axis" in found.dims:
        some = ", ".join(f"'{name}_{axis}'" for axis in dataset["axis"].values)
        raise ExperimentError(f"'{name}' is a vector; take one of {some}")
    if found.dtype.kind not in "biuf":
        raise ExperimentError(f"'{name}' holds no numbers")
    for dim, argument in CHOSEN_BY.items():
        if dim in found.dims:
            found = _one_of(found, dim, argument, chosen.get(argument))
    for dim in ("particle", "bond"):
        if dim in found.dims:
            found = _over(found, dataset, dim)
    more = [str(d) for d in found.dims if d in OF_A_RUN]
    if len(more) > 1:
        raise ExperimentError(f"'{name}' is no single number a step: it has {' and '.join(more)}")
    return in_units(found)


def in_units(found: xarray.DataArray) -> xarray.DataArray:
    """The values, now read, in mm and so on where the variable says its scale."""
    factor, units = in_its_units(found.attrs)
    said = {"long_name": found.attrs.get("long_name", str(found.name)), "units": units}
    read = found.astype(float) * factor
    read.attrs = said
    return read


def _one_of(found: xarray.DataArray, dim: str, argument: str, place: int | None) -> Any:
    known = found[dim].values.tolist()
    if place is None and len(known) == 1:
        (place,) = known
    if place not in known:
        text = "which is meant" if place is None else f"there is no {place}"
        said = f"'{found.name}' has {dim.replace('_', ' ')}s {', '.join(map(str, known))}"
        raise ExperimentError(f"{said}: {text}; say {argument}={known[-1]}")
    meaning = f"{found.attrs.get('long_name', found.name)} {place}"
    return found.sel({dim: place}).assign_attrs(long_name=meaning)


def _over(found: xarray.DataArray, dataset: xarray.Dataset, dim: str) -> Any:
    """The sum or mean over body particles or bonds, so many steps at a time."""
    import xarray

    summed = found.name in SUMMED
    what = (
        "sum over the body" if summed else f"mean over {'bonds' if dim == 'bond' else 'the body'}"
    )
    said = found.attrs | {"long_name": f"{found.attrs.get('long_name', found.name)}, {what}"}
    role = dataset.get("role") if dim == "particle" else None
    body = slice(None) if role is None or role.dims != (dim,) else role.values == OF_BODY

    def reduced(part: xarray.DataArray) -> xarray.DataArray:
        whole = part.transpose(..., dim)
        values = np.asarray(whole.values, float)[..., body]
        some = np.isfinite(values).any(axis=-1)
        total = np.nansum(values, axis=-1)
        if not summed:
            total = total / np.maximum(np.isfinite(values).sum(axis=-1), 1)
        return whole.isel({dim: 0}, drop=True).copy(data=np.where(some, total, np.nan))

    if "time" not in found.dims:
        return reduced(found).assign_attrs(said)
    each = max(1, found.nbytes // max(1, found.sizes["time"]))
    block = max(1, BLOCK_BYTES // each)
    starts = range(0, found.sizes["time"], block)
    parts = [reduced(found.isel(time=slice(n, n + block))) for n in starts]
    return xarray.concat(parts, "time").assign_attrs(said)
