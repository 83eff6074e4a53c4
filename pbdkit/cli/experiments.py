"""What there is to start from: ``pbdkit experiments``, ``init`` and ``schema``."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click


@click.command()
def experiments() -> None:
    """List the shipped experiments."""
    from pbdkit.experiment.shipped import shipped_names, shipped_title

    width = max(map(len, names := shipped_names()))
    for name in names:
        click.echo(f"{name:<{width}}  {shipped_title(name)}")


@click.command()
@click.argument("file", default="experiment.yaml", type=click.Path(path_type=Path))
def init(file: Path) -> None:
    """Write a commented experiment to start from."""
    from pbdkit.cli.output import refusals_as
    from pbdkit.errors import ExperimentError
    from pbdkit.experiment.shipped import shipped_text

    if os.path.lexists(file):
        raise ExperimentError(f"{file}: exists and is left as it is; name another file")
    with refusals_as(f"{file}: cannot be written"), file.open("x", encoding="utf-8") as written:
        written.write(shipped_text("start"))
    click.echo(f"{file} written; next: pbdkit check {file}, then pbdkit run {file}")


@click.command()
@click.argument(
    "what", type=click.Choice(["experiment", "dataset", "sweep", "fit"]), default="experiment"
)
@click.option("--builtin", is_flag=True, help="Leave third-party components out.")
def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments, datasets, sweeps or fits, with what is installed."""
    from pbdkit.experiment.schema import experiment_schema
    from pbdkit.fitting.schema import fit_schema
    from pbdkit.registry.registry import Registry
    from pbdkit.results.layout import dataset_schema
    from pbdkit.sweeps.specification import sweep_schema

    if what in (of_files := {"sweep": sweep_schema, "fit": fit_schema}):
        made = of_files[what]()
    else:
        make = {"experiment": experiment_schema, "dataset": dataset_schema}[what]
        made = make(Registry(), installed=not builtin)
    click.echo(json.dumps(made, indent=2))
