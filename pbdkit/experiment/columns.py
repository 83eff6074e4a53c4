"""Columns of numbers in a CSV file beside the experiment."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from pydantic import ValidationInfo

from pbdkit.errors import did_you_mean
from pbdkit.experiment.beside import beside
from pbdkit.experiment.parts import fault

MOST_BYTES, MOST_ROWS = 2**26, 200_000
LONGEST_LINE = 2**16
"""Maximum number of characters in a line."""


def or_a_file(*names: str) -> Callable[[dict[str, Any]], None]:
    """For a model's JSON Schema: these fields are needed, or `file` in their place."""

    def either(schema: dict[str, Any]) -> None:
        schema["required"] = [name for name in schema.get("required", ()) if name not in names]
        schema["anyOf"] = [{"required": ["file"]}, {"required": [*names]}]

    return either


def in_place_of(
    given: Any, info: ValidationInfo, columns: Sequence[str], names: Sequence[str]
) -> tuple[dict[str, Any], list[list[float]]] | None:
    """What is given besides `file`, and the rows of these columns in it, which take the place of
    the fields of these names; None where no file is given."""
    if not isinstance(given, dict) or given.get("file") is None:
        return None
    if given.keys() & {*names}:
        raise fault(f"give either a file, or {' and '.join(names)}", key="file")
    rest = {key: value for key, value in given.items() if key != "file"}
    return rest, read_columns(given["file"], info, columns)


def read_columns(given: Any, info: ValidationInfo, names: Sequence[str]) -> list[list[float]]:
    """The rows of a file, relative to the experiment's, numbers in the order of the names.

    Raises a fault of the key `file` that says what is wrong in it, where, and the remedy.
    """
    try:
        path = beside(info).path(given, "CSV")
        if path.stat().st_size > MOST_BYTES:
            raise fault(f"{path}: is larger than 64 MiB; leave out points", key="file")
        return list(_rows(path, names))
    except UnicodeDecodeError as error:
        raise fault(
            f"{given}: is not UTF-8: {error.reason}; save it as UTF-8", key="file"
        ) from None
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise fault(f"{given}: cannot be read: {reason}", key="file") from None
    except ValueError as error:
        raise fault(str(error), key="file") from None


def _rows(path: Path, names: Sequence[str]) -> Iterator[list[float]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(_bounded(file, path), skipinitialspace=True)
        columns = _columns([name.strip() for name in next(lines, [])], names, path)
        count = 0
        for row in lines:
            if not row:
                continue
            count += 1
            if count > MOST_ROWS:
                raise fault(f"{path}: has more than {MOST_ROWS} rows; leave out some", key="file")
            place = f"{path}:{lines.line_num}"
            yield [_number(row[n : n + 1], name, place) for name, n in columns.items()]
        if not count:
            raise fault(f"{path}: holds no row of numbers below its first line", key="file")


def _bounded(file: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a table. Raises a fault where one is longer than those of a table are."""
    while line := file.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            text = f"{path}: has a line of more than {LONGEST_LINE} characters"
            raise fault(f"{text}; leave out the columns that are not needed", key="file")
        yield line


def _columns(header: list[str], names: Sequence[str], path: Path) -> dict[str, int]:
    """Return where the columns stand. Raises a fault where one is missing, or there twice."""
    for name in names:
        if header.count(name) != 1:
            found = f"two '{name}'" if name in header else f"no '{name}'"
            text = f"needs columns {', '.join(names)}, named in its first line; there are"
            hint = _separators(header) or did_you_mean(name, {*header} - {*names})
            raise fault(f"{path}:1: {text} {found}{hint}", key="file")
    return {name: header.index(name) for name in names}


def _separators(header: list[str]) -> str:
    """A hint where something else than commas stands between the columns."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if any(separator in column for column in header):
            return (
                f"; the columns of this file are separated by {name}: save it with commas between "
                "columns, and points in numbers"
            )
    return ""


def _number(cell: list[str], name: str, place: str) -> float:
    """The number in a cell, empty where the row is too short. Python would take 1_0 for 10."""
    text = "".join(cell)
    try:
        number = math.nan if "_" in text else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        got = repr(text)[:40] if text else "nothing"
        raise fault(f"{place}: column '{name}' needs a finite number, got {got}", key="file")
    return number
