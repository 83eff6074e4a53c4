"""``pbdkit bench``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import experiment_argument, set_option

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from pbdkit.experiment.model import Experiment

    Found = tuple[dict[str, Any], Callable[[], Figure]]
    Sizing = tuple[int | None, ...]

TABLE_WIDTH = 116


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
    from pbdkit.api import load
    from pbdkit.cli.pictures import refuse_unwritable

    refuse_unwritable(picture, json_file)
    loaded = load(experiment, settings=(*settings, *([f"steps={steps}"] if steps else ())))
    compare = _step if loaded.solver.makes_steps else _find
    figures, draw = compare(loaded, experiment, settings, sizes or (None,))
    _write(json_file, picture, figures, draw)


def _step(loaded: Experiment, name: str, settings: tuple[str, ...], sizes: Sizing) -> Found:
    from pbdkit.benching.measuring import Bench
    from pbdkit.benching.method import Measured, methods
    from pbdkit.benching.picture import work_precision
    from pbdkit.benching.report import LEGEND, as_dict, reasons, table

    bench = Bench(name, settings, loaded.steps)
    rows = [row for size in sizes for row in bench.measure(methods(), size, _tell)]
    title = f"{loaded.name}, {bench.steps} steps"
    click.echo(f"{loaded.name}: {loaded.steps} steps")
    _print(table(rows), (*LEGEND, *(f"cannot be had: {line}" for line in reasons(rows))))
    measured = [row for row in rows if isinstance(row, Measured)]
    return as_dict(bench, rows), partial(work_precision, measured, title)


def _find(loaded: Experiment, name: str, settings: tuple[str, ...], sizes: Sizing) -> Found:
    from pbdkit.benching import equilibria_report as report
    from pbdkit.benching.equilibria import EquilibriumBench, Solved
    from pbdkit.benching.equilibria_picture import equilibria_picture

    bench = EquilibriumBench(name, settings, loaded.steps)
    found = [bench.measure(size, _tell) for size in sizes]
    truths, rows = [truth for truth, _ in found], [row for _, some in found for row in some]
    click.echo(f"{loaded.name}: equilibrium")
    absent = (f"left out: {line}" for line in report.equilibria_reasons(rows))
    lines = (*report.LEGEND, *report.truths(truths), *absent, *report.gains(rows))
    _print(report.equilibria_table(rows), lines)
    solved = [row for row in rows if isinstance(row, Solved)]
    figures = report.equilibria_as_dict(bench, truths, rows)
    return figures, partial(equilibria_picture, solved, f"{loaded.name}: to equilibrium")


def _print(table: Table, lines: Iterable[str]) -> None:
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else TABLE_WIDTH).print(table)
    click.echo("\n".join(lines))


def _tell(what: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"measuring {what}", err=True)


def _write(
    json_file: Path | None,
    picture: Path | None,
    figures: dict[str, Any],
    draw: Callable[[], Figure],
) -> None:
    from pbdkit.cli.pictures import save
    from pbdkit.errors import StorageError

    if json_file:
        try:
            json_file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"{json_file}: cannot be written: {error.strerror}") from None
        click.echo(f"{json_file} written")
    if picture:
        save(picture, draw())
