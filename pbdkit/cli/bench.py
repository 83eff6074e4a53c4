"""``pbdkit bench``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import experiment_argument, set_option

if TYPE_CHECKING:
    from pbdkit.benching.measuring import Bench, Row

TABLE_WIDTH = 110


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
    """Measure speed against error: engines, precisions and threads, at one or several sizes."""
    from rich.console import Console

    from pbdkit.api import load
    from pbdkit.benching.measuring import Bench
    from pbdkit.benching.method import methods
    from pbdkit.benching.report import LEGEND, reasons, table
    from pbdkit.cli.pictures import refuse_unwritable

    refuse_unwritable(picture, json_file)
    loaded = load(experiment, settings=(*settings, *([f"steps={steps}"] if steps else ())))
    measured = Bench(experiment, settings, loaded.steps)
    rows = [row for size in sizes or (None,) for row in measured.measure(methods(), size, _tell)]
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    click.echo(f"{loaded.name}: {loaded.steps} steps")
    console.print(table(rows))
    click.echo("\n".join(LEGEND))
    for line in reasons(rows):
        click.echo(f"cannot be had: {line}")
    _write(json_file, picture, loaded.name, measured, rows)


def _tell(what: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"measuring {what}", err=True)


def _write(
    json_file: Path | None, picture: Path | None, name: str, bench: Bench, rows: list[Row]
) -> None:
    from pbdkit.benching.method import Measured
    from pbdkit.benching.picture import work_precision
    from pbdkit.benching.report import as_dict
    from pbdkit.cli.pictures import save
    from pbdkit.errors import StorageError

    if json_file:
        text = json.dumps(as_dict(bench, rows), indent=1)
        try:
            json_file.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"{json_file}: cannot be written: {error.strerror}") from None
        click.echo(f"{json_file} written")
    if picture:
        measured = [row for row in rows if isinstance(row, Measured)]
        save(picture, work_precision(measured, f"{name}, {bench.steps} steps"))
