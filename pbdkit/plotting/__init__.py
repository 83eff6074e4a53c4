"""Pictures over matplotlib: set-ups of experiments, bodies, histories, curves, cracks, movies.

The functions here are the public ones; what they draw with is imported when they are called, since
matplotlib is an extra.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from pbdkit.errors import refuse_no_matplotlib
from pbdkit.plotting.movie import animate, animation
from pbdkit.plotting.style import Look

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from pbdkit.model.experiment import Experiment
    from pbdkit.plotting.cracks import Kind as CrackKind
    from pbdkit.plotting.curves import Kind as CurveKind, Numbers

__all__ = [
    "animate", "animation", "compare", "crack", "curve", "history", "plot", "plot_experiment",
]  # fmt: skip


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
    refuse_no_matplotlib()
    from pbdkit.plotting.configuration import draw

    return draw(dataset, color, time, look, ax)


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
    refuse_no_matplotlib()
    from pbdkit.plotting.configuration import draw_comparison

    return draw_comparison(first, second, color, time, look, difference=difference)


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
    a figure is made, of size `figsize` in inches, with the resolution `dpi`.

    Raises ExperimentError where there is no such scene, where space is no plane, and where
    matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.scene_axes import draw_experiment

    return draw_experiment(experiment, Look(figsize=figsize, dpi=dpi), ax)


def crack(dataset: xarray.Dataset, kind: CrackKind = "map", *, ax: Axes | None = None) -> Axes:
    """Draw broken bonds and return the axes.

    `map` shows the broken bonds on the body at rest, coloured by step of breaking; `length` the
    length of the longest crack over the steps, measured as the largest distance between the middles
    of its bonds; `bonds` the number of broken bonds. Bonds that were cut, or broken from the start,
    count; bonds to the frame do not.

    Raises ExperimentError where bonds could not break, for several runs, and where matplotlib is
    missing.
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.cracks import draw_crack

    return draw_crack(dataset, kind, ax)


def curve(
    dataset: xarray.Dataset,
    x: str | None = None,
    y: str | None = None,
    *,
    kind: CurveKind | None = None,
    group: int | None = None,
    load: int | None = None,
    obstacle: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a curve and return its axes.

    `kind` is which, by default the first that the dataset has. `curve(y)` draws a variable over
    the time instead and `curve(x, y)` one over another, one number a step each: a component as
    `reaction_x`, and of what particles have the sum or mean. `group`, `load` and `obstacle` choose
    the one to draw; without them it is the one that moves farthest. Lengths, forces
    and energies are in mm, N and mJ where the dataset has their scale. A dataset of a sweep has a
    line a member.

    Raises ExperimentError for what is not there, with the diagnostic that it takes, and where
    matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.curves import draw_curve

    chosen = {"group": group, "load": load, "obstacle": obstacle}
    return draw_curve(dataset, x, y, kind, chosen, ax)


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

    The particles are selected by number, one or several, or by their site indices: `i` and `j` are
    one particle, one of them alone is a line of them. `name` is any variable of particles, a vector
    (its first component is drawn through, the others dashed) or a component as `u_x`; by default
    the displacement `u`, made of positions where it was not recorded. `track` shows every step.
    `bond` names a bond by the numbers of its two particles: its strain, or a variable of bonds.
    Only what is drawn is read.

    Raises ExperimentError for what is not there, for more than 200 lines, and where matplotlib is
    missing.
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.curves import draw_history

    return draw_history(dataset, name, particle, (i, j), bond, ax)
