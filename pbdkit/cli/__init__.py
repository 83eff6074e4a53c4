"""Command line. Each command imports its modules when it is called, so that `--help` is fast."""

from __future__ import annotations

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from itertools import groupby
from typing import Any

import click

import pbdkit
from pbdkit import errors
from pbdkit.cli.commands import CommandTable, builtin_commands
from pbdkit.cli.options import with_no_plugins
from pbdkit.cli.streams import standard_streams
from pbdkit.memory import refuse_little_memory

COMPLETING = "_PBDKIT_COMPLETE"
"""Environment variable with which a shell requests completions."""


FIRST = {
    "pbdkit run paper/a": "Run a paper case: paper-a.nc.",
    "pbdkit plot paper-a.nc --color pe1": "Draw the result: paper-a.png.",
    "pbdkit init": "Write a template: experiment.yaml.",
}
"""The first commands that a user needs, with their purpose."""
WELCOME = """\
pbdkit computes the deformation of bodies on lattices. Particles follow their
neighbours by rules instead of forces. An experiment file describes the run; its
result is a dataset.
"""
"""Text that is printed if no command is given."""
SYSTEM = {*errors.REMEDIES, errno.EFBIG, errno.EROFS, errno.ENAMETOOLONG}
"""Errors of the operating system that no defect of pbdkit causes, by number."""
MORE = """\
`pbdkit COMMAND --help` describes a command, `pbdkit --help` all options."""
"""Hint to further help."""


@with_no_plugins
@click.group(
    cls=CommandTable,
    context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True,
    epilog='In bash, `eval "$(_PBDKIT_COMPLETE=bash_source pbdkit)"` enables completion of '
    "commands, settings, variables and steps with the Tab key; for zsh and fish see "
    'the page "Write and run experiment files" of the documentation.',
)
@click.option("--debug", is_flag=True, help="Show a traceback if a command fails.")
@click.option("--version", is_flag=True, help="Print the version.")
@click.option(
    "--verbose",
    is_flag=True,
    help="With --version: also the system, dependencies and plugins, for the report of a defect.",
)
@click.pass_context
def program(context: click.Context, debug: bool, version: bool, verbose: bool) -> None:
    """Position-based dynamics of deformable bodies on lattices: rules instead of forces."""
    if version:
        click.echo(_version_report() if verbose else f"pbdkit {pbdkit.__version__}")
        context.exit()
    if verbose:
        raise click.UsageError("--verbose: requires --version, as in `pbdkit --version --verbose`")
    if context.invoked_subcommand is None:
        click.echo(_welcome())


def _version_report() -> str:
    from pbdkit.cli.version import version_report

    return version_report()


def _welcome() -> str:
    """Return a text that lists the first commands that a user needs, and all commands."""
    lines = [WELCOME, "First commands:"]
    lines += [f"  {typed:<36} {does}" for typed, does in FIRST.items()]
    for group, commands in groupby(builtin_commands().values(), key=lambda command: command.group):
        lines += [f"\n{group}:", *(f"  {command.name:<12} {command.does}" for command in commands)]
    return "\n".join([*lines, "", MORE])


def main(arguments: list[str] | None = None) -> None:
    """Run the program and return its exit status. It is 0 after success, 1 for a defect of pbdkit,
    2 for an invalid experiment or call, and 3 for a missing or broken plugin. It is 4 if the run
    diverged, 5 if part of a sweep failed, and 6 if storage failed. After an interrupt, it is 130,
    and after any other signal 128 plus the number of the signal."""
    with standard_streams():
        code = _exit_status(arguments)
        # If an interrupt had occurred in another `exec`, Python would be ended by the signal.
        exec("")
        sys.exit(code)


def _exit_status(arguments: list[str] | None) -> int:
    """Run a command, report a failure, and return the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    if debug := "--debug" in words:
        words = [argument for argument in words if argument != "--debug"]
    # pydantic would search for its own plugins, and fail if a distribution has damaged metadata.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", errors.PbdkitWarning)
            warnings.showwarning = _warn_once()
            refuse_little_memory()
            if COMPLETING in os.environ:
                from pbdkit.cli.completion import register_bash

                register_bash()
            code: Any = program.main(words, prog_name="pbdkit", standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        where = getattr(error.__cause__, "args", error.args)
        code = _failed(" ".join(["interrupted", *map(str, where)]), 130)
    except click.ClickException as error:
        code = _failed(error.format_message(), error.exit_code)
    except (Exception, SystemExit) as error:  # pbdkit exits below.
        if isinstance(error, SystemExit) and COMPLETING in os.environ:
            raise  # click has printed the completion for a shell.
        if debug:
            traceback.print_exc()
        code = _report(error)
    return code or 0


def _warn_once() -> Callable[..., None]:
    """Return a `warnings.showwarning` that prints each text once."""
    printed = set[str]()

    def warn(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        ours = issubclass(category, errors.PbdkitWarning)
        text = str(message) if ours else f"{category.__name__}: {message}"
        if text not in printed:
            click.echo(f"warning: {errors.printable(text)}", err=True)
        printed.add(text)

    return warn


def _report(error: BaseException) -> int:
    if isinstance(error, errors.PbdkitError):
        return error.exit_status if error.is_reported else _failed(str(error), error.exit_status)
    if _of_memory(error):
        text = f"out of memory: {error}" if str(error) else "out of memory"
        return _failed(f"{text}; `pbdkit check` estimates what an experiment needs", 6)
    if any(isinstance(e, KeyboardInterrupt) for e in _contexts(error)):
        return _failed("interrupted", 130)
    if isinstance(error, OSError) and error.errno in SYSTEM:
        place = f"{error.filename}: " if error.filename else ""
        return _failed(f"{place}{errors.reason_of(error)}", 6)
    what = f"a bug in pbdkit, please report it: {type(error).__name__}: {error}"
    return _failed(f"{what} (`pbdkit --debug ...` shows where)", 1)


def _contexts(error: BaseException | None) -> Iterator[BaseException]:
    """Yield the error, and the errors that were being handled when it was raised."""
    while error:
        yield error
        error = error.__context__


def _of_memory(error: BaseException) -> bool:
    """Return whether the error means that memory is exhausted. Threads and libraries report this in
    different ways."""
    words = (
        "can't start new thread",
        "failed to map segment",
        "Cannot allocate memory",
        "memory allocation failed",  # of HDF5
    )
    return isinstance(error, MemoryError) or any(word in str(error) for word in words)


def _failed(message: str, code: int) -> int:
    message = errors.printable(message)
    click.echo(f"pbdkit: {message}" if "\n" not in message else f"pbdkit:\n{message}", err=True)
    return code
