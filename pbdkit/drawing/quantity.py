"""What is drawn in colour: a variable of particles or bonds, a component or length of a vector."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.labels import in_its_units
from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.results.layout import INDICES, broken_by, makers_of

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
PLACES = ("position", "reference", "number", "particle", "site", *INDICES)
"""Variables of where things are, or what they are called."""


@dataclass(frozen=True)
class Quantity:
    """Values of each `owner`, particle or bond, out of the variable `variable`: its component
    number `component`, or the length where it is a vector and that is None, times `factor` in its
    `units`. `words` has the meanings of whole numbers that stand for words.
    """

    variable: str
    owner: str
    meaning: str
    factor: float
    units: str
    vector: bool
    component: int | None
    words: dict[int, str]

    @property
    def is_place(self) -> bool:
        """Whether it is where things are, or a number: zero is one of many."""
        return self.variable.split("_")[0] in PLACES

    @property
    def is_signed(self) -> bool:
        """Whether zero is neutral, between values of both signs."""
        return not self.is_place and (self.component is not None or not self.vector)

    def values(self, part: xarray.Dataset) -> Array:
        """(time, owner), of a dataset in memory that has a time; NaN where there is none."""
        variable = part[self.variable]
        found = np.asarray(variable.transpose("time", self.owner, "axis", missing_dims="ignore"))
        found = found.astype(float) if found.dtype.kind in "biu" else found
        if self.vector:
            along = self.component
            found = np.linalg.norm(found, axis=-1) if along is None else found[..., along]
        if "time" not in variable.dims:
            found = np.repeat(found[None], part.sizes["time"], axis=0)
        if self.variable == "broken_step":  # -1 where it is whole, as it was at earlier steps
            found = np.where(broken_by(found, part["time"].values[:, None]), found, np.nan)
        return found if self.factor == 1.0 else self.factor * found


def axes_of(dataset: xarray.Dataset) -> list[str]:
    """The names of the axes along which vectors have components."""
    return [str(axis) for axis in dataset["axis"].values] if "axis" in dataset.coords else []


def component_of(dataset: xarray.Dataset, name: str) -> tuple[str, int | None]:
    """Of `u_x` the vector `u` and the place of x along its axis; of all else the name itself and
    None."""
    stem, _, axis = name.rpartition("_")
    axes, there = axes_of(dataset), dataset.variables
    if name not in there and stem in there and axis in axes and "axis" in there[stem].dims:
        return stem, axes.index(axis)
    return name, None


def quantity_of(dataset: xarray.Dataset, name: str) -> Quantity:
    """The quantity of that name: a variable, its length where it is a vector, or `u_x`, the
    component along x of a vector `u`. Raises ExperimentError for what cannot be drawn."""
    if not isinstance(name, str):
        raise ExperimentError(
            f"color: expected the name of a variable, such as 'pe1' or 'u_x', got {name!r}; a "
            "recorded step is given as time=400"
        )
    found = {str(n): v for n, v in dataset.variables.items() if _is_drawable(v)}
    axes = axes_of(dataset)
    variable, component = component_of(dataset, name)
    if variable not in found:
        refuse_color(name, dataset, found, axes)
    chosen = found[variable]
    vector, words = "axis" in chosen.dims, _words(chosen.attrs)
    meaning = str(chosen.attrs.get("long_name") or variable)
    if vector:
        meaning = (
            f"length of {meaning}" if component is None else f"{meaning}, along {axes[component]}"
        )
    return Quantity(
        variable,
        "bond" if "bond" in chosen.dims else "particle",
        meaning,
        *in_its_units(chosen.attrs),
        vector,
        component,
        words,
    )


def refuse_color(
    name: str, dataset: xarray.Dataset, found: Iterable[str], axes: Iterable[str]
) -> None:
    """Raise ExperimentError that names the diagnostic which makes the variable, or what can be
    drawn instead."""
    known = [n for n in found if n in dataset.data_vars]
    if makers := makers_of_missing(dataset, name):
        raise ExperimentError(
            f"'{name}' was not recorded, and cannot be drawn: add {' or '.join(makers)} to "
            f"`diagnostics`, and run again; what can be drawn now: {', '.join(known)}"
        )
    vectors = [n for n in (*known, *found) if "axis" in dataset[n].dims]
    parts = [f"{n}_{axis}" for n in vectors for axis in axes]
    near = did_you_mean(name, [*found, *parts]) or ";"
    raise ExperimentError(
        f"'{name}' cannot be drawn{near} what can be drawn: {', '.join(known)}; of vectors, the "
        f"length and components, as {parts[0]}"
    )


def makers_of_missing(dataset: xarray.Dataset, name: str) -> list[str]:
    """Return the diagnostics that make the variable, or the vector of which it is a component, as
    an experiment names them; none where it was recorded, or no diagnostic makes it."""
    vector, _, axis = name.rpartition("_")
    names = {name, vector} if axis in axes_of(dataset) else {name}
    recorded = [*map(str, dataset.variables)]
    if names & {*recorded} or any(other.startswith(f"{name}_") for other in recorded):
        return []
    return makers_of(names)


def _is_drawable(variable: xarray.Variable) -> bool:
    """Whether it has a number or a vector for each particle, or a number for each bond."""
    shapes = ({"particle"}, {"particle", "axis"}, {"bond"})
    return {*variable.dims} - {"time"} in shapes and variable.dtype.kind in "biuf"


def _words(attributes: dict[Any, Any]) -> dict[int, str]:
    if "flag_values" not in attributes or "flag_meanings" not in attributes:
        return {}
    values = np.atleast_1d(attributes["flag_values"])
    return dict(zip(map(int, values), str(attributes["flag_meanings"]).split(), strict=False))
