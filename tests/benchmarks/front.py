"""The measured figures of the finite-element problems as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

Data = dict[str, Any]
Table = Callable[[Iterable[str], Iterable[Iterable[str]]], str]
SHORT = 0.0995
"""Seconds below this are written in milliseconds."""


def fronts(found: Data, table: Table) -> str:
    """Error against time, a table a problem; times to errors, and errors, against goals."""
    rows, parts = found["rows"], []
    for problem in dict.fromkeys(row["problem"] for row in rows):
        some = [row for row in rows if row["problem"] == problem]
        parts.append(f"**{problem}**\n\n" + _of_problem(some, table))
    return "\n".join([*parts, _times(found["times"], table), _errors(found["errors"], table)])


def _of_problem(rows: list[Data], table: Table) -> str:
    cells = list(dict.fromkeys(row["cells"] for row in rows))
    names = list(dict.fromkeys(row["contestant"] for row in rows))
    at = {(row["contestant"], row["cells"]): row for row in rows}
    lines = ((name, *(_cell(at[name, n], rows) for n in cells)) for name in names)
    return table(("", *(f"n = {n}" for n in cells)), lines)


def _cell(row: Data, rows: list[Data]) -> str:
    if row["reason"]:
        return "–"
    text = f"{_time(_seconds(row))}, {row['error']:.1e}"
    return f"**{text}**" if _leads(row, rows) else text


def _leads(row: Data, rows: list[Data]) -> bool:
    """Return whether no other program has less error in less time, at any size."""
    return not any(
        other is not row
        and not other["reason"]
        and other["error"] <= row["error"]
        and _seconds(other) <= _seconds(row)
        for other in rows
    )


def _seconds(row: Data) -> float:
    return float(row["setup_s"] + row["solving_s"])


def _time(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds < SHORT else f"{seconds:.3g} s"


def _times(rows: list[Data], table: Table) -> str:
    def cells(row: Data) -> tuple[str, ...]:
        met = "met" if row["factor"] >= row["goal"] else "**not met**"
        own, other = (f"{_time(row[f'{k}_s'])} ({row[k]})" for k in ("own", "other"))
        goal, factor = f"≥ {row['goal']:g} ×", f"{row['factor']:.2g} ×"
        return row["problem"], f"{row['error']:g}", own, other, goal, factor, met

    head = ("problem", "to an error of", "pbdkit, all", "scikit-fem, assembly and solution",
            "goal", "faster", "")  # fmt: skip
    return table(head, map(cells, rows))


def _errors(rows: list[Data], table: Table) -> str:
    def cells(row: Data) -> tuple[str, ...]:
        digits = len(row["goal"].partition("e")[0]) - 1
        error = f"{row['error']:.{digits}g}"
        met = "met" if float(error) <= float(row["goal"]) else "**not met**"
        what = f"{row['problem']}, n = {row['cells']}, {row['measure']}"
        return what, f"≤ {row['goal']}", error, met

    return table(("error of the equilibrium", "goal", "measured", ""), map(cells, rows))
