"""The store of an unfinished run: pieces of bytes under keys, each with its digest, in SQLite."""

from __future__ import annotations

import json
import math
import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import FULL, is_full, is_local
from pbdkit.storage.pieced_array import Array, PiecedArray

FORMAT = "2"
"""Of the store; a newer one is refused."""
TABLE = "CREATE TABLE pieces (key TEXT PRIMARY KEY, data BLOB NOT NULL, digest BLOB NOT NULL)"
SCHEMA = [(TABLE,), (None,)]
"""The table, and the index of its keys."""
PART_BYTES = 2**20
"""Bytes a piece of an array."""
LONGEST = 2**26
"""Bytes of anything in the file that this program believes."""
PATIENCE_S = 60.0
"""So long a commit waits for somebody who reads."""
JOURNAL_MARK = bytes.fromhex("d9d505f920a163d7")
"""How a journal of SQLite ends that names another one."""
MARK = 0x70626472
"""The application_id of the file: `pbdr`."""

Piece = tuple[str, bytes | memoryview]


class RunStore:
    """Pieces by key in one SQLite file. A commit is there whole or not at all, whatever stops the
    process or the machine; what it returns from is on the disk.

    Raises StorageError, with the file's name, for whatever SQLite or a digest has against it.
    """

    def __init__(self, path: Path, *, mode: str = "ro") -> None:
        """`mode` is ro, rw, or rwc to make it. To read what a killed process was writing, SQLite
        may have to write, so that nobody opens it but for both."""
        self.path, self._writes = path, mode != "ro"
        _refuse_others(path)
        self._digests: dict[str, bytes] = {}
        with self._sqlite():
            # Nobody but the process's own writer thread uses it, one call after the other.
            self._file = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={'rwc' if mode == 'rwc' else 'rw'}",
                timeout=PATIENCE_S,
                isolation_level=None,
                check_same_thread=False,
                uri=True,
            )
            self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
            for setting in ("trusted_schema = OFF", "cell_size_check = ON", "synchronous = FULL"):
                self._file.execute(f"PRAGMA {setting}")
            schema = self._file.execute("SELECT sql FROM sqlite_master").fetchall()
            self.made = mode == "rwc" or schema != []
            """False where it was left while it was made."""
            if self._writes:
                self._file.execute(f"PRAGMA journal_mode = {_journal(path)}")
            if mode == "rwc":
                self._file.execute(f"PRAGMA application_id = {MARK}")
                self._file.execute(TABLE)
            elif schema not in ([], SCHEMA):
                raise StorageError(f"{path}: is no store of a run")
            if mode == "ro":  # all that is read is of one commit
                self._file.execute("PRAGMA query_only = ON")
                self._file.execute("BEGIN")

    def __enter__(self) -> RunStore:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def commit(self, pieces: Iterable[Piece], gone: Iterable[str] = ()) -> None:
        """Puts pieces in the place of those of the same keys, and takes others away."""
        new: dict[str, bytes] = {}
        with self._sqlite():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                self._file.executemany("DELETE FROM pieces WHERE key = ?", ((k,) for k in gone))
                for key, data in pieces:
                    new[key] = found = _digest(key, data)
                    if self._digests.get(key) != found:
                        row = (key, data, found)
                        self._file.execute("REPLACE INTO pieces VALUES (?, ?, ?)", row)
                self._file.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    self._file.execute("ROLLBACK")
                raise
        self._digests |= new

    def keys(self, begin: str) -> list[str]:
        """The keys that begin so."""
        with self._sqlite():
            rows = self._file.execute(
                "SELECT key FROM pieces WHERE substr(key, 1, ?) = ?", (len(begin), begin)
            )
            return [str(key) for (key,) in rows]

    def piece(self, key: str) -> bytes:
        """What was committed last under a key."""
        with self._sqlite():
            row = self._file.execute(
                "SELECT data, digest FROM pieces WHERE key = ?", (key,)
            ).fetchone()
        if row is None:
            raise StorageError(f"{self.path}: is damaged: '{key}' is missing")
        data, found = row
        if not isinstance(data, bytes) or _digest(key, data) != found:
            raise StorageError(f"{self.path}: is damaged: '{key}' is not what was written")
        self._digests[key] = found
        return data

    def facts(self, key: str) -> Any:
        """What was committed there as JSON."""
        try:
            return json.loads(self.piece(key))
        except (ValueError, RecursionError):
            raise StorageError(f"{self.path}: is damaged: '{key}' is no JSON") from None

    def close(self) -> None:
        """Without an error, whatever the state of the disk; as one file, where it can be."""
        with suppress(sqlite3.Error):
            if self._writes:
                self._file.execute("PRAGMA journal_mode = DELETE")
        with suppress(sqlite3.Error):
            self._file.close()

    @contextmanager
    def _sqlite(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:  # which says of a full disk this and that
            reason = FULL if is_full(self.path.absolute().parent) else error
            raise StorageError(f"{self.path}: {reason}") from None
        except sqlite3.Error as error:
            raise StorageError(f"{self.path}: {error}") from None


def json_piece(facts: Any) -> bytes:
    """Facts as a piece."""
    return json.dumps(facts).encode()


def parts_of(name: str, array: np.ndarray[Any, Any] | PiecedArray) -> Iterator[Piece]:
    """An array as pieces of bounded size, made one after the other."""
    pieced = array if isinstance(array, PiecedArray) else PiecedArray.of(array)
    for key, block in zip(keys_of(name, array), pieced.blocks(PART_BYTES), strict=True):
        yield key, block.data


def keys_of(name: str, array: np.ndarray[Any, Any] | PiecedArray) -> list[str]:
    """The keys of its pieces."""
    return [f"{name}/{n}" for n in range(-(-array.nbytes // PART_BYTES))]


class StoredArray:
    """An array of such parts. They are read when somebody asks for them: for all, or for some rows,
    ``array[:, :, 3:7]``, one axis cut and those before it whole. Raises StorageError then where
    they are not as many as it needs."""

    def __init__(
        self, store: RunStore, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        self.shape, self.dtype, self.ndim = shape, dtype, len(shape)
        self.nbytes = math.prod(shape) * dtype.itemsize
        self._store, self._name = store, name

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """The whole."""
        whole = np.empty(self.shape, self.dtype)
        self._read(0, whole)
        return whole if dtype is None else whole.astype(dtype, copy=False)

    def __getitem__(self, index: tuple[slice, ...]) -> Array:
        """Some rows."""
        axis = len(index) - 1
        first, last, _ = index[axis].indices(self.shape[axis])
        lead, inner = self.shape[:axis], self.shape[axis + 1 :]
        row = math.prod(inner) * self.dtype.itemsize
        found = np.empty((math.prod(lead), last - first, *inner), self.dtype)
        for n, part in enumerate(found):
            self._read((n * self.shape[axis] + first) * row, part)
        return found.reshape(*lead, last - first, *inner)

    def _read(self, start: int, into: Array) -> None:
        """What stands from a byte on."""
        data: memoryview = into.reshape(-1).view(np.uint8).data
        done = 0
        while done < len(data):
            n, skip = divmod(start + done, PART_BYTES)
            piece = self._store.piece(f"{self._name}/{n}")
            if len(piece) != min(PART_BYTES, self.nbytes - n * PART_BYTES):
                raise StorageError(
                    f"{self._store.path}: is damaged: '{self._name}' has another size"
                )
            some = piece[skip : skip + len(data) - done]
            data[done : done + len(some)] = some
            done += len(some)


def files_of(path: Path) -> list[Path]:
    """The files that SQLite keeps of a store."""
    return [path.with_name(path.name + more) for more in ("", "-journal", "-wal", "-shm")]


def _refuse_others(path: Path) -> None:
    """Raises StorageError where the journal names a further file, which SQLite would remove once
    it has rolled back: no store has such a journal."""
    with suppress(FileNotFoundError), Path(f"{path}-journal").open("rb") as journal:
        journal.seek(max(0, journal.seek(0, os.SEEK_END) - len(JOURNAL_MARK)))
        if journal.read() == JOURNAL_MARK:
            raise StorageError(f"{path}-journal: names another file, and is none of pbdkit's")


def _journal(path: Path) -> str:
    """On a network the write-ahead log would need memory that machines share."""
    return "WAL" if is_local(path) else "TRUNCATE"


def _digest(key: str, data: bytes | memoryview) -> bytes:
    own = xxhash.xxh3_128(key.encode())
    own.update(data)
    return own.digest()
