"""Commands ``pbdkit plot``, ``animate`` and ``curve``: pictures, movies and curves of results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit import plotting
from pbdkit.cli.interface import CRACKS, HISTORY
from pbdkit.cli.options import load_experiment
from pbdkit.cli.output import refuse_output, refuse_unwritable, save
from pbdkit.errors import ExperimentError, refuse_no_matplotlib
from pbdkit.io.atomic_file import write
from pbdkit.io.open import reading
from pbdkit.io.other_files import is_experiment, refuse_other_file
from pbdkit.plotting.movie import refuse_no_movie
from pbdkit.plotting.style import COMMAND_OPTIONS, figure_of
from pbdkit.progress import progress_bar

if TYPE_CHECKING:
    import xarray

    from pbdkit.plotting.curves import Chart

TABLE = ".csv"
"""File name extension of tables of curves."""


def plot(
    file: Path,
    output: Path | None,
    times: tuple[float, ...],
    at: dict[str, str],
    settings: tuple[str, ...],
    force: bool,
    **look: Any,
) -> None:
    """Draw configurations of a result, or the set-up of an experiment."""
    if is_experiment(file):
        _plot_set_up(
            str(file), output, settings, force=force, look={"times": times, "at": at} | look
        )
        return
    refuse_other_file(file)
    if settings:
        raise ExperimentError(f"--set: changes an experiment, but {file} is a result")
    path = output or file.with_suffix(".png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file, at=at) as dataset:
        time = times if len(times) > 1 else times[0] if times else None
        axes = plotting.plot(dataset, time=time, **look)
        save(path, figure_of(axes[0] if isinstance(axes, list) else axes), replace=force)


def _plot_set_up(
    name: str, output: Path | None, settings: tuple[str, ...], *, force: bool, look: dict[str, Any]
) -> None:
    """Draw an experiment before it runs; raise ExperimentError for options of results."""
    page = {name: look.pop(name) for name in ("window", "figsize", "dpi")}
    option_names = COMMAND_OPTIONS | {"times": "time"}
    if options := [
        option_names.get(key, key)
        for key, value in look.items()
        if value not in (None, False, (), {}, "linear", "all")
    ]:
        raise ExperimentError(
            f"--{options[0]}: applies to results, but {name} is an experiment; "
            f"`pbdkit run {name}` computes a result"
        )
    experiment = load_experiment(name, settings)
    path = output or Path(f"{experiment.name.replace('/', '-')}-setup.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    axes = plotting.plot_experiment(experiment, **page)
    save(path, figure_of(axes), replace=force)


def animate(file: Path, output: Path | None, at: dict[str, str], force: bool, **look: Any) -> None:
    """Make a movie of a result: every recorded step, with one colour scale."""
    refuse_other_file(file)
    path = output or file.with_suffix(".mp4")
    refuse_no_movie(path)
    refuse_output(path, force=force)
    refuse_unwritable(None, path)
    with reading(file, at=at) as dataset, progress_bar(sys.stderr.isatty()) as show:
        plotting.animate(dataset, file=path, show=show, replace=force, **look)
    click.echo(f"{path} written")


def curve(
    file: Path,
    kind: str | None,
    output: Path | None,
    at: dict[str, str],
    force: bool,
    **options: Any,
) -> None:
    """Draw quantities of a result over time, or write them as CSV."""
    refuse_other_file(file)
    path = output or file.with_name(f"{file.stem}-{_default_name(kind, options)}.png")
    is_table = path.suffix == TABLE
    refuse_output(path, force=force)
    refuse_no_matplotlib()
    refuse_unwritable(None if is_table else path, path, or_table=TABLE)
    with reading(file, sweeps=True, at=at) as dataset:
        if is_table:
            write(path, _chart(dataset, kind, **options).csv().encode(), replace=force)
            click.echo(f"{path} written")
        elif kind in CRACKS:
            save(path, figure_of(plotting.crack(dataset, kind=CRACKS[kind])), replace=force)
        else:
            axes = _chart(dataset, kind, **options).draw(None)
            save(path, figure_of(axes), replace=force)


def _default_name(kind: str | None, options: dict[str, Any]) -> str:
    """Return the default name of the picture."""
    if kind in (None, HISTORY) and (options["particles"] or options["bond"]):
        return f"{HISTORY}-{options['y']}" if options["y"] else HISTORY
    return kind or options["y"] or "curve"


def _chart(
    dataset: xarray.Dataset,
    kind: Any,
    x: str | None,
    y: str | None,
    particles: tuple[int, ...],
    bond: tuple[int, int] | None,
    **forces: Any,
) -> Chart:
    """Return the lines of a curve. Raises ExperimentError for the map of a crack, which has
    none."""
    from pbdkit.plotting.cracks import crack_chart
    from pbdkit.plotting.curves import curve_chart, history_chart

    if x is not None and y is None:
        raise ExperimentError(f"--x {x}: requires a variable to draw; add --y VARIABLE")
    if kind in CRACKS:
        if CRACKS[kind] == "map":
            raise ExperimentError(
                f"{kind} is a map and cannot be written as CSV; `pbdkit explain --json` lists the "
                "broken bonds"
            )
        return crack_chart(dataset, CRACKS[kind])
    if kind == HISTORY or (kind is None and (particles or bond)):
        return history_chart(dataset, y, particles or None, (None, None), bond)
    return curve_chart(dataset, x, y, kind, forces)
