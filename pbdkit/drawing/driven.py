"""Force and displacement of what drives a body: a leader group, a load or an obstacle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.labels import in_its_units
from pbdkit.drawing.series import BLOCK_BYTES, CHOSEN_BY, OF_A_RUN, in_units
from pbdkit.errors import ExperimentError
from pbdkit.results.carried import scene_of
from pbdkit.scene.scene import Scene

if TYPE_CHECKING:
    import xarray

Floats = NDArray[np.float64]
FORCE_OF = {"load": "load_resultant", "obstacle": "contact_force", "leader_group": "reaction"}
"""The forces on a curve, by the dimension of what exerts them."""
NEEDED = (
    "a curve of force over displacement needs a diagnostic of forces: add "
    "{type: load-displacement, youngs_modulus: ...} for loads, {type: contact, ...} for obstacles "
    "or {type: reaction, ...} for leader groups to `diagnostics`, and run again"
)


@dataclass(frozen=True)
class Way:
    """`force` over `displacement`, DataArrays along time that say along which axis."""

    displacement: Any
    force: Any


def way(dataset: xarray.Dataset, chosen: Mapping[str, int | None]) -> Way:
    """That of the chosen group, load or obstacle, else of the one that goes farthest, along the
    axis along which it does.

    Raises ExperimentError where the dataset has no such forces, or not of the chosen one.
    """
    dim, moved = _moved(dataset, chosen)
    force, place = in_units(dataset[FORCE_OF[dim]]), chosen.get(CHOSEN_BY[dim])
    known = force[dim].values.tolist()
    if place is None:
        place = known[int(np.argmax(_greatest(moved, dim)))]
    if place not in known:
        said = f"there is no {dim.replace('_', ' ')} {place}"
        raise ExperimentError(f"{said}; there are {', '.join(map(str, known))}")
    force, moved = force.sel({dim: place}), moved.sel({dim: place})
    leads = moved if _greatest(moved, "axis").any() else force
    axis = int(np.argmax(_greatest(leads, "axis")))
    force, moved, leads = (values.isel(axis=axis) for values in (force, moved, leads))
    backwards = -float(leads.min()) > float(leads.max())
    along = f"{'−' if backwards else ''}{dataset['axis'].values[axis]}"
    name = f"{dim.replace('_', ' ')} {place} along {along}"
    return Way(*(
        (-values if backwards else values).assign_attrs(values.attrs | {"long_name": said})
        for values, said in ((moved, f"displacement of {name}"), (force, f"force of {name}"))
    ))  # fmt: skip


def _moved(dataset: xarray.Dataset, chosen: Mapping[str, int | None]) -> tuple[str, Any]:
    """What exerts the forces, and how it moves: what is asked for, else the first that moves."""
    asked = [dim for dim, argument in CHOSEN_BY.items() if chosen.get(argument) is not None]
    there = [dim for dim in asked or FORCE_OF if FORCE_OF[dim] in dataset.variables]
    found = [(dim, _displacements(dataset, dim)) for dim in there]
    if not found:
        raise ExperimentError(NEEDED)
    return next((each for each in found if np.nan_to_num(each[1].values).any()), found[0])


def _greatest(values: Any, dim: str) -> Floats:
    """(place along dim,): the largest absolute value there."""
    found = np.abs(values.transpose(dim, ...).values).reshape(values.sizes[dim], -1)
    return np.asarray(np.nanmax(found, axis=1))


def _displacements(dataset: xarray.Dataset, dim: str) -> Any:
    """(time, group, axis): the mean displacement of whoever exerts the force, with units."""
    import xarray

    if dim == "load":
        return in_units(dataset["load_displacement"])
    if more := [str(d) for d in dataset[FORCE_OF[dim]].dims if d not in OF_A_RUN]:
        raise ExperimentError(
            f"who moves how far is not known of all members of a sweep (along {', '.join(more)}): "
            "take one with isel, or name x and y"
        )
    scene = scene_of(dataset, "the way of leaders and obstacles")
    if dim == "obstacle":
        steps = dataset["time"].values
        moved = np.stack([_of_barriers(scene, int(step)) for step in steps])
    else:
        moved = np.stack([_of_rows(dataset, leading.rows) for leading in scene.leading], axis=1)
    factor, units = in_its_units(dataset["position"].attrs)
    along = {"time": dataset["time"], dim: dataset[dim], "axis": dataset["axis"]}
    return xarray.DataArray(moved * factor, along, ("time", dim, "axis"), attrs={"units": units})


def _of_barriers(scene: Scene, step: int) -> Floats:
    """(obstacle, axis): how far each has gone by a step; it stays where it last was."""
    found = []
    for barrier in scene.barriers:
        n = min(step, barrier.group.last(step)) - barrier.group.from_ + 1
        found.append(barrier.offset(n).mean(axis=0) if n > 0 else np.zeros(scene.axes))
    return np.array(found)


def _of_rows(dataset: xarray.Dataset, rows: NDArray[Any]) -> Floats:
    """(time, axis): the mean displacement of some particles, so many steps at a time."""
    low, high = int(rows.min()), int(rows.max()) + 1
    reference = dataset["reference"].isel(particle=slice(low, high)).transpose("particle", "axis")
    position = dataset["position"].isel(particle=slice(low, high))
    block = max(1, BLOCK_BYTES // max(1, reference.nbytes))
    found = []
    for begin in range(0, dataset.sizes["time"], block):
        part = position.isel(time=slice(begin, begin + block)).transpose("time", "particle", "axis")
        moved = part.values[:, rows - low] - reference.values[rows - low]
        found.append(moved.mean(axis=1))
    return np.concatenate(found)
