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
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Self

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import is_local, lock
from pbdkit.sweeps.worker import Report, digest_of

DATABASE, LOCK, LARGE = "sweep.sqlite", "lock", "members"
LARGE_BYTES = 2**20
"""What is larger is a file."""
COMMIT_S = 1.0
"""So much at most of what was finished is lost when the machine stops."""
APPLICATION, FORMAT = 0x70626473, 1
"""What SQLite keeps to tell whose database it is, and which form it has."""
TABLE = """CREATE TABLE IF NOT EXISTS member
(key TEXT, status TEXT, message TEXT, file INTEGER, content BLOB, digest BLOB)"""


class Store:
    """The members that are held, by key; to be used as a context manager.

    Raises StorageError where another sweep writes here, where it is no store of this version, and
    for whatever the system or SQLite refuses.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._closing = folder, ExitStack()
        self._rows: dict[str, int] = {}
        self._due = time.monotonic() + COMMIT_S

    def __enter__(self) -> Self:
        """Creates the folder, locks it, and opens the database."""
        with self._storing():
            self._folder.mkdir(parents=True, exist_ok=True)
            self._closing.enter_context(_locked(self._folder / LOCK))
        try:
            with self._storing():
                self._open()
        except BaseException:
            self._closing.close()
            raise
        return self

    def __exit__(self, *raised: object) -> None:
        """Keeps what was put, whatever ended the sweep."""
        with self._closing, self._storing():
            self._database.commit()

    def held(self) -> tuple[dict[str, tuple[str, str]], list[str]]:
        """Status and message of all members that are held and sound, by key; and what is said of
        those that are not, which are removed."""
        faults, found = [], {}
        for row, report in self._all():
            if isinstance(report, str):
                faults.append(f"{self._folder / DATABASE}: row {row} {report}; it runs again")
                with self._storing():
                    self._database.execute("DELETE FROM member WHERE rowid = ?", (row,))
            else:
                self._rows[report.key] = row
                found[report.key] = (report.status, report.message)
        self.commit()
        return found, faults

    def put(self, report: Report) -> None:
        """Keeps a report; it is on the disk with the next commit."""
        large = len(report.content) > LARGE_BYTES
        with self._storing():
            if large:
                self._write(report)
            found = self._database.execute(
                "INSERT INTO member VALUES (?, ?, ?, ?, ?, ?)",
                (report.key, report.status, report.message, int(large),
                 None if large else report.content, report.digest),
            )  # fmt: skip
        assert found.lastrowid is not None
        self._rows[report.key] = found.lastrowid
        self.commit_if_due()

    def commit_if_due(self) -> None:
        """About once a second: each commit waits for the disk."""
        if time.monotonic() >= self._due:
            self.commit()

    def commit(self) -> None:
        """Now."""
        with self._storing():
            self._database.commit()
        self._due = time.monotonic() + COMMIT_S

    def report(self, key: str) -> Report:
        """What is held of a member; StorageError where it is not what was written."""
        row = self._rows[key]
        report = self._read(row)
        if isinstance(report, str):
            where = f"{self._folder / DATABASE}: row {row}"
            raise StorageError(f"{where} {report}; the same command runs that member again")
        return report

    def _all(self) -> Iterator[tuple[int, Report | str]]:
        """Every row with its report, or what is wrong with it."""
        with self._storing():
            rows = [row for (row,) in self._database.execute("SELECT rowid FROM member")]
        for row in rows:
            yield row, self._read(row)

    def _read(self, row: int) -> Report | str:
        with self._storing():
            query = "SELECT * FROM member WHERE rowid = ?"
            return self._checked(self._database.execute(query, (row,)).fetchone())

    def _checked(self, row: tuple[Any, ...] | None) -> Report | str:
        """Whatever may stand in the row."""
        changed = "is not what was written"
        key, status, message, large, content, digest = row or (None,) * 6
        if not re.fullmatch("[0-9a-f]{32}", str(key)):
            return changed
        if large:
            try:
                content = self._file(key).read_bytes()
            except (OSError, ValueError) as error:
                return f"belongs to {self._file(key)}, which cannot be read: {error}"
        if not isinstance(content, bytes) or digest_of(key, status, message, content) != digest:
            return changed
        return Report(key, status, message, content, digest)

    def _file(self, key: str) -> Path:
        return self._folder / LARGE / f"{key}.member"

    def _write(self, report: Report) -> None:
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

    def _open(self) -> None:
        path = self._folder / DATABASE
        new = not path.exists() or path.stat().st_size == 0
        self._database = database = sqlite3.connect(path)
        self._closing.callback(database.close)
        database.text_factory = partial(str, encoding="utf-8", errors="replace")
        (owner,) = database.execute("PRAGMA application_id").fetchone()
        (form,) = database.execute("PRAGMA user_version").fetchone()
        if not new and (owner, form) != (APPLICATION, FORMAT):
            raise StorageError(f"{path}: is no store of a sweep that this pbdkit reads")
        journal = "WAL" if is_local(path) else "TRUNCATE"
        for pragma in (f"journal_mode = {journal}", "synchronous = FULL",
                       f"application_id = {APPLICATION}", f"user_version = {FORMAT}"):  # fmt: skip
            database.execute(f"PRAGMA {pragma}")
        database.execute(TABLE)
        database.commit()

    @contextmanager
    def _storing(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            where = self._folder / DATABASE
            raise StorageError(
                f"{where}: {error}; where it is damaged, remove it to run all members again"
            ) from None
        except OSError as error:
            raise StorageError(f"{self._folder}: {error.strerror or error}") from None


def _locked(path: Path) -> io.FileIO:
    """The lock file, which this process alone holds while it is open. Raises StorageError."""
    file = io.FileIO(path, "ab")
    if lock(file):
        return file
    file.close()
    raise StorageError(
        f"{path.parent}: another sweep is running into this folder; wait for its end, or name "
        "another folder"
    )
