"""Columns of numbers in a CSV file beside the experiment."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo

from pbdkit.experiment.parts import fault
from pbdkit.interfaces.component import did_you_mean

MOST_BYTES, MOST_ROWS = 2**26, 200_000


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
        return list(_rows(_path(given, (info.context or {}).get("folder", Path())), names))
    except UnicodeDecodeError as error:
        raise fault(
            f"{given}: is not UTF-8: {error.reason}; save it as UTF-8", key="file"
        ) from None
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise fault(f"{given}: cannot be read: {reason}", key="file") from None


def _path(given: Any, folder: Path) -> Path:
    if not isinstance(given, str) or not given or "\0" in given:
        raise fault(f"expected the name of a CSV file, got {given!r:.40}", key="file")
    path = folder / given
    if not path.is_file():
        raise fault(
            f"{path}: is no regular file; its place counts from the experiment's file", key="file"
        )
    if path.stat().st_size > MOST_BYTES:
        raise fault(f"{path}: is larger than 64 MiB; leave out points", key="file")
    return path


def _rows(path: Path, names: Sequence[str]) -> Iterator[list[float]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.DictReader(file, skipinitialspace=True)
        header = [name.strip() for name in lines.fieldnames or ()]
        lines.fieldnames = header
        for name in names:
            if header.count(name) != 1:
                found = f"two '{name}'" if name in header else f"no '{name}'"
                text = f"needs columns {', '.join(names)}, named in its first line; there are"
                hint = _separators(header) or did_you_mean(name, {*header} - {*names})
                raise fault(f"{path}:1: {text} {found}{hint}", key="file")
        count = 0
        for row in lines:
            count += 1
            if count > MOST_ROWS:
                raise fault(f"{path}: has more than {MOST_ROWS} rows; leave out some", key="file")
            yield [_number(row, name, f"{path}:{lines.line_num}") for name in names]
        if not count:
            raise fault(f"{path}: holds no row of numbers below its first line", key="file")


def _separators(header: list[str]) -> str:
    """A hint where something else than commas stands between the columns."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if any(separator in column for column in header):
            return (
                f"; the columns of this file are separated by {name}: save it with commas between "
                "columns, and points in numbers"
            )
    return ""


def _number(row: Mapping[str, Any], name: str, place: str) -> float:
    text = row[name]
    try:
        number = float(text)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        got = "nothing" if text in (None, "") else repr(text)[:40]
        raise fault(f"{place}: column '{name}' needs a finite number, got {got}", key="file")
    return number
