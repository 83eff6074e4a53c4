"""The store of an unfinished run: pieces of bytes under keys, each with its digest, in SQLite."""

from __future__ import annotations

import json
import math
import os
import secrets
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import FULL, is_full, is_local
from pbdkit.storage.pieced_array import Array, PiecedArray
from pbdkit.storage.sqlite_file import connect, fault_of, is_database, look

FORMAT = "3"
"""Of the store; a newer one is refused."""
TABLE = "CREATE TABLE pieces (key TEXT PRIMARY KEY, digest BLOB NOT NULL, data BLOB NOT NULL)"
SCHEMA = [(TABLE,), (None,)]
"""The table, and the index of its keys. Digests can be read without the data behind them."""
IDENTITY, COMMIT = "identity", "commit"
"""The keys of a random number, which every digest depends on, and of the number of the commit with
the digest of all other digests."""
IDENTITY_BYTES = 16
PART_BYTES = 2**20
"""Bytes a piece of an array."""
LONGEST = 2**26
"""Bytes of anything in the file that this program believes."""
JOURNAL_MARK = bytes.fromhex("d9d505f920a163d7")
"""How a journal of SQLite ends that names another one."""
MARK = 0x70626472
"""The application_id of the file: `pbdr`."""

Piece = tuple[str, bytes | memoryview]


class RunStore:
    """Pieces by key in one SQLite file. A commit is there whole or not at all, whatever stops the
    process or the machine; what it returns from is on the disk.

    What is read is of one commit of one store: pieces of another commit or of another store, in
    whichever way they came into the file, are damage. Raises StorageError, with the file's name,
    for whatever SQLite or a digest has against it.
    """

    def __init__(self, path: Path, *, mode: str = "ro") -> None:
        """`mode` is ro, rw, or rwc to make it. With ro nothing on the disk changes, whatever is
        wrong; with rw a damaged log is dropped, so that `check` and the header of the records come
        first."""
        self.path, self._writes = path, mode != "ro"
        self.identity, self.commits = b"", 0
        """The latter is the number of commits that it holds."""
        self._verified: dict[str, bytes] = {}
        self._listed: dict[str, bytes] = {}
        """The digests of what was written or read by now, and those of all pieces, by key."""
        self._settled, self._closing = False, ExitStack()
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

    def commit(self, pieces: Iterable[Piece], gone: Iterable[str] = ()) -> None:
        """Puts pieces in the place of those of the same keys, and takes others away."""
        with self._sqlite():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                listed, put = dict(self._listed), dict[str, bytes]()
                for key in gone:
                    self._file.execute("DELETE FROM pieces WHERE key = ?", (key,))
                    listed.pop(key, None)
                for key, data in pieces:
                    put[key] = self._put(key, data)
                listed, number = listed | put, self.commits + 1
                whole = {"number": number, "pieces": _digest_of_all(listed)}
                self._put(COMMIT, json_piece(whole))
                self._file.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    self._file.execute("ROLLBACK")
                raise
            self._listed, self.commits = listed, number
            self._verified |= put
            if not self._settled:  # table and first commit last, should the log be lost
                _, frames, moved = self._file.execute("PRAGMA wal_checkpoint").fetchone()
                self._settled = frames == moved

    def keys(self, begin: str) -> list[str]:
        """The keys that begin so."""
        return [key for key in self._listed if key.startswith(begin)]

    def piece(self, key: str) -> bytes:
        """What was committed last under a key."""
        with self._sqlite():
            query = "SELECT data, digest FROM pieces WHERE key = ?"
            row = self._file.execute(query, (key,)).fetchone()
        if row is None:
            raise StorageError(f"{self.path}: is damaged: '{key}' is missing")
        data, found = row
        if not isinstance(data, bytes) or self._digest(key, data) != found:
            raise StorageError(f"{self.path}: is damaged: '{key}' is not what was written")
        self._verified[key] = found
        return data

    def check(self) -> None:
        """Reads all of it. Raises StorageError where anything is not what was written."""
        with self._sqlite():
            if fault := fault_of(self._file):
                raise StorageError(f"{self.path}: is damaged: {fault}")
        for key in self._listed:
            self.piece(key)

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
        with suppress(sqlite3.Error, OSError):
            self._closing.close()

    def _open(self, mode: str) -> None:
        if mode != "rwc" and not is_database(self.path):
            raise StorageError(f"{self.path}: is damaged: it is missing, or no database")
        if mode == "ro":
            try:
                self._file = look(self.path, self._closing)
            except OSError as error:
                raise StorageError(f"{self.path}: cannot be read: {error}") from None
        else:
            self._file = self._closing.enter_context(closing(connect(self.path, mode)))
        self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
        if mode == "rwc":
            self._make()
            return
        schema = self._file.execute("SELECT sql FROM sqlite_master").fetchall()
        if schema not in ([], SCHEMA):
            raise StorageError(f"{self.path}: is no store of a run, or one of an earlier pbdkit")
        if self._writes:
            self._file.execute(f"PRAGMA journal_mode = {_journal(self.path)}")
        if schema:
            self._list()

    def _make(self) -> None:
        self.identity = secrets.token_bytes(IDENTITY_BYTES)
        self._file.execute(f"PRAGMA journal_mode = {_journal(self.path)}")
        self._file.execute("BEGIN")
        self._file.execute(f"PRAGMA application_id = {MARK}")
        self._file.execute(TABLE)
        self._listed[IDENTITY] = self._put(IDENTITY, self.identity)
        self._file.execute("COMMIT")

    def _put(self, key: str, data: bytes | memoryview) -> bytes:
        """Writes a piece, unless it stands there already; its digest."""
        found = self._digest(key, data)
        if self._verified.get(key) != found:
            self._file.execute("REPLACE INTO pieces VALUES (?, ?, ?)", (key, found, data))
        return found

    def _list(self) -> None:
        """The pieces of the last commit, and whose they are. Raises StorageError where they are not
        those that were committed together."""
        rows = self._file.execute("SELECT key, CAST(digest AS BLOB) FROM pieces").fetchall()
        query = "SELECT CAST(data AS BLOB) FROM pieces WHERE key = ?"
        self.identity, *_ = self._file.execute(query, (IDENTITY,)).fetchone() or (b"",)
        self.piece(IDENTITY)
        self._listed = {str(key): digest or b"" for key, digest in rows}
        if len(rows) == 1:
            return
        whole = self.facts(COMMIT)
        del self._listed[COMMIT]
        number = whole.get("number") if isinstance(whole, dict) else None
        if type(number) is not int or whole.get("pieces") != _digest_of_all(self._listed):
            raise StorageError(f"{self.path}: is damaged: not all of it is of one commit")
        self.commits = number

    def _digest(self, key: str, data: bytes | memoryview) -> bytes:
        own = xxhash.xxh3_128(self.identity + key.encode())
        own.update(data)
        return own.digest()

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


def _digest_of_all(listed: dict[str, bytes]) -> str:
    return xxhash.xxh3_128_hexdigest(b"".join(sorted(listed.values())))
