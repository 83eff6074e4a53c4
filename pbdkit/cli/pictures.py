"""Files that commands write besides what they print: refused before the work, not after."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")


def refuse_unwritable(picture: Path | None, *others: Path | None) -> None:
    """ExperimentError or StorageError where a picture or another file cannot be written there."""
    from pbdkit.errors import ExperimentError, StorageError

    if picture and picture.suffix not in FORMATS:
        raise ExperimentError(f"{picture}: a picture ends in {', '.join(FORMATS)}")
    if picture and find_spec("matplotlib") is None:
        raise ExperimentError("a picture needs matplotlib: pip install 'pbdkit[plot]'")
    for path in (picture, *others):
        if path and path.is_dir():
            raise ExperimentError(f"{path}: is a folder; name a file")
        if path and not path.parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.parent}")


def save(picture: Path, drawn: Figure, *, quiet: bool = False) -> None:
    """Writes a figure and says so; StorageError where the system refuses."""
    from pbdkit.errors import StorageError

    try:
        drawn.savefig(picture)
    except OSError as error:
        raise StorageError(f"{picture}: cannot be written: {error.strerror}") from None
    if not quiet:
        click.echo(f"{picture} written")
