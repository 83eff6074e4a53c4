"""Two datasets side by side on one scale, or what the second has more than the first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.drawing.extent import extent_of, joined
from pbdkit.drawing.look import Look
from pbdkit.drawing.picture import plot
from pbdkit.drawing.quantity import quantity_of
from pbdkit.drawing.recording import Recording, of_one_run
from pbdkit.errors import ExperimentError
from pbdkit.registry.extras import refuse_no_matplotlib

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


def compare(
    first: xarray.Dataset,
    second: xarray.Dataset,
    time: float | None = None,
    color: str | None = None,
    *,
    difference: bool = False,
    **look: Any,
) -> Axes | list[Axes]:
    """Draws one step (default the last of each) of two datasets side by side, with the same limits
    and one scale of colours, and returns both axes.

    With `difference` it is one panel, and its axes: `color` of the second less that of the first,
    at the places that the second has at rest; particles are joined by number. Without `color` that
    is the distance of positions. `look` are the options of `Look`. Raises ExperimentError for what
    `plot` does, and where no particle is in both.
    """
    if difference:
        return plot(*difference_of(first, second, time, color or "position"), **look)
    refuse_no_matplotlib()
    from pbdkit.drawing.sheet import Sheet

    recordings = [Recording(dataset, color or "kind") for dataset in (first, second)]
    shown = [next(r.snapshots([r.row(time)])) for r in recordings]
    chosen = Look(**look)
    extent = joined([extent_of(r, [now], chosen) for r, now in zip(recordings, shown, strict=True)])
    titles = [
        f"{r.title}, step {now.step}".lstrip(", ") for r, now in zip(recordings, shown, strict=True)
    ]
    sheet = Sheet(recordings, titles, "", extent, chosen)
    for panel, now in zip(sheet.panels, shown, strict=True):
        panel.show(now)
    return sheet.axes


def difference_of(
    first: xarray.Dataset, second: xarray.Dataset, time: float | None, color: str
) -> tuple[xarray.Dataset, None, str]:
    """The second dataset at one step, at rest, with the difference in `color` as a variable more,
    where a particle of that number is in both; the time to draw, and the name of what to draw."""
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
    return found.assign_attrs(title=title), None, name
