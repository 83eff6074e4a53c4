"""``pbdkit plugins``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from pbdkit.cli.conformance import check
from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.registry.loading import Plugin


@click.group()
def plugins() -> None:
    """What is installed, and in which state."""


plugins.add_command(check)


@plugins.command("list")
@json_option
def list_(as_json: bool) -> None:
    """A row for each component and one for each plugin."""
    from pbdkit.registry.registry import Registry

    rows = [row for plugin in Registry().plugins for row in _rows(plugin)]
    if as_json:
        click.echo(json.dumps(rows))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*rows[0])
    for row in rows:
        table.add_row(*row.values())
    Console().print(table)


def _rows(plugin: Plugin) -> list[dict[str, str]]:
    from pbdkit.registry.registry import interface_of

    rest = {
        "distribution": plugin.distribution,
        "version": plugin.version,
        "state": plugin.state,
        "reason": plugin.reason,
    }
    offered = [(interface_of(c).__name__, c.type_name()) for c in plugin.components]
    return [
        {"interface": interface, "type": name} | rest
        for interface, name in [("plugin", plugin.name), *offered]
    ]
