"""The file that a command is to write, looked at before the work and not after; and tables."""

from __future__ import annotations

import io
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.registry.extras import refuse_no_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from pbdkit.scene.scene import Scene

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
    from pbdkit.storage.destination import kind_of

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
    from pbdkit.storage.run_files import make_room

    if not make_room(path, discard=force):
        raise ExperimentError(
            f"{path}: an unfinished run of it is here; `pbdkit resume {path}` goes on with it, "
            "--force discards it, -o names another file"
        )


def disk_warnings(path: Path, scene: Scene) -> Iterator[str]:
    """What is to be said where the output may not fit on its disk."""
    from pbdkit.scene.sizes import MIB, sizes_of

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
    from pbdkit.storage.destination import write

    content = io.BytesIO()
    drawn.savefig(content, format=picture.suffix.removeprefix("."))
    write(picture, content.getvalue(), replace=replace)
    if not quiet:
        click.echo(f"{picture} written")
