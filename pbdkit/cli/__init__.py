"""The command line. Commands load what they need when they run: `--help` costs next to nothing."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import click

from pbdkit import errors
from pbdkit.cli.options import with_no_plugins
from pbdkit.scene.memory import refuse_little_memory

MODULES = {
    "run": "run resume",
    "sweep": "sweep",
    "experiments": "check identify experiments init schema bench",
    "result": "plot explain status verify",
    "plugins": "plugins",
}
COMMANDS = {name: module for module, names in MODULES.items() for name in names.split()}
"""Every command with the module of pbdkit.cli in which it stands."""


class Commands(click.Group):
    """A group whose commands are imported when first needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order of a first session."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The command of that name, or a usage error with the nearest right one."""
        if name not in COMMANDS:
            if ctx.resilient_parsing:  # a shell asks how to go on
                return None
            from pbdkit.interfaces.component import did_you_mean

            ctx.fail(f"there is no command '{name}'{did_you_mean(name, COMMANDS)}")
        command: click.Command = getattr(import_module(f"pbdkit.cli.{COMMANDS[name]}"), name)
        return with_no_plugins(command)

    def invoke(self, ctx: click.Context) -> Any:
        """Ends quietly where whoever reads the output has had enough of it, as `head` has."""
        try:
            return super().invoke(ctx)
        except (BrokenPipeError, SystemExit) as error:  # rich makes the one of the other
            cause = error if isinstance(error, BrokenPipeError) else error.__context__
            if not isinstance(cause, BrokenPipeError):
                raise
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0


@with_no_plugins
@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True,
    epilog="Start with `pbdkit run paper/a`, or `pbdkit init` for an experiment of your own.",
)
@click.option("--debug", is_flag=True, help="Show a traceback where something fails.")
@click.version_option(package_name="pbdkit")
@click.pass_context
def program(context: click.Context, debug: bool) -> None:
    """Position-based dynamics of deformable bodies on lattices: rules instead of forces."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


def main(arguments: list[str] | None = None) -> None:
    """The program: exits 0 done, 1 a bug of ours, 2 a wrong experiment or call, 3 a missing or
    broken plugin, 4 diverged, 5 part of a sweep failed, 6 storage failed, 130 interrupted, 128
    and the number of another signal."""
    given = sys.argv[1:] if arguments is None else arguments
    if debug := "--debug" in given:
        given = [argument for argument in given if argument != "--debug"]
    # pydantic would look for plugins of its own, and stop at any torn distribution.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", errors.PbdkitWarning)
            warnings.showwarning = _warn
            refuse_little_memory()
            code: Any = program.main(given, prog_name="pbdkit", standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        where = getattr(error.__cause__, "args", error.args)
        code = _failed(" ".join(["interrupted", *map(str, where)]), 130)
    except click.ClickException as error:
        code = _failed(error.format_message(), error.exit_code)
    except (Exception, SystemExit) as error:  # pbdkit itself exits below
        if isinstance(error, SystemExit) and "_PBDKIT_COMPLETE" in os.environ:
            raise  # click has told a shell how the line goes on
        if debug:
            traceback.print_exc()
        code = _report(error)
    exec("")  # after an interrupt in another `exec` Python would end by the signal
    sys.exit(code or 0)


def _warn(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
    ours = issubclass(category, errors.PbdkitWarning)
    told = str(message) if ours else f"{category.__name__}: {message}"
    click.echo(f"warning: {errors.printable(told)}", err=True)


def _report(error: BaseException) -> int:
    if isinstance(error, errors.PbdkitError):
        return _failed(str(error), error.exit_status)
    if _of_memory(error):
        told = f"out of memory: {error}" if str(error) else "out of memory"
        return _failed(f"{told}; `pbdkit check` estimates what an experiment needs", 6)
    if any(isinstance(e, KeyboardInterrupt) for e in _contexts(error)):
        return _failed("interrupted", 130)
    what = f"a bug in pbdkit, please report it: {type(error).__name__}: {error}"
    return _failed(f"{what} (`pbdkit --debug ...` shows where)", 1)


def _contexts(error: BaseException | None) -> Iterator[BaseException]:
    """The error and what it was made of: while modules are loaded, of an interrupt too."""
    while error:
        yield error
        error = error.__context__


def _of_memory(error: BaseException) -> bool:
    """Whether memory is what was missing, which threads and libraries say in words of their own."""
    words = "can't start new thread", "failed to map segment", "Cannot allocate memory"
    return isinstance(error, MemoryError) or any(word in str(error) for word in words)


def _failed(message: str, code: int) -> int:
    message = errors.printable(message)
    click.echo(f"pbdkit: {message}" if "\n" not in message else f"pbdkit:\n{message}", err=True)
    return code
