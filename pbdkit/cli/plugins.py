"""``pbdkit plugins``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.cli.conformance import check
from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.registry.plugin import Plugin

UNLIMITED = 10_000
INTERFACES = (
    "FollowerRule",
    "Lattice",
    "NeighbourMetric",
    "FramePolicy",
    "FractureModel",
    "Diagnostic",
)
"""The open interfaces by name, here so that `--help` imports none of them."""


@click.group()
def plugins() -> None:
    """What is installed, and in which state."""


plugins.add_command(check)


@plugins.command("list")
@json_option
def list_(as_json: bool) -> None:
    """A row for each component and one for each plugin."""
    from pbdkit.registry.registry import Registry

    registry = Registry()
    rows = [row for plugin in registry.plugins for row in _rows(plugin)]
    for warning in registry.doubts():
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        click.echo(json.dumps(rows))
    else:
        _print(rows)


@plugins.command()
@click.argument("name")
@click.option(
    "--interface",
    type=click.Choice(INTERFACES),
    default=INTERFACES[0],
    show_default=True,
    help="What the plugin adds.",
)
@click.option(
    "--dir",
    "parent",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=".",
    help="Where the project's folder is made; here by default.",
)
def new(name: str, interface: str, parent: Path) -> None:
    """Write a plugin project NAME, e.g. pbdkit-my-rule, that installs and runs as it stands."""
    from pbdkit.skeleton.project import project_of

    project = project_of(name, interface)
    folder = project.write(parent)
    click.echo(
        f"{folder}: the {interface} '{project.type}' stands in {project.module}.py; next:\n"
        f"  pip install -e {folder if folder.is_absolute() else f'./{folder}'}\n"
        f"  pbdkit run {folder / 'example.yaml'}"
    )


def _rows(plugin: Plugin) -> list[dict[str, str]]:
    """One of the plugin and one of each of its components."""
    origin = {"distribution": plugin.distribution, "version": plugin.version}
    offers = [
        {"interface": offer.interface.__name__ if offer.interface else "", "type": offer.name}
        | origin
        | {"state": offer.state, "reason": offer.reason}
        for offer in plugin.offers
    ]
    own = {"interface": "plugin", "type": plugin.name} | origin
    return [own | {"state": plugin.state, "reason": plugin.reason}, *offers]


def _print(rows: list[dict[str, str]]) -> None:
    """A table; a line a row where it goes to a file or another program."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for column in rows[0]:
        table.add_column(column, overflow="fold", no_wrap=column not in ("reason", "type"))
    for row in rows:
        table.add_row(*(Text(value) for value in row.values()))  # no markup: [x] is what it says
    Console(width=None if sys.stdout.isatty() else UNLIMITED).print(table)
