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
    color: str | None = None,
    time: float | Iterable[float | None] | None = None,
    *,
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
    ax: Axes | Sequence[Axes] | None = None,
) -> Axes | list[Axes]:
    """Draw recorded steps with the same limits and one scale of colours.

    Parameters
    ----------
    dataset : xarray.Dataset
        The result of one run.
    color : str, optional
        A variable of particles or bonds: its values, the length of a vector, or a component as
        `u_x`. By default the kinds of particles.
    time : float or iterable of float, optional
        A recorded step, or several, a panel each. By default the last.
    filled : bool, optional
        True draws the variable as a field over the body, False as dots; by default a field where
        dots would hide one another.
    contours : bool
        Draw the field in steps at round levels.
    bonds, broken : bool
        Draw bonds (by default where there is room), and broken ones too, dashed.
    outline : bool
        Draw the outline of the body at rest.
    numbers : bool
        Write the numbers of the particles, as many as there is room for.
    vmin, vmax : float, optional
        The lower and the upper limit of the colours. By default those of all panels, and where
        there are both signs the same on both sides of zero.
    cmap : str, optional
        A colour map of matplotlib.
    figsize : (float, float), optional
        Width and height of the figure in inches.
    dpi : int
        Pixels an inch.
    ax : Axes or sequence of Axes, optional
        Axes to draw into, one for each step. By default a new figure is made.

    Returns the axes: one, or a list where `time` is iterable. Raises ExperimentError for a step
    that was not recorded, for no step at all, for a variable that cannot be drawn, for options
    that make no picture, and where matplotlib is missing.
    """
    look = Look(
        filled, contours, bonds, broken, outline, numbers, vmin, vmax, cmap, figsize, dpi
    )  # fmt: skip
    return draw(dataset, color, time, look, ax)


def draw(
    dataset: xarray.Dataset,
    color: str | None,
    time: float | Iterable[float | None] | None,
    look: Look,
    ax: Axes | Sequence[Axes] | None = None,
) -> Axes | list[Axes]:
    """Draw as `plot` does, with the options in `look`."""
    refuse_no_matplotlib()
    from pbdkit.drawing.sheet import Sheet

    recording = Recording(dataset, color or "kind")
    several = isinstance(time, Iterable)
    rows = [recording.row(one) for one in _listed(time)]
    if not rows:
        raise ExperimentError("a figure needs at least one time")
    shown = list(recording.snapshots(rows))
    titles = [f"step {now.step}" for now in shown]
    if not several or len(shown) == 1:
        titles = [f"{recording.title}, {titles[0]}".lstrip(", ")]
    extent = extent_of(recording, shown, look)
    given = None if ax is None else [*ax] if isinstance(ax, Iterable) else [ax]
    if given is not None and len(given) != len(shown):
        raise ExperimentError(f"{len(shown)} steps need as many axes; {len(given)} are given")
    sheet = Sheet([recording] * len(shown), titles, recording.title, extent, look, given)
    for panel, now in zip(sheet.panels, shown, strict=True):
        panel.show(now)
        if look.numbers:
            sheet.number(panel.ax, now)
    return sheet.axes if several else sheet.axes[0]


def plot_experiment(
    experiment: Experiment,
    *,
    ax: Axes | None = None,
    figsize: tuple[float, float] | None = None,
    dpi: int = 200,
) -> Axes:
    """Draw the set-up of an experiment before it runs, and return the axes.

    The picture shows the body with its frame and regions, supports and leaders, loads, obstacles,
    cracks and cuts. Arrows are as long in proportion to each other as motions and forces are.
    Coordinates are in mm where the experiment has `units`. `ax` are axes to draw into; without them
    a figure is made, of that `figsize` in inches, with so many `dpi`.

    Raises ExperimentError where there is no such scene, where space is no plane, and where
    matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.drawing.scene_axes import draw_on_axes
    from pbdkit.scene.scene import build_scene

    look, scene = Look(figsize=figsize, dpi=dpi), build_scene(experiment)
    if scene.axes != 2:
        raise ExperimentError(f"pictures are of the plane, and this lattice has {scene.axes} axes")
    return draw_on_axes(scene, look, ax)


def _listed(time: Any) -> list[Any]:
    return [*time] if isinstance(time, Iterable) and not isinstance(time, str) else [time]
