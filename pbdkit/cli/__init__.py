"""The command line. Commands load what they need when they run: `--help` costs next to nothing."""

from __future__ import annotations

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import click

from pbdkit import errors
from pbdkit.cli.options import with_no_plugins
from pbdkit.cli.streams import standard_streams
from pbdkit.memory import refuse_little_memory

COMPLETING = "_PBDKIT_COMPLETE"
"""The variable in which a shell asks how a line goes on."""


@dataclass(frozen=True)
class Listed:
    """A command, the module of pbdkit.cli in which it stands, and what it does, in a sentence."""

    name: str
    module: str
    does: str


GROUPS = {
    "Start": (
        Listed("init", "sweep", "Writes an experiment to start from, or copies a shipped one."),
        Listed("experiments", "sweep", "Lists the shipped experiments, or prints one."),
    ),
    "Run": (
        Listed("run", "run", "Runs an experiment, and writes its result to a file."),
        Listed("resume", "run", "Goes on with an interrupted run, or makes one longer."),
        Listed("status", "result", "Says how far a run is, and when it will end."),
        Listed("live", "live", "Steps an experiment in the browser, led by the mouse."),
    ),
    "Look": (
        Listed("plot", "plot", "Draws a result, or the set-up of an experiment before it runs."),
        Listed("animate", "plot", "Makes a movie of a result."),
        Listed("curve", "plot", "Draws what changes: a curve, a history, the crack."),
        Listed("report", "report", "Makes one page to share: its motion, curves, all else."),
        Listed("export", "result", "Writes a result for ParaView."),
        Listed("explain", "result", "Says which bonds broke, when and why."),
        Listed("verify", "result", "Says whether results are as they were written."),
    ),
    "Understand": (
        Listed("check", "check", "Says before a run whether it is stable, and how long it takes."),
        Listed("identify", "check", "Says what a rule is physically, with its constants."),
        Listed("bench", "bench", "Measures speed against error, to choose a solver."),
    ),
    "Vary and fit": (
        Listed("sweep", "sweep", "Runs an experiment over many values of its parameters."),
        Listed("fit", "sweep", "Finds the parameters that meet what was measured, with errors."),
    ),
    "Extend": (
        Listed("plugins", "plugins", "Lists, checks and begins components of your own."),
        Listed("schema", "sweep", "Prints the JSON Schema, for completion in an editor."),
    ),
}
"""Every command, by what somebody wants; a new one is a line here."""
COMMANDS = {one.name: one.module for group in GROUPS.values() for one in group}
"""Every command with its module."""
FIRST = {
    "pbdkit run paper/a": "Runs a case, and writes paper-a.nc.",
    "pbdkit plot paper-a.nc --color pe1": "Draws it into paper-a.png.",
    "pbdkit init": "Writes experiment.yaml to be changed.",
}
"""What to type first, and what it does."""
WELCOME = """\
pbdkit deforms bodies on lattices. Particles follow their neighbours by rules
instead of forces. A file says what is to be done; the result is a dataset.
"""
SYSTEM = dict.fromkeys(
    (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.ENAMETOOLONG), ""
)
SYSTEM |= dict.fromkeys(
    (errno.EMFILE, errno.ENFILE),
    "; raise the limit (`ulimit -n`), or let fewer processes work at once",
)
"""What the system may refuse whatever is done, which is no bug of pbdkit, and the remedy."""
MORE = """\
`pbdkit COMMAND --help` says what a command takes; `pbdkit --help` has the rest."""


MEANT = {
    ("list", "ls"): "`pbdkit experiments` lists shipped experiments, `pbdkit plugins list` plugins",
    ("show", "view", "draw", "plot", "image"): "`pbdkit plot` draws a result or a set-up",
    ("movie", "video", "gif"): "`pbdkit animate` makes a movie",
    ("continue", "restart"): "`pbdkit resume` goes on with a run",
    ("validate", "lint", "analyse", "analyze"): "`pbdkit check` checks an experiment",
    (
        "new",
        "create",
        "template",
    ): "`pbdkit init` writes an experiment, `pbdkit plugins new` a plugin",
    ("convert", "vtk", "paraview"): "`pbdkit export` writes VTKHDF for ParaView",
    (
        "info",
        "progress",
    ): "`pbdkit status` shows how far a run is, `pbdkit report` makes a page of it",
    ("simulate", "solve", "start"): "`pbdkit run` runs an experiment",
    ("test",): "`pbdkit plugins check` tests a plugin",
    ("gui", "play", "interactive"): "`pbdkit live` shows a body that follows the mouse",
    ("version",): "`pbdkit --version` prints it",
}
"""What is meant by words that are no commands."""


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
            from pbdkit.errors import did_you_mean
            from pbdkit.model.shipped import shipped_names

            run = f"; `pbdkit run {name}` runs it" * (name in shipped_names())
            meant = next((f"; {what}" for words, what in MEANT.items() if name in words), "")
            near = run or meant or did_you_mean(name, COMMANDS) or "; `pbdkit` alone lists them"
            ctx.fail(f"there is no command '{name}'{near}")
        command: click.Command = getattr(import_module(f"pbdkit.cli.{COMMANDS[name]}"), name)
        return with_no_plugins(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """By what somebody wants; no command is imported for its line."""
        for wanted, group in GROUPS.items():
            with formatter.section(wanted):
                formatter.write_dl([(f"{one.name:<12}", one.does) for one in group])


@with_no_plugins
@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True,
    epilog='In bash, `eval "$(_PBDKIT_COMPLETE=bash_source pbdkit)"` lets the tabulator key '
    "complete commands, settings, variables and steps; docs/experiments.md has zsh and fish.",
)
@click.option("--debug", is_flag=True, help="Show a traceback where something fails.")
@click.version_option(package_name="pbdkit")
@click.pass_context
def program(context: click.Context, debug: bool) -> None:
    """Position-based dynamics of deformable bodies on lattices: rules instead of forces."""
    if context.invoked_subcommand is None:
        click.echo(_welcome())


def _welcome() -> str:
    """What there is to type first, and what for."""
    lines = [WELCOME, "Type this first:"]
    lines += [f"  {typed:<36} {does}" for typed, does in FIRST.items()]
    for wanted, group in GROUPS.items():
        lines += [f"\n{wanted}:", *(f"  {one.name:<12} {one.does}" for one in group)]
    return "\n".join([*lines, "", MORE])


def main(arguments: list[str] | None = None) -> None:
    """The program: exits 0 done, 1 a bug of ours, 2 a wrong experiment or call, 3 a missing or
    broken plugin, 4 diverged, 5 part of a sweep failed, 6 storage failed, 130 interrupted, 128
    and the number of another signal."""
    with standard_streams():
        code = _exit_status(arguments)
        exec("")  # after an interrupt in another `exec` Python would end by the signal
        sys.exit(code)


def _exit_status(arguments: list[str] | None) -> int:
    """Run a command, and report how it failed where it did."""
    given = sys.argv[1:] if arguments is None else arguments
    if debug := "--debug" in given:
        given = [argument for argument in given if argument != "--debug"]
    # pydantic would look for plugins of its own, and stop at any torn distribution.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", errors.PbdkitWarning)
            warnings.showwarning = _warn_once()
            refuse_little_memory()
            if COMPLETING in os.environ:
                import_module("pbdkit.cli.completion").speak_bash()
            code: Any = program.main(given, prog_name="pbdkit", standalone_mode=False)
        sys.stdout.flush()
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        where = getattr(error.__cause__, "args", error.args)
        code = _failed(" ".join(["interrupted", *map(str, where)]), 130)
    except click.ClickException as error:
        code = _failed(error.format_message(), error.exit_code)
    except (Exception, SystemExit) as error:  # pbdkit itself exits below
        if isinstance(error, SystemExit) and COMPLETING in os.environ:
            raise  # click has told a shell how the line goes on
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
        return error.exit_status if error.told else _failed(str(error), error.exit_status)
    if _of_memory(error):
        told = f"out of memory: {error}" if str(error) else "out of memory"
        return _failed(f"{told}; `pbdkit check` estimates what an experiment needs", 6)
    if any(isinstance(e, KeyboardInterrupt) for e in _contexts(error)):
        return _failed("interrupted", 130)
    if isinstance(error, OSError) and error.errno in SYSTEM:
        place = f"{error.filename}: " if error.filename else ""
        return _failed(f"{place}{error.strerror}{SYSTEM[error.errno]}", 6)
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
