"""One recorded step of a dataset, as a picture needs it: positions, values, bonds, triangles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.interfaces.component import did_you_mean
from pbdkit.registry.blame import one_line
from pbdkit.results.layout import OF_BODY

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
LONGEST = 200
"""So many characters of a title or name are shown."""
BRIDGE = 1.35
"""A reference triangle longer than so many usual ones bridges a hole or a notch."""


@dataclass(frozen=True)
class Snapshot:
    """One step: `position` (particle, axis), `kind` and `values` (particle,), the rows of intact
    bonds (bond, 2), and of the triangles to fill (triangle, 3), None where there are no contours.
    """

    step: int
    position: Array
    kind: Array
    values: Array | None
    bonds: Array
    triangles: Array | None

    def shown_values(self) -> Array:
        """The finite values that get a colour, in no order."""
        assert self.values is not None
        shown = self.values if self.triangles is None else self.values[np.unique(self.triangles)]
        return np.asarray(shown[np.isfinite(shown)])


def take_snapshots(
    dataset: xarray.Dataset, times: Iterable[int | None], color: str | None, contours: bool
) -> list[Snapshot]:
    """Reads steps (None: the last) with the variable `color`, if any; a vector's values are its
    lengths. The body is triangulated, once, for `contours` only.

    Raises ExperimentError for a step that was not recorded, a variable that cannot be drawn, and
    a body that has no triangles.
    """
    if color is not None or contours:
        _check(color, dataset)
    rows = [_row(dataset["time"].values, time) for time in times]
    triangles = _body_triangles(dataset) if contours and rows else None
    return [_snapshot(dataset.isel(time=row), color, triangles) for row in rows]


def _snapshot(now: xarray.Dataset, color: str | None, triangles: Array | None) -> Snapshot:
    step = int(now["time"])
    bonds = now["bond_ends"].values - 1 if "bond_ends" in now else np.empty((0, 2), np.intp)
    broken = now["broken_step"].values if "broken_step" in now else np.full(len(bonds), -1)
    gone = (broken >= 0) & (broken <= step)
    values = None if color is None else _values(now[color])
    if triangles is not None and values is not None:
        whole = ~_have_side(triangles, bonds[gone]) & np.isfinite(values)[triangles].all(axis=1)
        triangles = triangles[whole]
    position = now["position"].transpose("particle", "axis").values
    return Snapshot(step, position, now["kind"].values, values, bonds[~gone], triangles)


def variable_label(dataset: xarray.Dataset, name: str) -> str:
    """What the values of a variable are, with their units."""
    attributes = dataset[name].attrs
    meaning = attributes.get("long_name", name)
    vector = "axis" in dataset[name].dims
    return label(f"length of {meaning}" if vector else meaning, counted_in(attributes))


def counted_in(attributes: Mapping[Any, Any]) -> str:
    """The units of a variable, those of the lattice with what they are."""
    units = str(attributes.get("units", ""))
    if "physical_factor" not in attributes:
        return units
    return f"{units} of {attributes['physical_factor']:g} {attributes['physical_units']}"


def plain(text: object) -> str:
    """A text for a picture: short, and never taken for a formula."""
    return one_line(str(text)[:LONGEST]).replace("$", r"\$")


def label(meaning: object, units: object) -> str:
    """A quantity and its units, as they stand at an axis."""
    meaning, units = plain(meaning), plain(units).replace("^2", "²").replace("^3", "³")
    return meaning if units in ("", "1") else f"{meaning} ({units})"


def _body_triangles(dataset: xarray.Dataset) -> Array:
    """Delaunay's triangles of the body at rest, (triangle, 3), without those that bridge gaps."""
    from matplotlib.tri import Triangulation

    reference = dataset["reference"].values
    body = np.flatnonzero(dataset["role"].values == OF_BODY)
    try:
        triangles = body[Triangulation(*reference[body].T).triangles]
    except (RuntimeError, ValueError):
        raise ExperimentError("contours need a body of particles that are not in line") from None
    corners = reference[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.hypot(sides[..., 0], sides[..., 1]).max(axis=1)
    return np.asarray(triangles[longest <= BRIDGE * np.median(longest)])


def _have_side(triangles: Array, pairs: Array) -> Array:
    """Which triangles, (triangle,), have a pair of these rows as a side."""
    sides = np.sort(np.stack([triangles, np.roll(triangles, 1, axis=1)], axis=-1), axis=-1)
    count = 1 + max(triangles.max(initial=0), pairs.max(initial=0))
    found = np.isin(sides @ (count, 1), np.sort(pairs, axis=-1) @ (count, 1))
    return np.asarray(found.any(axis=1))


def _check(color: str | None, dataset: xarray.Dataset) -> None:
    """What can be drawn has a number or a vector for each particle."""
    shapes, variables = ({"particle"}, {"particle", "axis"}), dataset.drop_vars("kind").data_vars
    known = [str(name) for name, v in variables.items()
             if set(v.dims) - {"time"} in shapes and v.dtype.kind in "biuf"]  # fmt: skip
    names = f"what can be drawn: {', '.join(known)}"
    if color is None:
        raise ExperimentError(f"contours need a variable as color; {names}")
    if color not in known:
        near = did_you_mean(color, known) or ";"
        raise ExperimentError(f"'{color}' cannot be drawn{near} {names}")


def _values(variable: xarray.DataArray) -> Array:
    if "axis" in variable.dims:
        return np.asarray(np.hypot(*variable.transpose("axis", "particle").values))
    return np.asarray(variable.values, float)


def _row(steps: Array, time: int | None) -> int:
    if time is None:
        return len(steps) - 1
    rows = np.flatnonzero(steps == time)
    if not len(rows):
        near = [*steps[steps < time][-1:], *steps[steps > time][:1]]
        raise ExperimentError(
            f"step {time} was not recorded; the nearest recorded: {' and '.join(map(str, near))}"
        )
    return int(rows[-1])
