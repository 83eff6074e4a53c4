"""Arguments and options that several commands take."""

from __future__ import annotations

import os
from typing import TypeVar

import click

from pbdkit.cli.experiments import complete_experiments

C = TypeVar("C", bound=click.Command)

experiment_argument = click.argument(
    "experiment", metavar="EXPERIMENT", shell_complete=complete_experiments
)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    help="Change a value, e.g. rule.K=-0.002 or leaders.1.until=20.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def with_no_plugins(command: C) -> C:
    """The command, and those in it, with the option --no-plugins."""
    if not any(option.name == "no_plugins" for option in command.params):
        command.params.append(
            click.Option(
                ["--no-plugins"],
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_disable_plugins,
                help="Load no plugin, as if only pbdkit itself were installed.",
            )
        )
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command


def _disable_plugins(context: click.Context, option: click.Parameter, given: bool) -> None:
    """For this call and the processes that it starts: it is what the variable does."""
    if not given:
        return
    from pbdkit.registry.discovery import ALL, DISABLE

    before = {name: value for name, value in os.environ.items() if name == DISABLE}

    def restore() -> None:
        os.environ.pop(DISABLE, None)
        os.environ.update(before)

    os.environ[DISABLE] = ALL
    context.call_on_close(restore)
