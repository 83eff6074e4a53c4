"""``pbdkit plot``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("file", metavar="OUT.nc", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
@click.option("--time", "times", type=int, multiple=True, help="A recorded step; several panels.")
@click.option("--color", metavar="VARIABLE", help="Colour by a variable, e.g. pe1.")
@click.option("--contours", is_flag=True, help="Fill contours of the variable.")
@click.option("--numbers", is_flag=True, help="Write the particles' numbers.")
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def plot(
    file: Path,
    output: Path | None,
    times: tuple[int, ...],
    color: str | None,
    contours: bool,
    numbers: bool,
    force: bool,
) -> None:
    """Draw configurations of a result: kinds, numbers, any diagnostic in colour."""
    from pbdkit.errors import ExperimentError, StorageError
    from pbdkit.results.accessor import open as open_result
    from pbdkit.results.picture import figure

    path = output or file.with_suffix(".png")
    if path.exists() and not force:
        raise ExperimentError(f"{path}: exists; --force replaces it, -o names another file")
    with open_result(file) as dataset:
        last = int(dataset["time"][-1])
        drawn = figure(dataset, times or (last,), color=color, contours=contours, numbers=numbers)
    try:
        drawn.savefig(path)
    except (OSError, ValueError) as error:
        raise StorageError(f"{path}: cannot be written: {error}") from None
    click.echo(f"{path} written")
