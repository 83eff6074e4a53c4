"""The work-precision picture: what a particle-step costs against how far it is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pbdkit.benching.method import Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of Okabe and Ito, one a method and number of threads."""
MARKERS = {"float64": "o", "float32": "s"}
FLOOR = 1e-18
"""Where errors of exactly zero are drawn."""
INK, LINE = "#404040", "#B0B0B0"


def work_precision(rows: Sequence[Measured], title: str) -> Figure:
    """Error against time a particle-step, both logarithmic; a marker a method and size.

    Colour tells method and threads, shape the precision; larger markers are larger sizes, and a
    line joins the sizes of one method. Runs that left the finite numbers are not drawn.
    """
    from matplotlib.figure import Figure

    shown = [row for row in rows if row.error is not None]
    drawn = Figure(figsize=(7.2, 4.6), dpi=200, layout="constrained")
    ax = drawn.add_subplot()
    sizes = sorted({row.particles for row in shown})
    colours = dict(zip(dict.fromkeys(map(_line, shown)), COLOURS * len(shown), strict=False))
    for method in dict.fromkeys(row.method for row in shown):
        of_method = [row for row in shown if row.method == method]
        colour = colours[_line(of_method[0])]
        x = [row.ns_per_particle_step for row in of_method]
        y = [max(row.error or 0.0, FLOOR) for row in of_method]
        ax.plot(x, y, color=colour, linewidth=0.8, alpha=0.5, zorder=1)
        area = [_area(row.particles, sizes) for row in of_method]
        ax.scatter(
            x, y, s=area, marker=MARKERS.get(method.precision, "D"), color=colour, alpha=0.8,
            edgecolors="white", linewidths=0.6, zorder=2,
        )  # fmt: skip
    _label(ax, title, [row.error or 0.0 for row in shown])
    _legends(ax, shown, colours, sizes)
    return drawn


def _line(row: Measured) -> str:
    threads = f", {row.method.threads} threads" if row.method.threads > 1 else ""
    return f"{row.method.name}{threads}"


def _area(particles: int, sizes: list[int]) -> float:
    return 30.0 + 35.0 * sizes.index(particles)


def _label(ax: Axes, title: str, errors: list[float]) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_title(title, fontsize=9)
    ax.set_xlabel("ns a particle and step")
    ax.set_ylabel("largest error / largest displacement")
    ax.set_ylim(FLOOR / 30, max([10 * e for e in errors if e] + [1e-5]))
    ax.axhline(FLOOR, color=LINE, linewidth=0.8, linestyle="--", zorder=0)
    ax.annotate(
        "no error at all: the same to the last bit",
        (0.01, FLOOR),
        xycoords=("axes fraction", "data"),
        xytext=(0, -17),
        textcoords="offset points",
        fontsize=7,
        color=INK,
    )
    ax.grid(visible=True, which="major", color=LINE, linewidth=0.3, alpha=0.6)
    low, high = ax.get_xlim()
    ax.set_xlim(low / 1.3, high * 1.3)
    narrow = high / low < 300
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if narrow and _leads(value) else "")
    # At the floor stands 0, and no power of ten that would be taken for an error.
    ticks = [10.0**n for n in range(-16, 3, 2) if 10.0**n < ax.get_ylim()[1]]
    ax.set_yticks(
        [FLOOR, *ticks], ["0", *(f"$10^{{{n}}}$" for n in range(-16, 3, 2))][: 1 + len(ticks)]
    )
    ax.minorticks_on()
    ax.yaxis.set_minor_locator(_no_ticks())


def _leads(value: float) -> bool:
    return f"{value:e}"[0] in "25"


def _no_ticks() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()


def _legends(ax: Axes, rows: list[Measured], colours: dict[str, str], sizes: list[int]) -> None:
    from matplotlib.lines import Line2D

    def dot(colour: str, marker: str, area: float) -> Line2D:
        return Line2D([], [], color=colour, marker=marker, linestyle="", markersize=area**0.5)

    precisions = [p for p in MARKERS if any(row.method.precision == p for row in rows)]
    entries = [(line, dot(colour, "o", 40)) for line, colour in colours.items()]
    entries += [(p, dot(INK, MARKERS[p], 40)) for p in precisions]
    entries += [
        (f"{n:,} particles".replace(",", " "), dot(LINE, "o", _area(n, sizes))) for n in sizes
    ]
    ax.legend(
        [handle for _, handle in entries],
        [label for label, _ in entries],
        loc="upper left",
        bbox_to_anchor=(1.01, 1.0),
        fontsize=7,
        frameon=False,
        labelspacing=0.9,
    )
