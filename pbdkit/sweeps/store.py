"""What members came to, in one SQLite database of the sweep's folder; large ones are files beside
it. Nobody writes here but the process of the sweep."""

from __future__ import annotations

import io
import os
import re
import socket
import sqlite3
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Self

from pbdkit.errors import StorageError
from pbdkit.io.atomic_file import FULL, is_full, lock, sync_folder
from pbdkit.io.sqlite_file import (
    BEGINNING,
    ONE_PAGE,
    PATIENCE_S,
    connect,
    fault_of,
    files_of,
    is_database,
    journal_mode,
    look,
    size_of,
)
from pbdkit.sweeps.worker import MemberReport, digest_of

DATABASE, LOCK, LARGE, ASIDE = "sweep.sqlite", "lock", "members", "set-aside"
NEW = DATABASE + ".new"
"""The database while it is made."""
TEMPORARY = re.compile(r"\..+\.\d+\.[0-9a-f]{32}(\.nc)?")
"""The names of files that are being written: host, process, random number."""
LARGE_BYTES = 2**20
"""What is larger is a file."""
COMMIT_S = 1.0
"""So much at most of what was finished is lost when the machine stops."""
APPLICATION, FORMAT = 0x70626473, 2
"""What SQLite keeps to tell whose database it is, and which form it has."""
TABLE = (
    "CREATE TABLE member (key TEXT PRIMARY KEY, status TEXT, message TEXT, file INTEGER, "
    "digest BLOB, content BLOB)"
)
COLUMNS = "key, status, message, file, digest, content"
PUT = "REPLACE INTO member VALUES (?, ?, ?, ?, ?, ?)"
LOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
Row = tuple[Any, ...]


class Store:
    """The members that are held, by key; to be used as a context manager.

    A database that is damaged is set aside, not removed, and what is sound of it copied into a new
    one; `faults` says so. Raises StorageError where another sweep writes here, where it is no store
    of this version, and for whatever the system or SQLite refuses.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._path, self._closing = folder, folder / DATABASE, ExitStack()
        self._keys: set[str] = set()
        self._due = time.monotonic() + COMMIT_S
        self.faults: list[str] = []
        """What is to be said of the store: what was found damaged, and what became of that."""

    def __enter__(self) -> Self:
        """Creates the folder, locks it, and opens the database."""
        with self._storing():
            self._folder.mkdir(parents=True, exist_ok=True)
            self._place = self._folder.stat()
            self._lock = self._closing.enter_context(_locked(self._folder / LOCK))
        try:
            with self._storing():
                self._clear()
                self._make_sound()
                self._open()
        except BaseException:
            self._closing.close()
            raise
        return self

    def __exit__(self, *raised: object) -> None:
        """Keeps what was put, whatever ended the sweep."""
        with self._closing:
            if not isinstance(raised[1], StorageError):
                self.commit()
                return
            with suppress(sqlite3.Error, StorageError):  # that has waited for it long enough
                self._database.execute("PRAGMA busy_timeout = 0")
                self.commit()

    def held(self) -> dict[str, tuple[str, str]]:
        """Status and message of all members that are held and sound, by key. Those that are not are
        removed, with a line in `faults`."""
        found = {}
        with self._storing():
            numbers = self._database.execute("SELECT rowid FROM member").fetchall()
            for (number,) in numbers:
                query = f"SELECT {COLUMNS} FROM member WHERE rowid = ?"
                report = self._checked(self._database.execute(query, (number,)).fetchone() or ())
                if isinstance(report, str):
                    self.faults.append(f"{self._path}: row {number} {report}; it runs again")
                    self._begin()
                    self._database.execute("DELETE FROM member WHERE rowid = ?", (number,))
                else:
                    found[report.key] = (report.status, report.message)
        self._keys = {*found}
        self.commit()
        return found

    def put(self, report: MemberReport) -> None:
        """Keeps a report; it is on the disk with the next commit."""
        large = len(report.content) > LARGE_BYTES
        with self._storing():
            if large:
                self._write(report)
            content = None if large else report.content
            key, status, message = report.key, report.status, report.message
            self._begin()
            row = (key, status, message, int(large), report.digest, content)
            self._database.execute(PUT, row)
        self._keys.add(report.key)
        self.commit_if_due()

    def commit_if_due(self) -> None:
        """About once a second: each commit waits for the disk."""
        if time.monotonic() >= self._due:
            self.commit()

    def commit(self) -> None:
        """Now; then the number of members that are held is noted beside the database."""
        with self._storing():
            if self._database.in_transaction:
                self._database.execute("COMMIT")
            self._lock.seek(0)
            self._lock.write(f"{len(self._keys):>19}\n".encode())
        self._due = time.monotonic() + COMMIT_S

    def report(self, key: str) -> MemberReport:
        """What is held of a member; StorageError where it is not what was written."""
        with self._storing():
            query = f"SELECT {COLUMNS} FROM member WHERE key = ?"
            report = self._checked(self._database.execute(query, (key,)).fetchone() or ())
        if not isinstance(report, str) and report.key != key:
            report = "is of another member"
        if isinstance(report, str):
            raise StorageError(
                f"{self._path}: what is held of a member {report}; the same command runs it again"
            )
        return report

    def look_around(self) -> None:
        """After the last commit: raises StorageError where the folder is gone, and adds to `faults`
        where the database is."""
        self._refuse_moved()
        try:
            there = os.path.samestat(self._path.stat(), self._opened)
        except OSError:
            there = False
        if not there:
            self.faults.append(
                f"{self._path}: was removed or replaced while the sweep ran; what this call did is "
                "in sweep.nc alone, and the next one runs the members again"
            )

    def _refuse_moved(self) -> None:
        try:
            there = os.path.samestat(self._folder.stat(), self._place)
        except OSError:
            there = False
        if not there:
            raise StorageError(
                f"{self._folder}: was moved or removed while the sweep ran; where it is there "
                "again, the same command goes on with what it holds"
            )

    def _checked(self, row: Row) -> MemberReport | str:
        """The report in a row, or what is wrong with it."""
        changed = "is not what was written"
        key, status, message, large, digest, content = row or (None,) * 6
        if not re.fullmatch("[0-9a-f]{32}", str(key)):
            return changed
        if large:
            try:
                content = self._file(key).read_bytes()
            except (OSError, ValueError) as error:
                return f"belongs to {self._file(key)}, which cannot be read: {error}"
        if not isinstance(content, bytes) or digest_of(key, status, message, content) != digest:
            return changed
        return MemberReport(key, status, message, content, digest)

    def _file(self, key: str) -> Path:
        return self._folder / LARGE / f"{key}.member"

    def _write(self, report: MemberReport) -> None:
        """Under a name that no process on any machine has, then under its own."""
        path = self._file(report.key)
        path.parent.mkdir(exist_ok=True)
        temporary = path.with_name(f".{socket.gethostname()}.{os.getpid()}.{uuid.uuid4().hex}")
        try:
            with temporary.open("xb") as file:
                file.write(report.content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def _clear(self) -> None:
        """Removes what killed sweeps were writing: none runs, as this one has the lock."""
        for folder in (self._folder, self._folder / LARGE):
            for path in folder.glob(".*"):
                if TEMPORARY.fullmatch(path.name):
                    path.unlink()

    def _make_sound(self) -> None:
        """Makes the database, or one of what is sound in a damaged one, which is set aside. It gets
        its name when it is whole."""
        new, noted = self._folder / NEW, self._noted()
        if new.exists() and not self._path.exists():  # killed while it changed places
            new.replace(self._path)
        fault = self._fault(noted)
        if fault is None:
            return
        for path in files_of(new):
            path.unlink(missing_ok=True)
        with closing(connect(new, "rwc")) as database:
            database.execute("BEGIN")
            for setting in (f"application_id = {APPLICATION}", f"user_version = {FORMAT}"):
                database.execute(f"PRAGMA {setting}")
            database.execute(TABLE)
            if fault:
                database.executemany(PUT, self._sound())
            database.execute("COMMIT")
            (kept,) = database.execute("SELECT COUNT(*) FROM member").fetchone()
        if fault:
            aside = self._set_aside()
            moved = f"; what was there is in {aside}" if aside else ""
            self.faults.append(
                f"{self._path}: {fault}; {kept} members of it are sound and stay held, in a new "
                f"one; the others run again{moved}"
            )
        new.replace(self._path)
        sync_folder(self._folder)

    def _fault(self, noted: int) -> str | None:
        """Why the database cannot be used as it is: empty where it was never made whole, None where
        it can be used. Raises StorageError for what may be somebody else's."""
        logs = any(size_of(path) for path in files_of(self._path)[1:3])
        if not is_database(self._path):
            if noted or logs:
                return f"is missing, or no database, and {noted or 'some'} members were held"
            if size_of(self._path) > ONE_PAGE or not _may_become_database(self._path):
                raise self._stranger()
            return ""
        try:
            with ExitStack() as looking:
                return self._fault_within(look(self._path, looking), noted, logs)
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode & 0xFF in LOCKED:
                raise
            return f"is damaged: {error}"

    def _fault_within(self, database: sqlite3.Connection, noted: int, logs: bool) -> str | None:
        (owner,) = database.execute("PRAGMA application_id").fetchone()
        (form,) = database.execute("PRAGMA user_version").fetchone()
        schema = database.execute("SELECT sql FROM sqlite_master").fetchall()
        if not noted and not schema and owner in (0, APPLICATION):
            return "is damaged: its log is not what was written" if logs else ""
        if (not noted and owner != APPLICATION) or (owner == APPLICATION and form > FORMAT):
            raise self._stranger()
        if fault := fault_of(database):
            return f"is damaged: {fault}"
        if (owner, form) != (APPLICATION, FORMAT) or schema != [(TABLE,), (None,)]:
            return "is damaged, or of an earlier pbdkit"
        (held,) = database.execute("SELECT COUNT(*) FROM member").fetchone()
        if held < noted:
            return f"is damaged: it holds {held} members of {noted}, as where its log was removed"
        return None

    def _stranger(self) -> StorageError:
        return StorageError(f"{self._path}: is no store of a sweep that this pbdkit reads")

    def _sound(self) -> Iterator[Row]:
        """The rows of a damaged database that are as they were written, from both of its ends."""
        for order in ("", "ORDER BY rowid DESC"):
            with suppress(sqlite3.Error), ExitStack() as looking:
                if not is_database(self._path):
                    return
                database = look(self._path, looking)
                database.text_factory = partial(str, encoding="utf-8", errors="replace")
                for row in database.execute(f"SELECT {COLUMNS} FROM member {order}"):
                    if not isinstance(self._checked(row), str):
                        yield row

    def _set_aside(self) -> Path | None:
        """Moves what there is of the database to a folder of its own, which it returns."""
        there = [path for path in files_of(self._path) if path.exists()]
        if not there:
            return None
        names = (self._folder / f"{ASIDE}-{n}" for n in count(1))
        aside = next(path for path in names if not path.exists())
        aside.mkdir()
        for path in there:
            path.replace(aside / path.name)
        return aside

    def _noted(self) -> int:
        """The number of members that were held after the last commit; 0 where nothing tells."""
        self._lock.seek(0)
        try:
            return int(self._lock.read(20))
        except ValueError:
            return 0

    def _open(self) -> None:
        self._database = database = self._closing.enter_context(closing(connect(self._path, "rw")))
        self._opened = self._path.stat()
        database.text_factory = partial(str, encoding="utf-8", errors="replace")
        database.execute(f"PRAGMA journal_mode = {journal_mode(self._path)}")
        self._keys = {key for (key,) in database.execute("SELECT key FROM member")}

    def _begin(self) -> None:
        if not self._database.in_transaction:
            self._database.execute("BEGIN IMMEDIATE")

    @contextmanager
    def _storing(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            self._refuse_moved()
            raise StorageError(f"{self._path}: {self._reason(error)}") from None
        except OSError as error:
            self._refuse_moved()
            raise StorageError(f"{self._folder}: {error.strerror or error}") from None

    def _reason(self, error: sqlite3.Error) -> str:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in LOCKED:
            return (
                f"another program has kept it locked for {PATIENCE_S:g} s; close that, and give "
                "the same command again: it goes on with what is held"
            )
        if is_full(self._folder):
            return FULL
        return f"{error}; what is held stays, and the same command goes on with what is sound of it"


def _may_become_database(path: Path) -> bool:
    """Whether a file is not there, empty, or the beginning of a database. Raises OSError."""
    if not path.exists():
        return True
    with path.open("rb") as file:
        head = file.read(len(BEGINNING))
    return BEGINNING.startswith(head)


def _locked(path: Path) -> io.FileIO:
    """The lock file, which this process alone holds while it is open. Raises StorageError."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
    file = io.FileIO(descriptor, "r+b")
    if lock(file):
        return file
    file.close()
    raise StorageError(
        f"{path.parent}: another sweep is running into this folder; wait for its end, or name "
        "another folder"
    )
