"""Arguments and options that several commands take."""

from __future__ import annotations

import os
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

C = TypeVar("C", bound=click.Command)
SUFFIXES = (".yaml", ".yml", ".json")


def _completed(
    context: click.Context, parameter: click.Parameter, begun: str
) -> list[CompletionItem]:
    """The shipped experiments and the experiment files here that begin so; where no shipped one
    does, whatever the shell itself offers as files."""
    from click.shell_completion import CompletionItem

    from pbdkit.experiment.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    if not names:
        return [CompletionItem(begun, type="file")]
    files = sorted(p.name for p in Path().glob(f"{escape(begun)}*") if p.suffix in SUFFIXES)
    return [CompletionItem(name) for name in [*names, *files]]


experiment_argument = click.argument("experiment", metavar="EXPERIMENT", shell_complete=_completed)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    help="Change a value, e.g. rule.K=-0.002 or leaders.1.until=20.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def _disable_plugins(context: click.Context, option: click.Parameter, given: bool) -> None:
    """For this call and the processes that it starts: it is what the variable does."""
    if not given:
        return
    from pbdkit.registry.discovery import ALL, DISABLE

    before = {name: value for name, value in os.environ.items() if name == DISABLE}
    os.environ[DISABLE] = ALL
    context.call_on_close(lambda: os.environ.update(before))
    context.call_on_close(lambda: os.environ.pop(DISABLE, None))  # the last comes first


NO_PLUGINS = click.Option(
    ["--no-plugins"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_disable_plugins,
    help="Load no plugin, as if only pbdkit itself were installed.",
)


def with_no_plugins(command: C) -> C:
    """The command, and those in it, with the option --no-plugins."""
    if NO_PLUGINS not in command.params:
        command.params.append(NO_PLUGINS)
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command
