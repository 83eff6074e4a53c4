"""Particles by number, and by the indices of their sites."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.results.layout import INDICES

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]


def indices_of(dataset: xarray.Dataset) -> list[str]:
    """Those that particles are found by."""
    found = dataset.variables
    return [name for name in INDICES if name in found and found[name].dims == ("particle",)]


def rows_at(dataset: xarray.Dataset, index: Mapping[str, int]) -> Array:
    """The rows of the particles whose sites have these indices. Raises ExperimentError where there
    is none, and for what is no index."""
    known = indices_of(dataset)
    here = np.ones(dataset.sizes.get("particle", 0), np.bool_)
    for name, value in index.items():
        if name not in known:
            raise ExperimentError(f"particles here are found by {known}, not by '{name}'")
        here &= dataset.variables[name].values == value
    if not here.any():
        place = ", ".join(f"{name}={value}" for name, value in index.items())
        raise ExperimentError(f"there is no particle at {place}")
    return np.flatnonzero(here)


def rows_of(numbers: Array, given: Array) -> Array:
    """Where particles of those numbers are; -1 where they are not."""
    wanted = np.nan_to_num(given, nan=-1.0).astype(np.int64)
    last = len(numbers)
    if last and numbers[0] == 1 and numbers[-1] == last:  # all of them, as in most datasets
        return np.where(wanted <= last, wanted - 1, -1)
    if not last:
        return np.full(wanted.shape, -1)
    order = np.argsort(numbers)
    at = order[np.searchsorted(numbers[order], wanted).clip(max=last - 1)]
    return np.where(numbers[at] == wanted, at, -1)
