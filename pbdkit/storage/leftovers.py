"""What a run left beside its output: its names, whether there is anything to go on with, and an end
of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.storage.file_system import opened_alone
from pbdkit.storage.run_store import RunStore, files_of

STORE, RECORDS = ".run", ".run-records"
"""Behind the name of the output: the store, and the file of large values."""


def store_of(output: Path) -> Path:
    """The SQLite file of an unfinished run."""
    return output.with_name(output.name + STORE)


def records_of(output: Path) -> Path:
    """The file of its large values."""
    return output.with_name(output.name + RECORDS)


def remove_unfinished(output: Path) -> None:
    """Removes the files of a store; the records last, whose lock keeps others away."""
    remove_store(output)
    with suppress(OSError):
        records_of(output).unlink(missing_ok=True)


def is_unfinished(output: Path, *, discard: bool = False) -> bool:
    """Whether there is a run to go on with. What one left behind that committed nothing is removed,
    and, to `discard` it, any. Raises ExperimentError where one is going on."""
    with _alone(output) as ours:
        committed = not discard and has_committed(output)
        if ours and not committed:
            remove_unfinished(output)
        return committed


@contextmanager
def _alone(output: Path) -> Iterator[bool]:
    """Whether there is a run, which nobody else writes meanwhile. At its end its records have the
    name of the result."""
    there = store_of(output).exists()
    for path in (records_of(output), output) if there else [records_of(output)]:
        try:
            file = opened_alone(path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from None
        if file is None:
            raise being_written(output)
        with file:
            yield True
        return
    yield there


def being_written(output: Path) -> ExperimentError:
    """The error of who wants to write it, too."""
    return ExperimentError(
        f"{output}: is being written by another run; `pbdkit status {output}` says how far it is; "
        "-o names another file"
    )


def has_committed(output: Path) -> bool:
    """Whether anything of a run was kept that is not finished. Raises StorageError."""
    if not is_left(output):
        return False
    with RunStore(store_of(output)) as found:
        return found.made and bool(found.keys("about"))


def is_left(output: Path) -> bool:
    """Whether there is a store, and its records have not got the name of the result yet."""
    return store_of(output).exists() and (records_of(output).exists() or not output.exists())


def remove_store(output: Path) -> None:
    """Removes the files that SQLite keeps."""
    for path in reversed(files_of(store_of(output))):
        with suppress(OSError):
            path.unlink(missing_ok=True)
