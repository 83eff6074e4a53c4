"""A figure with panels of one body, as large as what stands around them leaves room for.

The shape of a body decides that of its panels, from 200 by 6 to 6 by 200. Texts are measured, and
the figure is made around them: nothing is clipped, nothing lies over anything else.
"""

from __future__ import annotations

import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, Locator, MaxNLocator

from pbdkit.drawing.figures import new_figure, renderer_of
from pbdkit.drawing.key import Legend, ScaleBar, shortened, text_inches
from pbdkit.drawing.plan import Panels, Plan, Room, best_plan
from pbdkit.errors import ExperimentError

PAGE_IN, TALLEST_IN, AREA_IN2 = 7.2, 8.0, 20.0
"""The width and height of a page, and the area of one panel at most."""
SEVERAL_IN, SEVERAL = 5.6, 6
"""The height of a page of no more than so many panels."""
GAP_IN, MARGIN_IN, SMALLEST_IN = 0.1, 0.08, 0.05
HEAD_PT, TEXT_PT, SMALL_PT = 10.0, 9.0, 8.0
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
        ax.set_title(title, fontsize=HEAD_PT if self._one else TEXT_PT, pad=4)
        ax.tick_params(labelsize=SMALL_PT if self._one else SMALL_PT - 1, length=3, pad=2)
        return ax

    def _text(self, text: str, **more: Any) -> Text:
        style: dict[str, Any] = {"fontsize": TEXT_PT, "ha": "center", "va": "center"} | more
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
        points = HEAD_PT if self._one else TEXT_PT
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
        x_label = text_inches(self.figure, self._shown.labels[0], TEXT_PT)[0]
        widest = max([text_inches(self.figure, heading, HEAD_PT)[0], x_label, *below])
        title = 0.0 if self._one else self._widest_title() - plan.width
        over = max(0.0, (widest - width) / 2, title / 2)
        return MARGIN_IN + max(over, self._left), MARGIN_IN + max(over, self._over + self._beside)

    def _widest_title(self) -> float:
        return max(text_inches(self.figure, t, TEXT_PT)[0] for t in self._shown.titles)

    @property
    def _said(self) -> str:
        return self._shown.titles[0] if self._one else self._shown.heading

    def _put_texts(self, corner: tuple[float, float], plan: Plan, middle: float) -> None:
        """Labels in the middle of all panels, and the heading above them."""
        (width, height), whole = plan.block, self.figure.get_size_inches()
        x, y = self._shown.labels
        upright = text_inches(self.figure, y, TEXT_PT)[0] <= height + 0.5 * self._bottom
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
