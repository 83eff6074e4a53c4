"""``pbdkit experiments``, ``init`` and ``schema``: what there is to start from, for a shell too."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


@click.command()
def experiments() -> None:
    """List the shipped experiments."""
    from pbdkit.experiment.shipped import shipped_names, shipped_text

    names = shipped_names()
    width = max(map(len, names))
    for name in names:
        title = shipped_text(name).splitlines()[0].removeprefix("# ")
        click.echo(f"{name:<{width}}  {title}")


@click.command()
@click.argument("file", default="experiment.yaml", type=click.Path(path_type=Path))
def init(file: Path) -> None:
    """Write a commented experiment to start from."""
    from pbdkit.cli.output import storing
    from pbdkit.errors import ExperimentError
    from pbdkit.experiment.shipped import shipped_text

    if os.path.lexists(file):
        raise ExperimentError(f"{file}: exists and is left as it is; name another file")
    with storing(file), file.open("x", encoding="utf-8") as written:
        written.write(shipped_text("start"))
    click.echo(f"{file} written; next: pbdkit check {file}, then pbdkit run {file}")


@click.command()
@click.argument("what", type=click.Choice(["experiment", "dataset"]), default="experiment")
@click.option("--builtin", is_flag=True, help="Leave third-party components out.")
def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments or datasets, closed over what is installed."""
    from pbdkit.experiment.schema import experiment_schema
    from pbdkit.registry.registry import Registry
    from pbdkit.results.layout import dataset_schema

    make = {"experiment": experiment_schema, "dataset": dataset_schema}[what]
    click.echo(json.dumps(make(Registry(), installed=not builtin), indent=2))


SUFFIXES = (".yaml", ".yml", ".json")


def complete_experiments(
    context: click.Context, parameter: click.Parameter, begun: str
) -> list[CompletionItem]:
    """The shipped experiments and the experiment files here that begin so; where no shipped one
    does, whatever the shell itself offers as files."""
    from click.shell_completion import CompletionItem

    from pbdkit.experiment.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    if not names:
        return [CompletionItem(begun, type="file")]
    here = (path.name for path in Path().iterdir() if path.suffix in SUFFIXES)
    files = sorted(name for name in here if name.startswith(begun))
    return [CompletionItem(name) for name in [*names, *files]]
