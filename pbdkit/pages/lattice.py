"""The moving lattice of a run as a page holds it: displacements, kinds, values, triangles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.mesh import cells_of, triangles_of
from pbdkit.drawing.outline import distance_from, lattice_unit, shape_of
from pbdkit.pages.naming import factor_of, meaning_of, units_of
from pbdkit.pages.packing import packed
from pbdkit.pages.thinning import Rows, Thinning
from pbdkit.results.layout import OF_BODY
from pbdkit.results.physical import TWIN_OF
from pbdkit.scene.raster import FOLLOWER, FRAME

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
AT_ONCE = 2**28
"""So many bytes of a variable are read at once; of larger ones a step at a time."""
FAR = 20.0
"""A body that leaves a box so many times its own is no longer followed: it has diverged."""


def shown_variables(dataset: xarray.Dataset) -> list[str]:
    """The names of what colours can show: a number, or a vector, of each particle."""
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if name not in ("position", "kind", "u")
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and {*variable.dims} - {"time"} in ({"particle"}, {"particle", "axis"})
    ]


def bytes_a_particle(dataset: xarray.Dataset) -> int:
    """What each particle takes a step, before it is packed: displacement, kind and values."""
    values = (2 if "axis" in dataset[n].dims else 1 for n in shown_variables(dataset))
    return 9 + 4 * sum(values)


def read(variable: xarray.DataArray, steps: Rows) -> Iterator[Array]:
    """The values at each of the steps, (particle, ...), in the units of the page."""
    factor = factor_of(variable)
    if "time" not in variable.dims:
        yield in_units(variable.values, factor)
        return
    variable = variable.transpose("time", "particle", ...)
    if variable.nbytes <= AT_ONCE:
        each = iter(variable.values[steps])
    else:
        each = (variable.isel(time=row).values for row in steps.tolist())
    yield from (in_units(values, factor) for values in each)


def in_units(values: Any, factor: float) -> Array:
    """Return the values times a factor; as they are where that is 1."""
    return np.asarray(values) if factor == 1.0 else factor * np.asarray(values)


def resting(
    dataset: xarray.Dataset, reference: Array, shown: Thinning, spacing: float
) -> dict[str, Any]:
    """What does not move: names, reference, triangles.

    `reference` (particle, axis) is where displacements are counted from, `spacing` the distance of
    neighbours there, both in the units of the page.
    """
    rows, role = shown.particles, role_of(dataset)
    labels = {n: dataset[n].values for n in ("number", "i", "j") if n in dataset.variables}
    labels = {"number": np.arange(1, shown.count + 1)} | labels
    labels = {name: values[rows] for name, values in labels.items() if values.ndim == 1}
    sites = [labels[n] // shown.stride for n in ("i", "j")] if {"i", "j"} <= {*labels} else []
    return {
        "spacing": spacing * shown.stride,
        "length": units_of(dataset["position"]),
        "reference": packed(reference[rows], "f8"),
        "labels": {name: packed(values, "i4") for name, values in labels.items()},
        "triangles": packed(_triangles(reference[rows], sites, role[rows] == OF_BODY), "i4"),
    } | _outline(dataset, reference, rows)


def _outline(dataset: xarray.Dataset, reference: Array, rows: Rows) -> dict[str, Any]:
    """How far particles lie beyond the outline of the body, negative inside, where it cuts cells:
    there fields end. In lattice units."""
    if "inside" not in dataset.variables or dataset["inside"].ndim != 1:
        return {}
    if dataset["inside"].values.all() or (shape := shape_of(dataset)) is None:
        return {}
    return {"beyond": packed(distance_from(shape, reference[rows] / lattice_unit(dataset)), "f4")}


def moving(dataset: xarray.Dataset, reference: Array, shown: Thinning) -> dict[str, Any]:
    """What moves: arrays of the particles shown, with time as their last dimension; and of each
    variable what all particles come to."""
    u, summary = _over_time(_displacements(dataset, reference, shown.steps), shown.particles)
    return {
        "times": dataset["time"].values[shown.steps].tolist(),
        "box": _box(reference, reference[shown.particles, :, None] + u),
        "u": packed(u, "f4"),
        "summary": summary,
        "kind": packed(_kinds(dataset, shown), "u1"),
        "variables": [_variable(dataset, name, shown) for name in shown_variables(dataset)],
    }


def role_of(dataset: xarray.Dataset) -> Array:
    """Body or frame, (particle,); all body where nobody says."""
    if "role" in dataset.variables:
        return np.asarray(dataset["role"].values)
    return np.full(dataset.sizes["particle"], OF_BODY)


def _over_time(each: Iterator[Array], rows: Rows) -> tuple[Array, dict[str, Any]]:
    """The values of some rows, (particle, ..., time), and over time the mean, the largest and the
    least of all; of vectors, of their lengths."""
    shown, whole = [], []
    for values in each:
        shown.append(values[rows])
        sizes = np.linalg.norm(values, axis=1) if values.ndim > 1 else values
        known = sizes[np.isfinite(sizes)]
        whole.append([known.mean(), known.max(), known.min()] if len(known) else [np.nan] * 3)
    names = "mean", "largest", "least"
    summary = {n: packed(v, "f8") for n, v in zip(names, np.transpose(whole), strict=True)}
    return np.stack(shown, axis=-1), summary


def _displacements(dataset: xarray.Dataset, reference: Array, steps: Rows) -> Iterator[Array]:
    if "u" in dataset:
        return read(dataset["u"], steps)
    return (position - reference for position in read(dataset["position"], steps))


def _variable(dataset: xarray.Dataset, name: str, shown: Thinning) -> dict[str, Any]:
    variable = dataset[name]
    values, summary = _over_time(read(variable, shown.steps), shown.particles)
    return {
        "name": name,
        "meaning": meaning_of(variable),
        "units": units_of(variable),
        "vector": "axis" in variable.dims,
        "values": packed(values, "f4"),
        "summary": summary,
    }


def _kinds(dataset: xarray.Dataset, shown: Thinning) -> Array:
    if "kind" in dataset:
        each = read(dataset["kind"], shown.steps)
        return np.stack([kinds[shown.particles] for kinds in each], axis=-1)
    kinds = np.where(role_of(dataset) == OF_BODY, FOLLOWER, FRAME)[shown.particles]
    return np.repeat(kinds[:, None], len(shown.steps), axis=1)


def _box(reference: Array, places: Array) -> list[float]:
    """Left, bottom, right, top of all that is shown at any step; of the body at rest where it
    goes far beyond."""
    low, high = np.nanmin(places, axis=(0, 2)), np.nanmax(places, axis=(0, 2))
    rest = np.nanmin(reference, axis=0), np.nanmax(reference, axis=0)
    if not (np.ptp([low, high], axis=0) < FAR * np.ptp(rest, axis=0).max()).all():
        low, high = rest
    return [*low.tolist(), *high.tolist()]


def spacing_of(reference: Array) -> float:
    """How far neighbours are apart at rest, about, where no bonds say it."""
    sides = np.ptp(reference, axis=0)
    count = len(reference)
    return float(max(math.sqrt(sides.prod() / count), sides.max() / count)) or 1.0


def _triangles(reference: Array, sites: list[Array], body: NDArray[np.bool_]) -> Array:
    """Rows of the triangles that fill the body at rest, (triangle, 3), by its `sites` if they are
    known."""
    rows = np.flatnonzero(body & np.isfinite(reference).all(axis=1))
    if not sites:
        return np.asarray(rows[triangles_of(reference[rows])])
    cells = cells_of(np.stack(sites, axis=1)[rows], reference[rows])
    halves = cells[cells[:, 2] != cells[:, 3]][:, [0, 2, 3]]
    return np.asarray(rows[np.concatenate([cells[:, :3], halves])])
