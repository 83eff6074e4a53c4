"""Pictures of a dataset's configurations: kinds, or a variable as dots, bonds or a field; and of an
experiment before it runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from pbdkit.drawing.extent import extent_of
from pbdkit.drawing.look import Look
from pbdkit.drawing.recording import Recording
from pbdkit.errors import ExperimentError
from pbdkit.registry.extras import refuse_no_matplotlib

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from pbdkit.experiment.model import Experiment


def plot(
    dataset: xarray.Dataset,
    time: float | Iterable[float | None] | None = None,
    color: str | None = None,
    *,
    ax: Axes | Sequence[Axes] | None = None,
    **look: Any,
) -> Axes | list[Axes]:
    """Draws recorded steps (default the last), a panel each, with the same limits and one scale of
    colours, and returns their axes: one, or a list where `time` is one.

    `color` is a variable of particles or bonds (default the kinds of particles): its values, the
    length of a vector, or a component as `u_x`. `ax` are axes to draw into, one for each step;
    without it a new figure is made. `look` are the options of `Look`.

    Raises ExperimentError for a step that was not recorded, for no step at all, for a variable that
    cannot be drawn, for options that make no picture, and where matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.drawing.sheet import Sheet

    recording, chosen = Recording(dataset, color or "kind"), Look(**look)
    several = isinstance(time, Iterable)
    rows = [recording.row(one) for one in (time if isinstance(time, Iterable) else [time])]
    if not rows:
        raise ExperimentError("a figure needs at least one time")
    shown = list(recording.snapshots(rows))
    titles = [f"step {now.step}" for now in shown]
    if not several or len(shown) == 1:
        titles = [f"{recording.title}, {titles[0]}".lstrip(", ")]
    extent = extent_of(recording, shown, chosen)
    given = None if ax is None else [*ax] if isinstance(ax, Iterable) else [ax]
    if given is not None and len(given) != len(shown):
        raise ExperimentError(f"{len(shown)} steps need as many axes; {len(given)} are given")
    sheet = Sheet([recording] * len(shown), titles, recording.title, extent, chosen, given)
    for panel, now in zip(sheet.panels, shown, strict=True):
        panel.show(now)
        if chosen.numbers:
            sheet.number(panel.ax, now)
    return sheet.axes if several else sheet.axes[0]


def plot_experiment(
    experiment: Experiment,
    *,
    ax: Axes | None = None,
    size: tuple[float, float] | None = None,
    dpi: int = 200,
) -> Axes:
    """Draw the set-up of an experiment before it runs, and return the axes.

    The picture shows the body with its frame and regions, supports and leaders, loads, obstacles,
    cracks and cuts. Arrows are as long in proportion to each other as motions and forces are.
    Coordinates are in mm where the experiment has `units`. `ax` are axes to draw into; without them
    a figure is made, of that `size` in inches, with so many `dpi`.

    Raises ExperimentError where there is no such scene, where space is no plane, and where
    matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.drawing.scene_axes import draw_on_axes
    from pbdkit.scene.scene import build_scene

    look, scene = Look(size=size, dpi=dpi), build_scene(experiment)
    if scene.axes != 2:
        raise ExperimentError(f"pictures are of the plane, and this lattice has {scene.axes} axes")
    return draw_on_axes(scene, look, ax)
