"""``pbdkit bench``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from pbdkit.cli.options import experiment_argument, set_option

TABLE_WIDTH = 132


class Sizes(click.ParamType[tuple[int, ...]]):
    """Numbers of sites, separated by commas."""

    name = "sizes"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """The numbers, each from 2."""
        words = [word.strip() for word in str(value).split(",")]
        for word in words:
            if not (word.isascii() and word.isdecimal()) or not 2 <= int(word) < 2**31:
                self.fail(f"'{word}' is no number of sites from 2; write for instance 50,100,200")
        return tuple(dict.fromkeys(int(word) for word in words))


@click.command()
@experiment_argument
@click.option("--sizes", type=Sizes(), help="Sites along the longer side, e.g. 50,100,200.")
@click.option("--steps", type=click.IntRange(min=1), help="Steps of each run; else its own.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures.")
@click.option("--plot", "picture", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
@set_option
def bench(
    experiment: str,
    sizes: tuple[int, ...] | None,
    steps: int | None,
    json_file: Path | None,
    picture: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Measure speed against error, at one or several sizes: engines, precisions and threads; where
    the solver is `equilibrium`, its methods and the steps, over tolerances."""
    from rich.console import Console

    from pbdkit.api import load
    from pbdkit.bench import work_precision
    from pbdkit.bench.measurement import measure
    from pbdkit.cli.output import refuse_unwritable, save
    from pbdkit.errors import StorageError

    refuse_unwritable(picture, json_file)
    changed = (*settings, *([f"steps={steps}"] if steps else ()))
    loaded = load(experiment, settings=changed)
    rows = [row for n in sizes or (None,) for row in measure(experiment, changed, n, _tell)]
    title = f"{loaded.name}, {loaded.solver.type}, {loaded.steps} steps"
    click.echo(title)
    Console(width=None if sys.stdout.isatty() else TABLE_WIDTH).print(work_precision.table(rows))
    click.echo("\n".join(work_precision.lines(rows)))
    if json_file:
        figures = work_precision.as_dict(experiment, settings, loaded.steps, rows)
        try:
            json_file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"{json_file}: cannot be written: {error.strerror}") from None
        click.echo(f"{json_file} written")
    if picture:
        save(picture, work_precision.picture(rows, title))


def _tell(what: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"measured {what}", err=True)
