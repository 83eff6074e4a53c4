"""Two datasets side by side on one scale, or what the second has more than the first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pbdkit.drawing.extent import extent_of, joined
from pbdkit.drawing.look import Look
from pbdkit.drawing.picture import draw
from pbdkit.drawing.quantity import quantity_of
from pbdkit.drawing.recording import Recording, of_one_run
from pbdkit.errors import ExperimentError
from pbdkit.registry.extras import refuse_no_matplotlib
from pbdkit.results.older_layout import in_this_layout

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


def compare(
    first: xarray.Dataset,
    second: xarray.Dataset,
    color: str | None = None,
    time: float | None = None,
    *,
    difference: bool = False,
    filled: bool | None = None,
    contours: bool = False,
    bonds: bool | None = None,
    broken: bool = False,
    outline: bool = False,
    numbers: bool = False,
    vmin: float | None = None,
    vmax: float | None = None,
    cmap: str | None = None,
    figsize: tuple[float, float] | None = None,
    dpi: int = 200,
) -> Axes | list[Axes]:
    """Draw one step of two datasets side by side, with the same limits and one scale of colours.

    Parameters
    ----------
    first, second : xarray.Dataset
        Results of one run each.
    color : str, optional
        What is drawn, as in `plot`; of a `difference` by default the distance of positions.
    time : float, optional
        A recorded step, by default the last of each.
    difference : bool
        Draw in one panel `color` of the second less that of the first, at the places that the
        second has at rest; particles are joined by number.

    The other parameters are those of `plot`.

    Returns
    -------
    list of Axes, or Axes
        Both axes; of a `difference` its own.

    Raises
    ------
    ExperimentError
        As `plot` does, and where no particle is in both.
    """
    look = Look(
        filled, contours, bonds, broken, outline, numbers, vmin, vmax, cmap, figsize, dpi
    )  # fmt: skip
    first, second = in_this_layout(first), in_this_layout(second)
    if difference:
        changed, name = difference_of(first, second, color or "position", time)
        return draw(changed, name, None, look)
    return _side_by_side([first, second], color, time, look)


def _side_by_side(
    datasets: list[xarray.Dataset], color: str | None, time: float | None, look: Look
) -> list[Axes]:
    refuse_no_matplotlib()
    from pbdkit.drawing.sheet import Sheet

    recordings = [Recording(dataset, color or "kind") for dataset in datasets]
    shown = [next(r.snapshots([r.row(time)])) for r in recordings]
    extent = joined([extent_of(r, [now], look) for r, now in zip(recordings, shown, strict=True)])
    titles = [
        f"{r.title}, step {now.step}".lstrip(", ") for r, now in zip(recordings, shown, strict=True)
    ]
    sheet = Sheet(recordings, titles, "", extent, look)
    for panel, now in zip(sheet.panels, shown, strict=True):
        panel.show(now)
    return sheet.axes


def difference_of(
    first: xarray.Dataset, second: xarray.Dataset, color: str, time: float | None
) -> tuple[xarray.Dataset, str]:
    """Return the second dataset at one step, at rest, with the difference in `color` as a variable
    more, where a particle of that number is in both; and the name of what to draw."""
    both = [of_one_run(dataset) for dataset in (first, second)]
    quantity, _ = (quantity_of(dataset, color) for dataset in reversed(both))
    if quantity.owner != "particle":
        raise ExperimentError(f"a difference is one of particles, and '{color}' is of bonds")
    now = [d.isel(time=Recording(d).row(time)) for d in both]
    numbers = np.intersect1d(now[0]["number"].values, now[1]["number"].values)
    if not len(numbers):
        raise ExperimentError("the two have no particle in common: no number is in both")
    a, b = (d.isel(particle=np.flatnonzero(np.isin(d["number"], numbers))) for d in now)
    before, after = (d[quantity.variable].transpose("particle", "axis", missing_dims="ignore")
                     for d in (a, b))  # fmt: skip
    less = after.variable.copy(data=after.values.astype(float) - before.values)
    less.attrs["long_name"] = f"difference in {less.attrs.get('long_name', quantity.variable)}"
    rest = b["reference"].transpose(*b["position"].dims).values
    title = f"{b.attrs.get('title', '')} less {a.attrs.get('title', '')}"
    found = b.assign(difference=less, position=b["position"].copy(data=rest))
    name = f"difference{color.removeprefix(quantity.variable)}"
    return found.assign_attrs(title=title), name
