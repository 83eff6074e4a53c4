"""What `pbdkit bench --json` measured, as a table in a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pbdkit.bench.work_precision import COLUMNS
from pbdkit.errors import ExperimentError, StorageError


def speed(path: Path) -> dict[str, Any]:
    """Headings with what they mean, and a row a method. Raises StorageError where the file cannot
    be read, and ExperimentError where it holds something else."""
    try:
        told = json.loads(path.read_text("utf-8"))
        rows: list[dict[str, Any]] = [dict(row) for row in told["rows"]]
        machine, experiment = dict(told["machine"]), f"{told['experiment']}, {told['steps']} steps"
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from None
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ExperimentError(
            f"{path}: holds no measurement; `pbdkit bench EXPERIMENT --json {path}` writes one"
        ) from None
    names = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
    return {
        "of": experiment,
        "on": ", ".join(f"{name} {value}" for name, value in machine.items()),
        "columns": [[COLUMNS[name][0], COLUMNS[name][2]] for name in names],
        "rows": [[_cell(row, name) for name in names] for row in rows],
        "left_out": [f"{row.get('method')}: {row['reason']}" for row in rows if row.get("reason")],
    }


def _cell(row: dict[str, Any], name: str) -> str:
    value = row.get(name)
    if not isinstance(value, int | float):
        return str(value or "")
    return format(value, COLUMNS[name][1])
