"""Writes a script as an experiment file, and long ways of the hand beside it."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.source import MAX_BYTES, MAX_NODES
from pbdkit.experiment.yaml_text import yaml_text
from pbdkit.sessions.script import Script
from pbdkit.storage.destination import write_together

INLINE = 500
"""Knots of a way that are written into the experiment; those of longer ones take a table beside."""
COMMENT = "# Made by hand with pbdkit live: `pbdkit run` repeats it bit for bit.\n"


@dataclass(frozen=True)
class Saved:
    """Where it was written; `text` is the file where it needs no other, else None."""

    path: Path
    text: str | None


def saved(script: Script, step: int, output: Path | None) -> Saved:
    """Writes what was done until a step. Where there is such a file already, or none is named, it
    takes the next name that is free.

    Raises ExperimentError where there is no step yet, or more than a file may hold; StorageError
    where it cannot be written.
    """
    if step < 1:
        raise ExperimentError("nothing has been stepped yet: an experiment has a step at least")
    parts = script.written(step)
    name = parts["name"].replace("/", "-")
    path = _free(output or Path(f"{name}.yaml"), len(parts["leaders"]))
    tables = _tables(parts, path)
    text = COMMENT + yaml_text(parts)
    script.experiment.of_parts(script.written(step))
    if len(text) > MAX_BYTES or _nodes(parts) > MAX_NODES:
        text = "what was done is more than an experiment file may hold"
        raise ExperimentError(f"{text}; go back, and save a part of it")
    write_together({**tables, path: text})
    return Saved(path, None if tables else text)


def _free(path: Path, groups: int) -> Path:
    """The first name of which there is neither a file nor a table of one of so many groups."""
    names = (path if n == 1 else path.with_stem(f"{path.stem}-{n}") for n in count(1))
    return next(
        name
        for name in names
        if not any(each.exists() for each in (name, *(_table(name, n) for n in range(groups))))
    )


def _table(path: Path, group: int) -> Path:
    """Where the way of a group is, beside the experiment."""
    return path.with_name(f"{path.stem}-{group}.csv")


def _tables(parts: dict[str, Any], path: Path) -> dict[Path, str]:
    """Puts the longest ways into tables beside the file, by their paths."""
    found = {}
    for n, group in enumerate(parts["leaders"]):
        motion = group["motion"]
        if motion.get("type") == "path" and len(motion["steps"]) > INLINE:
            table = _table(path, n)
            rows = zip(motion["steps"], motion["displacements"], strict=True)
            out = io.StringIO()
            lines = csv.writer(out, lineterminator="\n")
            lines.writerow(["step", "ux", "uy"])
            lines.writerows([step, repr(x), repr(y)] for step, (x, y) in rows)
            found[table] = out.getvalue()
            group["motion"] = {"type": "table", "file": table.name}
    return found


def _nodes(parts: Any) -> int:
    """About as many as the reader of files counts."""
    if isinstance(parts, dict):
        return 1 + sum(1 + _nodes(part) for part in parts.values())
    return 1 + sum(map(_nodes, parts)) if isinstance(parts, list) else 1
