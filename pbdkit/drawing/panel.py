"""A panel of lines: its axes and labels, the colours of the lines, and who is who."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.labels import label, plain
from pbdkit.registry.extras import refuse_no_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[Any]
SIZE_IN, DPI = (4.8, 3.3), 200
HUES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""Colours of Okabe and Ito, without the yellow that no white page shows."""
MANY, MOST, WITHIN, FEW_POINTS = "viridis", 12, 4, 40
"""The colours of more lines than that; so many are told by a legend, and by one within the panel;
so many points are marked."""
BROAD, TALL, NAMED = 44, 34, 34
"""Characters of a line of a label below and beside the panel, and of the legend."""
QUICK, LEGEND_IN = 20_000, 1.9
"""Of so many points it is found out where a legend hides none; so broad is one beside the panel."""
ROUND = [1, 2, 5, 10]
"""Ticks lie at multiples of these."""


@dataclass(frozen=True)
class Line:
    """Values `y` over `x`. Lines of one `hue`, a particle or a member of a sweep, have one colour,
    which stands for `value` where there is a number; `dashed` tells a second component."""

    x: Array
    y: Array
    name: str = ""
    hue: int = 0
    value: float | None = None
    dashed: bool = False


def new_axes(width: float = SIZE_IN[0], height: float = SIZE_IN[1]) -> Axes:
    """The axes of a figure of that size, in inches."""
    refuse_no_matplotlib()
    from pbdkit.drawing.figures import new_figure

    return new_figure(figsize=(width, height), dpi=DPI, layout="constrained").add_subplot()


def draw_lines(ax: Axes, lines: Sequence[Line], title: str, hues: str) -> None:
    """Draws lines with a legend; with a scale of colours, of what `hues` says, where they are more
    than a legend tells."""
    from matplotlib import colormaps
    from matplotlib.ticker import MaxNLocator

    order = {hue: n for n, hue in enumerate(dict.fromkeys(line.hue for line in lines))}
    shares = _shares(lines, order)
    for line in lines:
        few = len(order) <= len(HUES)
        colour = HUES[order[line.hue]] if few else colormaps[MANY](shares[line.hue])
        ax.plot(
            line.x, line.y, color=colour, lw=1.2, ls="--" if line.dashed else "-", ms=3.0,
            marker="o" if len(line.x) <= FEW_POINTS else None, label=_wrapped(line.name),
        )  # fmt: skip
    ax.ticklabel_format(scilimits=(-3, 4), useMathText=True)
    whole = all((np.mod(line.x, 1.0) == 0.0).all() for line in lines)
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=whole, steps=ROUND))
    ax.yaxis.set_major_locator(MaxNLocator(6, steps=ROUND))
    ax.margins(x=0.02)
    ax.grid(color="#E8E8E8", lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title(label(title, broad=BROAD), fontsize="medium", pad=12)
    if len(lines) > MOST:
        _scale(ax, lines, order, hues)
    elif any(line.name for line in lines):
        _legend(ax, lines, hues)


def _legend(ax: Axes, lines: Sequence[Line], hues: str) -> None:
    style: dict[str, Any] = {"frameon": False, "fontsize": "small", "title_fontsize": "small"}
    style["title"] = label(hues, broad=NAMED)
    if len(lines) <= WITHIN and sum(len(line.x) for line in lines) < QUICK:
        ax.legend(loc="best", **style)
        return
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), **style)
    whole = ax.get_figure(root=True)
    if whole and len(whole.axes) == 1:
        whole.set_size_inches(whole.get_figwidth() + LEGEND_IN, whole.get_figheight())


def _wrapped(name: str) -> str:
    return textwrap.fill(plain(name), NAMED, break_on_hyphens=False)


def _shares(lines: Sequence[Line], order: dict[int, int]) -> dict[int, float]:
    """Where the colour of each hue lies between the first and the last, 0 to 0.9."""
    low, high = _range(lines, order)
    at = {line.hue: _value(line, order) for line in lines}
    return {hue: 0.9 * (value - low) / ((high - low) or 1.0) for hue, value in at.items()}


def _value(line: Line, order: dict[int, int]) -> float:
    return order[line.hue] if line.value is None else line.value


def _range(lines: Sequence[Line], order: dict[int, int]) -> tuple[float, float]:
    values = [_value(line, order) for line in lines]
    return min(values), max(values)


def _scale(ax: Axes, lines: Sequence[Line], order: dict[int, int], hues: str) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    shown = ListedColormap(colormaps[MANY](np.linspace(0.0, 0.9, 256)))
    colours = ScalarMappable(Normalize(*_range(lines, order)), shown)
    ax.figure.colorbar(colours, ax=ax, aspect=25).set_label(label(hues, broad=BROAD))
