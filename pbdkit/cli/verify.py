"""Command ``pbdkit verify``: checksums of results."""

from __future__ import annotations

from pathlib import Path

import click

from pbdkit.cli.output import refusals_as
from pbdkit.errors import StorageError, one_line
from pbdkit.io.open import UNSEALED, refuse_no_file
from pbdkit.io.other_files import other_file
from pbdkit.io.seal import SealedFile, open_sealed
from pbdkit.progress import waiting
from pbdkit.untrusted_files import refuse_no_result


def verify(files: tuple[Path, ...]) -> int:
    """Recompute the checksums of results, and report for each file whether it is unchanged."""
    faults = []
    for file in files:
        with waiting(f"reading {file}"):
            fault = _fault_of(file)
        click.echo(fault or f"{file}: unchanged since it was written")
        faults += [fault] if fault else []
    return 6 if faults else 0


def _fault_of(file: Path) -> str:
    """Return the fault of a result. The text is empty if there is none."""
    fault = ""
    try:
        if description := other_file(file):
            raise StorageError(f"{file}: {description}")
        refuse_no_file(file)
        with refusals_as(str(file)), SealedFile(file) as content:
            content.check()
            if content.seal is None:
                refuse_no_result(file)
                fault = f"{file}: {UNSEALED}"
            else:
                _refuse_elsewhere(file)
    except StorageError as error:
        fault = str(error)
    return fault


def _refuse_elsewhere(file: Path) -> None:
    """Raise StorageError if a file with a correct checksum refers to other files."""
    try:
        open_sealed(file).close()
    except (StorageError, MemoryError):
        raise
    except Exception as error:  # h5py raises errors of many types
        raise StorageError(f"{file}: cannot be read as netCDF-4: {one_line(str(error))}") from None
