"""Arguments and options that several commands have."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pbdkit.hooks import import_object

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from pbdkit.cli.completion import Completer
    from pbdkit.model.experiment import Experiment


PATH = click.Path(path_type=Path)
"""Click type of paths."""


class _Number(click.types.FloatParamType):
    """Click type of numbers. An error repeats the help of the option, which has the unit."""

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> float:
        """Return the number; a call of `fail` reports other text."""
        try:
            return float(value)
        except ValueError:
            help_ = getattr(parameter, "help", None)
            form = f"; expected {parameter.metavar}: {help_}" if parameter and help_ else ""
            self.fail(f"'{value}' is not a number{form}", parameter, context)


NUMBER = _Number()
"""Click type of numbers."""
C = TypeVar("C", bound=click.Command)
F = TypeVar("F", bound=Callable[..., Any])


def call(target: str, *args: Any, **options: Any) -> int | None:
    """Import a function of `pbdkit.cli`, given as ``file:name``, call it, and return its exit
    status."""
    status: int | None = import_object(f"pbdkit.cli.{target}")(*args, **options)
    return status


def load_experiment(name: str, settings: tuple[str, ...]) -> Experiment:
    """Load an experiment, given by its file or its shipped name, with settings.

    The file is read before the modules that validate it are imported, so that a mistyped name is
    reported quickly.
    """
    from pbdkit.model.shipped import read_experiment

    source = read_experiment(name)
    from pbdkit.model.loading import experiment_of_source

    return experiment_of_source(source, settings)


def completed_by(name: str) -> Completer:
    """Return a completer that is given as ``file:name``. It is imported only when a shell requests
    completions."""

    def complete(
        context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        completer: Completer = import_object(f"pbdkit.cli.{name}")
        return completer(context, parameter, incomplete)

    return complete


def result_argument(name: str, metavar: str = "OUT.nc", **more: Any) -> Callable[[F], F]:
    """Return a click argument for one or several results."""
    complete = completed_by("completion:results")
    return click.argument(name, metavar=metavar, type=PATH, shell_complete=complete, **more)


color_option = click.option(
    "--color",
    metavar="VARIABLE",
    help="Variable that gives the colours, e.g. pe1, u, u_x; an unknown name lists all.",
    shell_complete=completed_by("completion:variables"),
)
times_option = click.option(
    "--time",
    "times",
    type=float,
    multiple=True,
    help="Recorded step to draw, default the last; repeat it for further panels.",
    shell_complete=completed_by("completion:times"),
)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    shell_complete=completed_by("setting_completion:settings"),
    help="Change a value of the experiment, e.g. rule.K=-0.002 or leaders.1.until=20.",
)


def _choice(
    context: click.Context, option: click.Parameter, texts: tuple[str, ...]
) -> dict[str, str]:
    """Return the values by name. Raise click.BadParameter for a text that does not have the form
    NAME=VALUE."""
    for text in texts:
        if not all(text.partition("=")):
            raise click.BadParameter(f"'{text}': expected NAME=VALUE, for instance steel=3")
    return dict(text.split("=", 1) for text in texts)


at_option = click.option(
    "--at",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_choice,
    help="Select the member of a sweep by a parameter; repeat it for further parameters.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
verbose_option = click.option("--verbose", is_flag=True, help="Print all details.")


def _setting(constant: str) -> Callable[[click.Context, click.Parameter, bool], None]:
    """Return the callback of a flag that sets an environment variable to "*".

    The variable is set for this call and the processes that it starts. Its name is the value of a
    constant, which is given as ``module:name``.
    """

    def set_variable(context: click.Context, option: click.Parameter, flag: bool) -> None:
        if not flag:
            return
        variable = import_object(constant)
        previous = os.environ.get(variable)
        os.environ[variable] = "*"

        def restore() -> None:
            os.environ.pop(variable, None)
            os.environ.update({} if previous is None else {variable: previous})

        context.call_on_close(restore)

    return set_variable


outside_option = click.option(
    "--allow-outside",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_setting("pbdkit.model.reading:ALLOW_OUTSIDE"),
    help="Read files outside the folder of the file that names them.",
)


def experiment_argument(command: F) -> F:
    """Add the argument EXPERIMENT, and the option that permits an experiment to refer to files
    outside its folder."""
    argument = click.argument(
        "experiment", metavar="EXPERIMENT", shell_complete=completed_by("completion:experiments")
    )
    return outside_option(argument(command))


NO_PLUGINS = click.Option(
    ["--no-plugins"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_setting("pbdkit.hooks:DISABLE"),
    help="Load no plugins, as if pbdkit alone were installed.",
)
"""Option to load no plugins."""


def with_no_plugins(command: C) -> C:
    """Return the command, and its subcommands, with the option --no-plugins."""
    if NO_PLUGINS not in command.params:
        command.params.append(NO_PLUGINS)
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command
