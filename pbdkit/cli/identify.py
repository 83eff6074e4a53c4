"""``pbdkit identify``."""

from __future__ import annotations

import json
import sys

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option

TABLE_WIDTH = 100


@click.command()
@experiment_argument
@set_option
@json_option
def identify(experiment: str, settings: tuple[str, ...], as_json: bool) -> None:
    """Say what the experiment's rule is physically, on its lattice and neighbours."""
    from pbdkit.api import identify, load

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
