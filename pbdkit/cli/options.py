"""Arguments and options shared by commands, checks of output paths, tables, and progress on a
terminal."""

from __future__ import annotations

import io
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pbdkit.errors import ExperimentError, StorageError, refuse_no_matplotlib
from pbdkit.progress import DELAY_S

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem
    from matplotlib.figure import Figure
    from rich.table import Table

    from pbdkit.cli.completion import Completer
    from pbdkit.scene.scene import Scene


PATH = click.Path(path_type=Path)
C = TypeVar("C", bound=click.Command)
F = TypeVar("F", bound=Callable[..., Any])


def completed_by(name: str) -> Completer:
    """Return the completer of a name in `completion`, which is imported only when a shell needs
    it."""

    def complete(
        context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        completer: Completer = getattr(import_module("pbdkit.cli.completion"), name)
        return completer(context, parameter, incomplete)

    return complete


def result_argument(name: str, metavar: str = "OUT.nc", **more: Any) -> Callable[[F], F]:
    """Return a click argument for one result or several."""
    complete = completed_by("results")
    return click.argument(name, metavar=metavar, type=PATH, shell_complete=complete, **more)


color_option = click.option(
    "--color",
    metavar="VARIABLE",
    help="Variable that gives the colours, e.g. pe1, u, u_x; an unknown name lists all.",
    shell_complete=completed_by("variables"),
)
times_option = click.option(
    "--time",
    "times",
    type=float,
    multiple=True,
    help="Recorded step to draw, default the last; repeat it for further panels.",
    shell_complete=completed_by("times"),
)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="PATH=VALUE",
    shell_complete=completed_by("settings"),
    help="Change a value of the experiment, e.g. rule.K=-0.002 or leaders.1.until=20.",
)


def _choice(
    context: click.Context, option: click.Parameter, texts: tuple[str, ...]
) -> dict[str, str]:
    """Return the values by name; raise click.BadParameter for text without a value."""
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


def _setting(module: str, name: str) -> Callable[[click.Context, click.Parameter, bool], None]:
    """Return the callback of a flag that sets an environment variable to "*".

    The variable is set for this call and the processes that it starts. Its name is the constant
    `name` of a module.
    """

    def set_variable(context: click.Context, option: click.Parameter, flag: bool) -> None:
        if not flag:
            return
        variable = getattr(import_module(module), name)
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
    callback=_setting("pbdkit.model.reading", "ALLOW_OUTSIDE"),
    help="Read files outside the folder of the file that names them.",
)


def experiment_argument(command: F) -> F:
    """Add the argument EXPERIMENT, and the option that permits files elsewhere."""
    argument = click.argument(
        "experiment", metavar="EXPERIMENT", shell_complete=completed_by("experiments")
    )
    return outside_option(argument(command))


NO_PLUGINS = click.Option(
    ["--no-plugins"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_setting("pbdkit.hooks", "DISABLE"),
    help="Load no plugins, as if pbdkit alone were installed.",
)


def with_no_plugins(command: C) -> C:
    """Return the command, and its subcommands, with the option --no-plugins."""
    if NO_PLUGINS not in command.params:
        command.params.append(NO_PLUGINS)
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command


FORMATS = (".png", ".svg", ".pdf")
"""File name extensions of pictures."""
UNLIMITED = 10_000
"""Width of tables that are not printed on a terminal."""


@contextmanager
def refusals_as(subject: str) -> Iterator[None]:
    """Raise a StorageError that begins with `subject` for each OSError in the block."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{subject}: {error.strerror}") from None


@contextmanager
def folder_kept() -> Iterator[None]:
    """Return to the current folder after the block: plugins may change it when they are imported.

    Raises
    ------
    StorageError
        If there is no current folder.
    """
    with refusals_as("the current folder"):
        folder = Path.cwd()
    with chdir(folder):
        yield


def refuse_output(path: Path, *, force: bool, experiment: Path | None = None) -> None:
    """Check that a file may be written at a path.

    Parameters
    ----------
    force
        Whether an existing file may be replaced.
    experiment
        Experiment file, which is never replaced.

    Raises
    ------
    ExperimentError
        If the name is not UTF-8, if the path is a folder or no regular file, if it is the
        experiment under any name, or if a file exists and `force` is not set.
    StorageError
        If the file system returns an error.
    """
    from pbdkit.io.atomic_file import kind_of

    try:  # in the bytes of the file system, whatever the locale
        os.fsencode(path.absolute()).decode()
    except UnicodeDecodeError:
        shown = os.fsencode(path.absolute()).decode(errors="backslashreplace")
        raise ExperimentError(
            f"{shown}: the name is not UTF-8; name another file with -o"
        ) from None
    with refusals_as(f"{str(path)[:80]}..."):
        kind, exists = kind_of(path), os.path.lexists(path)
    if not exists:
        return
    if kind == "a folder":
        raise ExperimentError(f"{path}: is a folder; name a file with -o")
    if kind:
        raise ExperimentError(
            f"{path}: is {kind}, which is not replaced; remove it, or name another file with -o"
        )
    if experiment and experiment.exists() and path.samefile(experiment):
        raise ExperimentError(f"{path}: is the experiment itself; name another file with -o")
    if not force:
        raise ExperimentError(f"{path}: exists; --force replaces it, -o names another file")


def refuse_unfinished(path: Path, *, force: bool) -> None:
    """Raise ExperimentError beside an unfinished run, unless `force` discards it.

    A run that another process is writing is never discarded.
    """
    from pbdkit.io.run_store import make_room

    if not make_room(path, discard=force):
        raise ExperimentError(
            f"{path}: there is an unfinished run; `pbdkit resume {path}` continues it, "
            "--force discards it, -o names another file"
        )


def disk_warnings(path: Path, scene: Scene) -> Iterator[str]:
    """Warn if the output may not fit on its disk."""
    from pbdkit.scene.memory_estimate import MIB, sizes_of

    output = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total).output
    with suppress(OSError):  # a missing folder is reported when the file is opened
        if output > (free := shutil.disk_usage(path.parent).free):
            yield (
                f"record: the output of about {output / MIB:.3g} MiB may not fit into the "
                f"{free / MIB:.3g} MiB that are free in {path.parent}; record fewer steps, or "
                "name a file on another disk with -o"
            )


def show_table(table: Table) -> None:
    """Print a table; one line for each row if the output is no terminal."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else UNLIMITED
    Console(width=width, highlight=False).print(table)


def refuse_unwritable(picture: Path | None, *files: Path | None) -> None:
    """Raise ExperimentError or StorageError if a picture or another file cannot be written."""
    if picture and picture.suffix not in FORMATS:
        raise ExperimentError(f"{picture}: a picture ends in {', '.join(FORMATS)}")
    if picture:
        refuse_no_matplotlib()
    for path in (picture, *files):
        if path and path.is_dir():
            raise ExperimentError(f"{path}: is a folder; name a file")
        if path and not path.parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.parent}")


def save(picture: Path, figure: Figure, *, replace: bool, quiet: bool = False) -> None:
    """Write a figure, and print its path unless `quiet`.

    Raises
    ------
    WriteError
        If the file system returns an error.
    """
    from pbdkit.io.atomic_file import write

    content = io.BytesIO()
    figure.savefig(content, format=picture.suffix.removeprefix("."))
    write(picture, content.getvalue(), replace=replace)
    if not quiet:
        click.echo(f"{picture} written")


@contextmanager
def waiting(task: str, *, silent: bool = False) -> Iterator[Callable[[str], None]]:
    """Show a task and its duration on stderr after a second, until the block ends.

    Nothing is shown if `silent`, or if stderr is no terminal.

    Yields
    ------
    callable
        Function that replaces the description of the task.
    """
    if silent or not sys.stderr.isatty():
        yield lambda task: None
        return
    line = _line(task)
    timer = threading.Timer(DELAY_S, line.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda task: line.update(line.task_ids[0], description=task)
    finally:
        timer.cancel()
        timer.join()
        if line.live.is_started:
            line.stop()


def _line(task: str) -> Any:
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    line = Progress(*columns, console=Console(file=sys.stderr), transient=True)
    line.add_task(task, total=None)
    return line
