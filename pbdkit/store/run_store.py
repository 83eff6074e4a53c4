"""What is on disk of an unfinished run: `OUT.nc.run`, a folder with a database and two files.

The database says which bytes count, and their digests. Large ones lie in the files beside it, and
are synced before the commit that names them: whatever is cut off at whatever moment, what was
committed is there, and nothing else is taken for it.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import xxhash

from pbdkit.errors import StorageError
from pbdkit.store.file_system import is_local

VERSION = 1
LARGE_BYTES = 2**20
"""From here on an entry lies in the file of records, and a state in the file of states."""
SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL, digest TEXT) WITHOUT ROWID;
CREATE TABLE records (
    name TEXT, first INTEGER, count INTEGER, place INTEGER, size INTEGER, content BLOB, digest TEXT,
    PRIMARY KEY (name, first)
) WITHOUT ROWID;
CREATE TABLE state (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    data TEXT, counts TEXT, place INTEGER, size INTEGER, content BLOB, digest TEXT
);
"""
BUSY_S = 20.0


def folder_of(output: Path) -> Path:
    """Where the store of the run that is to write this file lies."""
    return output.with_name(output.name + ".run")


class Saved(NamedTuple):
    """A state as it was committed: its data as JSON, the bytes of its arrays, and how many entries
    of each column belong to it."""

    data: str
    content: bytes
    counts: dict[str, int]


class RunStore:
    """The store of one run. One process at a time writes it; any number may read.

    Every method raises StorageError where the system refuses, and where what is read is not what
    was written.
    """

    def __init__(self, folder: Path, *, make: bool = False, write: bool = False) -> None:
        self.folder = folder
        self.counts: dict[str, int] = {}
        """How many entries of each column have been put."""
        with self._storing():
            if make:
                folder.mkdir()
            self._lock = _locked(folder / "lock") if make or write else None
            if make or write:
                (folder / "records.bin").touch()
                (folder / "state.bin").touch()
            self._open("rwc" if make else "rw" if write else "ro")
            if make:
                self._database.executescript(SCHEMA)
                self._sync_folder()
        if not make:
            self._read_counts()

    def _open(self, mode: str) -> None:
        uri = f"{(self.folder / 'run.sqlite').absolute().as_uri()}?mode={mode}"
        self._database = sqlite3.connect(
            uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False
        )
        for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "synchronous = FULL"):
            self._database.execute(f"PRAGMA {pragma}")
        if mode == "rwc":
            journal = "WAL" if is_local(self.folder) else "TRUNCATE"
            self._database.execute(f"PRAGMA journal_mode = {journal}")
        flags = os.O_RDONLY if mode == "ro" else os.O_RDWR
        self._records = os.open(self.folder / "records.bin", flags)
        self._states = os.open(self.folder / "state.bin", flags)
        self._end = os.fstat(self._records).st_size
        self._unsynced = False
        self._rows: list[tuple[Any, ...]] = []

    # What is written

    def tell(self, **about: Any) -> None:
        """Keeps what is known of the run, as JSON, from the next commit on."""
        for key, value in about.items():
            text = json.dumps(value)
            self._rows.append(("about", key, text, _digest(key, text)))

    def put(self, name: str, count: int, content: bytes) -> None:
        """So many more entries of a column, from the next commit on."""
        first, size, place = self.counts.get(name, 0), len(content), None
        digest = _digest(name, first, count, content)
        if size >= LARGE_BYTES:
            place, self._end = self._end, self._end + size
            with self._storing():
                _write(self._records, content, place)
            self._unsynced, content = True, b""
        self._rows.append(("records", name, first, count, place, size, content, digest))
        self.counts[name] = first + count

    def commit(self, data: str, parts: Iterable[bytes]) -> None:
        """Makes all that was put safe, and the state that belongs to it."""
        content, counts, place = b"".join(parts), json.dumps(self.counts), None
        digest, size = _digest(data, counts, content), len(content)
        with self._storing():
            if size >= LARGE_BYTES:
                place = self._free_place(size)
                _write(self._states, content, place)
                os.fdatasync(self._states)
                content = b""
            if self._unsynced:
                os.fdatasync(self._records)
            row = ("state", 1, data, counts, place, size, content, digest)
            self._database.execute("BEGIN IMMEDIATE")
            for table, *values in (*self._rows, row):
                marks = ", ".join("?" * len(values))
                self._database.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", values)
            self._database.execute("COMMIT")
        self._rows, self._unsynced = [], False

    def _free_place(self, size: int) -> int:
        """Where the last committed state is not."""
        found = self._database.execute("SELECT place, size FROM state").fetchone()
        if not found or found[0] is None or found[0] >= size:
            return 0
        return int(found[0] + found[1])

    def remove(self) -> None:
        """The run is done: nothing of the store is left."""
        self.close()
        with self._storing():
            shutil.rmtree(self.folder)

    def close(self) -> None:
        """Lets others write."""
        with suppress(sqlite3.Error):
            self._database.close()
        for descriptor in (self._records, self._states, self._lock):
            if descriptor is not None:
                with suppress(OSError):
                    os.close(descriptor)

    # What is read

    def known(self, key: str) -> Any:
        """What was told of the run; None where nothing was."""
        with self._storing():
            rows = self._database.execute("SELECT value, digest FROM about WHERE key = ?", (key,))
            found = rows.fetchone()
        if found is None:
            return None
        if found[1] != _digest(key, found[0]):
            raise self._damaged(f"'{key}'")
        return json.loads(found[0])

    def saved(self) -> Saved:
        """The state that was committed last."""
        asked = "SELECT data, counts, place, size, content, digest FROM state"
        with self._storing():
            found = self._database.execute(asked).fetchone()
            if found is None:
                raise self._damaged("the state")
            data, counts, place, size, content, digest = found
            content = self._content(self._states, place, size, content)
        if _digest(data, counts, content) != digest:
            raise self._damaged("the state")
        return Saved(data, content, json.loads(counts))

    def entries(self, name: str) -> Iterator[tuple[int, bytes]]:
        """(count, bytes) of the entries of a column, as they were put, one after the other."""
        asked = "SELECT first, count, place, size, content, digest FROM records WHERE name = ?"
        reached = 0
        with self._storing():
            for first, count, place, size, content, digest in self._database.execute(
                f"{asked} ORDER BY first", (name,)
            ):
                content = self._content(self._records, place, size, content)
                if first != reached or _digest(name, first, count, content) != digest:
                    raise self._damaged(f"entry {first} of '{name}'")
                reached += count
                yield count, content
        if reached != self.counts.get(name, 0):
            raise self._damaged(f"entry {reached} of '{name}'")

    def _content(self, file: int, place: int | None, size: int, content: bytes) -> bytes:
        return bytes(content) if place is None else os.pread(file, size, place)

    def _read_counts(self) -> None:
        if self.known("version") != VERSION:
            raise StorageError(
                f"{self.folder}: is of version {self.known('version')}, and this pbdkit reads "
                f"version {VERSION}; go on with the pbdkit that began the run"
            )
        self.counts = self.saved().counts

    def _damaged(self, what: str) -> StorageError:
        return StorageError(f"{self.folder}: {what} is damaged: its digest does not hold")

    def _sync_folder(self) -> None:
        for folder in (self.folder, self.folder.parent):
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)

    @contextmanager
    def _storing(self) -> Iterator[None]:
        try:
            yield
        except BlockingIOError:
            raise StorageError(f"{self.folder}: another process writes it") from None
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, "strerror", None) or error
            raise StorageError(f"{self.folder}: {reason}") from None


def _locked(file: Path) -> int:
    """A descriptor that locks the file until it is closed, or the process ends. Raises
    BlockingIOError where another process has it."""
    import fcntl

    descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _write(file: int, content: bytes, place: int) -> None:
    """All of it, where the system takes less at a time."""
    left = memoryview(content)
    while left:
        written = os.pwrite(file, left, place)
        left, place = left[written:], place + written


def _digest(*parts: Any) -> str:
    """Of bytes, texts and numbers, told apart."""
    found = xxhash.xxh3_128()
    for part in parts:
        content = part if isinstance(part, bytes) else str(part).encode()
        found.update(len(content).to_bytes(8, "little"))
        found.update(content)
    return str(found.hexdigest())
