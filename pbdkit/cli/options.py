"""Arguments and options that several commands take."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from pbdkit.cli.completion import Completer

PATH = click.Path(path_type=Path)
C = TypeVar("C", bound=click.Command)
F = TypeVar("F", bound=Callable[..., Any])


def completed_by(name: str) -> Completer:
    """The completer of that name in `completion`, which is imported when a shell asks."""

    def complete(
        context: click.Context, parameter: click.Parameter, begun: str
    ) -> list[CompletionItem]:
        completer: Completer = getattr(import_module("pbdkit.cli.completion"), name)
        return completer(context, parameter, begun)

    return complete


def result_argument(name: str, metavar: str = "OUT.nc", **more: Any) -> Callable[[F], F]:
    """The argument of that name: a result, or several."""
    completed = completed_by("results")
    return click.argument(name, metavar=metavar, type=PATH, shell_complete=completed, **more)


color_option = click.option(
    "--color",
    metavar="VARIABLE",
    help="Colour by a variable, e.g. pe1, u, u_x; a wrong one lists all.",
    shell_complete=completed_by("variables"),
)
times_option = click.option(
    "--time",
    "times",
    type=float,
    multiple=True,
    help="Draw this recorded step, else the last; again for a panel more.",
    shell_complete=completed_by("times"),
)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    shell_complete=completed_by("settings"),
    help="Change a value, e.g. rule.K=-0.002 or leaders.1.until=20.",
)


def _choice(
    context: click.Context, option: click.Parameter, given: tuple[str, ...]
) -> dict[str, str]:
    """The values by name. Raises click.BadParameter."""
    for text in given:
        if not all(text.partition("=")):
            raise click.BadParameter(f"'{text}': expected NAME=VALUE, for instance steel=3")
    return dict(text.split("=", 1) for text in given)


at_option = click.option(
    "--at",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_choice,
    help="Of a sweep, the member with this parameter; again for one more.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
verbose_option = click.option("--verbose", is_flag=True, help="Say all that is known.")


def _setting(module: str, name: str) -> Callable[[click.Context, click.Parameter, bool], None]:
    """Return the callback of a flag that sets the environment variable of that name in a module to
    "*", for this call and the processes that it starts."""

    def set_variable(context: click.Context, option: click.Parameter, given: bool) -> None:
        if not given:
            return
        variable = getattr(import_module(module), name)
        before = os.environ.get(variable)
        os.environ[variable] = "*"

        def restore() -> None:
            os.environ.pop(variable, None)
            os.environ.update({} if before is None else {variable: before})

        context.call_on_close(restore)

    return set_variable


outside_option = click.option(
    "--allow-outside",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_setting("pbdkit.experiment.beside", "ALLOW_OUTSIDE"),
    help="Read files that lie outside the folder of the file that names them.",
)


def experiment_argument(command: F) -> F:
    """Add the argument of that name, and the option which of the files that it names are read."""
    argument = click.argument(
        "experiment", metavar="EXPERIMENT", shell_complete=completed_by("experiments")
    )
    return outside_option(argument(command))


NO_PLUGINS = click.Option(
    ["--no-plugins"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_setting("pbdkit.registry.discovery", "DISABLE"),
    help="Load no plugin, as if only pbdkit itself were installed.",
)


def with_no_plugins(command: C) -> C:
    """The command, and those in it, with the option --no-plugins."""
    if NO_PLUGINS not in command.params:
        command.params.append(NO_PLUGINS)
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command
