"""What says which colour means what: a bar beside or below the panels, and a legend."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from pbdkit.drawing.figures import renderer_of
from pbdkit.drawing.layers import INK
from pbdkit.drawing.palette import Palette
from pbdkit.drawing.scale import Scale

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure

THICK_IN, LONGEST_IN, SHORTEST_IN, LINES = 0.14, 3.4, 1.3, 3
SHORTER_IN = 0.12
"""A bar is so much shorter than the panels, for its lowest and highest number."""
TEXT_PT, SMALL_PT = 9.0, 8.0


def inches(figure: Figure, artist: Artist) -> tuple[float, float]:
    """How wide and tall something is, with all that belongs to it."""
    box = artist.get_tightbbox(renderer_of(figure))
    return (box.width / figure.dpi, box.height / figure.dpi) if box else (0.0, 0.0)


def dress_bar(bar: Colorbar, scale: Scale, length: float) -> None:
    """Round numbers at a bar of so many inches, without the power of ten that its label has."""
    upright = bar.orientation == "vertical"
    ten = 10.0**scale.exponent
    many = max(2, int(length / (0.32 if upright else 0.6)))
    locator = MaxNLocator(many, steps=[1, 2, 2.5, 5, 10])
    ticks = np.asarray(locator.tick_values(scale.low, scale.high))
    slack = 1e-6 * (scale.high - scale.low)
    ticks = ticks[(ticks >= scale.low - slack) & (ticks <= scale.high + slack)]
    digits = max(0, 2 - math.floor(math.log10(np.ptp(ticks) / ten))) if len(ticks) > 1 else 6
    bar.set_ticks(ticks.tolist(), labels=[_number(t / ten, digits) for t in ticks])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL_PT)
    bar.outline.set_linewidth(0.5)


def _number(value: float, digits: int) -> str:
    """As matplotlib writes it, with a sign as broad as a plus."""
    return f"{round(value, digits) + 0.0:g}".replace("-", "−")


class ScaleBar:
    """The bar of a scale. It stands beside panels that are tall enough for what it says, else below
    them."""

    def __init__(self, figure: Figure, scale: Scale, text: str) -> None:
        self._figure, self._scale, self._text = figure, scale, text
        self._ax = figure.add_axes((0.1, 0.1, 0.1, 0.1))
        self.beside, self.size, self._length = True, (0.0, 0.0), 0.0

    def fit(self, width: float, height: float) -> None:
        """Chooses where it stands at panels of that size in all, and measures `size`."""
        upright = self._wrapped(min(height, LONGEST_IN))
        self.beside = height >= SHORTEST_IN and upright is not None
        if self.beside:
            self._length, text = min(height - SHORTER_IN, LONGEST_IN), upright
        else:
            self._length = min(max(width, SHORTEST_IN), LONGEST_IN)
            text = self._wrapped(max(width, self._length)) or self._text
        self._ax.remove()
        thick, page = THICK_IN, self._figure.get_size_inches()
        box = (thick, self._length) if self.beside else (self._length, thick)
        self._ax = self._figure.add_axes((0.0, 0.0, box[0] / page[0], box[1] / page[1]))
        colours = ScalarMappable(self._scale.norm, self._scale.colours)
        across = "vertical" if self.beside else "horizontal"
        more: dict[str, Any] = {"extend": self._scale.extend, "extendfrac": 0.04}
        bar = self._figure.colorbar(colours, cax=self._ax, orientation=across, **more)
        dress_bar(bar, self._scale, self._length)
        bar.set_label(text or "", fontsize=TEXT_PT)
        self.size = inches(self._figure, self._ax)

    def _wrapped(self, length: float) -> str | None:
        """What it says, in as few lines of that length as do; None where none do."""
        for lines in range(1, LINES + 1):
            for broad in range(math.ceil(len(self._text) / lines), len(self._text) + 1):
                said = textwrap.wrap(self._text, max(1, broad), break_long_words=False)
                if len(said) > lines:
                    continue
                if max(text_inches(self._figure, line, TEXT_PT)[0] for line in said) <= length:
                    return "\n".join(said)
                break
        return None

    def put(self, left: float, bottom: float, room: float) -> None:
        """There, in inches from the lower left corner of the whole; along it in the middle of
        that `room`."""
        page, renderer = self._figure.get_size_inches(), renderer_of(self._figure)
        width, height = (THICK_IN, self._length) if self.beside else (self._length, THICK_IN)
        self._ax.set_position((left / page[0], bottom / page[1], width / page[0], height / page[1]))
        box = self._ax.get_tightbbox(renderer)
        assert box is not None
        dpi = self._figure.dpi
        if self.beside:
            move = (left - box.x0 / dpi, 0.5 * (room - self._length))
        else:
            move = (0.5 * (room - width), bottom - box.y0 / dpi)
        place = (left + move[0]) / page[0], (bottom + move[1]) / page[1]
        self._ax.set_position((*place, width / page[0], height / page[1]))


class Legend:
    """Names and colours, below the panels."""

    def __init__(self, figure: Figure, handles: list[Line2D]) -> None:
        self._figure, self._handles = figure, handles
        self.beside = False
        self.size = (0.0, 0.0)
        self._legend: Any = None

    def fit(self, width: float) -> None:
        """In as many columns as there is room for, one at least."""
        for columns in range(len(self._handles), 0, -1):
            if self._legend is not None:
                self._legend.remove()
            self._legend = self._figure.legend(
                handles=self._handles, ncols=columns, loc="lower left", frameon=False,
                handletextpad=0.1, columnspacing=1.2, borderpad=0.1, borderaxespad=0.0,
                fontsize=TEXT_PT,
            )  # fmt: skip
            self.size = inches(self._figure, self._legend)
            if self.size[0] <= width:
                break

    def put(self, left: float, bottom: float) -> None:
        """There, in inches from the lower left corner of the whole."""
        page = self._figure.get_size_inches()
        self._legend.set_bbox_to_anchor((left / page[0], bottom / page[1]))


def text_inches(figure: Figure, text: str, points: float) -> tuple[float, float]:
    """How wide and tall a line of text is."""
    probe = Text(0, 0, text, fontsize=points)
    probe.set_figure(figure)
    box = probe.get_window_extent(renderer_of(figure))
    return box.width / figure.dpi, box.height / figure.dpi


def shortened(figure: Figure, text: str, points: float, width: float) -> str:
    """A line of text, with its end left out where it is longer than that."""
    kept = text
    while kept and text_inches(figure, kept, points)[0] > width:
        kept = kept[: -max(2, len(kept) // 20)].rstrip("\\") + "…"
        if len(kept) <= 2:
            break
    return kept


def legend_handles(palette: Palette, present: set[int]) -> list[Line2D]:
    """A dot with its name for each class that is there."""
    return [
        handle(name, colour)
        for number, (name, colour) in reversed(palette.colours.items())
        if number in present
    ]


def handle(name: str, colour: str) -> Line2D:
    """A dot with a name."""
    return Line2D([], [], ls="", marker="o", ms=5, mfc=colour, mec=INK, mew=0.5, label=name)
