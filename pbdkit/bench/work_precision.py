"""Measured rows as a table to read, lines about them, an object to keep, and a picture."""

from __future__ import annotations

import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import cycle, groupby
from math import inf, isfinite
from typing import TYPE_CHECKING, Any

from pbdkit.bench.measurement import Row
from pbdkit.stepping.choice import processors

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

COLUMNS = {n: (n, "", "") for n in ("size", "particles", "method", "precision", "threads")} | {
    "tolerance": ("tolerance", ".0e", "a share of the largest prescribed displacement"),
    "steps": ("steps", "", "made, or iterations of the linear solver"),
    "setup_first_s": ("set-up", ".2f", "seconds until the first step, with compiling"),
    "setup_s": ("cached", ".2f", "the same with what was compiled before"),
    "ns_per_particle_step": ("ns", ".3g", "a particle and step"),
    "seconds": ("seconds", ".3g", "from the experiment on, imports and compiling done"),
    "cpu_s": ("CPU s", ".3g", "of all processors together"),
    "peak_memory_mib": ("MiB", ".1f", "peak memory above that of the imports"),
    "certified": ("certified", ".1e", "what the certificate says; *: it misses the tolerance"),
    "error": ("error", ".1e", "at most, as a share: the largest distance from the first row"),
}
"""Of each field of a row: its heading, its form and what it is."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of Okabe and Ito, one a line."""
MARKERS = ("o", "s", "^", "D", "v", "P")
FLOOR = 1e-18
"""Where errors of exactly zero are drawn."""


def table(rows: Sequence[Row]) -> Table:
    """A row each, with the columns in which there is something; sizes apart by a line."""
    from rich import box
    from rich.table import Table

    found, shown = Table(box=box.SIMPLE_HEAD, pad_edge=False), _shown(rows)
    for name in shown:
        is_word = name in ("method", "precision")
        found.add_column(COLUMNS[name][0], justify="left" if is_word else "right", no_wrap=is_word)
    for _, block in groupby(rows, key=lambda row: row.size):
        for row in block:
            found.add_row(*(_cell(row, name) for name in shown))
        found.add_section()
    return found


def _shown(rows: Sequence[Row]) -> list[str]:
    return [n for n in COLUMNS if n == "size" or any(getattr(r, n) is not None for r in rows)]


def _cell(row: Row, name: str) -> str:
    value = getattr(row, name)
    if value is None:
        missing = {"size": "as it is", "error": "left out" if row.reason else ""}
        return missing.get(name, "")
    if name == "error":
        return "0" if value == 0 else f"{value:.1e}" if isfinite(value) else "not finite"
    missed = name == "certified" and row.tolerance is not None and value > row.tolerance
    told = " (predicted)" * (name == "method" and row.is_predicted)
    return format(value, COLUMNS[name][1]) + "*" * missed + told


def lines(rows: Sequence[Row]) -> list[str]:
    """What the columns are, and why rows are left out."""
    told = [f"{COLUMNS[n][0]}: {COLUMNS[n][2]}" for n in _shown(rows) if COLUMNS[n][2]]
    for row in (row for row in rows if row.reason):
        place = f"size {_cell(row, 'size')}" + (f", {row.tolerance:.0e}" if row.tolerance else "")
        told.append(f"left out: {row.line} at {place}: {row.reason}")
    return list(dict.fromkeys(told))


def as_dict(name: str, settings: Sequence[str], steps: int, rows: Sequence[Row]) -> dict[str, Any]:
    """What ``--json`` writes (docs/performance.md lists the keys)."""
    machine = {"processor": platform.processor() or platform.machine(), "processors": processors()}
    machine |= {"system": platform.system(), "python": sys.version.split()[0]}
    figures = [{k: v if v != inf else None for k, v in asdict(row).items()} for row in rows]
    asked = {"experiment": name, "settings": list(settings), "steps": steps}
    return asked | {"machine": machine, "rows": figures}


def picture(rows: Sequence[Row], title: str) -> Figure:
    """Error against cost, both logarithmic: a panel a size, a colour a method (and its threads), a
    marker each row. What was predicted is hollow, errors of exactly zero lie on a line of their own
    at the bottom; runs that left the finite numbers are not drawn."""
    from matplotlib.figure import Figure

    measured = [row for row in rows if row.error is not None and isfinite(row.error) and _x(row)]
    sizes = list(dict.fromkeys(row.particles for row in measured)) or [0]
    kinds = list(dict.fromkeys(row.line for row in measured))
    across = min(2, len(sizes))
    down = -(-len(sizes) // across)
    drawn = Figure(figsize=(1.6 + 3.6 * across, 1.0 + 2.9 * down), dpi=150, layout="constrained")
    panels = drawn.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, particles in zip(panels, sizes, strict=False):
        for kind, colour, marker in zip(kinds, cycle(COLOURS), cycle(MARKERS)):
            some = [row for row in measured if row.line == kind and row.particles == particles]
            x, y = [_x(row) for row in some], [max(row.error or 0.0, FLOOR) for row in some]
            face = ["white" if row.is_predicted else colour for row in some]
            ax.plot(x, y, color=colour, linewidth=0.9, linestyle=":")
            ax.scatter(x, y, s=22, marker=marker, facecolor=face, edgecolor=colour, zorder=2)
            ax.scatter([], [], color=colour, marker=marker, label=kind)
        ax.set_title(f"{particles:,} particles".replace(",", " "), fontsize=8)
        ax.set(xscale="log", yscale="log")
        ax.grid(visible=True, linewidth=0.3, alpha=0.6)
        ax.tick_params(labelsize=7)
    for ax in panels[len(sizes) :]:
        ax.set_visible(False)
    if any(row.error == 0 for row in measured):
        ticks = [10.0**n for n in range(-16, 1, 4)]
        panels[0].set_yticks([FLOOR, *ticks], ["0", *(f"{tick:.0e}" for tick in ticks)])
    by_step = any(row.ns_per_particle_step for row in measured)
    for ax in panels[-across:]:
        ax.set_xlabel("ns a particle and step" if by_step else "seconds of processor time")
    drawn.supylabel("largest error, as a share", fontsize=8)
    drawn.suptitle(title, fontsize=9)
    named, ncols = panels[0].get_legend_handles_labels(), min(4, len(kinds) or 1)
    drawn.legend(*named, loc="outside lower center", ncols=ncols, fontsize=7, frameon=False)
    return drawn


def _x(row: Row) -> float:
    return row.ns_per_particle_step or row.cpu_s or 0.0
