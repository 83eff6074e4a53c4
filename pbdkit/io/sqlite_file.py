"""Access to SQLite files, for writing or for reading without a change to anything on the disk."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory

from pbdkit.io.atomic_file import is_local

BEGINNING = b"SQLite format 3\0"
"""First bytes of a SQLite database."""
SMALLEST_PAGE = 512
"""Smallest size of a page in bytes."""
PATIENCE_S = 60.0
"""Time in seconds to wait for another program that has locked the file."""
LOGS = ("-journal", "-wal")
"""Suffixes of the files with commits that are not yet in the database, or that are being rolled
back."""
SHARED_MEMORY = "-shm"
"""Suffix of the file of shared memory."""
ONE_PAGE = 4096
"""Maximum size in bytes of a database in which nothing was committed."""


def files_of(path: Path) -> list[Path]:
    """Return the paths of all files that SQLite keeps of a database, whether they exist or not."""
    return [path.with_name(path.name + suffix) for suffix in ("", *LOGS, SHARED_MEMORY)]


def journal_mode(path: Path) -> str:
    """Return the journal mode. No write-ahead log is used on a network drive, since it would need
    shared memory."""
    return "WAL" if is_local(path) else "TRUNCATE"


def size_of(path: Path) -> int:
    """Return the size of a file in bytes; 0 where there is none."""
    return path.stat().st_size if path.exists() else 0


def is_database(path: Path) -> bool:
    """Return whether a file begins as an SQLite database does. Raises OSError.

    SQLite would remove the log beside a file that is not a database.
    """
    try:
        with path.open("rb") as file:
            head = file.read(SMALLEST_PAGE)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return len(head) == SMALLEST_PAGE and head.startswith(BEGINNING)


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a database without trusting its schema; `mode` is ro, rw, or rwc to create it.

    Raises sqlite3.Error.
    """
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        timeout=PATIENCE_S,
        isolation_level=None,
        check_same_thread=False,
        uri=True,
    )
    settings = ["trusted_schema = OFF", "cell_size_check = ON"]
    if mode != "ro":  # SQLite reads the database to set this, which may need to be rolled back.
        settings.append("synchronous = FULL")
    try:
        for setting in settings:
            connection.execute(f"PRAGMA {setting}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def open_read_only(path: Path, closing: contextlib.ExitStack) -> sqlite3.Connection:
    """Open a database to read one commit of it; `closing` closes it.

    A connection with write access would drop a damaged write-ahead log when it is closed. A
    transaction that a killed process left in a journal has to be rolled back before reading: that
    is done in a copy. Raises sqlite3.Error and OSError.
    """
    connection = closing.enter_context(contextlib.closing(connect(path, "ro")))
    try:
        connection.execute("BEGIN")
        connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_READONLY_ROLLBACK:
            raise
        folder = Path(closing.enter_context(TemporaryDirectory(prefix="pbdkit-")))
        for file in files_of(path)[:-1]:
            if file.exists():
                shutil.copyfile(file, folder / file.name)
        connection = closing.enter_context(contextlib.closing(connect(folder / path.name, "rw")))
        connection.execute("BEGIN")
    return connection


def fault_of(connection: sqlite3.Connection) -> str:
    """Return the first fault that SQLite finds in a database; empty if there is none."""
    try:
        (report,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        return str(error)
    return "" if report == "ok" else str(report).splitlines()[-1]
