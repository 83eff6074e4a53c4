"""The store of an unfinished run beside its output: a SQLite database with the last checkpoint, and
the records, which become the result.
"""

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
from pbdkit.errors import ExperimentError, StorageError
from pbdkit.io.atomic_file import FULL, is_full, lock, opened_alone, sync_folder
from pbdkit.io.checkpoint import Arrays, Checkpoint
from pbdkit.io.paged_file import (
    PAGE,
    SETTLED,
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
    look,
    size_of,
)

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


def _digest_of_all(listed: dict[str, bytes]) -> str:
    return xxhash.xxh3_128_hexdigest(b"".join(sorted(listed.values())))


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
        if header or size_of(store) > ONE_PAGE or size_of(Path(f"{store}-wal")):
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


def remove_store(output: Path) -> None:
    """Without its records, which the result may have become."""
    for path in reversed(files_of(store_of(output))):
        with suppress(OSError):
            path.unlink(missing_ok=True)


EXTENT = np.dtype([("start", "<u8"), ("stop", "<u8"), ("digest", "<u8")])
LARGEST_ARRAY = 2**40
PAGES, EXTENTS, ARRAYS = "page/", "extents/", "array/"
"""How the keys of pieces begin."""


class UnfinishedRun:
    """The store of a run, and the records it names.

    Who writes it holds a lock on the records. A commit holds where the run stands and the file of
    the result as far as it is: its pages, the extents of the records, and the entries that wait for
    a chunk to be full. Raises StorageError.
    """

    def __init__(self, output: Path, disk: io.FileIO, store: RunStore) -> None:
        self.output, self.disk, self._store = output, disk, store
        self._arrays: set[str] = set()
        self.records = records_of(output)
        self.kept = False
        """Whether anything was committed."""

    @classmethod
    def begin(cls, output: Path, temporary: Path, disk: io.FileIO) -> UnfinishedRun:
        """Makes a store beside the output; the temporary file, open as `disk`, becomes its
        records."""
        store, records = store_of(output), records_of(output)
        taken = StorageError(f"{output}: another run began to write it meanwhile")
        try:
            os.link(temporary, records)
        except FileExistsError:
            raise taken from None
        except OSError:  # no hard links on this file system
            if records.exists():
                raise taken from None
            temporary.rename(records)
        else:
            temporary.unlink()
        if store.exists():  # one that is just being finished
            records.unlink()
            raise taken
        try:
            return cls(output, disk, RunStore(store, mode="rwc"))
        except BaseException:
            remove_unfinished(output)
            raise

    @classmethod
    def open(cls, output: Path, *, writing: bool, anyway: bool = False) -> UnfinishedRun:
        """The one that is there; commits may be lost where it is opened `anyway`. Nothing on the
        disk changes where it is damaged. Raises ExperimentError where another process writes it."""
        store, records = store_of(output), records_of(output)
        try:
            disk = opened_alone(records) if writing else io.FileIO(records, "rb")
        except OSError as error:
            raise StorageError(f"{records}: cannot be read: {error.strerror}") from None
        if disk is None:
            raise being_written(output)
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
        opened.kept = True
        return opened

    def keep(
        self,
        checkpoint: Checkpoint,
        file: PagedFile,
        waiting: Mapping[str, list[NDArray[Any]]],
        written: Mapping[str, int],
    ) -> None:
        """Commits where the run stands, and its file, whose pages hold all but what waits."""
        batches = {f"waiting.{n}": np.stack(v) for n, v in waiting.items() if v}
        arrays = batches | checkpoint.arrays
        kinds = {n: [a.dtype.str, list(a.shape)] for n, a in arrays.items()}
        facts = checkpoint.facts | {"arrays": kinds, "written": dict(written)}
        keys = {key for n, a in arrays.items() for key in keys_of(ARRAYS + n, a)}
        gone, self._arrays = self._arrays - keys, keys
        said = [("about", json_piece(checkpoint.about | {"format": FORMAT}))]
        parts = (parts_of(ARRAYS + n, a) for n, a in arrays.items())
        self._commit(file, chain(said, *parts, [("facts", json_piece(facts))]), gone)

    def conclude(self, file: PagedFile, status: str) -> None:
        """Commits the file of a finished run, whose pages hold all of it."""
        self._commit(file, [("facts", json_piece({"finished": status}))], set())

    def _commit(self, file: PagedFile, pieces: Iterable[Piece], gone: set[str]) -> None:
        self._note_commits()
        file.sync()
        numbers = file.changed if self.kept else file.pages
        pages = [(f"{PAGES}{n}", bytes(file.pages[n])) for n in numbers]
        added = file.added if self.kept else file.extents
        extents = [(f"{EXTENTS}{len(file.extents)}", np.array(added, EXTENT).tobytes())]
        layout = {"size": file.size, "pages": len(file.pages), "extents": len(file.extents)}
        described = [*pages, *(extents if added else []), ("file", json_piece(layout))]
        self._store.commit(chain(pieces, described), gone)
        self._note_commits()
        file.commit()
        if not self.kept:
            sync_folder(self.output.absolute().parent)
        self.kept = True

    @property
    def about(self) -> dict[str, Any]:
        """What was asked for, and by which versions."""
        return self._dict("about")

    @property
    def facts(self) -> dict[str, Any]:
        """Where it stood, without the arrays."""
        return self._dict("facts")

    def checkpoint(self, *, on_disk: bool = False) -> Checkpoint:
        """Return the checkpoint of the last commit; its arrays are those of the run, which stay
        `on_disk` on request, and those that wait for a chunk to be full, ``waiting.NAME``."""
        facts, arrays = self.facts, Arrays()
        try:
            for name, (dtype, shape) in facts["arrays"].items():
                kind = np.dtype(dtype)
                if kind.kind not in "fiub" or np.prod(shape, dtype=float) > LARGEST_ARRAY:
                    raise ValueError(dtype)
                stored = StoredArray(self._store, ARRAYS + name, kind, tuple(shape))
                waits = not on_disk or name.startswith("waiting.")
                arrays[name] = np.asarray(stored) if waits else stored
        except (KeyError, TypeError, ValueError, MemoryError) as error:
            raise StorageError(f"{self._store.path}: is damaged: {error}") from None
        self._arrays = {*self._store.keys(ARRAYS)}
        return Checkpoint(self.about, facts, arrays)

    def file(self, *, read_only: bool) -> PagedFile:
        """The file of the result, as it was committed last."""
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
            raise StorageError(f"{self.disk.name}: is shorter than it was written")
        return PagedFile(self.disk, layout["size"], pages, extents, read_only=read_only)

    def close(self) -> None:
        """It stays to be gone on with, if anything was committed; else nothing of it does."""
        self._store.close()
        if not self.kept and not self.disk.closed:
            remove_unfinished(self.output)
        self.disk.close()

    def release(self) -> None:
        """Whoever writes is no longer kept waiting; the records can still be read."""
        self._store.close()

    def remove(self) -> None:
        """Once the records have the name of the result: the store goes, and then the lock."""
        self._store.close()
        remove_store(self.output)
        self.disk.close()

    def _dict(self, key: str) -> dict[str, Any]:
        found = self._store.facts(key)
        if not isinstance(found, dict):
            raise StorageError(f"{self._store.path}: is damaged: '{key}' is no map of keys")
        return found

    def _note_commits(self) -> None:
        """In the records: how many the store must have from now on."""
        write_header(self.disk, Header(self._store.identity, self._store.commits))

    def _refuse_other(self, header: Header | None, anyway: bool) -> None:
        """Raises StorageError where the records, which have this header, belong to another run, and
        unless it is opened `anyway`, where they tell of commits that the store does not have."""
        commits, store = self._store.commits, self._store.path
        if header is None or (header is SETTLED and "finished" not in self.facts):
            raise damaged(self.records, "its first bytes are not what was written")
        if header is not SETTLED and header.identity != self._store.identity:
            raise damaged(store, f"it belongs to another run than {self.records}")
        if commits < header.commits and not anyway:
            raise StorageError(
                f"{store}: is damaged: it holds {commits} commits of {header.commits}, and the "
                "last lie in a log that was damaged, cut or removed; nothing was changed; `pbdkit "
                f"resume {self.output}` with --anyway goes on from the last commit that it holds, "
                f"of step {self.facts.get('step')}"
            )

    def _refuse_newer(self) -> None:
        found = self.about.get("format")
        if found != FORMAT:
            raise StorageError(
                f"{self._store.path}: is of format {found}, and this pbdkit reads {FORMAT}; take "
                "the pbdkit that wrote it"
            )


def status_of(output: Path) -> dict[str, Any] | None:
    """Of the unfinished run of an output: `step`, `steps`, `rate` in steps a second, `left_s`,
    seconds to its end if it goes on so, `age_s`, seconds since it was kept, and `state`, running or
    stopped; None where there is no such run."""
    try:
        return _status(output) if has_committed(output) else None
    except StorageError:
        if is_left(output):
            raise
        return None  # it was finished meanwhile


def _status(output: Path) -> dict[str, Any]:
    left = UnfinishedRun.open(output, writing=False)
    try:
        about, facts = left.about, left.facts
        running = not lock(left.disk)
        steps = int(about["steps"])
        step = steps if "finished" in facts else int(facts["step"])
        rate = float(facts.get("rate", 0.0))
        age = max(0.0, time.time() - float(facts.get("at", math.inf)))  # clocks are set back
        remaining = max(0.0, (steps - step) / rate - age) if rate > 0.0 else None
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StorageError(f"{store_of(output)}: is damaged: {error}") from None
    finally:
        left.close()
    state = "running" if running else "stopped"
    found = {"step": step, "steps": steps, "rate": rate, "left_s": remaining, "age_s": age}
    return found | {"state": state}
