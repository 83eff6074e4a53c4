"""Histories: what becomes of single particles and bonds, step by step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.drawing.labels import label
from pbdkit.drawing.members import hues_of, lines_of
from pbdkit.drawing.panel import BROAD, TALL, Line, draw_lines, new_axes
from pbdkit.drawing.series import in_units, variable
from pbdkit.errors import ExperimentError
from pbdkit.results.layout import INDICES
from pbdkit.results.sites import rows_at

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

MOST = 200
"""So many lines are drawn at most."""
Numbers = int | Iterable[int]


def history(
    dataset: xarray.Dataset,
    name: str | None = None,
    *,
    particle: Numbers | None = None,
    i: int | None = None,
    j: int | None = None,
    bond: Sequence[int] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a variable of particles over the steps and return the axes.

    The particles are told by number, one or several, or by their site indices: `i` and `j` are one
    particle, one of them alone is a line of them. `name` is any variable of particles, a vector
    (its first component is drawn through, the others dashed) or a component as `u_x`; by default
    the displacement `u`, made of positions where it was not recorded. `track` shows every step.
    `bond` names a bond by the numbers of its two particles: its strain, or a variable of bonds.
    Only what is drawn is read.

    Raises ExperimentError for what is not there, for more than 200 lines, and where matplotlib is
    missing.
    """
    if not isinstance(name, str | None):
        raise ExperimentError(
            f"history: expected the name of a variable first, such as 'u', got {name!r}; a "
            "particle is given as particle=67"
        )
    if bond is not None:
        drawn = [_of_bond(dataset, name or "strain", bond)]
    else:
        numbers = _numbers(dataset, particle, i, j)
        drawn = _of_particles(dataset, name or "u", numbers)
    alone = len(drawn) == 1
    lines = [line for n, one in enumerate(drawn) for line in _lines(dataset, one, n, alone)]
    if not 0 < len(lines) <= MOST:
        what = f"{len(lines)} lines are too many" if lines else "there is no value to draw"
        raise ExperimentError(f"{what}; name other particles, for at most {MOST} lines")
    shown, title = drawn[0].values, str(dataset.attrs.get("title", ""))
    hues = "bond" if bond is not None else "number of the particle"
    if len(drawn) == 1 and (members := hues_of(shown)):
        title, hues = f"{title}, {hues} {drawn[0].name}".replace("number of the ", ""), members
    ax = ax or new_axes()
    ax.set_xlabel(label("time", "step", broad=BROAD))
    ax.set_ylabel(label(shown.attrs["long_name"], shown.attrs["units"], broad=TALL))
    draw_lines(ax, lines, title, hues)
    return ax


@dataclass(frozen=True)
class Followed:
    """Of whom, by name and number, which `values`, a DataArray along time."""

    name: str
    number: float | None
    values: Any


def _lines(dataset: xarray.Dataset, one: Followed, n: int, alone: bool) -> Iterator[Line]:
    """A line a component and a member of a sweep. Colours tell particles apart, or where there is
    one particle alone the members."""
    along = "step" if "step" in one.values.dims else "time"
    vector = "axis" in one.values.dims
    parts = [one.values.isel(axis=k) for k in range(one.values.sizes["axis"])] if vector else []
    for k, part in enumerate(parts or [one.values]):
        axis = str(part["axis"].item()) if vector else ""
        for line in lines_of(dataset, part[along], part):
            by_member = alone and line.name
            said = [line.name, axis] if by_member else [one.name, axis, line.name]
            hue, value = (line.hue, line.value) if by_member else (n, one.number)
            name = ", ".join(filter(None, said))
            yield replace(line, name=name, hue=hue, value=value, dashed=k > 0)


def _numbers(
    dataset: xarray.Dataset, particle: Numbers | None, i: int | None, j: int | None
) -> list[int] | None:
    """Those asked for; None where nothing is said, which only `track` knows what to do with."""
    if particle is not None:
        if i is not None or j is not None:
            raise ExperimentError("name particles by number or by i and j, not by both")
        return [particle] if isinstance(particle, int | np.integer) else [*particle]
    asked = {name: value for name, value in zip(INDICES, (i, j), strict=False) if value is not None}
    return dataset["number"].values[rows_at(dataset, asked)].tolist() if asked else None


def _of_particles(dataset: xarray.Dataset, name: str, numbers: list[int] | None) -> list[Followed]:
    dim = "tracked" if name.partition("_")[0] == "track" else "particle"
    if numbers is None and dim == "particle":
        raise ExperimentError(
            f"history: no particle is given; write history('{name}', particle=67), or i=4, j=5"
        )
    made = name.partition("_")[0] == "u" and "u" not in dataset.variables
    found = variable(dataset, name.replace("u", "position", 1) if made else name)
    if dim not in found.dims:
        raise ExperimentError(f"'{name}' has no values at particles; `curve` draws it")
    known, followed = dataset[dim].values, []
    for number in known if numbers is None else numbers:
        if number not in known:
            few = f"tracked are {known.tolist()}" if dim == "tracked" else f"there are {len(known)}"
            raise ExperimentError(f"there is no particle {number}; {few}")
        values = found.isel({dim: int(np.flatnonzero(known == number)[0])})
        if made:
            values = _displacement(dataset, values, number)
        followed.append(Followed(_name(dataset, number), float(number), in_units(values)))
    return followed


def _displacement(dataset: xarray.Dataset, position: Any, number: int) -> Any:
    """What is left of positions of a particle, or a component of them, less that at rest."""
    reference = dataset["reference"].sel(particle=number)
    if "axis" not in position.dims:
        reference = reference.sel(axis=position["axis"])
    said = str(position.attrs["long_name"]).replace("position", "displacement")
    return (position - reference).assign_attrs(position.attrs | {"long_name": said})


def _name(dataset: xarray.Dataset, number: int) -> str:
    one = dataset["site"].sel(particle=number).values
    return f"{number} ({', '.join(f'{n} {k}' for n, k in zip(INDICES, one, strict=False))})"


def _of_bond(dataset: xarray.Dataset, name: str, bond: Sequence[int]) -> Followed:
    """The strain between two particles, or what a bond remembers."""
    ends = sorted(bond)
    if len(ends) != 2 or not np.isin(ends, dataset["number"].values).all():
        raise ExperimentError(f"a bond is named by two numbers of particles, not by {[*bond]}")
    said = f"{ends[0]}-{ends[1]}"
    if name == "strain":
        return Followed(said, None, _strain(dataset, ends))
    found = variable(dataset, name)
    if {"bond", "time"} - {*found.dims}:
        known = [n for n, v in dataset.data_vars.items() if {"bond", "time"} <= {*v.dims}]
        raise ExperimentError(f"bonds have no history of '{name}'; they have {['strain', *known]}")
    rows = np.flatnonzero((dataset["bond_ends"].values == ends).all(axis=-1))
    if not len(rows):
        raise ExperimentError(f"there is no bond between {ends[0]} and {ends[1]}")
    return Followed(said, None, in_units(found.isel(bond=int(rows[0]))))


def _strain(dataset: xarray.Dataset, ends: list[int]) -> Any:
    """By what share two particles are farther apart than at rest."""
    a, b = (dataset["position"].sel(particle=number) for number in ends)
    X, Y = (dataset["reference"].sel(particle=number) for number in ends)
    rest = float(np.hypot(*(Y.values - X.values)))
    apart = ((b - a) ** 2).sum("axis", skipna=False) ** 0.5
    return (apart / rest - 1.0).assign_attrs(long_name="strain of the bond", units="1")
