"""Datasets of version 1 of the layout, with the names that they have now."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.components.diagnostics import CrackPath
from pbdkit.errors import ExperimentError
from pbdkit.results import layout
from pbdkit.results.layout import INDICES, OF_BODY, OF_FRAME
from pbdkit.scene.raster import FRAME

if TYPE_CHECKING:
    import xarray


def refuse_no_dataset(given: Any) -> None:
    """Raise ExperimentError where a file, or anything else, is given in place of a dataset."""
    if not hasattr(given, "data_vars"):
        opening = f"pbdkit.open({str(given)!r})" if isinstance(given, str | Path) else ""
        raise ExperimentError(
            f"expected a dataset of pbdkit, got an object of type {type(given).__name__}; "
            f"{opening or 'pbdkit.open(file)'} returns that of a file, pbdkit.run(...) a new one"
        )


def in_this_layout(dataset: xarray.Dataset) -> xarray.Dataset:
    """The dataset itself, or an older one with the names of now: indices and roles of particles,
    and bonds by number, which were places from 0; all of the body counts as inside its outline.

    What was measured stays as it was: frame points hold 0 in what is NaN there now. Raises
    ExperimentError for what is no dataset.
    """
    refuse_no_dataset(dataset)
    found, dims = dataset.variables, {name: v.dims for name, v in dataset.variables.items()}
    new: dict[str, Any] = {}
    if dims.get("site") == ("particle", "index") and "i" not in found:
        axes = zip(INDICES, range(dataset.sizes["index"]), strict=False)
        new |= {name: found["site"].isel(index=n) for name, n in axes}
    if "particle" in dims.get("kind", ()) and "role" not in found:
        frame = found["kind"].isel(time=0, missing_dims="ignore") == FRAME
        new["role"] = frame.copy(data=np.where(frame, OF_FRAME, OF_BODY))
    role = new.get("role", found.get("role"))
    if role is not None and "inside" not in found:
        new["inside"] = (role.dims, role.values == OF_BODY)
    if dims.get("bond") == ("bond", "end"):
        new["bond_ends"] = found["bond"] + 1
        places = {"crack_bond": found["crack_bond"] + 1} if "crack_bond" in found else {}
        counted = ("bond", "crack") if places else ("bond",)
        new |= places | {dim: (dim, np.arange(1, dataset.sizes[dim] + 1)) for dim in counted}
    return _described(dataset, new) if new else dataset


def _described(dataset: xarray.Dataset, new: dict[str, Any]) -> xarray.Dataset:
    """The dataset with what is new, all of it labelled as now."""
    dataset = dataset.assign(new)
    crack = (layout.diagnostic_column(v, CrackPath) for v in CrackPath().variables())
    ours = chain(layout.base_columns(len(INDICES)), *layout.optional_columns(), crack)
    known = [c for c in (*ours, layout.own_coordinate(CrackPath)) if c.name in dataset.variables]
    for column in known:
        if column.name in new:
            dataset[column.name] = dataset[column.name].astype(column.dtype).drop_encoding()
        dataset[column.name].attrs |= column.attributes
    return dataset.set_coords([column.name for column in known if column.coordinate])
