"""``pbdkit plugins``."""

from __future__ import annotations

import json
from typing import Any

import click

from pbdkit.cli.options import json_option


@click.group()
def plugins() -> None:
    """What is installed, and in which state."""


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


def _rows(plugin: Any) -> list[dict[str, str]]:
    from pbdkit.interfaces import INTERFACES

    origin = {"distribution": plugin.distribution, "version": plugin.version}
    state = {"state": plugin.state, "reason": plugin.reason}
    rows = [
        {
            "interface": next(i.__name__ for i in INTERFACES.values() if issubclass(c, i)),
            "type": c.type_name(),
        }
        | origin
        | state
        for c in plugin.components
    ]
    return [{"interface": "plugin", "type": plugin.name} | origin | state, *rows]
