"""``pbdkit plugins check``."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.registry.plugin import Plugin
    from pbdkit.testing import Report

FAILED = 3


@click.command("check")
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
        if plugin.state not in ("ok", "conflict"):
            holds = False
            click.echo(f"{plugin} is {plugin.state}: {plugin.reason}", err=True)
        for report in examine_all(plugin.components):
            holds = holds and report.holds
            rows.append({"distribution": plugin.distribution} | asdict(report))
            if not as_json:
                click.echo(_told(report, verbose))
    if as_json:
        click.echo(json.dumps({"holds": holds, "reports": rows}))
    elif holds:
        tried = "1 example" if len(rows) == 1 else f"{len(rows)} examples"
        click.echo(f"all properties hold for {tried} of its components")
    context.exit(0 if holds else FAILED)


def _asked_for(distributions: tuple[str, ...]) -> list[Plugin]:
    """The plugins of these distributions, or all but the built-in one.

    Raises PluginError for a name that is not installed, and where there is no plugin at all.
    """
    from pbdkit.errors import PluginError
    from pbdkit.interfaces.naming import did_you_mean
    from pbdkit.registry.discovery import canonical
    from pbdkit.registry.registry import Registry

    plugins = Registry().plugins
    if not distributions:
        if not plugins[1:]:
            raise PluginError(
                "no plugin is installed; `pbdkit plugins check pbdkit` tries what is built in"
            )
        return plugins[1:]
    found = []
    for name in distributions:
        own = [p for p in plugins if canonical(p.distribution) == canonical(name)]
        if not own:
            hint = did_you_mean(name, [p.distribution for p in plugins])
            raise PluginError(f"'{name}' is not installed, or is no plugin{hint}")
        found += own
    return found


def _told(report: Report, verbose: bool) -> str:
    if verbose:
        return str(report)
    faults = [f"  failed  {outcome.property}: {outcome.reason}" for outcome in report.failed]
    return "\n".join([report.summary(), *faults])
