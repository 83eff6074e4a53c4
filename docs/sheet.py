"""One page with small pictures of all shipped experiments, 180 mm wide, for print.

`python docs/sheet.py [FILE.pdf] [EXPERIMENT ...]` runs the experiments and writes the page, by
default `experiments.pdf`; the site is built with the same page. Texts and axes are vectors, and
fields are pixels.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import xarray
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.text import Text

from pbdkit.plotting.configuration import PanelFigure
from pbdkit.plotting.data import Trajectory, extent_of
from pbdkit.plotting.figure_layout import style_bar
from pbdkit.plotting.style import PlotOptions, label

MM = 1.0 / 25.4
"""A millimetre in inches."""
WIDTH_MM = 180.0
"""Width of the page."""
COLUMNS = 5
"""Number of pictures in a row."""
CELL_MM = (WIDTH_MM / COLUMNS, 28.5)
"""Width and height of the space of a picture with its texts."""
BODY_MM = (32.0, 16.0)
"""Width and height of a picture."""
MARGIN_MM = 2.0
"""Height of the space below the last row."""
BAR_MM = (17.0, 1.1)
"""Width and height of a colour bar."""
TITLE_PT, LABEL_PT, TICK_PT = 5.8, 5.2, 5.0
"""Sizes of texts in points."""
DPI = 400
"""Resolution of fields in pixels per inch."""
STYLE = {
    "font.family": "DejaVu Sans",
    "axes.linewidth": 0.4,
    "xtick.major.width": 0.4,
    "ytick.major.width": 0.4,
    "pdf.fonttype": 42,
}
"""Settings of matplotlib for the page. Fonts are embedded as text."""


class BarePanel(PanelFigure):
    """A panel without colour bar and legend, which are placed on the sheet."""

    def _key(self) -> None:
        """Omit colour bar and legend."""


class Sheet:
    """A page with a grid of pictures, to which one experiment after the other is added."""

    def __init__(self, count: int) -> None:
        self._rows, self._added = math.ceil(count / COLUMNS), 0
        size = (WIDTH_MM * MM, (self._rows * CELL_MM[1] + MARGIN_MM) * MM)
        self.figure = Figure(figsize=size, dpi=DPI)
        FigureCanvasAgg(self.figure)

    def add(self, name: str, dataset: xarray.Dataset, color: str, time: float | None) -> None:
        """Draw the last step of an experiment, or the step at `time`, with a variable in colour."""
        with rc_context(STYLE):
            row, column = divmod(self._added, COLUMNS)
            self._added += 1
            left, top = column * CELL_MM[0], (self._rows - row) * CELL_MM[1] + MARGIN_MM
            middle = left + CELL_MM[0] / 2
            self._write(middle, top - 1.0, name, TITLE_PT, "top")
            corner = middle - BODY_MM[0] / 2, top - 4.6 - BODY_MM[1]
            recording = Trajectory(dataset, color)
            assert recording.quantity is not None
            field = recording.quantity.owner == "particle" and not recording.quantity.words
            look = PlotOptions(filled=field or None, bonds=None if field else False, dpi=DPI)
            (snapshot,) = recording.snapshots([recording.row(time)])
            extent = extent_of(recording, [snapshot], look)
            ax = self._axes(*corner, *BODY_MM)
            panel = BarePanel([recording], [""], "", extent, look, [ax])
            panel.panels[0].show(snapshot)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
            ax.spines[:].set_visible(False)
            for artist in (*ax.images, *ax.collections):
                artist.set_rasterized(True)
            self._bar(panel, middle, corner[1] - 0.8)

    def _bar(self, panel: PanelFigure, middle: float, top: float) -> None:
        """Draw the colour bar of a panel, with its limits and its label."""
        scale, quantity = panel._scale, panel._quantity
        assert scale is not None
        ax = self._axes(middle - BAR_MM[0] / 2, top - BAR_MM[1], *BAR_MM)
        mappable = ScalarMappable(scale.norm, scale.colours)
        bar = self.figure.colorbar(mappable, cax=ax, orientation="horizontal")
        style_bar(bar, scale)
        low, high = scale.low, scale.high
        bar.set_ticks([low, 0.0, high] if low < 0.0 < high else [low, high])
        if scale.whole:
            bar.set_ticks([math.ceil(low), math.floor(high)])
        ten = 10.0**scale.exponent
        bar.ax.set_xticklabels([f"{t / ten:.3g}".replace("-", "−") for t in bar.get_ticks()])
        bar.ax.tick_params(labelsize=TICK_PT, length=1.2, width=0.4, pad=0.8)
        bar.outline.set_linewidth(0.3)
        text = label(quantity.meaning, quantity.units, scale.exponent, width=38)
        self._write(middle, top - BAR_MM[1] - 2.6, text, LABEL_PT, "top", linespacing=1.0)

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Any:
        """Return new axes at a place in mm."""
        page = self.figure.get_size_inches() / MM
        return self.figure.add_axes(
            (left / page[0], bottom / page[1], width / page[0], height / page[1]),
            label=f"{len(self.figure.axes)}",
        )

    def _write(self, x: float, y: float, text: str, size: float, va: str, **style: Any) -> None:
        page = self.figure.get_size_inches() / MM
        self.figure.text(x / page[0], y / page[1], text, size=size, ha="center", va=va, **style)

    def save(self, *files: Path) -> None:
        """Write the page to files. Raises ValueError if a text is clipped."""
        page, renderer = self.figure.bbox, self.figure.canvas.get_renderer()  # type: ignore[attr-defined]
        for text in self.figure.findobj(Text):
            box = text.get_window_extent(renderer)
            inside = page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0
            if text.get_text() and not inside:
                raise ValueError(f"the text {text.get_text()!r} is clipped")
        with rc_context(STYLE):
            for file in files:
                self.figure.savefig(
                    file, metadata={"CreationDate": None} if file.suffix == ".pdf" else {}
                )


def main() -> None:
    """Run all shipped experiments and write the page."""
    from gallery import Entry

    import pbdkit
    from pbdkit.model.shipped import shipped_names

    file, *chosen = sys.argv[1:] or ["experiments.pdf"]
    names = chosen or shipped_names()
    sheet = Sheet(len(names))
    for name in names:
        entry = Entry.read(name)
        sheet.add(name, pbdkit.run(name, progress=False), *entry.shown)
        print(name)
    sheet.save(Path(file))


if __name__ == "__main__":
    main()
