"""The measurements as a table to read and as an object to keep."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal

from pbdkit.benching.measuring import Bench, Row
from pbdkit.benching.method import Measured, NotMeasured, processors

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "size", "particles", "method", "precision", "threads", "set-up", "cached", "ns", "MiB", "error",
)  # fmt: skip
WORDS = ("method", "precision")
LEGEND = (
    "set-up: seconds until the first step, with compiling, and with what was compiled before",
    "ns: a particle and step; MiB: peak memory above that of the imports; error: largest distance",
    "from the positions of numpy in float64 over the run, relative to the largest displacement",
)


def table(rows: Iterable[Row]) -> Table:
    """A row a method and size; sizes apart by a line."""
    return by_size(COLUMNS, ((row.size, _cells(row)) for row in rows))


def by_size(columns: Iterable[str], rows: Iterable[tuple[object, list[str]]]) -> Table:
    """Rows of a size and their cells, sizes apart by a line; words to the left, numbers to the
    right."""
    from rich import box
    from rich.table import Table

    found = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        justify: Literal["left", "right"] = "left" if name in WORDS else "right"
        found.add_column(name, justify=justify, no_wrap=name == "method")
    for _, block in groupby(rows, key=lambda row: row[0]):
        for _, cells in block:
            found.add_row(*cells)
        found.add_section()
    return found


def _cells(row: Row) -> list[str]:
    size = "as it is" if row.size is None else str(row.size)
    method = [row.method.name, row.method.precision, str(row.method.threads)]
    if isinstance(row, NotMeasured):
        return [size, "", *method, "cannot be had"]
    return [
        size,
        str(row.particles),
        *method,
        f"{row.setup_first_s:.2f}",
        f"{row.setup_s:.2f}",
        f"{row.ns_per_particle_step:.3g}",
        f"{row.peak_memory_mib:.1f}",
        "not finite" if row.error is None else f"{row.error:.1e}" if row.error else "0",
    ]


def reasons(rows: Iterable[Row]) -> list[str]:
    """Why methods could not be had, one line each."""
    lines = [f"{row.method.name}: {row.reason}" for row in rows if isinstance(row, NotMeasured)]
    return list(dict.fromkeys(lines))


def as_dict(bench: Bench, rows: Iterable[Row]) -> dict[str, Any]:
    """What ``--json`` writes (docs/performance.md lists the keys)."""
    return {
        "experiment": bench.experiment,
        "settings": list(bench.settings),
        "steps": bench.steps,
        "machine": machine(),
        "measurements": [_measurement(row) for row in rows if isinstance(row, Measured)],
        "not_measured": [
            _method(row) | {"reason": row.reason} for row in rows if isinstance(row, NotMeasured)
        ],
    }


def machine() -> dict[str, Any]:
    """What it was measured on."""
    return {
        "processor": platform.processor() or platform.machine(),
        "processors": processors(),
        "system": platform.system(),
        "python": sys.version.split()[0],
    }


def _method(row: Row) -> dict[str, Any]:
    return {
        "size": row.size,
        "method": row.method.name,
        "precision": row.method.precision,
        "threads": row.method.threads,
    }


def _measurement(row: Measured) -> dict[str, Any]:
    return _method(row) | {
        "particles": row.particles,
        "setup_first_s": row.setup_first_s,
        "setup_s": row.setup_s,
        "ns_per_particle_step": row.ns_per_particle_step,
        "peak_memory_mib": row.peak_memory_mib,
        "error": row.error,
    }
