"""``pbdkit plot`` and ``animate``: a result as a picture, and as a movie."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

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
    from pbdkit.cli.output import refuse_output, refuse_unwritable, save
    from pbdkit.drawing.picture import plot as draw
    from pbdkit.errors import ExperimentError
    from pbdkit.results.other_files import is_experiment, refuse_other_file
    from pbdkit.results.result_file import reading

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
        from pbdkit.drawing.figures import figure_of  # needs matplotlib, which is there by now

        save(path, figure_of(axes[0] if isinstance(axes, list) else axes), replace=force)


def _plot_set_up(
    name: str, output: Path | None, settings: tuple[str, ...], *, force: bool, look: dict[str, Any]
) -> None:
    """Draw an experiment before it runs. Raises ExperimentError for options of results."""
    from pbdkit.api import load
    from pbdkit.cli.output import refuse_output, refuse_unwritable, save
    from pbdkit.drawing.picture import plot_experiment
    from pbdkit.errors import ExperimentError

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
    from pbdkit.drawing.figures import figure_of  # needs matplotlib, which is there by now

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
    from pbdkit.cli.output import refuse_output, refuse_unwritable
    from pbdkit.drawing.movie import animate as write
    from pbdkit.drawing.movie import refuse_no_movie
    from pbdkit.results.other_files import refuse_other_file
    from pbdkit.results.progress import progress_bar
    from pbdkit.results.result_file import reading

    refuse_other_file(file)
    path = output or file.with_suffix(".mp4")
    refuse_no_movie(path)
    refuse_output(path, force=force)
    refuse_unwritable(None, path)
    with reading(file, at=at) as dataset, progress_bar(sys.stderr.isatty()) as show:
        write(dataset, file=path, show=show, replace=force, **look)
    click.echo(f"{path} written")
