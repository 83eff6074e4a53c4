"""Access to SQLite files for writing, and for reading without changing anything on the disk."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from pbdkit.io.atomic_file import is_local

BEGINNING = b"SQLite format 3\0"
"""First bytes of a SQLite database."""
MIN_PAGE_BYTES = 512
"""Smallest size of a page in bytes."""
PATIENCE_S = 60.0
"""Time in seconds to wait for another program that has locked the file."""
LOGS = ("-journal", "-wal")
"""Suffixes of the files that contain commits that are not yet in the database, or transactions that
have to be rolled back."""
SHARED_MEMORY = "-shm"
"""Suffix of the file of shared memory."""
ONE_PAGE = 4096
"""Maximum size in bytes of a database in which nothing was committed."""


def files_of(path: Path) -> list[Path]:
    """Return the paths of all files that SQLite may create for a database. They need not exist."""
    return [path.with_name(path.name + suffix) for suffix in ("", *LOGS, SHARED_MEMORY)]


def journal_mode(path: Path) -> str:
    """Return the journal mode. On a network drive no write-ahead log is used, because it would need
    shared memory."""
    return "WAL" if is_local(path) else "TRUNCATE"


def size_of(path: Path) -> int:
    """Return the size of a file in bytes, and 0 if it does not exist."""
    return path.stat().st_size if path.exists() else 0


def is_database(path: Path) -> bool:
    """Return whether a file begins in the same way as an SQLite database. Raises OSError.

    The check is necessary because SQLite would remove the log of a file that is not a database.
    """
    try:
        with path.open("rb") as file:
            head = file.read(MIN_PAGE_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return len(head) == MIN_PAGE_BYTES and head.startswith(BEGINNING)


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
    # In order to set this, SQLite reads the database, which may have to be rolled back first.
    if mode != "ro":
        settings.append("synchronous = FULL")
    try:
        with _decoding_messages():
            for setting in settings:
                connection.execute(f"PRAGMA {setting}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


@contextlib.contextmanager
def _decoding_messages() -> Iterator[None]:
    """Raise sqlite3.DatabaseError if a message of SQLite quotes bytes of a damaged schema that are
    not valid UTF-8. Python raises UnicodeDecodeError in place of such a message."""
    try:
        yield
    except UnicodeDecodeError as error:
        damage = sqlite3.DatabaseError(f"the schema is damaged: {error}")
        damage.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
        raise damage from error


def open_read_only(path: Path, closing: contextlib.ExitStack) -> sqlite3.Connection:
    """Open a database in order to read one of its commits. `closing` closes it.

    A connection with write access would drop a damaged write-ahead log when it is closed. A
    transaction that a killed process left in a journal has to be rolled back before the database
    can be read. This is done in a copy. Raises sqlite3.Error and OSError.
    """
    connection = closing.enter_context(contextlib.closing(connect(path, "ro")))
    try:
        with _decoding_messages():
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
    """Return the first fault that SQLite finds in a database. The text is empty if there is
    none."""
    try:
        (report,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        return str(error)
    return "" if report == "ok" else str(report).splitlines()[-1]
