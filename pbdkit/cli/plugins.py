"""``pbdkit plugins``."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.registry.loading import Plugin

UNLIMITED = 10_000


@click.group()
def plugins() -> None:
    """What is installed, and in which state."""


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
