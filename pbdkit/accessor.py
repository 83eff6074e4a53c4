"""Methods of the accessor `pbd` of datasets; imported when it is first used."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import xarray

from pbdkit.errors import ExperimentError
from pbdkit.io.layout import (
    TIMES,
    experiment_of,
    in_this_layout,
    indices_of,
    rows_at,
    with_principal_values,
)
from pbdkit.io.members import member
from pbdkit.io.physical import in_physical_units
from pbdkit.io.save import save
from pbdkit.plotting import animate, animation, compare, crack, curve, history, plot
from pbdkit.plotting.style import figure_of

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pbdkit.model.experiment import Experiment
    from pbdkit.plugin import Component

REPEATED = ("number", "reference_x", "reference_y", "reference_mm_x", "reference_mm_y")
"""Coordinates of particles that a table omits, with the values of `particle`, `X` and `Y`."""
P = ParamSpec("P")
R = TypeVar("R")


def _method(
    function: Callable[Concatenate[xarray.Dataset, P], R],
) -> Callable[Concatenate[PbdAccessor, P], R]:
    """Return the function as a method that uses the dataset of the accessor."""

    @wraps(function)
    def call(accessor: PbdAccessor, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(accessor._dataset, *args, **kwargs)

    # The first parameter in the docstring is the dataset.
    call.__doc__ = re.sub(
        r"(-{10}\n) +\w+ : .*\n( {8}.*\n)+", r"\1", function.__doc__ or "", count=1
    )
    return call  # type: ignore[return-value]  # `accessor` is also a keyword


def _with_figure(function: Callable[P, Axes | list[Axes]]) -> Callable[P, Axes | Figure]:
    """Return a function that returns a Figure where the original returns a list of its Axes."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Axes | Figure:
        drawn = function(*args, **kwargs)
        return figure_of(drawn[0]) if isinstance(drawn, list) else drawn

    return call


class PbdAccessor:
    """Methods of pbdkit for datasets: ``ds.pbd.plot(...)``.

    Parameters
    ----------
    dataset : xarray.Dataset
        Dataset of pbdkit.
    """

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
        """Return the experiment of the dataset.

        Parameters
        ----------
        components : iterable of classes
            Component classes that the experiment uses in addition to the installed ones.

        Returns
        -------
        Experiment
            Experiment with all defaults.

        Raises
        ------
        ExperimentError
            If the dataset has no experiment, or a component is not available.

        Examples
        --------
        >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
        >>> ds.pbd.experiment().name
        'paper/a'
        """
        return experiment_of(self._dataset, components)

    def member(self, **choice: Any) -> xarray.Dataset:
        """Select members of a sweep by the values of its parameters.

        Parameters
        ----------
        **choice : object
            Values by name of the parameter, for instance ``relaxation=0.5``. A value is a number,
            or a text such as the type of a component.

        Returns
        -------
        xarray.Dataset
            The selected members. If every parameter is given, the result is the dataset of one run
            and contains its experiment.

        Raises
        ------
        ExperimentError
            If the dataset is not that of a sweep, or no member has these values.

        Examples
        --------
        >>> experiment = pbdkit.load("paper/a", settings={"steps": 20})
        >>> values = {"solver.relaxation": [0.5, 1.0]}
        >>> ds = pbdkit.sweep(experiment, vary=values, workers=1, progress=False)
        >>> ds.pbd.member(relaxation=0.5).sizes["time"]
        21
        """
        return member(self._dataset, choice)

    def at(self, **index: int) -> xarray.Dataset:
        """Select particles by site indices.

        Parameters
        ----------
        **index : int
            Site indices `i` and `j`.

        Returns
        -------
        xarray.Dataset
            The particle, if all indices are given; otherwise all particles with these indices.
            Sites of one repeat cell have different indices.

        Raises
        ------
        ExperimentError
            If no particle has these indices.

        Examples
        --------
        >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
        >>> ds.pbd.at(i=4, j=5).particle.item()
        67
        >>> ds.pbd.at(j=5).sizes["particle"]
        12
        """
        rows, whole = rows_at(self._dataset, index), {*index} == {*indices_of(self._dataset)}
        return self._dataset.isel(particle=rows[0] if whole else rows)

    def components(self) -> xarray.Dataset:
        """Split vectors into components, for tables and plots of one component against another.

        Returns
        -------
        xarray.Dataset
            Dataset with `position_x` and `position_y` in place of `position`, and likewise for
            every variable along `axis`. The principal values of `stress_principal` are also in
            `stress_1`, the larger one, and `stress_2`.

        Examples
        --------
        >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
        >>> table = ds.pbd.components().isel(time=-1)[["position_x", "position_y"]].to_dataframe()
        """
        parts: dict[str, xarray.Variable] = {}
        labels = []
        dataset = with_principal_values(self._dataset)
        for name, vector in dataset.variables.items():
            for n in range(vector.sizes.get("axis", 0)) if name != "axis" else ():
                axis = dataset["axis"].values[n]
                part = parts[f"{name}_{axis}"] = vector.isel(axis=n)
                part.attrs["long_name"] = f"{part.attrs.get('long_name', name)}, {axis} component"
                labels += [f"{name}_{axis}"] if name in dataset.coords else []
        return dataset.drop_dims("axis", errors="ignore").assign(parts).set_coords(labels)

    def to_dataframe(self, dim: str = "particle") -> pandas.DataFrame:
        """Convert the variables of one kind of objects to a table.

        Parameters
        ----------
        dim : str
            Dimension of the objects, such as "particle", "bond", "leader_group" or "crack". With
            "time" or "step", the table contains the quantities of the whole body.

        Returns
        -------
        pandas.DataFrame
            Table with a row for each object and, if a variable depends on time, each recorded time;
            both are in the index. The columns are the variables that have no further dimension,
            the components of vectors, and coordinates of the objects.
            Quantities of other objects are omitted. The size is that of these variables, unlike
            that of ``ds.to_dataframe()``, which combines all dimensions.

        Raises
        ------
        ExperimentError
            If no variable has this dimension.

        Examples
        --------
        >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
        >>> table = ds.pbd.to_dataframe()
        >>> table.loc[(20, 67), ["X", "Y", "position_x"]].to_list()[:2]
        [4.0, 5.0]
        """
        parts = self.components()
        dims = {dim} if dim in TIMES else {dim, "time"}
        columns = [n for n, v in parts.data_vars.items() if dim in v.dims and {*v.dims} <= dims]
        if not columns:
            names = ", ".join(sorted({str(d) for v in parts.data_vars.values() for d in v.dims}))
            text = f"no variable has only the dimension '{dim}'; there are {names}"
            if dim == "bond" and "bond" not in parts.dims:
                text += "; bonds are recorded if the experiment has `fracture` or `cuts`"
            raise ExperimentError(text)
        coordinates = [
            name
            for name, v in parts.coords.items()
            if v.dims == (dim,) and name not in (*REPEATED, *parts.dims)
        ]
        table = parts[[*coordinates, *columns]].reset_coords(coordinates)
        used = {str(d) for d in table.dims}
        order = [d for d in ("time", dim) if d in used]
        kept = table.drop_vars([n for n in table.coords if n not in order])
        return kept.to_dataframe(dim_order=[*dict.fromkeys(order)])

    def physical(self) -> xarray.Dataset:
        """Convert the dataset to mm, MPa, N and mJ.

        Returns
        -------
        xarray.Dataset
            Dataset with converted variables. Variables without a scale, such as all variables of
            experiments without `units`, are unchanged.
        """
        return in_physical_units(self._dataset)
