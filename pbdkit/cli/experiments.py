"""What there is to start from: ``pbdkit experiments``, ``init`` and ``schema``."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from pbdkit.cli.options import PATH, completed_by

START = "start"
"""The shipped experiment that `init` writes by default."""


@click.command()
@click.argument("name", required=False, shell_complete=completed_by("shipped"))
def experiments(name: str | None) -> None:
    """List the shipped experiments, or print the file of one, e.g. paper/f1."""
    from pbdkit.experiment.shipped import shipped_names, shipped_text, shipped_title

    if name is not None:
        click.echo(shipped_text(name), nl=False)
        return
    width = max(map(len, names := shipped_names()))
    for each in names:
        click.echo(f"{each:<{width}}  {shipped_title(each)}")


@click.command()
@click.argument("file", required=False, type=PATH)
@click.option(
    "--from",
    "origin",
    metavar="NAME",
    shell_complete=completed_by("shipped"),
    help="Copy this shipped experiment with its data files, e.g. paper/f1.",
)
def init(file: Path | None, origin: str | None) -> None:
    """Write an experiment to start from: a commented one, or a copy of a shipped one.

    FILE is experiment.yaml by default, or with --from the last part of NAME with .yaml."""
    from pbdkit.errors import ExperimentError
    from pbdkit.experiment.shipped import SUFFIX, shipped_data, shipped_names, shipped_text
    from pbdkit.storage.destination import write_together

    path, text = (
        file or Path(Path(origin or "experiment").name + SUFFIX),
        shipped_text(origin or START),
    )
    if origin is None and str(path) in shipped_names():
        copy = f"`pbdkit init {path.name}{SUFFIX} --from {path}` copies it"
        raise ExperimentError(f"{path}: is a shipped experiment, no file to be written; {copy}")
    data = shipped_data(origin) if origin else []
    files = {path.with_name(d.name): d.read_bytes() for d in data} | {path: text.encode()}
    for each in files:
        if os.path.lexists(each):
            raise ExperimentError(f"{each}: exists and is left as it is; name another file")
    write_together(files)
    beside = f" with {', '.join(d.name for d in data)}" if data else ""
    click.echo(f"{path} written{beside}; next: pbdkit check {path}, then pbdkit run {path}")


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
