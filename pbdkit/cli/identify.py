"""``pbdkit identify``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option

TABLE_WIDTH = 100


@click.command()
@experiment_argument
@set_option
@json_option
@click.option("--picture", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
def identify(
    experiment: str, settings: tuple[str, ...], as_json: bool, picture: Path | None
) -> None:
    """Say what the experiment's rule is physically, on its lattice and neighbours."""
    from pbdkit.api import identify, load
    from pbdkit.cli.output import refuse_unwritable, save

    refuse_unwritable(picture)
    found = identify(load(experiment, settings=settings))
    if as_json:
        click.echo(json.dumps(found.as_dict()))
    else:
        from rich.console import Console

        from pbdkit.identity.verdict import table

        console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH, highlight=False)
        click.echo(f"{found.name}: {found.rule}, {found.lattice} lattice, {found.neighbours}")
        console.print(table(found))
        for note in found.notes:
            click.echo(f"note: {note}")
    if picture:
        from pbdkit.identity.polar import by_direction

        save(picture, by_direction(found), quiet=as_json)
