"""A figure of a body at several steps, or of several bodies, with one scale and one legend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from matplotlib.cm import ScalarMappable
from matplotlib.transforms import ScaledTranslation

from pbdkit.drawing.extent import Extent
from pbdkit.drawing.figures import figure_of
from pbdkit.drawing.key import Legend, ScaleBar, dress_bar, legend_handles
from pbdkit.drawing.labels import label
from pbdkit.drawing.layers import (
    BondField,
    Bonds,
    BondValues,
    Classes,
    Dots,
    Field,
    Layer,
    draw_numbers,
    draw_outline,
)
from pbdkit.drawing.look import Look
from pbdkit.drawing.manner import DETAILED, MANY_BONDS, manner_of
from pbdkit.drawing.page import Page
from pbdkit.drawing.palette import OF_KINDS, Palette, palette_of
from pbdkit.drawing.pixels import Grid
from pbdkit.drawing.plan import Panels
from pbdkit.drawing.recording import Recording, Snapshot
from pbdkit.drawing.scale import Scale, scale_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUMBERED_PT, LARGEST = 20.0, 2.5
"""How far apart numbers want particles, and how many times as large a page becomes for them."""


class Panel:
    """Axes with layers, each of which shows a step."""

    def __init__(self, ax: Axes, drawn: list[Layer]) -> None:
        self.ax, self._layers = ax, drawn
        self.artists = [artist for layer in drawn for artist in layer.artists]

    def show(self, now: Snapshot) -> None:
        """That step, in place of the one before."""
        for layer in self._layers:
            layer.show(now)


class Sheet:
    """Axes, `axes`, of which each shows steps of a recording, `panels`.

    All have the limits and the scale of an extent. Fields have `finer` times as many pixels, either
    way, as the picture. `axes` given are used as they are; else a figure is made around them,
    one `alone` or of pyplot.
    Raises ExperimentError for what there is no room or no data for.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        titles: list[str],
        heading: str,
        extent: Extent,
        look: Look,
        axes: list[Axes] | None = None,
        finer: float = 2.0,
        *,
        alone: bool = False,
    ) -> None:
        self._extent, self._look, self._finer = extent, look, finer
        first = recordings[0]
        assert first.quantity is not None
        self._quantity, self._body = first.quantity, first.body
        self._palette = palette_of(self._quantity) if self._quantity.words else None
        panels = Panels(extent.box, titles, heading, first.axis_labels)
        self._page = Page(panels, look.dpi, look.figsize, alone=alone) if axes is None else None
        self.axes = self._page.axes if self._page else list(axes or [])
        self._larger = 1.0
        if self._page:
            self._page.arrange(None, None)
            if look.numbers:
                self._larger = min(max(1.0, NUMBERED_PT / self._apart()), LARGEST)
                self._page.arrange(None, None, self._larger)
        else:
            self._dress(panels)
        self._manner = manner_of(self._body, self._quantity, look, self._apart())
        self._scale = self._scale_of_all()
        self._key()
        self._manner = replace(self._manner, apart=self._apart())  # the key took some of the page
        self.panels = [
            Panel(ax, list(self._layers(ax, recording)))
            for ax, recording in zip(self.axes, recordings, strict=True)
        ]

    @property
    def figure(self) -> Figure:
        """That of the axes."""
        return figure_of(self.axes[0])

    def number(self, ax: Axes, now: Snapshot) -> None:
        """Writes numbers at the particles of that step, beside their dots."""
        manner = self._manner
        draw_numbers(ax, self._body.number, now, manner.dot if manner.dots else 0.0)

    def _apart(self) -> float:
        """How far apart particles at rest lie on the page, in points."""
        ax, (left, right, bottom, top) = self.axes[0], self._extent.box
        inches = ax.get_window_extent().transformed(self.figure.dpi_scale_trans.inverted())
        scale = min(inches.width / (right - left), inches.height / (top - bottom))
        return float(72 * scale * self._body.spacing)

    def _scale_of_all(self) -> Scale | None:
        if self._palette is not None:
            return None
        filled = self._manner.filled
        values = self._extent.of_body if filled else self._extent.of_all
        return scale_of(self._quantity, values, self._look, filled)

    def _layers(self, ax: Axes, recording: Recording) -> Iterator[Layer]:
        """What is drawn, from below."""
        body, scale, manner, grid = recording.body, self._scale, self._manner, self._grid(ax)
        if manner.filled and scale:
            yield Field(ax, body, grid, scale, manner.alone)
        elif self._palette and manner.crowded:
            yield Classes(ax, body, grid, self._palette)
        if manner.lined:
            yield Bonds(ax, body, manner.line)
        if self._look.broken:
            yield Bonds(ax, body, manner.line, broken=True)
        if self._quantity.owner == "bond" and scale:
            many = len(body.ends) > MANY_BONDS
            width = 2.0 * manner.line
            yield BondField(ax, body, grid, scale) if many else BondValues(ax, body, width, scale)
        if self._look.outline:
            draw_outline(ax, body.outline)
        if manner.dots:
            colours = {"values": scale, "classes": self._palette}.get(manner.dots)
            yield Dots(ax, manner.dot, colours or OF_KINDS, body.beyond & manner.filled)

    def _grid(self, ax: Axes) -> Grid:
        """The pixels of a field, finer than those of the picture where cells are few."""
        extent = ax.get_window_extent()
        finer = 1 if len(self._body.reference) > DETAILED else self._finer
        across, up = (max(2, round(finer * side)) for side in (extent.width, extent.height))
        return Grid(self._extent.box, across, up)

    def _key(self) -> None:
        """The bar of the scale, and a legend of the kinds where they are seen."""
        quantity, scale, page = self._quantity, self._scale, self._page
        text = label(quantity.meaning, quantity.units, scale.exponent if scale else 0)
        of_kinds = self._manner.dots == "kinds"
        palette = OF_KINDS if of_kinds else self._palette
        if page:
            bar = ScaleBar(page.figure, scale, text) if scale else None
            present = set(self._extent.kinds if of_kinds else self._extent.classes)
            handles = legend_handles(palette, present) if palette else []
            legend = Legend(page.figure, handles) if palette else None
            page.arrange(bar, legend, self._larger)
            return
        if scale:
            bar_of = self.figure.colorbar(
                ScalarMappable(scale.norm, scale.colours), ax=self.axes, extend=scale.extend
            )
            length = bar_of.ax.get_window_extent().height / self.figure.dpi
            dress_bar(bar_of, scale, length)
            bar_of.set_label(text)
        if palette:
            self._add_legend(palette)

    def _dress(self, panels: Panels) -> None:
        """Axes that were given: limits, titles and labels."""
        left, right, bottom, top = panels.box
        for ax, title in zip(self.axes, panels.titles, strict=True):
            ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=title)
            ax.set(xlabel=panels.labels[0], ylabel=panels.labels[1])

    def _add_legend(self, palette: Palette) -> None:
        """Below axes that were given."""
        below = self.axes[0].transAxes + ScaledTranslation(0, -0.45, self.figure.dpi_scale_trans)
        handles = legend_handles(palette, set(self._extent.kinds | self._extent.classes))
        self.axes[0].legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below,
            ncols=3, frameon=False, handletextpad=0.1,
        )  # fmt: skip
