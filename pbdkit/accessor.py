"""Imported when a dataset's accessor `pbd` is first used: what it offers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import xarray

from pbdkit.io.layout import experiment_of, in_this_layout, indices_of, rows_at
from pbdkit.io.members import member
from pbdkit.io.physical import in_physical_units
from pbdkit.io.save import save
from pbdkit.plotting import animate, animation, compare, crack, curve, history, plot
from pbdkit.plotting.style import figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pbdkit.model.experiment import Experiment
    from pbdkit.plugin import Component

P = ParamSpec("P")
R = TypeVar("R")


def _method(
    function: Callable[Concatenate[xarray.Dataset, P], R],
) -> Callable[Concatenate[PbdAccessor, P], R]:
    """Return the function as a method that uses the dataset of the accessor."""

    @wraps(function)
    def call(accessor: PbdAccessor, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(accessor._dataset, *args, **kwargs)

    return call  # type: ignore[return-value]  # its first parameter has a name


def _with_figure(function: Callable[P, Axes | list[Axes]]) -> Callable[P, Axes | Figure]:
    """Return the function with a Figure in place of a list of its Axes."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Axes | Figure:
        drawn = function(*args, **kwargs)
        return figure_of(drawn[0]) if isinstance(drawn, list) else drawn

    return call


class PbdAccessor:
    """The methods that pbdkit gives every dataset: ``dataset.pbd.plot(...)``."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        self._dataset = in_this_layout(dataset)

    plot = _method(_with_figure(plot))
    compare = _method(compare)
    animate = _method(animate)
    animation = _method(animation)
    history = _method(history)
    curve = _method(curve)
    crack = _method(crack)
    save = _method(save)

    def experiment(self, components: Iterable[type[Component]] = ()) -> Experiment:
        """Return the experiment that the dataset carries, which `pbdkit.rerun` runs again.

        `components` are classes from Python, where it was run with such. Raises ExperimentError
        where the dataset carries none.
        """
        return experiment_of(self._dataset, components)

    def member(self, **choice: Any) -> xarray.Dataset:
        """Return the part of a sweep in which parameters have these values: ``member(steel=3)``.

        A member alone has its experiment too. Raises ExperimentError for what no member has.
        """
        return member(self._dataset, choice)

    def at(self, **index: int) -> xarray.Dataset:
        """Select particles by site indices: ``at(i=3, j=4)`` is one particle, as
        ``sel(particle=...)`` selects it, ``at(j=0)`` all particles of a line.

        Every site has indices of its own, those of one repeat cell too. Raises ExperimentError
        where no particle is, and for what is no index.
        """
        rows, whole = rows_at(self._dataset, index), {*index} == {*indices_of(self._dataset)}
        return self._dataset.isel(particle=rows[0] if whole else rows)

    def components(self) -> xarray.Dataset:
        """The dataset with `position_x`, `position_y` in place of `position`, and so on of
        everything along `axis`: for plots of one against the other, and for tables."""
        parts: dict[str, xarray.Variable] = {}
        labels = []
        for name, vector in self._dataset.variables.items():
            for n in range(vector.sizes.get("axis", 0)) if name != "axis" else ():
                axis = self._dataset["axis"].values[n]
                part = parts[f"{name}_{axis}"] = vector.isel(axis=n)
                part.attrs["long_name"] = f"{part.attrs.get('long_name', name)}, {axis} component"
                labels += [f"{name}_{axis}"] if name in self._dataset.coords else []
        return self._dataset.drop_dims("axis", errors="ignore").assign(parts).set_coords(labels)

    def physical(self) -> xarray.Dataset:
        """The dataset in mm, mm² and, of stresses, forces and energies, MPa, N and mJ, as far as
        variables have a scale: those of experiments with `units`."""
        return in_physical_units(self._dataset)
