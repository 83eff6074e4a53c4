"""Commands ``pbdkit plot``, ``animate`` and ``curve``: pictures, movies and curves of results."""

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
        help="Draw a filled field, or a dot for each particle; by default what is legible.",
    ),
    click.option("--contours", is_flag=True, help="Draw filled contours at round levels."),
    click.option(
        "--bonds/--no-bonds", default=None, help="Draw bonds; by default if they are legible."
    ),
    click.option("--broken", is_flag=True, help="Draw broken bonds, dashed."),
    click.option("--outline", is_flag=True, help="Draw the outline of the body at rest."),
    click.option(
        "--range",
        "limits",
        nargs=2,
        type=float,
        metavar="LOW HIGH",
        default=None,
        help="Limits of the colour scale.",
    ),
    click.option("--map", "cmap", metavar="NAME", help="Colour map of matplotlib, e.g. magma."),
    click.option(
        "--size",
        "figsize",
        nargs=2,
        type=float,
        metavar="WIDTH HEIGHT",
        default=None,
        help="Size of the figure in inches.",
    ),
]
"""Options that pictures and movies have in common."""
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
@click.option("--numbers", is_flag=True, help="Write the numbers of particles if there is room.")
@click.option(
    "--dpi", type=int, default=200, show_default=True, help="Resolution in pixels per inch."
)
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
    """Draw configurations of a result: kinds of particles, or a variable as dots, bonds or a field.

    For an experiment, draw the set-up before it runs, to NAME-setup.png: the body, supports,
    motions and loads.
    """
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.errors import ExperimentError
    from pbdkit.io.open import reading
    from pbdkit.io.other_files import is_experiment, refuse_other_file
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
        from pbdkit.plotting.style import figure_of  # needs matplotlib, which was checked above

        save(path, figure_of(axes[0] if isinstance(axes, list) else axes), replace=force)


def _plot_set_up(
    name: str, output: Path | None, settings: tuple[str, ...], *, force: bool, look: dict[str, Any]
) -> None:
    """Draw an experiment before it runs; raise ExperimentError for options of results."""
    from pbdkit.api import load
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.errors import ExperimentError
    from pbdkit.plotting.configuration import plot_experiment

    figsize, dpi = look.pop("figsize"), look.pop("dpi")
    option_names = {
        "filled": "field",
        "times": "time",
        "vmin": "range",
        "vmax": "range",
        "cmap": "map",
    }
    if options := [
        option_names.get(key, key)
        for key, value in look.items()
        if value not in (None, False, (), {})
    ]:
        raise ExperimentError(
            f"--{options[0]}: applies to results; {name} is an experiment, whose set-up is drawn; "
            f"`pbdkit run {name}` computes a result"
        )
    experiment = load(name, settings=settings)
    path = output or Path(f"{experiment.name.replace('/', '-')}-setup.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    axes = plot_experiment(experiment, figsize=figsize, dpi=dpi)
    from pbdkit.plotting.style import figure_of  # needs matplotlib, which was checked above

    save(path, figure_of(axes), replace=force)


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="MP4 or GIF; default OUT.mp4.")
@at_option
@look_options
@click.option(
    "--fps", type=float, default=25.0, show_default=True, help="Recorded steps per second."
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    metavar="N",
    help="Draw every N-th recorded step only.",
)
@click.option(
    "--dpi", type=int, default=120, show_default=True, help="Resolution in pixels per inch."
)
@force_option
def animate(file: Path, output: Path | None, at: dict[str, str], force: bool, **look: Any) -> None:
    """Make a movie of a result: every recorded step, with one colour scale."""
    from pbdkit.cli.options import refuse_output, refuse_unwritable
    from pbdkit.io.open import reading
    from pbdkit.io.other_files import refuse_other_file
    from pbdkit.plotting.movie import animate as write, refuse_no_movie
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
"""Kinds of curves."""
CRACKS: dict[str, Any] = {"crack": "map", "crack-length": "length", "broken-bonds": "bonds"}
"""Kinds of pictures of cracks, with their names in `pbdkit.plotting.crack`."""
HISTORY = "history"
"""Kind of histories."""


@click.command()
@result_argument("file")
@click.argument("kind", required=False, type=click.Choice([*CURVES, HISTORY, *CRACKS]))
@click.option("-o", "--output", type=PATH, help="PNG, SVG or PDF.")
@click.option("--y", metavar="VARIABLE", help="Variable to draw, e.g. reaction_x or pe1.")
@click.option("--x", metavar="VARIABLE", help="Variable of the abscissa; default the time.")
@click.option(
    "--particle",
    "particles",
    type=int,
    multiple=True,
    help="Number of a particle with a history; repeat it for further particles.",
)
@click.option(
    "--bond",
    nargs=2,
    type=int,
    metavar="A B",
    help="Numbers of the two particles of a bond with a history.",
)
@click.option("--group", type=int, help="Forces of this leader group.")
@click.option("--load", type=int, help="Forces of this load.")
@click.option("--obstacle", type=int, help="Forces of this obstacle.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def curve(
    file: Path,
    kind: str | None,
    output: Path | None,
    at: dict[str, str],
    force: bool,
    **options: Any,
) -> None:
    """Draw quantities of a result over time: a curve, histories, the crack.

    \b
    stress-strain      nominal stress over nominal strain
    load-displacement  force over displacement of a leader group, load or obstacle
    energies           the energies over the steps
    history            a variable (--y, else u) of particles or a bond over the steps
    crack              the broken bonds, by the step in which they broke
    crack-length       the length of the longest crack over the steps
    broken-bonds       their number over the steps

    KIND is by default the first that the result has. --y alone draws that variable over the steps,
    and with --particle or --bond its history there. Results of sweeps have a line for each member.
    """
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save
    from pbdkit.io.open import reading
    from pbdkit.io.other_files import refuse_other_file

    refuse_other_file(file)
    path = output or file.with_name(f"{file.stem}-{_default_name(kind, options)}.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file, sweeps=True, at=at) as dataset:
        from pbdkit.plotting.style import figure_of  # needs matplotlib, which was checked above

        save(path, figure_of(_draw(dataset, kind, **options)), replace=force)


def _default_name(kind: str | None, options: dict[str, Any]) -> str:
    """Return the default name of the picture."""
    if kind in (None, HISTORY) and (options["particles"] or options["bond"]):
        return f"{HISTORY}-{options['y']}" if options["y"] else HISTORY
    return kind or options["y"] or "curve"


def _draw(
    dataset: xarray.Dataset,
    kind: Any,
    x: str | None,
    y: str | None,
    particles: tuple[int, ...],
    bond: tuple[int, int] | None,
    **forces: Any,
) -> Axes:
    from pbdkit.plotting.crack import crack
    from pbdkit.plotting.curves import curve, history

    if x is not None and y is None:
        raise ExperimentError(f"--x {x}: there is no variable to draw over it; add --y VARIABLE")
    if kind in CRACKS:
        return crack(dataset, kind=CRACKS[kind])
    if kind == HISTORY or (kind is None and (particles or bond)):
        return history(dataset, y, particle=particles or None, bond=bond)
    return curve(dataset, x, y, kind=kind, **forces)
