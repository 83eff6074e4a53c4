"""Figures with one or more panels that show a body. The panels are as large as the texts around
them permit.

The panels have the aspect ratio of the body, which may range from 200 by 6 particles to 6 by 200.
The size of the figure depends on its content, so that nothing is clipped and nothing overlaps.
"""

from __future__ import annotations

import math
import sys
import textwrap
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator
from matplotlib.transforms import Bbox

from pbdkit.errors import ExperimentError
from pbdkit.plotting.colours import Palette, Scale, symlog_ticks
from pbdkit.plotting.layers import DOT_COLOUR
from pbdkit.plotting.style import renderer_of
from pbdkit.progress import in_notebook

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.axes import Axes
    from matplotlib.legend import Legend
    from matplotlib.text import Text
    from matplotlib.ticker import Locator
PAGE_WIDTH_IN = 7.2
"""Width of a page in inches."""
PAGE_HEIGHT_IN = 8.0
"""Height of a page in inches."""
SHORT_PAGE_HEIGHT_IN = 5.6
"""Height, in inches, of a page with at least 2 and at most `SHORT_PAGE_PANELS` panels."""
SHORT_PAGE_PANELS = 6
"""Maximum number of panels on a page with the height `SHORT_PAGE_HEIGHT_IN`."""
PANEL_AREA_IN2 = 20.0
"""Maximum area of one panel in square inches."""
SMALLEST_PANEL_IN = 0.05
"""Minimum width and height of a panel in inches."""
SHORT_AXIS_IN = 0.4
"""Length in inches below which an axis has one tick."""
GAP_IN = 0.1
"""Space between panels in inches."""
TITLE_IN = 0.26
"""Space for the title above each panel in inches."""
EDGE_IN = 0.08
"""Space at the edge of the page in inches."""
SAME_PLACE_IN = 1e-9
"""Distance in inches below which two places count as the same, because it is only rounding."""
BAR_LENGTH_IN = 3.4
"""Maximum length of a colour bar in inches."""
BAR_WIDTH_IN = 0.14
"""Width of a colour bar in inches."""
SIDE_BAR_HEIGHT_IN = 1.3
"""Minimum height of the panels, in inches, for which the colour bar is beside them. Beside lower
panels there is no room, and it is below them."""
LABEL_LINES = 3
"""Maximum number of lines of the label of a colour bar beside the panels."""
CHARACTERS_PER_IN = 14.5
"""Approximate number of characters of text in `TEXT_PT` per inch."""
HEADING_PT = 10.0
"""Font size of the heading in points."""
TEXT_PT = 9.0
"""Font size of labels in points."""
TICK_PT = 8.0
"""Font size of tick labels in points."""


PYPLOT = "matplotlib.pyplot"
"""Module that manages figures."""


def new_figure(*, standalone: bool = False, **options: Any) -> Figure:
    """Return a new figure of matplotlib, which is created with the given options.

    If pyplot is loaded, or the code runs in a notebook, pyplot manages the figure. A `standalone`
    figure is not managed; the caller shows or saves it.
    """
    if not standalone and (PYPLOT in sys.modules or in_notebook()):
        pyplot = import_module(PYPLOT)
        figure: Figure = pyplot.figure(**options)
        if hasattr(figure.canvas, "get_renderer"):
            return figure
        pyplot.close(figure)  # The backend of the figure cannot measure text.
    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


LIMITS = ("lowest", "highest")
"""Tick labels of a colour bar for panels with different limits."""


def style_bar(bar: Any, scale: Scale) -> None:
    """Label the ticks of a colour bar. The power of ten, which is written in the label of the bar,
    is omitted."""
    ten = 10.0**scale.exponent
    bar.formatter = lambda value, _: f"{value / ten + 0.0:.6g}".replace("-", "−")
    if scale.whole:
        bar.locator = MaxNLocator(6, integer=True, steps=[1, 2, 5, 10], min_n_ticks=1)
    if (ticks := symlog_ticks(scale)) is not None:
        bar.locator = FixedLocator(ticks)
    if scale.shares:
        bar.locator, bar.formatter = FixedLocator([0.0, 1.0]), lambda share, _: LIMITS[round(share)]
    bar.update_ticks()
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=TICK_PT)
    bar.outline.set_linewidth(0.5)


def legend_handles(palette: Palette, present: set[int]) -> list[Line2D]:
    """Return the entries of a legend: a labelled dot for each class that is present."""
    return [
        handle(name, colour)
        for number, (name, colour) in reversed(palette.colours.items())
        if number in present
    ]


def handle(name: str, colour: str) -> Line2D:
    """Return an entry of a legend: a dot, labelled with a name."""
    return Line2D([], [], ls="", marker="o", ms=5, mfc=colour, mec=DOT_COLOUR, mew=0.5, label=name)


@dataclass(frozen=True)
class Panels:
    """Texts and limits of panels: the limits (left, right, bottom, top) that all panels share, the
    longest title of each panel, the heading of the figure, and the labels of both axes."""

    box: tuple[float, float, float, float]
    titles: list[str]
    heading: str
    labels: tuple[str, str]

    @property
    def shape(self) -> float:
        """Ratio of width to height."""
        xmin, xmax, ymin, ymax = self.box
        return (xmax - xmin) / (ymax - ymin)


@dataclass(frozen=True)
class PanelGrid:
    """Rows of panels: the size of a panel, and the distance from one panel to the next, in
    inches."""

    columns: int
    rows: int
    width: float
    height: float
    pitch: tuple[float, float]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all panels together."""
        across = (self.columns - 1) * self.pitch[0] + self.width
        return across, (self.rows - 1) * self.pitch[1] + self.height


class Page:
    """A new figure with its axes. It is arranged again when its colour bar and its legend are
    known.

    `size` is the size of the figure in inches; if it is None, the figure is as large as its content
    requires. A `standalone` figure is not managed by pyplot.
    """

    def __init__(
        self, panels: Panels, dpi: float, size: tuple[float, float] | None, *, standalone: bool
    ) -> None:
        self.figure = new_figure(standalone=standalone, dpi=dpi)
        self._panels, self._size, self._single = panels, size, len(panels.titles) == 1
        self.axes = [self._panel(title) for title in panels.titles]
        self._labels = [self.figure.text(0, 0, text, fontsize=TEXT_PT) for text in panels.labels]
        self._heading = self.figure.text(0, 0, "", fontsize=HEADING_PT, ha="center", va="bottom")
        self._before, self._after = np.array((0.6, 0.5)), np.array((0.1, 0.4))
        """Space between the panels and the edges of the figure: `_before` to the left and below,
        `_after` to the right and above."""
        self._around, self._overhang = self._before + self._after, 0.1
        """Space around the panels of a page (`_around`), and length by which tick labels extend
        beyond a panel (`_overhang`), in inches."""
        self._grid = self._best_grid(1.0)

    def _panel(self, title: str) -> Axes:
        ax = self.figure.add_axes((0, 0, 1, 1), label=f"panel {len(self.figure.axes)}")
        xmin, xmax, ymin, ymax = self._panels.box
        ax.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal")
        ax.set_title(title, fontsize=HEADING_PT if self._single else TEXT_PT, pad=4)
        ax.tick_params(labelsize=TICK_PT - (not self._single), length=3, pad=2)
        return ax

    def arrange(
        self,
        scale: Scale | None = None,
        text: str = "",
        handles: list[Line2D] | None = None,
        larger: float = 1.0,
    ) -> None:
        """Arrange the figure with the colour bar of a scale and with a legend.

        If no size is given, the figure is at most `larger` times as large as the page of a journal.
        Raises ExperimentError if a given size is too small for the panels.
        """
        bar = self._bar(scale, text) if scale else None
        legend = self._legend(handles) if handles else None
        self._place(bar, legend, larger)
        # The size of the panels depends on the space around them, and this space on the size of the
        # panels.
        for _ in range(3):
            before = self._space()
            self._measure(bar)
            if np.allclose(self._space(), before, rtol=0.0, atol=SAME_PLACE_IN):
                break
            self._place(bar, legend, larger)

    def _place(self, bar: Any, legend: Legend | None, larger: float) -> None:
        """Place panels, texts, colour bar and legend, given the current space around the panels."""
        self._grid = self._best_grid(larger)
        self._place_panels()
        self._place_keys(bar, legend)

    def _space(self) -> tuple[float, ...]:
        """Return all measured lengths on which the placement depends."""
        return (*self._before, *self._after, *self._around, self._overhang)

    def _best_grid(self, larger: float) -> PanelGrid:
        """Return the grid with the largest panels and few empty places."""
        count, shape = len(self.axes), self._panels.shape
        tall = SHORT_PAGE_HEIGHT_IN if 1 < count <= SHORT_PAGE_PANELS else PAGE_HEIGHT_IN
        page = self._size or (PAGE_WIDTH_IN * larger, tall * larger)
        wide, high = np.array(page) - self._around
        area = math.inf if self._size else PANEL_AREA_IN2 * larger**2
        title = 0.0 if self._single else max(map(len, self._panels.titles)) / CHARACTERS_PER_IN
        gap, grids = GAP_IN + 2 * self._overhang, []
        for columns in range(1, count + 1):
            rows = math.ceil(count / columns)
            width = min(
                (wide - (columns - 1) * gap) / columns,
                (high - (rows - 1) * (GAP_IN + TITLE_IN)) / rows * shape,
                math.sqrt(area * shape),
            )
            pitch = max(width + gap, title + GAP_IN), width / shape + GAP_IN + TITLE_IN
            grids.append(PanelGrid(columns, rows, width, width / shape, pitch))
        fitting = [grid for grid in grids if grid.size[0] <= wide + 1e-6] or grids[:1]
        best = max(fitting, key=lambda g: g.width * (count / (g.columns * g.rows)) ** 0.7)
        if min(best.width, best.height) < SMALLEST_PANEL_IN:
            raise ExperimentError(
                f"figsize: {page[0]:g} by {page[1]:g} inches are too small for {count} panels "
                "and their texts; give a larger size, or fewer times"
            )
        return best

    def _place_panels(self) -> None:
        """Set the size of the figure, and place panels, heading and labels of the axes."""
        grid, (width, height) = self._grid, self._grid.size
        smallest = self._before + self._after + (width, height)
        page = np.array(self._size or smallest)
        self.figure.set_size_inches(*page)
        x0, y0 = self._before + np.maximum(0.0, page - smallest) / 2
        self._block = Bbox.from_bounds(x0, y0, width, height)
        for n, ax in enumerate(self.axes):
            row, column = divmod(n, grid.columns)
            x, y = x0 + column * grid.pitch[0], y0 + (grid.rows - 1 - row) * grid.pitch[1]
            ax.set_position(np.array((x, y, grid.width, grid.height)) / np.tile(page, 2))
            ax.tick_params(labelleft=column == 0, labelbottom=n + grid.columns >= len(self.axes))
            ax.xaxis.set_major_locator(_locator(*self._panels.box[:2], grid.width, 0.5))
            ax.yaxis.set_major_locator(_locator(*self._panels.box[2:], grid.height, 0.3))
        self._place_texts(page)

    def _place_texts(self, page: Any) -> None:
        block, y = self._block, self._panels.labels[1]
        middle = block.get_points().mean(axis=0)
        # The measured box contains the panel, its ticks and the height of its title, but not the
        # width of the title. One panel is measured for all, because measuring the ticks of many
        # panels would take most of the time of a layout.
        ticks = self._narrow = self._drawn(self.axes, for_layout_only=True)
        upright = block.height + 0.3 >= len(y) / CHARACTERS_PER_IN
        across, up = self._labels
        across.set(position=np.array((middle[0], ticks.y0)) / page, ha="center", va="top")
        up.set(position=np.array((ticks.x0 - 0.04, middle[1])) / page, ha="right", va="center")
        up.set(text=y if upright else y.split(" (")[0], rotation=90.0 if upright else 0.0)
        room = 2 * (min(middle[0], page[0] - middle[0]) if self._size else PAGE_WIDTH_IN / 2)
        heading = self.axes[0].title if self._single else self._heading
        text = self._panels.titles[0] if self._single else self._panels.heading
        self._shorten(heading, text, room - 2 * EDGE_IN)
        self._heading.set_position(np.array((middle[0], block.y1 + TITLE_IN + 0.05)) / page)

    def _shorten(self, artist: Text, text: str, width: float) -> None:
        """Set a text, and shorten it if it is too wide."""
        artist.set_text(text)
        while len(text) > 2 and self._drawn([artist]).width > width:
            text = text[: -max(2, len(text) // 20)].rstrip("\\") + "…"
            artist.set_text(text)

    def _bar(self, scale: Scale, text: str) -> Any:
        """Return the colour bar. It is placed beside the panels if they are tall enough for its
        label."""
        width, height = self._grid.size
        broad = int(min(height, BAR_LENGTH_IN) * CHARACTERS_PER_IN)
        lines = textwrap.wrap(text, max(1, broad), break_long_words=False)
        is_vertical = height >= SIDE_BAR_HEIGHT_IN and len(lines) <= LABEL_LINES
        is_vertical = is_vertical and max(map(len, lines)) <= broad
        if not is_vertical:
            lines = textwrap.wrap(text, int(max(width, BAR_LENGTH_IN) * CHARACTERS_PER_IN))
        bar = self.figure.colorbar(
            ScalarMappable(scale.norm, scale.colours), cax=self.figure.add_axes((0, 0, 1, 1)),
            orientation="vertical" if is_vertical else "horizontal", extend=scale.extend,
            extendfrac=0.04,
        )  # fmt: skip
        style_bar(bar, scale)
        bar.set_label("\n".join(lines), fontsize=TEXT_PT)
        return bar

    def _legend(self, handles: list[Line2D]) -> Legend:
        """Return the legend, with as many columns as fit on the page."""
        room = self._size[0] if self._size else max(self._grid.size[0], PAGE_WIDTH_IN)
        for columns in range(len(handles), 0, -1):
            legend = self.figure.legend(
                handles=handles, ncols=columns, loc="upper center", frameon=False,
                handletextpad=0.1, columnspacing=1.2, borderpad=0.1, borderaxespad=0.0,
                fontsize=TEXT_PT,
            )  # fmt: skip
            if columns == 1 or self._drawn([legend]).width <= room - 2 * EDGE_IN:
                break
            legend.remove()
        return legend

    def _place_keys(self, bar: Any, legend: Legend | None) -> None:
        """Place the colour bar beside or below the panels, and the legend below them and the colour
        bar."""
        block, page = self._block, self.figure.get_size_inches()
        middle = block.get_points().mean(axis=0)
        low = min(self._narrow.y0, self._drawn([self._labels[0]]).y0) - 0.08
        if bar and bar.orientation == "vertical":
            length, x0 = min(block.height - 0.12, BAR_LENGTH_IN), block.x1 + self._overhang
            place = np.array((x0 + GAP_IN, middle[1] - length / 2, BAR_WIDTH_IN, length))
            bar.ax.set_position(place / np.tile(page, 2))
        elif bar:
            length = min(max(block.width, SIDE_BAR_HEIGHT_IN), BAR_LENGTH_IN)
            place = np.array((middle[0] - length / 2, low - BAR_WIDTH_IN, length, BAR_WIDTH_IN))
            bar.ax.set_position(place / np.tile(page, 2))
            low = self._drawn([bar.ax]).y0 - 0.05
        if legend:
            legend.set_bbox_to_anchor((middle[0], low), self.figure.dpi_scale_trans)

    def _drawn(self, artists: Iterable[Any], **options: Any) -> Bbox:
        """Return the box around artists, including their labels and ticks, in inches."""
        renderer = renderer_of(self.figure)
        boxes = [box for artist in artists if (box := artist.get_tightbbox(renderer, **options))]
        return Bbox(Bbox.union(boxes).get_points() / self.figure.dpi)

    def _measure(self, bar: Any) -> None:
        """Measure the space around the panels."""
        bars = [bar.ax] if bar else []
        titles = [ax.title for ax in self.axes]
        texts = [text for text in (*titles, *self.figure.texts) if text.get_text()]
        drawn = self._drawn([*bars, *texts, *self.figure.legends])
        drawn = Bbox.union([self._narrow, drawn])
        self._before = np.subtract(self._block.min, drawn.min) + EDGE_IN
        self._after = np.subtract(drawn.max, self._block.max) + EDGE_IN
        # If titles are wider than the panels, the page is made wider, and the panels keep their
        # width.
        narrow = self._narrow
        if bars:
            narrow = Bbox.union([narrow, self._drawn(bars, for_layout_only=True)])
        x0 = min(narrow.x0, self._drawn([self._labels[1]]).x0)
        self._around = self._before + self._after
        self._around[0] = narrow.x1 - x0 - self._block.width + 2 * EDGE_IN
        ticks = self._drawn([self.axes[-1].xaxis])
        self._overhang = max(0.0, ticks.width - self._grid.width) / 2


def _locator(low: float, high: float, length: float, distance: float) -> Locator:
    """Return a locator that places ticks with a minimum distance, in inches. On a short axis it
    places one tick."""
    if length < SHORT_AXIS_IN:
        return FixedLocator([0.0 if low <= 0.0 <= high else float(f"{(low + high) / 2:.1g}")])
    return MaxNLocator(max(1, int(length / distance)), steps=[1, 2, 5, 10])
