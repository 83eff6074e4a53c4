"""A scene before it runs, on axes of matplotlib, with coordinates in the user's units."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from pbdkit.drawing.figures import figure_of
from pbdkit.drawing.key import Legend, handle
from pbdkit.drawing.labels import label, plain
from pbdkit.drawing.look import Look
from pbdkit.drawing.page import Page
from pbdkit.drawing.plan import Panels
from pbdkit.drawing.scene_picture import MARGIN, WITHIN, corners, draw_scene
from pbdkit.drawing.scene_picture import Legend as Meanings
from pbdkit.drawing.svg import Floats
from pbdkit.interfaces.units import LENGTH
from pbdkit.scene.scene import Scene

POINTS = 0.75
"""Points a pixel: 96 pixels are an inch."""


class AxesCanvas:
    """Axes as a canvas: their coordinates are `unit` times lattice units, their limits stay. Shapes
    stand in the order in which they are added."""

    def __init__(self, ax: Axes, unit: float) -> None:
        self._ax, self._unit, self._order = ax, unit, 1
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        self.low: Floats = np.array([left, bottom]) / unit
        self.high: Floats = np.array([right, top]) / unit
        inches = ax.get_window_extent().width / figure_of(ax).dpi
        self.scale = 72 * inches / POINTS / float(self.high[0] - self.low[0])

    def dots(
        self,
        places: Floats,
        size: float,
        colour: str,
        *,
        square: bool = False,
        opacity: float = 1.0,
    ) -> None:
        """Draw dots of one size."""
        style: dict[str, Any] = {"ls": "", "marker": "s" if square else "o", "mew": 0.0}
        self._plot(places, color=colour, ms=POINTS * size, alpha=opacity, **style)

    def line(self, places: Floats, colour: str, width: float, dashes: str = "") -> None:
        """Draw a line from place to place; `dashes` as SVG writes them."""
        lengths = [float(part) / width for part in dashes.split()]
        style: Any = (0.0, lengths) if lengths else "-"
        self._plot(places, color=colour, lw=POINTS * width, ls=style)

    def filled(self, outlines: list[Floats], fill: str, edge: str) -> None:
        """Fill what lies between closed outlines: an inner one is a hole."""
        turned = [line[:: 1 if n == 0 else -1] for n, line in enumerate(outlines)]
        path = Path.make_compound_path(
            *(Path(self._unit * o, closed=False) for o in map(_closed, turned))
        )
        self._ax.add_patch(PathPatch(path, fc=fill, ec=edge, lw=POINTS, zorder=self._next))

    def arrow(self, tail: Floats, way: Floats, colour: str) -> None:
        """Draw an arrow from a place, by so many pixels, y up."""
        if not np.any(way):
            return
        tip = self._unit * (np.asarray(tail) + np.asarray(way) / self.scale)
        style = {"arrowstyle": "-|>,head_width=0.2,head_length=0.4", "color": colour}
        more: dict[str, Any] = {"shrinkA": 0.0, "shrinkB": 0.0, "lw": 1.6 * POINTS}
        ends = (*tip,), (*(self._unit * np.asarray(tail)),)
        self._ax.annotate("", *ends, arrowprops=style | more, zorder=self._next)

    def _plot(self, places: Floats, **style: Any) -> None:
        x, y = self._unit * np.asarray(places).reshape(-1, 2).T
        self._ax.plot(x, y, scalex=False, scaley=False, zorder=self._next, **style)

    @property
    def _next(self) -> float:
        """The place of the next shape over those before."""
        self._order += 1
        return 1.0 + 1e-3 * self._order


def _closed(outline: Floats) -> Floats:
    return np.concatenate([outline, outline[:1]])


def draw_on_axes(scene: Scene, look: Look, ax: Axes | None) -> Axes:
    """Draw a scene in a plane on axes, or, without, in a new figure."""
    units = scene.experiment.units
    unit, words = (units.scale(LENGTH), LENGTH.unit) if units else (1.0, LENGTH.lattice)
    low, high = corners(scene)
    size = np.maximum(high - low, 1e-9 * max(1.0, *np.abs(high), *np.abs(low)))
    margin = MARGIN / ((np.array(WITHIN) - 2.0 * MARGIN) / size).min()
    (left, bottom), (right, top) = unit * (low - margin), unit * (high + margin)
    title, labels = plain(scene.experiment.name), (label("x", words), label("y", words))
    if ax is not None:
        ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=title)
        ax.set(xlabel=labels[0], ylabel=labels[1])
        meanings = draw_scene(scene, AxesCanvas(ax, unit))
        ax.legend(handles=_handles(meanings), fontsize="small")
        return ax
    page = Page(
        Panels((left, right, bottom, top), [title], "", labels), look.dpi, look.figsize, alone=True
    )
    page.arrange(None, None)
    ax = page.axes[0]
    meanings = draw_scene(scene, AxesCanvas(ax, unit))
    page.arrange(None, Legend(page.figure, _handles(meanings)))
    return ax


def _handles(meanings: Meanings) -> list[Any]:
    """A dot with its words for each colour."""
    named: dict[str, list[str]] = {}
    for colour, words in meanings:
        named.setdefault(colour, []).append(words)
    return [handle(", ".join(words), colour) for colour, words in named.items()]
