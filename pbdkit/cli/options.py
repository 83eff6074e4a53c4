"""Arguments and options that several commands share, output paths that are checked before the work,
tables, and progress at a terminal.
"""

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
from pbdkit.progress import PATIENCE_S

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
    callback=_setting("pbdkit.model.reading", "ALLOW_OUTSIDE"),
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
    callback=_setting("pbdkit.plugin.discovery", "DISABLE"),
    help="Load no plugin, as if only pbdkit itself were installed.",
)


def with_no_plugins(command: C) -> C:
    """The command, and those in it, with the option --no-plugins."""
    if NO_PLUGINS not in command.params:
        command.params.append(NO_PLUGINS)
    for inner in getattr(command, "commands", {}).values():
        with_no_plugins(inner)
    return command


FORMATS = (".png", ".svg", ".pdf")
UNLIMITED = 10_000


@contextmanager
def refusals_as(what: str) -> Iterator[None]:
    """What the system refuses in the block becomes a StorageError that begins with `what`."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{what}: {error.strerror}") from None


@contextmanager
def folder_kept() -> Iterator[None]:
    """Goes back to the current folder: a plugin may change it when it is imported. Raises
    StorageError where there is none."""
    with refusals_as("the current folder"):
        here = Path.cwd()
    with chdir(here):
        yield


def refuse_output(path: Path, *, force: bool, experiment: Path | None = None) -> None:
    """Raises ExperimentError where nothing is to be written there: a name that is no UTF-8, a
    folder, a file without `force`, and, forced or not, what is no plain file, and the experiment
    under this or another name. Raises StorageError where the system does not tell."""
    from pbdkit.io.atomic_file import kind_of

    try:  # in the bytes that the system has, whatever the locale makes of them
        os.fsencode(path.absolute()).decode()
    except UnicodeDecodeError:
        shown = os.fsencode(path.absolute()).decode(errors="backslashreplace")
        raise ExperimentError(f"{shown}: is no UTF-8; name another file with -o") from None
    with refusals_as(f"{str(path)[:80]}..."):
        kind, there = kind_of(path), os.path.lexists(path)
    if not there:
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
    """Raises ExperimentError beside an unfinished run, which `force` discards, unless another
    process is writing it."""
    from pbdkit.io.run_store import make_room

    if not make_room(path, discard=force):
        raise ExperimentError(
            f"{path}: an unfinished run of it is here; `pbdkit resume {path}` goes on with it, "
            "--force discards it, -o names another file"
        )


def disk_warnings(path: Path, scene: Scene) -> Iterator[str]:
    """What is to be said where the output may not fit on its disk."""
    from pbdkit.scene.memory_estimate import MIB, sizes_of

    output = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total).output
    with suppress(OSError):  # no such folder: said when the file is opened
        if output > (free := shutil.disk_usage(path.parent).free):
            yield (
                f"record: the output of about {output / MIB:.3g} MiB may not fit into the "
                f"{free / MIB:.3g} MiB that are free in {path.parent}; record fewer steps, or "
                "name a file on another disk with -o"
            )


def show_table(table: Table) -> None:
    """Prints it; a line a row where it goes to a file or another program."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else UNLIMITED
    Console(width=width, highlight=False).print(table)


def refuse_unwritable(picture: Path | None, *others: Path | None) -> None:
    """ExperimentError or StorageError where a picture or another file cannot be written there."""
    if picture and picture.suffix not in FORMATS:
        raise ExperimentError(f"{picture}: a picture ends in {', '.join(FORMATS)}")
    if picture:
        refuse_no_matplotlib()
    for path in (picture, *others):
        if path and path.is_dir():
            raise ExperimentError(f"{path}: is a folder; name a file")
        if path and not path.parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.parent}")


def save(picture: Path, drawn: Figure, *, replace: bool, quiet: bool = False) -> None:
    """Writes a figure and says so, unless quiet; WriteError where the system refuses."""
    from pbdkit.io.atomic_file import write

    content = io.BytesIO()
    drawn.savefig(content, format=picture.suffix.removeprefix("."))
    write(picture, content.getvalue(), replace=replace)
    if not quiet:
        click.echo(f"{picture} written")


@contextmanager
def waiting(what: str, *, silent: bool = False) -> Iterator[Callable[[str], None]]:
    """Says on stderr what is being done, and for how long already, once a second has passed; at its
    end the line goes. Nothing where nobody looks: `silent`, or stderr is no terminal.

    Yields a function to be told what is done from then on.
    """
    if silent or not sys.stderr.isatty():
        yield lambda what: None
        return
    line = _line(what)
    timer = threading.Timer(PATIENCE_S, line.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda what: line.update(line.task_ids[0], description=what)
    finally:
        timer.cancel()
        timer.join()
        if line.live.is_started:
            line.stop()


def _line(what: str) -> Any:
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    line = Progress(*columns, console=Console(file=sys.stderr), transient=True)
    line.add_task(what, total=None)
    return line
