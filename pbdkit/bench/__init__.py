"""Work–precision measurements: the cost of each solver against its error (`pbdkit bench`). The
module `work_precision` makes the measurements, each of them in a separate process."""

from __future__ import annotations

from typing import Any

import click

from pbdkit.cli.options import PATH, experiment_argument, load_experiment, set_option
from pbdkit.hooks import Command, hookimpl, import_object


@hookimpl
def pbdkit_commands() -> list[Command]:
    """Return the command `bench`."""
    does = "Measure speed against error, to choose a solver."
    return [Command("bench", "pbdkit.bench:bench", does, "Understand")]


def _sizes(context: click.Context, option: click.Parameter, text: str | None) -> tuple[int, ...]:
    """Return the numbers of sites in a text. The numbers are separated by commas."""
    words = [word.strip() for word in text.split(",")] if text is not None else []
    for word in words:
        if not (word.isascii() and word.isdecimal()) or not 2 <= int(word) < 2**31:
            raise click.BadParameter(
                f"'{word}' is not a number of sites of at least 2; write for instance 50,100,200"
            )
    return tuple(dict.fromkeys(map(int, words)))


@click.command()
@experiment_argument
@click.option("--sizes", callback=_sizes, help="Sites along the longer side, e.g. 50,100,200.")
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    help="Steps of each run; default those of the experiment.",
)
@click.option("--json", "json_file", type=PATH, help="JSON file for the figures.")
@click.option("--plot", "picture", type=PATH, help="PNG, SVG or PDF.")
@set_option
def bench(experiment: str, settings: tuple[str, ...], steps: int | None, **options: Any) -> None:
    """Measure speed against error, at one or several sizes. Engines, precisions and numbers of
    threads are compared or, with the solver `equilibrium`, its methods and steps at several
    tolerances."""
    changes = (*settings, *([f"steps={steps}"] if steps else ()))
    loaded = load_experiment(experiment, changes)
    show = import_object("pbdkit.bench.work_precision:show_work_precision")
    show(loaded, experiment, settings, changes, **options)
