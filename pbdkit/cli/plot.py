"""``pbdkit plot``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    from pbdkit.cli.output import FORMATS, refuse_output, save
    from pbdkit.errors import ExperimentError
    from pbdkit.results.accessor import reading
    from pbdkit.results.picture import draw, figure

    path = output or file.with_suffix(".png")
    if path.suffix not in FORMATS:
        raise ExperimentError(f"{path}: a picture ends in {', '.join(FORMATS)}")
    refuse_output(path, force=force)
    look: dict[str, Any] = {"color": color, "contours": contours, "numbers": numbers}
    with reading(file) as dataset:
        if len(times) > 1:
            drawn: Any = figure(dataset, times, **look)
        else:
            drawn = draw(dataset, next(iter(times), None), **look).figure
        save(path, drawn)
