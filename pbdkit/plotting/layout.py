"""What says which colour means what: a bar beside or below the panels, and a legend.

How many panels stand beside one another, and how large they are: numbers alone.

A figure with panels of one body, as large as what stands around them leaves room for.

The shape of a body decides that of its panels, from 200 by 6 to 6 by 200. Texts are measured, and
the figure is made around them: nothing is clipped, nothing lies over anything else.
"""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, Locator, MaxNLocator

from pbdkit.errors import ExperimentError
from pbdkit.plotting.colours import Palette, Scale
from pbdkit.plotting.layers import INK
from pbdkit.plotting.style import new_figure, renderer_of

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


@dataclass(frozen=True)
class Panels:
    """What the panels show: `box` (left, right, bottom, top) of each, the longest title of each,
    the heading of all, and what both axes are."""

    box: tuple[float, float, float, float]
    titles: list[str]
    heading: str
    labels: tuple[str, str]

    @property
    def shape(self) -> float:
        """How often as wide as tall."""
        left, right, bottom, top = self.box
        return (right - left) / (top - bottom)


@dataclass(frozen=True)
class Plan:
    """How panels stand: `columns` and `rows`, the size of each and from each to the next, inches,
    and the size of all with what stands around them."""

    columns: int
    rows: int
    width: float
    height: float
    pitch: tuple[float, float]

    def goodness(self, panels: int) -> float:
        """Large panels, and few places without one."""
        filled = panels / (self.columns * self.rows)
        return math.copysign(abs(self.width) * filled**0.7, self.width)

    @property
    def block(self) -> tuple[float, float]:
        """The size of all panels together."""
        across = (self.columns - 1) * self.pitch[0] + self.width
        return across, (self.rows - 1) * self.pitch[1] + self.height


@dataclass(frozen=True)
class Room:
    """What there is for panels, inches: `free` across and up, the `gap` between two either way, the
    least from one to the next, and the largest `area` of one."""

    free: tuple[float, float]
    gap: tuple[float, float]
    least: float
    area: float


def best_plan(panels: int, shape: float, room: Room) -> Plan:
    """Of so many panels, each so many times as wide as tall."""
    found = [_plan(panels, columns, shape, room) for columns in range(1, panels + 1)]
    fitting = [plan for plan in found if plan.block[0] <= room.free[0] + 1e-6]
    return max(fitting or found[:1], key=lambda plan: plan.goodness(panels))


def _plan(panels: int, columns: int, shape: float, room: Room) -> Plan:
    rows = math.ceil(panels / columns)
    width = (room.free[0] - (columns - 1) * room.gap[0]) / columns
    height = (room.free[1] - (rows - 1) * room.gap[1]) / rows
    width = min(width, height * shape, math.sqrt(room.area * shape))
    pitch = (max(width + room.gap[0], room.least), width / shape + room.gap[1])
    return Plan(columns, rows, width, width / shape, pitch)


PAGE_IN, TALLEST_IN, AREA_IN2 = 7.2, 8.0, 20.0
"""The width and height of a page, and the area of one panel at most."""
SEVERAL_IN, SEVERAL = 5.6, 6
"""The height of a page of no more than so many panels."""
GAP_IN, MARGIN_IN, SMALLEST_IN = 0.1, 0.08, 0.05
HEAD_PT, PAGE_TEXT_PT, PAGE_SMALL_PT = 10.0, 9.0, 8.0
LABEL_IN = 0.2
GUESS = (0.5, 0.45, 0.1)


class Page:
    """A new figure with its axes, in rows, to be arranged when its keys are known.

    `size`, in inches, is that of the whole; without it, the whole is as large as is needed.
    `alone` is that of `new_figure`.
    """

    def __init__(
        self, shown: Panels, dpi: float, size: tuple[float, float] | None, *, alone: bool
    ) -> None:
        self.figure, self._shown, self._size = new_figure(alone=alone, dpi=dpi), shown, size
        self._one = len(shown.titles) == 1
        self.axes = [self._panel(title) for title in shown.titles]
        self._labels = [self._text(shown.labels[0]), self._text(shown.labels[1], rotation=90)]
        self._heading = self._text("" if self._one else shown.heading, fontsize=HEAD_PT)
        self._left, self._bottom, self._over = GUESS
        self._under = self._beside = 0.0
        self._bar: ScaleBar | None = None
        self._legend: Legend | None = None

    def _panel(self, title: str) -> Axes:
        ax = self.figure.add_axes((0, 0, 1, 1), label=f"panel {len(self.figure.axes)}")
        left, right, bottom, top = self._shown.box
        ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        ax.set_title(title, fontsize=HEAD_PT if self._one else PAGE_TEXT_PT, pad=4)
        ax.tick_params(labelsize=PAGE_SMALL_PT if self._one else PAGE_SMALL_PT - 1, length=3, pad=2)
        return ax

    def _text(self, text: str, **more: Any) -> Text:
        style: dict[str, Any] = {"fontsize": PAGE_TEXT_PT, "ha": "center", "va": "center"} | more
        return self.figure.text(0, 0, text, **style)

    def arrange(self, bar: ScaleBar | None, legend: Legend | None, larger: float = 1.0) -> Plan:
        """Puts everything in its place, on a page so many times `larger` than that of a journal,
        and returns where the panels stand. Raises ExperimentError where a given size leaves nothing
        of the panels."""
        self._bar, self._legend = bar, legend
        for _ in range(3):  # what stands around panels depends on their size, and that on it
            plan = self._plan(larger)
            self._keys(plan)
            self._put(plan)
            self._measure(plan)
        plan = self._plan(larger)
        self._put(plan)
        return plan

    def _plan(self, larger: float) -> Plan:
        """The arrangement with the largest panels."""
        count = len(self._shown.titles)
        tall = TALLEST_IN if count == 1 or count > SEVERAL else SEVERAL_IN
        page = self._size or (PAGE_IN * larger, tall * larger)
        around = self._around()
        room = Room(
            (page[0] - around[0], page[1] - around[1]),
            (GAP_IN + 2 * self._over, GAP_IN + self._top),
            0.0 if self._one else self._widest_title() + GAP_IN,
            math.inf if self._size else AREA_IN2 * larger**2,
        )
        plan = best_plan(count, self._shown.shape, room)
        if min(plan.width, plan.height) < SMALLEST_IN:
            raise ExperimentError(
                f"figsize: {page[0]:g} by {page[1]:g} inches leave no room for {count} panels "
                "beside what is written there; give a larger size, or fewer times"
            )
        return plan

    @property
    def _top(self) -> float:
        """The height of a title with its distance."""
        points = HEAD_PT if self._one else PAGE_TEXT_PT
        return text_inches(self.figure, "Step 1y", points)[1] + 6 / 72

    def _around(self) -> tuple[float, float]:
        """What is taken by all that stands around the panels."""
        heading = 0.0 if self._one else HEAD_PT / 72 * 1.6
        wide = 2 * MARGIN_IN + self._left + self._over + self._beside
        return wide, 2 * MARGIN_IN + self._bottom + self._under + self._top + heading

    def _keys(self, plan: Plan) -> None:
        """Where bar and legend stand, and what they take."""
        width, height = plan.block
        self._under = self._beside = 0.0
        room = width + self._left + self._over if self._size is None else self._size[0]
        if self._bar:
            self._bar.fit(max(width, room - 2 * MARGIN_IN), height)
            if self._bar.beside:
                self._beside = self._bar.size[0] + GAP_IN
            else:
                self._under += self._bar.size[1] + GAP_IN
        if self._legend:
            self._legend.fit(room - 2 * MARGIN_IN)
            self._under += self._legend.size[1] + 0.5 * GAP_IN

    def _put(self, plan: Plan) -> None:
        """The size of the figure, and the places of everything."""
        (width, height), around, size = plan.block, self._around(), self._size
        left, right = self._sides(plan)
        whole = size or (left + width + right, height + around[1])
        self.figure.set_size_inches(*whole)
        if size:
            left += max(0.0, whole[0] - left - width - right) / 2
        low = MARGIN_IN + max(0.0, whole[1] - height - around[1]) / 2
        bottom = low + self._bottom + self._under
        for n, ax in enumerate(self.axes):
            row, column = divmod(n, plan.columns)
            x, y = left + column * plan.pitch[0], bottom + (plan.rows - 1 - row) * plan.pitch[1]
            each = (plan.width / whole[0], plan.height / whole[1])
            ax.set_position((x / whole[0], y / whole[1], *each))
            self._ticks(ax, plan, column == 0, n + plan.columns >= len(self.axes))
        middle = left + width / 2
        self._put_texts((left, bottom), plan, middle)
        if self._legend:
            self._legend.put(_inside(middle, self._legend.size[0], whole[0]), low)
            low += self._legend.size[1] + 0.5 * GAP_IN
        if self._bar and self._bar.beside:
            self._bar.put(left + width + self._over + GAP_IN, bottom, height)
        elif self._bar:
            self._bar.put(_inside(middle, self._bar.size[0], whole[0]), low, self._bar.size[0])

    def _sides(self, plan: Plan) -> tuple[float, float]:
        """What is left free to the left and to the right of all panels: as far as what stands in
        their middle, above and below, is wider than they are, unless the size is given."""
        width, _ = plan.block
        if self._size:
            return MARGIN_IN + self._left, MARGIN_IN + self._over + self._beside
        heading = shortened(self.figure, self._said, HEAD_PT, PAGE_IN)
        below = [key.size[0] for key in (self._bar, self._legend) if key and not key.beside]
        x_label = text_inches(self.figure, self._shown.labels[0], PAGE_TEXT_PT)[0]
        widest = max([text_inches(self.figure, heading, HEAD_PT)[0], x_label, *below])
        title = 0.0 if self._one else self._widest_title() - plan.width
        over = max(0.0, (widest - width) / 2, title / 2)
        return MARGIN_IN + max(over, self._left), MARGIN_IN + max(over, self._over + self._beside)

    def _widest_title(self) -> float:
        return max(text_inches(self.figure, t, PAGE_TEXT_PT)[0] for t in self._shown.titles)

    @property
    def _said(self) -> str:
        return self._shown.titles[0] if self._one else self._shown.heading

    def _put_texts(self, corner: tuple[float, float], plan: Plan, middle: float) -> None:
        """Labels in the middle of all panels, and the heading above them."""
        (width, height), whole = plan.block, self.figure.get_size_inches()
        x, y = self._shown.labels
        upright = text_inches(self.figure, y, PAGE_TEXT_PT)[0] <= height + 0.5 * self._bottom
        y, rotation = (y, 90.0) if upright else (y.split(" (")[0], 0.0)
        room = 2 * (min(middle, whole[0] - middle) - MARGIN_IN)
        heading = shortened(self.figure, self._said, HEAD_PT, room)
        if self._one:
            self.axes[0].title.set_text(heading)
        else:
            self._heading.set_text(heading)
        above = self._top + HEAD_PT / 72 * 0.8
        places = [
            (self._labels[0], x, corner[0] + width / 2, corner[1] - self._bottom + 0.5 * LABEL_IN),
            (self._labels[1], y, corner[0] - self._left + 0.5 * LABEL_IN, corner[1] + height / 2),
            (self._heading, self._heading.get_text(), middle, corner[1] + height + above),
        ]
        for text, said, across, up in places:
            text.set(text=said, position=(across / whole[0], up / whole[1]))
        self._labels[1].set_rotation(rotation)

    def _ticks(self, ax: Axes, plan: Plan, leftmost: bool, lowest: bool) -> None:
        """Round numbers, as many as there is room for."""
        left, right, bottom, top = self._shown.box
        digits = max(len(f"{v:.0f}") for v in (left, right))
        ax.xaxis.set_major_locator(_locator(left, right, plan.width, 0.2 + 0.1 * digits))
        ax.yaxis.set_major_locator(_locator(bottom, top, plan.height, 0.27))
        ax.tick_params(labelleft=leftmost, labelbottom=lowest)

    def _measure(self, plan: Plan) -> None:
        """What ticks take beside the panels."""
        dpi, renderer = self.figure.dpi, renderer_of(self.figure)
        left = bottom = over = 0.0
        for ax in self.axes:
            for axis in (ax.xaxis, ax.yaxis):
                ticks = axis.get_tightbbox(renderer)
                if ticks is None:
                    continue
                bottom = max(bottom, ax.bbox.y0 - ticks.y0)
                if axis is ax.xaxis:
                    over = max(over, ticks.x1 - ax.bbox.x1, ax.bbox.x0 - ticks.x0)
                else:
                    left = max(left, ax.bbox.x0 - ticks.x0)
        self._over = max(0.0, over / dpi)
        self._left = max(left / dpi, self._over) + LABEL_IN
        self._bottom = bottom / dpi + LABEL_IN


def _inside(middle: float, width: float, whole: float) -> float:
    """Where something begins that is to lie about the middle, and within the whole."""
    return max(MARGIN_IN, min(middle - width / 2, whole - MARGIN_IN - width))


def _locator(low: float, high: float, length: float, apart: float) -> Locator:
    """Ticks at least so many inches apart along so many."""
    many = int(length / apart)
    if many >= 2:
        return MaxNLocator(many, steps=[1, 2, 5, 10])
    ticks = MaxNLocator(2, steps=[1, 2, 5, 10]).tick_values(low, high)
    inner = [tick for tick in ticks if low <= tick <= high]
    return FixedLocator(sorted(inner, key=abs)[:1])
