"""Pictures with matplotlib: set-ups of experiments, bodies, histories, curves, cracks and movies.

The functions of this module are public. The modules that draw are imported when the functions are
called, because matplotlib is an optional dependency.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal

from typing_extensions import Unpack

from pbdkit.errors import refuse_no_matplotlib
from pbdkit.plotting.movie import animate, animation
from pbdkit.plotting.style import PlotKeywords, PlotOptions, Window, takes_options

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from pbdkit.model.experiment import Experiment
    from pbdkit.plotting.cracks import Kind as CrackKind
    from pbdkit.plotting.curves import Kind as CurveKind, Numbers

__all__ = [
    "animate", "animation", "compare", "crack", "curve", "history", "plot", "plot_experiment",
]  # fmt: skip


@takes_options()
def plot(
    dataset: xarray.Dataset,
    color: str | None = None,
    time: float | Iterable[float | None] | None = None,
    *,
    ax: Axes | Sequence[Axes] | None = None,
    **options: Unpack[PlotKeywords],
) -> Axes | list[Axes]:
    """Draw the configuration at recorded steps, coloured by a variable.

    Several steps are drawn side by side, with the same limits and one scale of colours.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of one run.
    color : str, optional
        Variable of particles or bonds: its values, the magnitude of a vector, or a component such
        as `u_x`. By default the kinds of particles are drawn.
    time : float or iterable of float, optional
        Recorded step, or several steps, one for each panel; by default the last.
    {options}
    ax : Axes or sequence of Axes, optional
        Axes to draw into, one for each step. By default a new figure is created.

    Returns
    -------
    Axes or list of Axes
        Axes of the step; a list for several steps, in place of which `ds.pbd.plot` returns their
        Figure.

    Raises
    ------
    ExperimentError
        If a step was not recorded, the variable cannot be drawn, options contradict each other, or
        matplotlib is missing.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ax = ds.pbd.plot("pe1", time=20, cmap="magma")
    >>> figure = ds.pbd.plot("pe1", time=[0, 20])
    """
    look = PlotOptions(**options)
    refuse_no_matplotlib()
    from pbdkit.plotting.configuration import draw

    return draw(dataset, color, time, look, ax)


@takes_options()
def compare(
    first: xarray.Dataset,
    second: xarray.Dataset,
    color: str | None = None,
    time: float | None = None,
    *,
    difference: bool = False,
    by: Literal["number", "site"] = "number",
    **options: Unpack[PlotKeywords],
) -> Axes | list[Axes]:
    """Draw one step of two datasets side by side, or their difference.

    Parameters
    ----------
    first : xarray.Dataset
        Result of one run.
    second : xarray.Dataset
        Result of the other run.
    color : str, optional
        Variable of particles or bonds, as for `plot`. For a difference the default is the distance
        between the positions.
    time : float, optional
        Recorded step; by default the last of each run.
    difference : bool
        Draw in one panel the values of `second` minus those of `first`, at the reference positions
        of `second`.
    by : {"number", "site"}
        Match the particles of a difference by number, or by site indices (i, j). In bodies of
        different shape the same number denotes particles at different sites, of which a warning is
        issued.
    {options}

    Returns
    -------
    list of Axes, or Axes
        Both axes; one Axes for a difference.

    Raises
    ------
    ExperimentError
        As for `plot`, and if the datasets have no particle in common.

    Examples
    --------
    >>> first = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> second = pbdkit.run("paper/a-weighted", settings={"steps": 20}, progress=False)
    >>> left, right = first.pbd.compare(second, "pe1")
    """
    look = PlotOptions(**options)
    refuse_no_matplotlib()
    from pbdkit.plotting.configuration import draw_comparison

    return draw_comparison(first, second, color, time, look, difference=difference, by=by)


def plot_experiment(
    experiment: Experiment,
    *,
    ax: Axes | None = None,
    window: Window | None = None,
    figsize: tuple[float, float] | None = None,
    dpi: int = 200,
) -> Axes:
    """Draw the set-up of an experiment before it is run.

    The picture contains the body with its frame and regions, supports, leaders, loads, obstacles,
    cracks and cuts. Arrows are proportional to displacements and forces. Coordinates are in mm if
    the experiment has `units`, otherwise in lattice units.

    Parameters
    ----------
    experiment : Experiment
        Experiment in the plane.
    ax : Axes, optional
        Axes to draw into. By default a new figure is created.
    window : (float, float, float, float), optional
        Part of the plane that is drawn: left, right, bottom and top, in the units of the axes.
    figsize : (float, float), optional
        Width and height of the figure in inches.
    dpi : int
        Pixels per inch.

    Returns
    -------
    Axes
        Axes of the picture.

    Raises
    ------
    ExperimentError
        If the scene is invalid or not plane, or matplotlib is missing.

    Examples
    --------
    >>> ax = pbdkit.plotting.plot_experiment(pbdkit.load("paper/a"))
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.scene_axes import draw_experiment

    return draw_experiment(experiment, PlotOptions(window=window, figsize=figsize, dpi=dpi), ax)


def crack(dataset: xarray.Dataset, kind: CrackKind = "map", *, ax: Axes | None = None) -> Axes:
    """Draw broken bonds, their number, or the length of the longest crack.

    Bonds that are cut or broken from the start are included; bonds to the frame are not.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of one run in which bonds can break.
    kind : {"map", "length", "bonds"}
        "map" draws the broken bonds on the body in the reference configuration, coloured by the
        step at which they broke; "length" the length of the longest crack over the steps, the
        largest distance between midpoints of its bonds; "bonds" the number of broken bonds over the
        steps.
    ax : Axes, optional
        Axes to draw into. By default a new figure is created.

    Returns
    -------
    Axes
        Axes of the picture.

    Raises
    ------
    ExperimentError
        If bonds cannot break, the dataset contains several runs, or matplotlib is missing.
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
    """Draw a curve: stress over strain, force over displacement, energies, or any two variables.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of a run, or of a sweep, for which one line is drawn for each member.
    x : str, optional
        Variable along the abscissa if `y` is given, otherwise the variable that is drawn over time.
        A variable has one number for each step, or is a component such as `reaction_x`; of a
        variable of particles the sum or the mean is drawn.
    y : str, optional
        Variable along the ordinate.
    kind : {"stress-strain", "load-displacement", "energies"}, optional
        Kind of curve, without `x` and `y`; by default the first of these that the dataset contains.
    group, load, obstacle : int, optional
        Leader group, load or obstacle with the force to draw; by default the one that moves
        farthest.
    ax : Axes, optional
        Axes to draw into. By default a new figure is created.

    Returns
    -------
    Axes
        Axes of the curve. Lengths, forces and energies are in mm, N and mJ if the experiment has
        `units`.

    Raises
    ------
    ExperimentError
        If a variable does not exist; the message names the diagnostic that records it. Also if
        matplotlib is missing.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ax = ds.pbd.curve("pe1")
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.curves import curve_chart

    chosen = {"group": group, "load": load, "obstacle": obstacle}
    return curve_chart(dataset, x, y, kind, chosen).draw(ax)


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
    """Draw a variable of selected particles, or of a bond, over the steps.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of one run.
    name : str, optional
        Variable of particles or bonds, or a component such as `u_x`. The first component of a
        vector is a solid line, the others are dashed. By default the displacement `u`; if it was
        not recorded, it is computed from the positions. To draw every step and not only the
        recorded ones, name the variable `track` of the diagnostic `track`.
    particle : int or iterable of int, optional
        Numbers of the particles.
    i, j : int, optional
        Site indices: both select one particle, one of them selects a line of particles.
    bond : sequence of int, optional
        Numbers of the two particles of a bond. Its strain is drawn, or the variable `name` of
        bonds.
    ax : Axes, optional
        Axes to draw into. By default a new figure is created.

    Returns
    -------
    Axes
        Axes of the curves.

    Raises
    ------
    ExperimentError
        If a variable, particle or bond does not exist, there are more than 200 lines, or matplotlib
        is missing.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ax = ds.pbd.history("u_x", particle=[67, 68])
    """
    refuse_no_matplotlib()
    from pbdkit.plotting.curves import history_chart

    return history_chart(dataset, name, particle, (i, j), bond).draw(ax)
