"""Ways to equilibrium as a table to read and as an object to keep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pbdkit.benching.equilibria import STEPPING, EquilibriumBench, Row, Solved, Truth, Unsolved
from pbdkit.benching.report import by_size, machine

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "size", "particles", "method", "tolerance", "iterations", "seconds", "CPU s", "MiB",
    "certified", "error",
)  # fmt: skip
LEGEND = (
    "tolerance, certified, error: shares of the largest prescribed displacement; error: the",
    "largest distance from the exact answer; seconds: from the experiment on, imports and",
    "compiling done; iterations: of the linear solver, or steps; predicted: the time of a step",
    "times the steps that the slowest mode needs; *: the certificate misses the tolerance",
)


def equilibria_table(rows: Iterable[Row]) -> Table:
    """A row a method and tolerance; sizes apart by a line."""
    return by_size(COLUMNS, ((row.size, cells(row)) for row in rows))


def cells(row: Row) -> list[str]:
    """The row as the table shows it."""
    size = "as it is" if row.size is None else str(row.size)
    tolerance = "any" if row.tolerance is None else f"{row.tolerance:.0e}"
    if isinstance(row, Unsolved):
        return [size, "", row.method, tolerance, "left out"]
    missed = row.certified is not None and row.certified > row.tolerance
    return [
        size,
        str(row.particles),
        row.method,
        tolerance,
        str(row.iterations),
        f"{row.seconds:.3g}",
        f"{row.cpu_s:.3g}",
        _shown(row.peak_memory_mib, "", ".0f"),
        "predicted" if row.is_predicted else _shown(row.certified, "", ".1e") + "*" * missed,
        _shown(row.error, "not finite", ".1e"),
    ]


def _shown(value: float | None, otherwise: str, form: str) -> str:
    return otherwise if value is None else f"{value:{form}}"


def truths(found: Iterable[Truth]) -> list[str]:
    """What errors were measured against, a line a size."""
    return [
        f"size {truth.size or 'as it is'}: the exact answer is "
        + ("affine" if truth.how == "affine" else f"that of {truth.how}, within {truth.within:.1e}")
        for truth in found
    ]


def equilibria_reasons(rows: Iterable[Row]) -> list[str]:
    """Why methods could not be had, one line each."""
    return [
        f"{row.method} at size {row.size or 'as it is'}"
        + (f", {row.tolerance:.0e}" if row.tolerance else "")
        + f": {row.reason}"
        for row in rows
        if isinstance(row, Unsolved)
    ]


def gains(rows: Sequence[Row]) -> list[str]:
    """How much less processor time than steps the cheapest method takes, a line a size, at the
    tightest tolerance that both reach."""
    lines = []
    for size in dict.fromkeys(row.size for row in rows):
        there = [row for row in rows if row.size == size and isinstance(row, Solved)]
        stepped = [row for row in there if row.method == STEPPING]
        for steps in sorted(stepped, key=lambda row: row.tolerance):
            reach = [r for r in there if r.certified is not None and r.certified <= steps.tolerance]
            if reach:
                lines.append(_gain(steps, min(reach, key=lambda row: row.cpu_s)))
                break
    return lines


def _gain(steps: Solved, best: Solved) -> str:
    where = f"size {steps.size or 'as it is'}, to {steps.tolerance:.0e}"
    how = "steps would take" if steps.is_predicted else "steps take"
    return (
        f"{where}: {steps.iterations} {how} {steps.cpu_s:.3g} s of processor time, {best.method} "
        f"{best.cpu_s:.3g} s, {steps.cpu_s / best.cpu_s:.3g} times less"
    )


def equilibria_as_dict(
    bench: EquilibriumBench, found: Iterable[Truth], rows: Iterable[Row]
) -> dict[str, Any]:
    """What ``--json`` writes (docs/performance.md lists the keys)."""
    rows = list(rows)
    return {
        "experiment": bench.experiment,
        "settings": list(bench.settings),
        "steps": bench.steps,
        "machine": machine(),
        "exact": [asdict(truth) for truth in found],
        "measurements": [asdict(row) for row in rows if isinstance(row, Solved)],
        "not_measured": [asdict(row) for row in rows if isinstance(row, Unsolved)],
    }
