"""The work-precision picture of equilibrium: what it costs against how far it is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pbdkit.benching.equilibria import Solved
from pbdkit.benching.picture import COLOURS, INK, LINE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = ("o", "s", "^", "D", "v", "P")


def equilibria_picture(rows: Sequence[Solved], title: str) -> Figure:
    """Error against processor time, both logarithmic: a panel a size, a line a method, a marker a
    tolerance. What was predicted is hollow and dashed; errors that are not finite are not drawn."""
    from matplotlib.figure import Figure

    shown = [row for row in rows if row.error is not None]
    sizes = list(dict.fromkeys(row.particles for row in shown))
    methods = list(dict.fromkeys(row.method for row in shown))
    columns = min(2, max(1, len(sizes)))
    lines = -(-max(1, len(sizes)) // columns)
    drawn = Figure(figsize=(1.6 + 3.6 * columns, 1.0 + 2.9 * lines), dpi=150, layout="constrained")
    panels = drawn.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, particles in zip(panels, sizes, strict=False):
        for n, method in enumerate(methods):
            some = [r for r in shown if r.particles == particles and r.method == method]
            _draw(ax, some, COLOURS[n % len(COLOURS)], MARKERS[n % len(MARKERS)])
        ax.set_title(f"{particles:,} particles".replace(",", " "), fontsize=8)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.grid(visible=True, which="major", color=LINE, linewidth=0.3, alpha=0.6)
        ax.tick_params(labelsize=7)
    for ax in panels[len(sizes) :]:
        ax.set_visible(False)
    drawn.suptitle(title, fontsize=9)
    for ax in panels[-columns:]:
        ax.set_xlabel("seconds of processor time", fontsize=8)
    drawn.supylabel("largest error / largest prescribed displacement", fontsize=8)
    _legend(drawn, methods, any(row.is_predicted for row in shown))
    return drawn


def _draw(ax: Axes, rows: Sequence[Solved], colour: str, marker: str) -> None:
    """Steps go on from what was made to what is predicted."""
    made = [row for row in rows if not row.is_predicted]
    predicted = [*made[-1:], *(row for row in rows if row.is_predicted)]
    for some, style in ((made, "-"), (predicted, ":")):
        ax.plot(_x(some), _y(some), color=colour, linewidth=0.9, linestyle=style, zorder=1)
    for row in rows:
        face = "white" if row.is_predicted else colour
        ax.scatter(
            _x([row]), _y([row]), s=22, marker=marker, facecolor=face, edgecolor=colour, zorder=2
        )


def _x(rows: Sequence[Solved]) -> list[float]:
    return [row.cpu_s for row in rows]


def _y(rows: Sequence[Solved]) -> list[float]:
    return [max(row.error or 0.0, 1e-18) for row in rows]


def _legend(drawn: Figure, methods: list[str], has_predicted: bool) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=COLOURS[n % len(COLOURS)], marker=MARKERS[n % len(MARKERS)],
               markersize=5, linewidth=0.9, label=method)
        for n, method in enumerate(methods)
    ]  # fmt: skip
    if has_predicted:
        entries.append(
            Line2D([], [], color=INK, marker="o", markerfacecolor="white", markersize=5,
                   linewidth=0.9, linestyle=":", label="predicted")
        )  # fmt: skip
    drawn.legend(
        handles=entries, loc="outside lower center", ncols=len(entries), fontsize=7, frameon=False
    )
