"""Store of the results of members, in the folder of the sweep.

It is a SQLite database, with separate files for large results.

Only the process of the sweep writes to it.
"""

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

from pbdkit.errors import StorageError, reason_of
from pbdkit.io.atomic_file import FULL, is_full, lock, make_folder, sync_folder
from pbdkit.io.sqlite_file import (
    BEGINNING,
    ONE_PAGE,
    PATIENCE_S,
    connect,
    fault_of,
    files_of,
    is_database,
    journal_mode,
    open_read_only,
    size_of,
)
from pbdkit.sweeps.worker import MemberReport, digest_of

DATABASE = "sweep.sqlite"
"""File name of the database."""

LOCK = "lock"
"""File name of the lock, which contains the number of stored members."""

LARGE_FOLDER = "members"
"""Folder of large results."""

DAMAGED_FOLDER = "set-aside"
"""Beginning of the names of folders for damaged databases."""
NEW = DATABASE + ".new"
"""File name of a database that is being created."""
TEMPORARY = re.compile(r"\..+\.\d+\.[0-9a-f]{32}(\.nc)?")
"""Pattern of file names of results that are being written.

They consist of the names of host and process, and a random number.
"""
LARGE_BYTES = 2**20
"""Results above this size are stored as files."""
COMMIT_S = 1.0
"""Interval between commits in seconds.

If the machine stops, at most the results of one interval are lost.
"""
APPLICATION = 0x70626473
"""SQLite's application_id of a store."""

FORMAT = 2
"""Version of the format of a store."""
TABLE = (
    "CREATE TABLE member (key TEXT PRIMARY KEY, status TEXT, message TEXT, file INTEGER, "
    "digest BLOB, content BLOB)"
)
"""Definition of the table."""
COLUMNS = "key, status, message, file, digest, content"
"""Columns of the table."""
PUT = "REPLACE INTO member VALUES (?, ?, ?, ?, ?, ?)"
"""Statement that stores a row."""
LOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
"""Error codes of a database that another program has locked."""
Row = tuple[Any, ...]


class Store:
    """Results of members by key. The store is used as a context manager.

    A damaged database is moved aside, and its intact rows are copied into a new one.

    Parameters
    ----------
    folder
        Folder of the sweep.

    Attributes
    ----------
    faults
        Messages about damage and its repair.

    Raises
    ------
    StorageError
        If another sweep uses the folder, if the store in it has another version, or if the file
        system or SQLite reports an error.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._path, self._closing = folder, folder / DATABASE, ExitStack()
        self._place: os.stat_result | None = None
        self._keys: set[str] = set()
        self._due = time.monotonic() + COMMIT_S
        self.faults: list[str] = []

    def __enter__(self) -> Self:
        """Create the folder, lock it, and open the database."""
        with self._report_errors():
            make_folder(self._folder)
            self._place = self._folder.stat()
            self._lock = self._closing.enter_context(_locked(self._folder / LOCK))
        try:
            with self._report_errors():
                self._clear()
                self._repair()
                self._open()
        except BaseException:
            self._closing.close()
            raise
        return self

    def __exit__(self, *raised: object) -> None:
        """Commit all results, even after an exception."""
        with self._closing:
            if not isinstance(raised[1], StorageError):
                self.commit()
                return
            # The statement that failed has already waited for the lock.
            with suppress(sqlite3.Error, StorageError):
                self._database.execute("PRAGMA busy_timeout = 0")
                self.commit()

    def held(self) -> dict[str, tuple[str, str]]:
        """Return the status and the message of each intact result, by key.

        Damaged results are removed, with a message in `faults`.
        """
        results = {}
        with self._report_errors():
            rows = self._database.execute("SELECT rowid FROM member").fetchall()
            for (row,) in rows:
                query = f"SELECT {COLUMNS} FROM member WHERE rowid = ?"
                report = self._verified(self._database.execute(query, (row,)).fetchone() or ())
                if isinstance(report, str):
                    self.faults.append(f"{self._path}: row {row} {report}; it runs again")
                    self._begin()
                    self._database.execute("DELETE FROM member WHERE rowid = ?", (row,))
                else:
                    results[report.key] = (report.status, report.message)
        self._keys = {*results}
        self.commit()
        return results

    def put(self, report: MemberReport) -> None:
        """Store a report. It is on the disk after the next commit."""
        is_large = len(report.content) > LARGE_BYTES
        with self._report_errors():
            if is_large:
                self._write(report)
            content = None if is_large else report.content
            key, status, message = report.key, report.status, report.message
            self._begin()
            row = (key, status, message, int(is_large), report.digest, content)
            self._database.execute(PUT, row)
        self._keys.add(report.key)
        self.commit_if_due()

    def commit_if_due(self) -> None:
        """Commit if the last commit is about a second ago, because a commit waits for the disk."""
        if time.monotonic() >= self._due:
            self.commit()

    def commit(self) -> None:
        """Commit all results, and write their number beside the database."""
        with self._report_errors():
            if self._database.in_transaction:
                self._database.execute("COMMIT")
            self._lock.seek(0)
            self._lock.write(f"{len(self._keys):>19}\n".encode())
        self._due = time.monotonic() + COMMIT_S

    def report(self, key: str) -> MemberReport:
        """Return the result of a member.

        Raises
        ------
        StorageError
            If the result is missing or damaged.
        """
        with self._report_errors():
            query = f"SELECT {COLUMNS} FROM member WHERE key = ?"
            report = self._verified(self._database.execute(query, (key,)).fetchone() or ())
        if not isinstance(report, str) and report.key != key:
            report = "belongs to another member"
        if isinstance(report, str):
            raise StorageError(
                f"{self._path}: the result of a member {report}; the same command runs it again"
            )
        return report

    def check_existence(self) -> None:
        """Check after the last commit that folder and database still exist.

        A missing database is reported in `faults`.

        Raises
        ------
        StorageError
            If the folder was moved or removed.
        """
        self._refuse_moved()
        try:
            exists = os.path.samestat(self._path.stat(), self._opened)
        except OSError:
            exists = False
        if not exists:
            self.faults.append(
                f"{self._path}: was removed or replaced during the sweep; its results are "
                "in sweep.nc only, and the next call runs the members again"
            )

    def _refuse_moved(self) -> None:
        if self._place is None:  # The folder could not be created.
            return
        try:
            exists = os.path.samestat(self._folder.stat(), self._place)
        except OSError:
            exists = False
        if not exists:
            raise StorageError(
                f"{self._folder}: was moved or removed during the sweep; once it is there again, "
                "repeat the command to continue with its results"
            )

    def _verified(self, row: Row) -> MemberReport | str:
        """Return the report in a row of the table, or a message if it is damaged."""
        fault = "has changed since it was written"
        key, status, message, is_large, digest, content = row or (None,) * 6
        texts = isinstance(status, str) and isinstance(message, str)
        if not texts or not re.fullmatch("[0-9a-f]{32}", str(key)):
            return fault
        if is_large:
            try:
                content = self._file(key).read_bytes()
            except (OSError, ValueError) as error:
                return f"belongs to {self._file(key)}, which cannot be read: {error}"
        if not isinstance(content, bytes) or digest_of(key, status, message, content) != digest:
            return fault
        return MemberReport(key, status, message, content, digest)

    def _file(self, key: str) -> Path:
        return self._folder / LARGE_FOLDER / f"{key}.member"

    def _write(self, report: MemberReport) -> None:
        """Write a report to a file with a name that no other process uses, and rename the file."""
        path = self._file(report.key)
        make_folder(path.parent)
        temporary = path.with_name(f".{socket.gethostname()}.{os.getpid()}.{uuid.uuid4().hex}")
        try:
            with temporary.open("xb") as file:
                file.write(report.content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def _clear(self) -> None:
        """Remove temporary files of killed sweeps.

        No other sweep is running in the folder, because this one holds the lock.
        """
        for folder in (self._folder, self._folder / LARGE_FOLDER):
            for path in folder.glob(".*"):
                if TEMPORARY.fullmatch(path.name):
                    path.unlink()

    def _repair(self) -> None:
        """Create the database, or a new one with the intact rows of a damaged one.

        The database is renamed to its final name when it is complete.
        """
        new, count = self._folder / NEW, self._member_count()
        has_journal = any(path.exists() for path in files_of(new)[1:])  # It is incomplete then.
        if new.exists() and not has_journal and not self._path.exists():
            new.replace(self._path)  # A sweep was killed between both renames.
        fault = self._fault(count)
        if fault is None:
            return
        for path in files_of(new):
            path.unlink(missing_ok=True)
        with closing(connect(new, "rwc")) as database:
            database.execute("BEGIN")
            for pragma in (f"application_id = {APPLICATION}", f"user_version = {FORMAT}"):
                database.execute(f"PRAGMA {pragma}")
            database.execute(TABLE)
            if fault:
                database.executemany(PUT, self._intact_rows())
            database.execute("COMMIT")
            (intact,) = database.execute("SELECT COUNT(*) FROM member").fetchone()
        if fault:
            folder = self._set_aside()
            remark = f"; the damaged one is in {folder}" if folder else ""
            self.faults.append(
                f"{self._path}: {fault}; its {intact} intact members are now in a new one; the "
                f"others run again{remark}"
            )
        new.replace(self._path)
        sync_folder(self._folder)

    def _fault(self, count: int) -> str | None:
        """Return the reason for which the database cannot be used, or None if it can be used.

        The reason is empty if the database was never completed.

        Raises
        ------
        StorageError
            If the file may belong to another program.
        """
        logs = any(size_of(path) for path in files_of(self._path)[1:3])
        if not is_database(self._path):
            if count or logs:
                return (
                    f"is missing or not a database, although {count or 'some'} members were stored"
                )
            if size_of(self._path) > ONE_PAGE or not _may_become_database(self._path):
                raise self._foreign_store()
            return ""
        try:
            with ExitStack() as stack:
                return self._fault_within(open_read_only(self._path, stack), count, logs)
        except sqlite3.DatabaseError as error:
            if _is_locked(error):
                raise
            return f"is damaged: {error}"

    def _fault_within(self, database: sqlite3.Connection, count: int, logs: bool) -> str | None:
        (owner,) = database.execute("PRAGMA application_id").fetchone()
        (version,) = database.execute("PRAGMA user_version").fetchone()
        schema = database.execute("SELECT sql FROM sqlite_master").fetchall()
        if not count and not schema and owner in (0, APPLICATION):
            return "is damaged: its log was changed" if logs else ""
        if (not count and owner != APPLICATION) or (owner == APPLICATION and version > FORMAT):
            raise self._foreign_store()
        if fault := fault_of(database):
            return f"is damaged: {fault}"
        if (owner, version) != (APPLICATION, FORMAT) or schema != [(TABLE,), (None,)]:
            return "is damaged, or was written by an earlier pbdkit"
        (stored,) = database.execute("SELECT COUNT(*) FROM member").fetchone()
        if stored < count:
            return (
                f"is damaged: it contains {stored} of {count} members; its log may have been "
                "removed"
            )
        return None

    def _foreign_store(self) -> StorageError:
        return StorageError(f"{self._path}: is not a store of a sweep that this pbdkit can read")

    def _intact_rows(self) -> Iterator[Row]:
        """Yield the intact rows of a damaged database.

        The database is read twice, from its beginning up to the damage and from its end back to the
        damage.
        """
        for order in ("", "ORDER BY rowid DESC"):
            with suppress(sqlite3.Error), ExitStack() as stack:
                if not is_database(self._path):
                    return
                database = open_read_only(self._path, stack)
                database.text_factory = partial(str, encoding="utf-8", errors="replace")
                for row in database.execute(f"SELECT {COLUMNS} FROM member {order}"):
                    if not isinstance(self._verified(row), str):
                        yield row

    def _set_aside(self) -> Path | None:
        """Move the files of the database to a new folder, and return it."""
        files = [path for path in files_of(self._path) if path.exists()]
        if not files:
            return None
        names = (self._folder / f"{DAMAGED_FOLDER}-{n}" for n in count(1))
        folder = next(path for path in names if not path.exists())
        folder.mkdir()
        for path in files:
            path.replace(folder / path.name)
        return folder

    def _member_count(self) -> int:
        """Return the number of members that were stored at the last commit; 0 if it is unknown."""
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
    def _report_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            self._refuse_moved()
            raise StorageError(f"{self._path}: {self._reason(error)}") from None
        except OSError as error:
            self._refuse_moved()
            raise StorageError(f"{self._folder}: {reason_of(error)}") from None

    def _reason(self, error: sqlite3.Error) -> str:
        if _is_locked(error):
            return (
                f"another program has locked it for {PATIENCE_S:g} s; close that program, and run "
                "the same command again: it continues with the stored results"
            )
        if is_full(self._folder):
            return FULL
        return f"{error}; repeat the command to continue with the stored results that are intact"


def _is_locked(error: sqlite3.Error) -> bool:
    """Return whether another program has locked the database. Errors of Python itself, such as that
    for text that is not UTF-8, have no code."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in LOCKED


def _may_become_database(path: Path) -> bool:
    """Return whether a file is missing, empty, or the beginning of a database.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    if not path.exists():
        return True
    with path.open("rb") as file:
        head = file.read(len(BEGINNING))
    return BEGINNING.startswith(head)


def _locked(path: Path) -> io.FileIO:
    """Open the lock file, which this process holds while it is open.

    Raises
    ------
    StorageError
        If another process holds it.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
    file = io.FileIO(descriptor, "r+b")
    if lock(file):
        return file
    file.close()
    raise StorageError(
        f"{path.parent}: another sweep is running in this folder; wait until it ends, or name "
        "another folder"
    )
