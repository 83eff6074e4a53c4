"""The files of an unfinished run beside its output: their names, whether they are there, their
removal."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum, auto
from pathlib import Path

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.storage.file_system import opened_alone
from pbdkit.storage.records_header import Header, read_header
from pbdkit.storage.run_store import RunStore
from pbdkit.storage.seal import seal_of
from pbdkit.storage.sqlite_file import files_of, is_database

STORE, RECORDS = ".run", ".run-records"
"""Behind the name of the output: the store, and the file of large values."""
ONE_PAGE = 4096
"""Bytes at most of a store in which nothing was committed yet."""


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


class Left(Enum):
    """What is left of a run beside its output."""

    NOTHING = auto()
    BEGUN = auto()
    """It committed nothing."""
    COMMITTED = auto()
    FINISHED = auto()
    """Its records have the name of the result, and its store is there still."""


def is_unfinished(output: Path) -> bool:
    """Whether there is a run to go on with. The store of one that is finished is removed, and
    nothing else. Raises ExperimentError where one is going on, and StorageError where it is
    damaged."""
    with _alone(output):
        left = left_of(output)
        if left is Left.FINISHED:
            remove_store(output)
        return left is Left.COMMITTED


def make_room(output: Path, *, discard: bool = False) -> bool:
    """Whether there is room for a run of an output: not beside an unfinished one, unless that is to
    be discarded. What a run left that committed nothing is removed. Raises as `is_unfinished` does;
    what is to be discarded may be damaged."""
    with _alone(output):
        if not discard and has_committed(output):
            return False
        remove_unfinished(output)
        return True


@contextmanager
def _alone(output: Path) -> Iterator[None]:
    """Nobody else writes the run of an output meanwhile. At its end its records have the name of
    the result."""
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
            yield
        return
    yield


def being_written(output: Path) -> ExperimentError:
    """What whoever comes second is told."""
    return ExperimentError(
        f"{output}: is being written by another run; `pbdkit status {output}` says how far it is; "
        "-o names another file"
    )


def has_committed(output: Path) -> bool:
    """Whether anything of a run was kept that is not finished. Raises StorageError as `left_of`."""
    return left_of(output) is Left.COMMITTED


def left_of(output: Path) -> Left:
    """What is left of a run; nothing on the disk changes. Raises StorageError where that is
    damaged."""
    store, records = store_of(output), records_of(output)
    if not is_left(output):
        return Left.NOTHING
    header = header_of(records)
    if not is_database(store):
        if header or _size(store) > ONE_PAGE or _size(Path(f"{store}-wal")):
            raise damaged(store, "it is missing, or no database")
        return Left.BEGUN
    with RunStore(store) as found:
        if not found.commits:
            if header and header.commits:
                raise damaged(store, "its log was damaged, cut or removed, and nothing is in it")
            return Left.BEGUN
        if records.exists():
            return Left.COMMITTED
        if _is_result(output, found):
            return Left.FINISHED
    raise damaged(records, "it is missing")


def header_of(records: Path) -> Header | None:
    """The header of the records of a run; None where none was written, or overwritten at its end.
    Raises StorageError."""
    try:
        with io.FileIO(records, "rb") as file:
            return read_header(file)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StorageError(f"{records}: cannot be read: {error.strerror}") from None


def _is_result(output: Path, store: RunStore) -> bool:
    """Whether a run is finished and its records have got the name of the result."""
    if "finished" not in store.facts("facts") or not output.exists():
        return False
    with output.open("rb", buffering=0) as file:
        seal = seal_of(file)
    return seal is not None and seal.size == store.facts("file").get("size")


def damaged(path: Path, what: str) -> StorageError:
    """The error of a file of an unfinished run that cannot be gone on with."""
    return StorageError(
        f"{path}: is damaged: {what}; nothing was removed, and a copy of the files that is whole "
        "can be put in their place; `pbdkit run` with --force discards them"
    )


def is_left(output: Path) -> bool:
    """Whether there is anything of a store, or records."""
    return any(path.exists() for path in (*files_of(store_of(output)), records_of(output)))


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def remove_store(output: Path) -> None:
    """Without its records, which the result may have become."""
    for path in reversed(files_of(store_of(output))):
        with suppress(OSError):
            path.unlink(missing_ok=True)
