"""``pbdkit plugins``: what is installed, whether it conforms, and new ones."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.registry.discovery import Offer, Plugin
    from pbdkit.testing import Report

INTERFACES = (
    "FollowerRule", "Lattice", "NeighbourMetric", "FramePolicy", "FractureModel", "Diagnostic",
)  # fmt: skip
"""The open interfaces by name, here so that `--help` imports none of them."""


@click.group(invoke_without_command=True)
@click.pass_context
def plugins(context: click.Context) -> None:
    """What is installed, and in which state."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


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
        return
    from rich.table import Table
    from rich.text import Text

    from pbdkit.cli.output import show_table

    table = Table(box=None, pad_edge=False)
    for column in rows[0]:
        table.add_column(column, overflow="fold", no_wrap=column not in ("reason", "type"))
    for row in rows:
        table.add_row(*map(Text, row.values()))  # no markup: [x] is what it says
    show_table(table)


@plugins.command(short_help="Write a plugin project that installs and runs.")
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
    from pbdkit.cli.project import project_of

    project = project_of(name, interface)
    folder = project.write(parent)
    click.echo(
        f"{folder}: the {interface} '{project.type}' stands in {project.module}.py; next:\n"
        f"  pip install -e {folder if folder.is_absolute() else f'./{folder}'}\n"
        f"  pbdkit run {folder / 'example.yaml'}"
    )


@plugins.command(short_help="Try every property on each component of a plugin.")
@click.argument("distributions", metavar="[DISTRIBUTION]...", nargs=-1)
@click.option("--verbose", is_flag=True, help="Show every property, held, failed and skipped.")
@json_option
@click.pass_context
def check(
    context: click.Context, distributions: tuple[str, ...], verbose: bool, as_json: bool
) -> None:
    """Tries every property of its interface on each component of a distribution.

    Without a name those of all plugins are tried. `pbdkit` is the distribution of the built-in
    components. Exits 3 where something fails, or a plugin does not load.
    """
    from pbdkit.testing import examine_all

    rows, holds = [], True
    for plugin in _asked_for(distributions):
        if plugin.fault:
            holds = False
            click.echo(f"{plugin} is {plugin.fault}", err=True)
        for report in examine_all(plugin.components):
            holds = holds and report.holds
            rows.append({"distribution": plugin.distribution} | asdict(report))
            if not as_json:
                click.echo(report if verbose else _told(report))
    if as_json:
        click.echo(json.dumps({"holds": holds, "reports": rows}))
    elif holds:
        tried = "1 example" if len(rows) == 1 else f"{len(rows)} examples"
        click.echo(f"all properties hold for {tried} of its components")
    context.exit(0 if holds else 3)


def _rows(plugin: Plugin) -> list[dict[str, str]]:
    """One of the plugin and one of each of its components."""
    rows: list[tuple[str, Plugin | Offer]] = [("plugin", plugin)]
    rows += [(o.interface.__name__ if o.interface else "", o) for o in plugin.offers]
    origin = {"distribution": plugin.distribution, "version": plugin.version}
    return [
        {"interface": kind, "type": row.name, **origin, "state": row.state, "reason": row.reason}
        for kind, row in rows
    ]


def _asked_for(distributions: tuple[str, ...]) -> list[Plugin]:
    """The plugins of these distributions, or all but the built-in one.

    Raises PluginError for a name that is not installed, and where there is no plugin at all.
    """
    from pbdkit.errors import PluginError, did_you_mean
    from pbdkit.registry import BUILTIN
    from pbdkit.registry.discovery import canonical
    from pbdkit.registry.registry import Registry

    known: dict[str, list[Plugin]] = {}
    for plugin in Registry().plugins:
        known.setdefault(canonical(plugin.distribution), []).append(plugin)
    asked = distributions or [name for name in known if name != BUILTIN]
    if not asked:
        raise PluginError(
            "no plugin is installed; `pbdkit plugins check pbdkit` tries what is built in"
        )
    for name in asked:
        if canonical(name) not in known:
            hint = did_you_mean(name, [own[0].distribution for own in known.values()])
            raise PluginError(f"'{name}' is not installed, or is no plugin{hint}")
    return [plugin for name in asked for plugin in known[canonical(name)]]


def _told(report: Report) -> str:
    faults = [f"  failed  {outcome.property}: {outcome.reason}" for outcome in report.failed]
    return "\n".join([report.summary(), *faults])
