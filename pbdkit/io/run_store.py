"""Store of an unfinished run in the folder of its output. It consists of a SQLite database with the
last checkpoint, and of the records, a file that becomes the result."""

from __future__ import annotations

import io
import json
import math
import os
import secrets
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from enum import Enum, auto
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError, StorageError, StorageWarning, reason_of, warn_caller
from pbdkit.io.atomic_file import FULL, is_full, lock, open_locked, sync_folder
from pbdkit.io.checkpoint import Arrays, Checkpoint
from pbdkit.io.paged_file import (
    FINALIZED,
    PAGE,
    Header,
    PagedFile,
    PiecedArray,
    read_header,
    write_header,
)
from pbdkit.io.seal import ByteRange, seal_of
from pbdkit.io.sqlite_file import (
    ONE_PAGE,
    connect,
    fault_of,
    files_of,
    is_database,
    journal_mode,
    open_read_only,
    size_of,
)

FORMAT = "3"
"""Version of the store. Stores of later versions are refused."""
TABLE = "CREATE TABLE pieces (key TEXT PRIMARY KEY, digest BLOB NOT NULL, data BLOB NOT NULL)"
"""SQL statement that creates the table of pieces. A piece is a block of bytes that is stored under
a key."""
SCHEMA = [(TABLE,), (None,)]
"""Schema of the database: the table, and the index of its keys. With the index, digests can be read
without reading the data."""
IDENTITY = "identity"
"""Key of the random number that identifies the store. Every digest depends on it."""
COMMIT = "commit"
"""Key of the number of the last commit and of the digest of all other digests."""
IDENTITY_BYTES = 16
"""Number of bytes of the random number."""
PART_BYTES = 2**20
"""Maximum number of bytes of a piece of an array."""
MAX_VALUE_BYTES = 2**26
"""Maximum number of bytes of a value that is read from the file."""
JOURNAL_MARK = bytes.fromhex("d9d505f920a163d7")
"""Last bytes of a journal of SQLite that refers to another journal."""
MARK = 0x70626472
"""The application_id of the file: `pbdr`."""

Piece = tuple[str, bytes | memoryview]


class RunStore:
    """Pieces of data by key in one SQLite file. Even if the process or the machine stops, a commit
    is complete or absent. When `commit` returns, the commit is on the disk.

    All data that are read belong to one commit of one store. A piece of another commit or store
    counts as damage. Errors of SQLite and wrong digests are raised as StorageError with the name of
    the file.
    """

    def __init__(self, path: Path, *, mode: str = "ro") -> None:
        """Open a store; `mode` is ro, rw, or rwc to create it.

        With ro, nothing on the disk is changed, even if the store is damaged. With rw, SQLite would
        discard a damaged log. Therefore `check` must be called, and the header of the records be
        verified, before a store is opened with rw.
        """
        self.path, self._writes = path, mode != "ro"
        self.identity, self.commits = b"", 0
        """Identity of the store, and number of commits that it contains."""
        self._verified: dict[str, bytes] = {}
        self._listed: dict[str, bytes] = {}
        """Digests by key: `_verified` contains those of the pieces that were written or read so
        far, and `_listed` those of all pieces."""
        self._is_checkpointed, self._closing = False, ExitStack()
        _refuse_others(path)
        try:
            with self._sqlite():
                self._open(mode)
        except BaseException:
            self._closing.close()
            raise

    def __enter__(self) -> RunStore:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def commit(self, pieces: Iterable[Piece], obsolete: Iterable[str] = ()) -> None:
        """Store pieces, which replace pieces with the same keys, and delete the pieces with the
        keys `obsolete`."""
        with self._sqlite():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                listed, digests = dict(self._listed), dict[str, bytes]()
                for key in obsolete:
                    self._file.execute("DELETE FROM pieces WHERE key = ?", (key,))
                    listed.pop(key, None)
                    self._verified.pop(key, None)
                for key, data in pieces:
                    digests[key] = self._put(key, data)
                listed, number = listed | digests, self.commits + 1
                summary = {"number": number, "pieces": _digest_of_all(listed)}
                self._put(COMMIT, json_piece(summary))
                self._file.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    self._file.execute("ROLLBACK")
                raise
            self._listed, self.commits = listed, number
            self._verified |= digests
            # The table and the first commit are also written to the database itself, in case the
            # log is lost.
            if not self._is_checkpointed:
                _, frames, moved = self._file.execute("PRAGMA wal_checkpoint").fetchone()
                self._is_checkpointed = frames == moved

    def keys(self, begin: str) -> list[str]:
        """Return the keys with a prefix."""
        return [key for key in self._listed if key.startswith(begin)]

    def piece(self, key: str) -> bytes:
        """Return the piece that the last commit has under a key."""
        with self._sqlite():
            query = "SELECT data, digest FROM pieces WHERE key = ?"
            row = self._file.execute(query, (key,)).fetchone()
        if row is None:
            raise StorageError(f"{self.path}: is damaged: '{key}' is missing")
        data, digest = row
        if not isinstance(data, bytes) or self._digest(key, data) != digest:
            raise StorageError(f"{self.path}: is damaged: '{key}' has changed since it was written")
        self._verified[key] = digest
        return data

    def check(self) -> None:
        """Read and verify all pieces. Raises StorageError if one differs from what was written."""
        with self._sqlite():
            if fault := fault_of(self._file):
                raise StorageError(f"{self.path}: is damaged: {fault}")
        for key in self._listed:
            self.piece(key)

    def facts(self, key: str) -> Any:
        """Return the facts that the last commit has under a key. They are stored as JSON."""
        try:
            return json.loads(self.piece(key))
        except (ValueError, RecursionError):
            raise StorageError(f"{self.path}: is damaged: '{key}' is not valid JSON") from None

    def close(self) -> None:
        """Close the store, as a single file if possible. No error is raised, whatever the state of
        the disk."""
        with suppress(sqlite3.Error):
            if self._writes:
                self._file.execute("PRAGMA journal_mode = DELETE")
        with suppress(sqlite3.Error, OSError):
            self._closing.close()

    def _open(self, mode: str) -> None:
        if mode != "rwc" and not is_database(self.path):
            raise StorageError(f"{self.path}: is damaged: it is missing, or not a database")
        if mode == "ro":
            try:
                self._file = open_read_only(self.path, self._closing)
            except OSError as error:
                raise StorageError(f"{self.path}: cannot be read: {reason_of(error)}") from None
        else:
            self._file = self._closing.enter_context(closing(connect(self.path, mode)))
        self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
        if mode == "rwc":
            self._make()
            return
        schema = self._file.execute("SELECT sql FROM sqlite_master").fetchall()
        if schema not in ([], SCHEMA):
            raise StorageError(
                f"{self.path}: is not the store of a run, or was written by an earlier pbdkit"
            )
        if self._writes:
            self._file.execute(f"PRAGMA journal_mode = {journal_mode(self.path)}")
        if schema:
            self._list()

    def _make(self) -> None:
        self.identity = secrets.token_bytes(IDENTITY_BYTES)
        self._file.execute(f"PRAGMA journal_mode = {journal_mode(self.path)}")
        self._file.execute("BEGIN")
        self._file.execute(f"PRAGMA application_id = {MARK}")
        self._file.execute(TABLE)
        self._listed[IDENTITY] = self._put(IDENTITY, self.identity)
        self._file.execute("COMMIT")

    def _put(self, key: str, data: bytes | memoryview) -> bytes:
        """Store a piece, unless the same piece is already stored, and return its digest."""
        digest = self._digest(key, data)
        if self._verified.get(key) != digest:
            self._file.execute("REPLACE INTO pieces VALUES (?, ?, ?)", (key, digest, data))
        return digest

    def _list(self) -> None:
        """Read the identity and the digests of the last commit. Raises StorageError if they were
        not committed together."""
        rows = self._file.execute("SELECT key, CAST(digest AS BLOB) FROM pieces").fetchall()
        query = "SELECT CAST(data AS BLOB) FROM pieces WHERE key = ?"
        self.identity, *_ = self._file.execute(query, (IDENTITY,)).fetchone() or (b"",)
        self.piece(IDENTITY)
        self._listed = {str(key): digest or b"" for key, digest in rows}
        if len(rows) == 1:
            return
        summary = self.facts(COMMIT)
        del self._listed[COMMIT]
        number = summary.get("number") if isinstance(summary, dict) else None
        if type(number) is not int or summary.get("pieces") != _digest_of_all(self._listed):
            raise StorageError(f"{self.path}: is damaged: its parts belong to different commits")
        self.commits = number

    def _digest(self, key: str, data: bytes | memoryview) -> bytes:
        hasher = xxhash.xxh3_128(self.identity + key.encode())
        hasher.update(data)
        return hasher.digest()

    @contextmanager
    def _sqlite(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:  # SQLite's message for a full disk varies.
            reason = FULL if is_full(self.path.absolute().parent) else error
            raise StorageError(f"{self.path}: {reason}") from None
        except sqlite3.Error as error:
            raise StorageError(f"{self.path}: {error}") from None


def json_piece(facts: Any) -> bytes:
    """Convert facts, which are data in the form of JSON, to a block of bytes that can be stored
    under a key."""
    return json.dumps(facts).encode()


def parts_of(name: str, array: np.ndarray[Any, Any] | PiecedArray) -> Iterator[Piece]:
    """Generate the pieces in which an array is stored. Their size is limited."""
    pieced = array if isinstance(array, PiecedArray) else PiecedArray.of(array)
    for key, block in zip(keys_of(name, array), pieced.blocks(PART_BYTES), strict=True):
        yield key, block.data


def keys_of(name: str, array: np.ndarray[Any, Any] | PiecedArray) -> list[str]:
    """Return the keys of the pieces of an array."""
    return [f"{name}/{n}" for n in range(-(-array.nbytes // PART_BYTES))]


class StoredArray:
    """Array that is stored in pieces and read when it is accessed. Either the whole array is read,
    or some rows, ``array[:, :, 3:7]``; then one axis is sliced, and all axes before it are
    complete. Raises StorageError if pieces are missing."""

    def __init__(
        self, store: RunStore, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        self.shape, self.dtype, self.ndim = shape, dtype, len(shape)
        self.nbytes = math.prod(shape) * dtype.itemsize
        self._store, self._name = store, name

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Return the whole array."""
        whole = np.empty(self.shape, self.dtype)
        self._read(0, whole)
        return whole if dtype is None else whole.astype(dtype, copy=False)

    def __getitem__(self, index: tuple[slice, ...]) -> Array:
        """Return some rows of the array."""
        axis = len(index) - 1
        first, last, _ = index[axis].indices(self.shape[axis])
        lead, inner = self.shape[:axis], self.shape[axis + 1 :]
        row = math.prod(inner) * self.dtype.itemsize
        values = np.empty((math.prod(lead), last - first, *inner), self.dtype)
        for n, part in enumerate(values):
            self._read((n * self.shape[axis] + first) * row, part)
        return values.reshape(*lead, last - first, *inner)

    def _read(self, start: int, into: Array) -> None:
        """Read bytes from an offset into an array."""
        data: memoryview = into.reshape(-1).view(np.uint8).data
        position = 0
        while position < len(data):
            n, skip = divmod(start + position, PART_BYTES)
            piece = self._store.piece(f"{self._name}/{n}")
            if len(piece) != min(PART_BYTES, self.nbytes - n * PART_BYTES):
                raise StorageError(
                    f"{self._store.path}: is damaged: '{self._name}' has another size"
                )
            section = piece[skip : skip + len(data) - position]
            data[position : position + len(section)] = section
            position += len(section)


def _refuse_others(path: Path) -> None:
    """Raise StorageError if the journal refers to another file, because SQLite would remove this
    file after rolling back. No store has such a journal."""
    with suppress(FileNotFoundError), Path(f"{path}-journal").open("rb") as journal:
        journal.seek(max(0, journal.seek(0, os.SEEK_END) - len(JOURNAL_MARK)))
        if journal.read() == JOURNAL_MARK:
            raise StorageError(
                f"{path}-journal: refers to another file, and was not written by pbdkit; remove it"
            )


def _digest_of_all(listed: dict[str, bytes]) -> str:
    return xxhash.xxh3_128_hexdigest(b"".join(sorted(listed.values())))


STORE = ".run"
"""Suffix that is added to the name of the output to obtain the name of the store."""
RECORDS = ".run-records"
"""Suffix that is added to the name of the output to obtain the name of the file of large values."""


def store_of(output: Path) -> Path:
    """Return the path of the SQLite file of an unfinished run."""
    return output.parent / (output.name + STORE)


def records_of(output: Path) -> Path:
    """Return the path of the file with the large values of an unfinished run."""
    return output.parent / (output.name + RECORDS)


def remove_unfinished(output: Path) -> None:
    """Remove the files of a store. The records are removed last, because their lock excludes other
    runs."""
    remove_store(output)
    with suppress(OSError):
        records_of(output).unlink(missing_ok=True)


class StoreState(Enum):
    """State of the store of a run."""

    NOTHING = auto()
    """There is no store."""
    BEGUN = auto()
    """The store has no commit."""
    COMMITTED = auto()
    """The store has a commit, from which the run can be resumed."""
    FINISHED = auto()
    """The records already have the name of the result, but the store still exists."""


def is_unfinished(output: Path) -> bool:
    """Return whether there is a run that can be resumed. The store of a finished run is removed.

    Raises ExperimentError if a run is in progress, and StorageError if the store is damaged.
    """
    with _exclusive(output):
        status = store_state(output)
        if status is StoreState.FINISHED:
            remove_store(output)
        return status is StoreState.COMMITTED


def make_room(output: Path, *, discard: bool = False) -> bool:
    """Return whether an output is free for a run. A store without commits is removed.

    The output of an unfinished run is free only if the run is to be discarded. This is also
    possible if its store is damaged. Raises the errors of `is_unfinished`.
    """
    with _exclusive(output):
        if not discard and has_committed(output):
            return False
        remove_unfinished(output)
        return True


@contextmanager
def _exclusive(output: Path) -> Iterator[None]:
    """Exclude other writers of an output during the block, by a lock on the records. The records of
    a finished run have the name of the result."""
    has_store = store_of(output).exists()
    for path in (records_of(output), output) if has_store else [records_of(output)]:
        try:
            file = open_locked(path)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise StorageError(f"{path}: {reason_of(error)}") from None
        if file is None:
            raise busy_error(output)
        with file:
            yield
        return
    yield


def busy_error(output: Path) -> ExperimentError:
    """Return the error for the second writer of an output."""
    return ExperimentError(
        f"{output}: is being written by another run; `pbdkit status {output}` prints its progress; "
        "-o writes another file"
    )


def has_committed(output: Path) -> bool:
    """Return whether there is a checkpoint of an unfinished run. Raises StorageError in the same
    cases as `store_state`."""
    return store_state(output) is StoreState.COMMITTED


def store_state(output: Path) -> StoreState:
    """Return the state of the store of a run, without changing anything on the disk. Raises
    StorageError if the store is damaged."""
    store, records = store_of(output), records_of(output)
    if not has_store_files(output):
        return StoreState.NOTHING
    header = header_of(records)
    if not is_database(store):
        if header or size_of(store) > ONE_PAGE or size_of(Path(f"{store}-wal")):
            raise damage_error(store, "it is missing, or not a database")
        return StoreState.BEGUN
    with RunStore(store) as database:
        if not database.commits:
            if header and header.commits:
                raise damage_error(
                    store, "its log was damaged, truncated or removed, and it is empty"
                )
            return StoreState.BEGUN
        if records.exists():
            return StoreState.COMMITTED
        if _is_result(output, database):
            return StoreState.FINISHED
    raise damage_error(records, "it is missing")


def header_of(records: Path) -> Header | None:
    """Read the header of the records of a run. Return None if there is no header, or if it was
    overwritten at the end of the run. Raises StorageError."""
    try:
        with io.FileIO(records, "rb") as file:
            return read_header(file)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StorageError(f"{records}: cannot be read: {reason_of(error)}") from None


def _is_result(output: Path, store: RunStore) -> bool:
    """Return whether a run has finished and its records have the name of the result."""
    if "finished" not in store.facts("facts") or not output.exists():
        return False
    with output.open("rb", buffering=0) as file:
        seal = seal_of(file)
    return seal is not None and seal.size == store.facts("file").get("size")


def damage_error(path: Path, what: str) -> StorageError:
    """Return the error of a damaged file of an unfinished run."""
    return StorageError(
        f"{path}: is damaged: {what}; nothing was removed; restore the files from an intact copy, "
        "or discard them by `pbdkit run` with --force"
    )


def has_store_files(output: Path) -> bool:
    """Return whether the records or any file of a store exist."""
    return any(path.exists() for path in (*files_of(store_of(output)), records_of(output)))


def remove_store(output: Path) -> None:
    """Remove the store, but not its records, which may have become the result."""
    for path in reversed(files_of(store_of(output))):
        with suppress(OSError):
            path.unlink(missing_ok=True)


EXTENT = np.dtype([("start", "<u8"), ("stop", "<u8"), ("digest", "<u8")])
"""Data type of the extents of the records."""
MAX_ARRAY_ENTRIES = 2**40
"""Maximum number of entries of an array that is read."""
PAGES = "page/"
"""Prefix of the keys of pages."""
EXTENTS = "extents/"
"""Prefix of the keys of extents."""
ARRAYS = "array/"
"""Prefix of the keys of pieces of arrays."""


class UnfinishedRun:
    """The store of a run and its records.

    The writing process holds a lock on the records. A commit contains the checkpoint and the
    present content of the result file: its pages, the extents in the records, and the entries that
    are buffered until a chunk is full. Raises StorageError.
    """

    def __init__(self, output: Path, disk: io.FileIO, store: RunStore) -> None:
        self.output, self.disk, self._store = output, disk, store
        self._arrays: set[str] = set()
        self.records = records_of(output)
        self.has_checkpoint = False
        """True after the first commit."""

    @classmethod
    def begin(cls, output: Path, temporary: Path, disk: io.FileIO) -> UnfinishedRun:
        """Create a store in the folder of the output. The temporary file, which is open as `disk`,
        becomes the records."""
        store, records = store_of(output), records_of(output)
        conflict = StorageError(f"{output}: another run has started to write it")
        try:
            os.link(temporary, records)
        except FileExistsError:
            raise conflict from None
        except OSError:  # The file system has no hard links.
            if records.exists():
                raise conflict from None
            temporary.rename(records)
        else:
            temporary.unlink()
        if store.exists():  # This is the store of a run that is being finished.
            records.unlink()
            raise conflict
        try:
            return cls(output, disk, RunStore(store, mode="rwc"))
        except BaseException:
            remove_unfinished(output)
            raise

    @classmethod
    def open(cls, output: Path, *, writing: bool, anyway: bool = False) -> UnfinishedRun:
        """Open an existing store. With `anyway`, a store is opened even if its last commits are
        lost. A damaged store is not changed. Raises ExperimentError if another process writes the
        store."""
        store, records = store_of(output), records_of(output)
        try:
            disk = open_locked(records) if writing else io.FileIO(records, "rb")
        except OSError as error:
            raise StorageError(f"{records}: cannot be read: {reason_of(error)}") from None
        if disk is None:
            raise busy_error(output)
        try:
            header = read_header(disk)
            opened = cls(output, disk, RunStore(store))
            try:
                opened._refuse_newer()
                opened._refuse_other(header, anyway)
                if writing:
                    opened._store.check()
            except BaseException:
                opened.release()
                raise
            if writing:
                opened.release()
                opened._store = RunStore(store, mode="rw")
        except BaseException:
            disk.close()
            raise
        opened.has_checkpoint = True
        return opened

    def keep(
        self,
        checkpoint: Checkpoint,
        file: PagedFile,
        waiting: Mapping[str, list[NDArray[Any]]],
        written: Mapping[str, int],
    ) -> None:
        """Commit a checkpoint and the present content of the result file in one transaction.
        Buffered entries are stored with the checkpoint, and all other entries in the pages and
        extents of the file."""
        batches = {f"waiting.{n}": np.stack(v) for n, v in waiting.items() if v}
        arrays = batches | checkpoint.arrays
        types = {n: [a.dtype.str, list(a.shape)] for n, a in arrays.items()}
        facts = checkpoint.facts | {"arrays": types, "written": dict(written)}
        keys = {key for n, a in arrays.items() for key in keys_of(ARRAYS + n, a)}
        obsolete, self._arrays = self._arrays - keys, keys
        about = [("about", json_piece(checkpoint.about | {"format": FORMAT}))]
        parts = (parts_of(ARRAYS + n, a) for n, a in arrays.items())
        self._commit(file, chain(about, *parts, [("facts", json_piece(facts))]), obsolete)

    def conclude(self, file: PagedFile, status: str) -> None:
        """Commit the complete file of a finished run."""
        self._commit(file, [("facts", json_piece({"finished": status}))], set())

    def _commit(self, file: PagedFile, pieces: Iterable[Piece], obsolete: set[str]) -> None:
        self._note_commits()
        file.sync()
        numbers = file.changed if self.has_checkpoint else file.pages
        pages = [(f"{PAGES}{n}", bytes(file.pages[n])) for n in numbers]
        added = file.added if self.has_checkpoint else file.extents
        extents = [(f"{EXTENTS}{len(file.extents)}", np.array(added, EXTENT).tobytes())]
        layout = {"size": file.size, "pages": len(file.pages), "extents": len(file.extents)}
        contents = [*pages, *(extents if added else []), ("file", json_piece(layout))]
        self._store.commit(chain(pieces, contents), obsolete)
        self._note_commits()
        file.commit()
        if not self.has_checkpoint:
            sync_folder(self.output.absolute().parent)
        self.has_checkpoint = True

    @property
    def about(self) -> dict[str, Any]:
        """Description of the run: experiment, versions, and origin."""
        return self._dict("about")

    @property
    def facts(self) -> dict[str, Any]:
        """Facts of the checkpoint: the state of the run without its arrays."""
        return self._dict("facts")

    def checkpoint(self, *, on_disk: bool = False) -> Checkpoint:
        """Return the checkpoint of the last commit. It contains the arrays of the run and, with the
        names ``waiting.NAME``, the buffered entries of each column. If `on_disk` is true, the
        arrays are read when they are accessed."""
        facts, arrays = self.facts, Arrays()
        try:
            for name, (dtype, shape) in facts["arrays"].items():
                kind = np.dtype(dtype)
                if kind.kind not in "fiub" or np.prod(shape, dtype=float) > MAX_ARRAY_ENTRIES:
                    raise ValueError(dtype)
                stored = StoredArray(self._store, ARRAYS + name, kind, tuple(shape))
                if len(self._store.keys(f"{ARRAYS}{name}/")) != -(-stored.nbytes // PART_BYTES):
                    raise ValueError(f"'{name}' has another size")
                waits = not on_disk or name.startswith("waiting.")
                arrays[name] = np.asarray(stored) if waits else stored
        except (KeyError, TypeError, ValueError) as error:
            raise StorageError(f"{self._store.path}: is damaged: {error}") from None
        self._arrays = {*self._store.keys(ARRAYS)}
        return Checkpoint(self.about, facts, arrays)

    def file(self, *, read_only: bool) -> PagedFile:
        """Return the file of the result as of the last commit."""
        layout = self._dict("file")
        pages = {}
        for key in self._store.keys(PAGES):
            pages[int(key.removeprefix(PAGES))] = self._store.piece(key)
        rows = b"".join(self._store.piece(key) for key in self._store.keys(EXTENTS))
        table = np.frombuffer(rows[: len(rows) // EXTENT.itemsize * EXTENT.itemsize], EXTENT)
        extents = [ByteRange(*row) for row in np.sort(table, order="start").tolist()]
        counts = {"size": layout.get("size"), "pages": len(pages), "extents": len(extents)}
        if layout != counts or any(len(page) != PAGE for page in pages.values()):
            raise StorageError(f"{self._store.path}: is damaged: parts of it are missing")
        end = extents[-1].stop if extents else 0
        if end > os.fstat(self.disk.fileno()).st_size:
            raise StorageError(f"{self.disk.name}: is shorter than when it was written")
        return PagedFile(self.disk, layout["size"], pages, extents, read_only=read_only)

    def close(self) -> None:
        """Close the store. If there is a commit, the store remains for `resume`; otherwise it is
        removed."""
        self._store.close()
        if not self.has_checkpoint and not self.disk.closed:
            remove_unfinished(self.output)
        self.disk.close()

    def release(self) -> None:
        """Close the store for writing. The records can still be read."""
        self._store.close()

    def remove(self) -> None:
        """Remove the store and release the lock, after the records have got the name of the
        result. Warn if a file cannot be removed."""
        self._store.close()
        remove_store(self.output)
        with suppress(OSError):  # The system may have kept the former name of the records, too.
            if os.path.samestat(self.records.stat(), os.fstat(self.disk.fileno())):
                self.records.unlink()
        with suppress(OSError):  # Otherwise a power cut could restore the store.
            sync_folder(self.output.absolute().parent)
        self.disk.close()
        for path in (store_of(self.output), self.records):
            if path.exists():
                text = f"{path}: cannot be removed; {self.output} is complete without it"
                warn_caller(text, StorageWarning)

    def _dict(self, key: str) -> dict[str, Any]:
        facts = self._store.facts(key)
        if not isinstance(facts, dict):
            raise StorageError(f"{self._store.path}: is damaged: '{key}' is not a map of keys")
        return facts

    def _note_commits(self) -> None:
        """Write the number of commits to the records. From now on a store with fewer commits counts
        as damaged."""
        write_header(self.disk, Header(self._store.identity, self._store.commits))

    def _refuse_other(self, header: Header | None, anyway: bool) -> None:
        """Raise StorageError if the records belong to another run. Unless the store is opened with
        `anyway`, also raise it if the store has fewer commits than the header of the records
        contains."""
        commits, store = self._store.commits, self._store.path
        if header is None or (header is FINALIZED and "finished" not in self.facts):
            raise damage_error(self.records, "its first bytes have changed since they were written")
        if header is not FINALIZED and header.identity != self._store.identity:
            raise damage_error(store, f"{self.records} belongs to another run")
        if commits < header.commits and not anyway:
            raise StorageError(
                f"{store}: is damaged: it contains {commits} of {header.commits} commits; the log "
                "with the last ones was damaged, truncated or removed; nothing was changed; "
                f"`pbdkit resume {self.output}` with --anyway continues from the last commit in "
                f"it, of step {self.facts.get('step')}"
            )

    def _refuse_newer(self) -> None:
        version = self.about.get("format")
        if version != FORMAT:
            raise StorageError(
                f"{self._store.path}: has the format {version}, but this pbdkit reads {FORMAT}; "
                "use the version of pbdkit that wrote it"
            )


def status_of(output: Path) -> dict[str, Any] | None:
    """Return the status of the unfinished run of an output, or None if there is no such run. `step`
    is the last step and `steps` the number of steps. `rate` is the number of steps per second, and
    `left_s` the predicted time to the end of the run in seconds. `age_s` is the time since the last
    checkpoint in seconds. `state` is running or stopped."""
    try:
        return _status(output) if has_committed(output) else None
    except StorageError:
        if has_store_files(output):
            raise
        return None  # The run has finished in the meantime.


def _status(output: Path) -> dict[str, Any]:
    run = UnfinishedRun.open(output, writing=False)
    try:
        about, facts = run.about, run.facts
        running = not lock(run.disk)
        steps = int(about["steps"])
        step = steps if "finished" in facts else int(facts["step"])
        rate = float(facts.get("rate", 0.0))
        # The clock may have been set back.
        age = max(0.0, time.time() - float(facts.get("at", math.inf)))
        remaining = max(0.0, (steps - step) / rate - age) if rate > 0.0 else None
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StorageError(f"{store_of(output)}: is damaged: {error}") from None
    finally:
        run.close()
    state = "running" if running else "stopped"
    figures = {"step": step, "steps": steps, "rate": rate, "left_s": remaining, "age_s": age}
    return figures | {"state": state}
