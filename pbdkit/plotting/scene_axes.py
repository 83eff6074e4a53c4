"""Drawing of the set-up of an experiment on matplotlib axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError
from pbdkit.model.experiment import Experiment
from pbdkit.plotting.figure_layout import Page, Panels, handle
from pbdkit.plotting.scene_figure import MARGIN, MAX_SIZE_PX, SceneLegend, corners, draw_scene
from pbdkit.plotting.style import PlotOptions, figure_of, label, plain
from pbdkit.plugin.units import LENGTH
from pbdkit.scene.scene import build_scene

POINTS = 0.75
"""Points per pixel: 96 pixels are an inch."""


class AxesCanvas:
    """Axes as a canvas with constant limits. A lattice unit has the length `unit` in the
    coordinates of the axes. Shapes are drawn in the order in which they are added."""

    def __init__(self, ax: Axes, unit: float) -> None:
        self._ax, self._unit, self._order = ax, unit, 1
        (xmin, xmax), (ymin, ymax) = ax.get_xlim(), ax.get_ylim()
        self.low: Floats = np.array([xmin, ymin]) / unit
        self.high: Floats = np.array([xmax, ymax]) / unit
        inches = ax.get_window_extent().width / figure_of(ax).dpi
        self.scale = 72 * inches / POINTS / float(self.high[0] - self.low[0])

    def dots(
        self,
        places: Floats,
        size: float,
        colour: str,
        *,
        square: bool = False,
    ) -> None:
        """Draw dots of one size."""
        style: dict[str, Any] = {"ls": "", "marker": "s" if square else "o", "mew": 0.0}
        self._plot(places, color=colour, ms=POINTS * size, **style)

    def line(self, places: Floats, colour: str, width: float, dashes: str = "") -> None:
        """Draw a polyline. `dashes` has the same form as in SVG."""
        lengths = [float(part) / width for part in dashes.split()]
        style: Any = (0.0, lengths) if lengths else "-"
        self._plot(places, color=colour, lw=POINTS * width, ls=style)

    def filled(self, outlines: list[Floats], fill: str, edge: str, *, opacity: float = 1.0) -> None:
        """Fill the area between closed outlines. An outline inside another one is the edge of a
        hole."""
        turned = [line[:: 1 if n == 0 else -1] for n, line in enumerate(outlines)]
        path = Path.make_compound_path(
            *(Path(self._unit * o, closed=False) for o in map(_closed, turned))
        )
        face = (fill, opacity)
        self._ax.add_patch(PathPatch(path, fc=face, ec=edge, lw=POINTS, zorder=self._next))

    def arrow(self, tail: Floats, vector: Floats, colour: str) -> None:
        """Draw an arrow that starts at a place. `vector` is in pixels, with y upward."""
        if not np.any(vector):
            return
        tip = self._unit * (np.asarray(tail) + np.asarray(vector) / self.scale)
        style = {"arrowstyle": "-|>,head_width=0.2,head_length=0.4", "color": colour}
        lengths: dict[str, Any] = {"shrinkA": 0.0, "shrinkB": 0.0, "lw": 1.6 * POINTS}
        ends = (*tip,), (*(self._unit * np.asarray(tail)),)
        self._ax.annotate("", *ends, arrowprops=style | lengths, zorder=self._next)

    def _plot(self, places: Floats, **style: Any) -> None:
        x, y = self._unit * np.asarray(places).reshape(-1, 2).T
        self._ax.plot(x, y, scalex=False, scaley=False, zorder=self._next, **style)

    @property
    def _next(self) -> float:
        """Z-order of the next shape, above all previous ones."""
        self._order += 1
        return 1.0 + 1e-3 * self._order


def _closed(outline: Floats) -> Floats:
    return np.concatenate([outline, outline[:1]])


def draw_experiment(experiment: Experiment, look: PlotOptions, ax: Axes | None) -> Axes:
    """Draw the set-up of an experiment on axes, by default in a new figure."""
    scene = build_scene(experiment)
    if scene.axes != 2:
        raise ExperimentError(
            f"pictures are two-dimensional, but this lattice has {scene.axes} axes"
        )
    units = experiment.units
    unit, words = (units.scale(LENGTH), LENGTH.unit) if units else (1.0, LENGTH.lattice)
    low, high = corners(scene)
    size = np.maximum(high - low, 1e-9 * max(1.0, *np.abs(high), *np.abs(low)))
    margin = MARGIN / ((np.array(MAX_SIZE_PX) - 2.0 * MARGIN) / size).min()
    (xmin, ymin), (xmax, ymax) = unit * (low - margin), unit * (high + margin)
    xmin, xmax, ymin, ymax = look.window or (xmin, xmax, ymin, ymax)
    title, labels = plain(experiment.name), (label("x", words), label("y", words))
    if ax is not None:
        ax.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal", title=title)
        ax.set(xlabel=labels[0], ylabel=labels[1])
        meanings = draw_scene(scene, AxesCanvas(ax, unit))
        ax.legend(handles=_handles(meanings), fontsize="small")
        return ax
    page = Page(
        Panels((xmin, xmax, ymin, ymax), [title], "", labels),
        look.dpi,
        look.figsize,
        standalone=True,
    )
    page.arrange()
    ax = page.axes[0]
    meanings = draw_scene(scene, AxesCanvas(ax, unit))
    page.arrange(handles=_handles(meanings))
    return ax


def _handles(meanings: SceneLegend) -> list[Any]:
    """Return a legend handle for each colour."""
    texts: dict[str, list[str]] = {}
    for colour, words in meanings:
        texts.setdefault(colour, []).append(words)
    return [handle("; ".join(words), colour) for colour, words in texts.items()]
