"""Databases with a damaged schema."""

from __future__ import annotations

import sqlite3
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from pbdkit.io.sqlite_file import connect, files_of, open_read_only

DAMAGE = {
    "name of the table": (b"tablemember", b"table\xffember"),
    "definition": (b"CREATE TABLE", b"CREATE\xffTABLE"),
}
"""Bytes of the schema, and bytes in their place that SQLite quotes in its message."""


def stored(folder: Path, *, spilled: bool) -> Path:
    """Write a database and, if `spilled`, leave the files of a process that was killed within a
    transaction."""
    path, copy = folder / "all.sqlite", folder / "left.sqlite"
    with closing(connect(path, "rwc")) as database:
        database.execute("CREATE TABLE member (key TEXT)")
        database.execute("INSERT INTO member VALUES (?)", ("a" * 9000,))
        if spilled:
            database.execute("PRAGMA cache_size = 1")
            database.execute("BEGIN IMMEDIATE")
            database.execute("UPDATE member SET key = ?", ("b" * 90_000,))
        for file, name in zip(files_of(path), files_of(copy), strict=True):
            if file.exists():
                name.write_bytes(file.read_bytes())
    return copy


@pytest.mark.parametrize("spilled", [False, True], ids=["complete", "killed"])
@pytest.mark.parametrize("what", DAMAGE)
def test_a_schema_that_is_not_text_is_damage(tmp_path: Path, what: str, spilled: bool) -> None:
    path = stored(tmp_path, spilled=spilled)
    with ExitStack() as stack:
        query = "SELECT SUBSTR(key, 1, 1) FROM member"
        assert open_read_only(path, stack).execute(query).fetchall() == [("a",)]
    before, after = DAMAGE[what]
    for file in tmp_path.glob("left.sqlite*"):
        file.write_bytes(file.read_bytes().replace(before, after))
    files = {file: file.read_bytes() for file in tmp_path.glob("left.sqlite*")}
    with ExitStack() as stack, pytest.raises(sqlite3.DatabaseError, match="schema") as caught:
        open_read_only(path, stack)
    assert caught.value.sqlite_errorcode == sqlite3.SQLITE_CORRUPT
    assert {file: file.read_bytes() for file in tmp_path.glob("left.sqlite*")} == files
    with pytest.raises(sqlite3.DatabaseError, match="schema"):
        connect(path, "rw")
