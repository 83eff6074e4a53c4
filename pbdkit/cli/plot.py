"""``pbdkit plot``, ``animate`` and ``curve``: a result as a picture, a movie and lines."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import (
    PATH,
    at_option,
    color_option,
    outside_option,
    result_argument,
    set_option,
    times_option,
)
from pbdkit.errors import ExperimentError

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


LOOK = [
    color_option,
    click.option(
        "--field/--dots",
        "filled",
        default=None,
        help="Fill the body with the variable, or a dot a particle; by default what is legible.",
    ),
    click.option("--contours", is_flag=True, help="Fill in steps at round levels."),
    click.option("--bonds/--no-bonds", default=None, help="Draw bonds; by default if legible."),
    click.option("--broken", is_flag=True, help="Draw broken bonds too, dashed."),
    click.option("--outline", is_flag=True, help="Draw the outline at rest."),
    click.option(
        "--range",
        "limits",
        nargs=2,
        type=float,
        metavar="LOW HIGH",
        default=None,
        help="The values of the first and the last colour.",
    ),
    click.option("--map", "cmap", metavar="NAME", help="A colour map of matplotlib, e.g. magma."),
    click.option(
        "--size",
        "figsize",
        nargs=2,
        type=float,
        metavar="WIDTH HEIGHT",
        default=None,
        help="In inches.",
    ),
]
force_option = click.option("--force", is_flag=True, help="Replace an existing file.")


def look_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that pictures and movies have in common, in the order of the help."""

    @wraps(command)
    def with_limits(*args: Any, limits: tuple[float, float] | None, **more: Any) -> Any:
        vmin, vmax = limits or (None, None)
        return command(*args, vmin=vmin, vmax=vmax, **more)

    for option in reversed(LOOK):
        with_limits = option(with_limits)
    return with_limits


@click.command()
@result_argument("file", metavar="OUT.nc|EXPERIMENT")
@click.option("-o", "--output", type=PATH, help="PNG, SVG or PDF.")
@times_option
@at_option
@set_option
@outside_option
@look_options
@click.option("--numbers", is_flag=True, help="Write the particles' numbers where there is room.")
@click.option("--dpi", type=int, default=200, show_default=True, help="Pixels an inch.")
@force_option
def plot(
    file: Path,
    output: Path | None,
    times: tuple[float, ...],
    at: dict[str, str],
    settings: tuple[str, ...],
    force: bool,
    **look: Any,
) -> None:
    """Draw configurations of a result: kinds, or a variable as dots, bonds or a field.

    Of an experiment, draw the set-up before it runs, to NAME-setup.png: the body, supports, motions
    and loads.
    """
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.errors import ExperimentError
    from pbdkit.io.open import is_experiment, reading, refuse_other_file
    from pbdkit.plotting.configuration import plot as draw

    if is_experiment(file):
        _plot_set_up(
            str(file), output, settings, force=force, look={"times": times, "at": at} | look
        )
        return
    refuse_other_file(file)
    if settings:
        raise ExperimentError(f"--set: changes an experiment, and {file} is a result")
    path = output or file.with_suffix(".png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file, at=at) as dataset:
        time = times if len(times) > 1 else times[0] if times else None
        axes = draw(dataset, time=time, **look)
        from pbdkit.plotting.style import figure_of  # needs matplotlib, which is there by now

        save(path, figure_of(axes[0] if isinstance(axes, list) else axes), replace=force)


def _plot_set_up(
    name: str, output: Path | None, settings: tuple[str, ...], *, force: bool, look: dict[str, Any]
) -> None:
    """Draw an experiment before it runs. Raises ExperimentError for options of results."""
    from pbdkit.api import load
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.errors import ExperimentError
    from pbdkit.plotting.configuration import plot_experiment

    figsize, dpi = look.pop("figsize"), look.pop("dpi")
    words = {"filled": "field", "times": "time", "vmin": "range", "vmax": "range", "cmap": "map"}
    if asked := [
        words.get(k, k) for k, value in look.items() if value not in (None, False, (), {})
    ]:
        raise ExperimentError(
            f"--{asked[0]}: is for results; {name} is an experiment, of which the set-up is drawn; "
            f"`pbdkit run {name}` makes a result of it"
        )
    experiment = load(name, settings=settings)
    path = output or Path(f"{experiment.name.replace('/', '-')}-setup.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    axes = plot_experiment(experiment, figsize=figsize, dpi=dpi)
    from pbdkit.plotting.style import figure_of  # needs matplotlib, which is there by now

    save(path, figure_of(axes), replace=force)


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="MP4 or GIF; default OUT.mp4.")
@at_option
@look_options
@click.option("--fps", type=float, default=25.0, show_default=True, help="Steps a second.")
@click.option(
    "--every", type=click.IntRange(min=1), default=1, metavar="N", help="Only each N-th step."
)
@click.option("--dpi", type=int, default=120, show_default=True, help="Pixels an inch.")
@force_option
def animate(file: Path, output: Path | None, at: dict[str, str], force: bool, **look: Any) -> None:
    """Make a movie of a result: every recorded step, with the same colours all along."""
    from pbdkit.cli.options import refuse_output, refuse_unwritable
    from pbdkit.io.open import reading, refuse_other_file
    from pbdkit.plotting.movie import animate as write
    from pbdkit.plotting.movie import refuse_no_movie
    from pbdkit.progress import progress_bar

    refuse_other_file(file)
    path = output or file.with_suffix(".mp4")
    refuse_no_movie(path)
    refuse_output(path, force=force)
    refuse_unwritable(None, path)
    with reading(file, at=at) as dataset, progress_bar(sys.stderr.isatty()) as show:
        write(dataset, file=path, show=show, replace=force, **look)
    click.echo(f"{path} written")


CURVES = ("stress-strain", "load-displacement", "energies")
CRACKS: dict[str, Any] = {"crack": "map", "crack-length": "length", "broken-bonds": "bonds"}
HISTORY = "history"


@click.command()
@result_argument("file")
@click.argument("kind", required=False, type=click.Choice([*CURVES, HISTORY, *CRACKS]))
@click.option("-o", "--output", type=PATH, help="PNG, SVG or PDF.")
@click.option("--y", metavar="VARIABLE", help="Draw this, e.g. reaction_x or pe1.")
@click.option("--x", metavar="VARIABLE", help="Over this; the time if it is not said.")
@click.option(
    "--particle",
    "particles",
    type=int,
    multiple=True,
    help="Its history; again for one more.",
)
@click.option("--bond", nargs=2, type=int, metavar="A B", help="The history of a bond.")
@click.option("--group", type=int, help="Forces of this leader group.")
@click.option("--load", type=int, help="Forces of this load.")
@click.option("--obstacle", type=int, help="Forces of this obstacle.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def curve(
    file: Path, kind: str | None, output: Path | None, at: dict[str, str], force: bool, **asked: Any
) -> None:
    """Draw what changes in the course of a result: a curve, histories, the crack.

    \b
    stress-strain      nominal stress over nominal strain
    load-displacement  force over displacement of a leader group, load or obstacle
    energies           the energies over the steps
    history            a variable (--y, else u) of particles or a bond over the steps
    crack              the broken bonds, by the step in which they broke
    crack-length       the length of the longest crack over the steps
    broken-bonds       their number over the steps

    Without KIND the first that the result has. --y alone draws that variable over the steps, and
    with --particle or --bond its history there. Results of sweeps have a line a member.
    """
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.io.open import reading, refuse_other_file

    refuse_other_file(file)
    path = output or file.with_name(f"{file.stem}-{_named(kind, asked)}.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file, sweeps=True, at=at) as dataset:
        from pbdkit.plotting.style import figure_of  # needs matplotlib, which is there by now

        save(path, figure_of(_drawn(dataset, kind, **asked)), replace=force)


def _named(kind: str | None, asked: dict[str, Any]) -> str:
    """What the picture is called where nobody says."""
    if kind in (None, HISTORY) and (asked["particles"] or asked["bond"]):
        return f"{HISTORY}-{asked['y']}" if asked["y"] else HISTORY
    return kind or asked["y"] or "curve"


def _drawn(
    dataset: xarray.Dataset,
    kind: Any,
    x: str | None,
    y: str | None,
    particles: tuple[int, ...],
    bond: tuple[int, int] | None,
    **chosen: Any,
) -> Axes:
    from pbdkit.plotting.crack import crack
    from pbdkit.plotting.curves import curve, history

    if x is not None and y is None:
        raise ExperimentError(
            f"--x {x}: no variable is given to be drawn over it; add --y VARIABLE"
        )
    if kind in CRACKS:
        return crack(dataset, kind=CRACKS[kind])
    if kind == HISTORY or (kind is None and (particles or bond)):
        return history(dataset, y, particle=particles or None, bond=bond)
    return curve(dataset, x, y, kind=kind, **chosen)
