"""Columns of numbers in CSV files."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TextIO

from pbdkit.errors import StorageError, did_you_mean, unreadable

MAX_BYTES = 2**26
"""Maximum size of a table in bytes."""
MAX_ROWS = 200_000
"""Maximum number of rows of a table."""
MAX_LINE = 2**16
"""Maximum number of characters in a line."""


def columns_of(path: Path, names: Sequence[str]) -> list[list[float]]:
    """Return the rows of a CSV file, with numbers in the order of `names`.

    Raises
    ------
    ValueError
        If the file cannot be read. The message contains the place and the remedy.
    StorageError
        If the disk fails.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"{path}: is larger than 64 MiB; remove points")
        return list(_rows(path, names))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not UTF-8: {error.reason}; save it as UTF-8") from None
    except OSError as error:
        fault = unreadable(path, error)
        if isinstance(fault, StorageError):
            raise fault from None
        raise ValueError(str(fault)) from None
    except csv.Error as error:
        raise ValueError(f"{path}: cannot be read: {error}") from None


def _rows(path: Path, names: Sequence[str]) -> Iterator[list[float]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(_bounded(file, path), skipinitialspace=True)
        columns = _columns([name.strip() for name in next(lines, [])], names, path)
        count = 0
        for row in lines:
            if not row:
                continue
            count += 1
            if count > MAX_ROWS:
                raise ValueError(f"{path}: has more than {MAX_ROWS} rows; remove some")
            place = f"{path}:{lines.line_num}"
            yield [_number(row[n : n + 1], name, place) for name, n in columns.items()]
        if not count:
            raise ValueError(f"{path}: has no row of numbers below its first line")


def _bounded(file: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a table, up to the maximum length of a line."""
    while line := file.readline(MAX_LINE + 1):
        if len(line) > MAX_LINE:
            text = f"{path}: has a line of more than {MAX_LINE} characters"
            raise ValueError(f"{text}; remove the columns that are not required")
        yield line


def _columns(header: list[str], names: Sequence[str], path: Path) -> dict[str, int]:
    """Return the index of each column, which must occur once."""
    for name in names:
        if header.count(name) != 1:
            problem = f"two '{name}'" if name in header else f"no '{name}'"
            text = f"requires the columns {', '.join(names)}, named in its first line, which has"
            hint = _separators(header) or did_you_mean(name, {*header} - {*names})
            raise ValueError(f"{path}:1: {text} {problem}{hint}")
    return {name: header.index(name) for name in names}


def _separators(header: list[str]) -> str:
    """Return a hint if columns are not separated by commas."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if any(separator in column for column in header):
            return (
                f"; the columns of this file are separated by {name}; save it with commas between "
                "columns, and points in numbers"
            )
    return ""


def _number(cell: list[str], name: str, place: str) -> float:
    """Return the number in a cell of the table. A cell that is missing is empty."""
    text = "".join(cell)
    try:
        number = math.nan if "_" in text else float(text)  # Python would read 1_0 as 10.
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        got = repr(text)[:40] if text else "nothing"
        raise ValueError(f"{place}: column '{name}' requires a finite number, got {got}")
    return number
