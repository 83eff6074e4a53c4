"""Output of commands. Paths are checked before anything is computed, and pictures are written."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.errors import ExperimentError, StorageError, reason_of, refuse_no_matplotlib
from pbdkit.io.atomic_file import encoding, kind_of, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FORMATS = (".png", ".svg", ".pdf")
"""File name extensions of pictures."""


@contextmanager
def refusals_as(subject: str) -> Iterator[None]:
    """Raise a StorageError that begins with `subject` for each OSError in the block."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{subject}: {reason_of(error)}") from None


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
        If the name is not UTF-8, if the path is a folder or another object that is not a regular
        file, if it leads to the experiment file, or if a file exists and `force` is not set.
    StorageError
        If the file system returns an error.
    """
    try:  # The name is in the bytes of the file system, independent of the locale.
        os.fsencode(path.absolute()).decode()
    except UnicodeDecodeError:
        text = os.fsencode(path.absolute()).decode(errors="backslashreplace")
        raise ExperimentError(f"{text}: the name is not UTF-8; name another file with -o") from None
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


def refuse_unwritable(picture: Path | None, *files: Path | None, or_table: str = "") -> None:
    """Raise ExperimentError or StorageError if a picture or another file cannot be written.
    `or_table` is the suffix of tables that can be written in place of the picture."""
    if picture and picture.suffix not in FORMATS:
        table = f", that of a table in {or_table}" if or_table else ""
        raise ExperimentError(
            f"{picture}: the name of a picture must end in {', '.join(FORMATS)}{table}"
        )
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
    content = io.BytesIO()
    with encoding(picture):
        figure.savefig(content, format=picture.suffix.removeprefix("."))
    write(picture, content.getvalue(), replace=replace)
    if not quiet:
        click.echo(f"{picture} written")
