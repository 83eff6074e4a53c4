"""``pbdkit bench``: speed against error."""

from __future__ import annotations

import json
from itertools import count
from pathlib import Path

import click

from pbdkit.cli.options import experiment_argument, set_option


def _sizes(context: click.Context, option: click.Parameter, given: str | None) -> tuple[int, ...]:
    """Numbers of sites, separated by commas, each from 2."""
    words = [word.strip() for word in given.split(",")] if given is not None else []
    for word in words:
        if not (word.isascii() and word.isdecimal()) or not 2 <= int(word) < 2**31:
            what = f"'{word}' is no number of sites from 2; write for instance 50,100,200"
            raise click.BadParameter(what)
    return tuple(dict.fromkeys(map(int, words)))


@click.command()
@experiment_argument
@click.option("--sizes", callback=_sizes, help="Sites along the longer side, e.g. 50,100,200.")
@click.option("--steps", type=click.IntRange(min=1), help="Steps of each run; else its own.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures.")
@click.option("--plot", "picture", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
@set_option
def bench(
    experiment: str,
    sizes: tuple[int, ...],
    steps: int | None,
    json_file: Path | None,
    picture: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Measure speed against error, at one or several sizes: engines, precisions and threads; where
    the solver is `equilibrium`, its methods and the steps, over tolerances."""
    from pbdkit.api import load
    from pbdkit.bench import work_precision
    from pbdkit.bench.work_precision import measure, ways
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save, show_table, waiting
    from pbdkit.io.atomic_file import write

    for path in filter(None, (picture, json_file)):
        refuse_output(path, force=True, experiment=Path(experiment))
    refuse_unwritable(picture, json_file)
    changed = (*settings, *([f"steps={steps}"] if steps else ()))
    loaded = load(experiment, settings=changed)
    total = ways(loaded) * max(1, len(sizes))
    with waiting(f"measuring in {total} ways, each in a process of its own") as say:
        told = count(1)

        def tell(what: str) -> None:
            say(f"measured {what}; {next(told)} of {total}")

        rows = [row for n in sizes or (None,) for row in measure(experiment, changed, n, tell)]
    title = f"{loaded.name}, {loaded.solver.type}, {loaded.steps} steps"
    click.echo(title)
    show_table(work_precision.table(rows))
    click.echo("\n".join(work_precision.lines(rows)))
    if json_file:
        figures = work_precision.as_dict(experiment, settings, loaded.steps, rows)
        write(json_file, json.dumps(figures, indent=1) + "\n", replace=True)
        click.echo(f"{json_file} written")
    if picture:
        save(picture, work_precision.picture(rows, title), replace=True)
