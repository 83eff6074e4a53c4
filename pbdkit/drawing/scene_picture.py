"""A scene before it runs: the body, who leads, what acts on it and what is in its way.

Shapes are drawn on a canvas: the SVG of a notebook, or axes of matplotlib (`scene_axes.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.svg import Floats, Svg
from pbdkit.drawing.ways import extreme, force_of, greatest
from pbdkit.experiment.motions import Hold
from pbdkit.experiment.newton import Newton
from pbdkit.scene.field_values import signed_distance
from pbdkit.scene.obstacles import Barrier
from pbdkit.scene.outlines import CIRCLES, HALF_PLANE, Outline
from pbdkit.scene.raster import FOLLOWER, Raster
from pbdkit.scene.scene import Scene
from pbdkit.scene.selecting import spacing

WITHIN, MARGIN, ARROW, LEAST, APART = (480.0, 400.0), 44.0, 34.0, 14.0, 14.0
"""Pixels: of the picture, around the body, of the longest arrow and the shortest, between two."""
BODY, OUTLINE, FRAME_POINT, LEADS, HELD = "#0072B2", "#5A87A8", "#DCCB2E", "#D55E00", "#7A3300"
ACTS, CUT, STANDS, DRIVEN = "#007A5A", "#C2185B", "#9A9A9A", "#404040"
TINTS = ("#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#F0E442", "#0072B2")
DOTS, TINTED, ARROWS, BEYOND = 3000, 1500, 5, 0.35
"""Bodies of more particles show their edge alone; so many dots at most of a region, so many arrows
of a group; by so much of the body's size the picture goes beyond it to show obstacles."""
Rows = NDArray[np.intp]


Legend = tuple[tuple[str, str], ...]
"""What colours mean: (colour, words)."""


class Canvas(Protocol):
    """What a scene is drawn on: places are in lattice units, sizes and widths in pixels, of which
    `scale` make a lattice unit; the picture reaches from the corner `low` to `high`."""

    scale: float
    low: Floats
    high: Floats

    def dots(
        self, places: Floats, size: float, colour: str, *, square: bool = ..., opacity: float = ...
    ) -> None:
        """Draw dots of one size."""

    def line(self, places: Floats, colour: str, width: float, dashes: str = ...) -> None:
        """Draw a line from place to place."""

    def filled(self, outlines: list[Floats], fill: str, edge: str) -> None:
        """Fill what lies between closed outlines: an inner one is a hole."""

    def arrow(self, tail: Floats, way: Floats, colour: str) -> None:
        """Draw an arrow from a place, by so many pixels, y up."""


@dataclass(frozen=True)
class Picture:
    """The element to be shown, and what its colours mean: (colour, words)."""

    svg: str
    legend: Legend


def picture_of(scene: Scene) -> Picture | None:
    """Return the picture of a scene in a plane as SVG; None in space."""
    if scene.axes != 2:
        return None
    svg = Svg(*corners(scene), WITHIN, MARGIN)
    legend = draw_scene(scene, svg)
    return Picture(svg.text(f"the scene of {scene.experiment.name}"), legend)


def draw_scene(scene: Scene, canvas: Canvas) -> Legend:
    """Draw a scene in a plane, and return what its colours mean. Arrows show where to and how far
    in proportion to each other, not to the body."""
    drawing = _Drawing(scene, canvas)
    drawing.draw()
    return tuple(drawing.legend)


def corners(scene: Scene) -> tuple[Floats, Floats]:
    """Return the lower left and the upper right corner of what a picture of a scene shows."""
    shown = _shown(scene)
    return _with_obstacles(scene.barriers, shown.min(axis=0), shown.max(axis=0))


def _is_small(scene: Scene) -> bool:
    return int(np.count_nonzero(scene.raster.table_kind == FOLLOWER)) <= DOTS


def _shown(scene: Scene) -> Floats:
    """The particles of a small body and its frame, and of a large body alone."""
    X = scene.raster.reference()
    return X if _is_small(scene) else X[scene.raster.table_kind == FOLLOWER]


class _Drawing:
    """One picture in the making."""

    def __init__(self, scene: Scene, canvas: Canvas) -> None:
        self.scene, self.canvas, self.legend = scene, canvas, list[tuple[str, str]]()
        self.X = scene.raster.reference()
        self.body = scene.raster.table_kind == FOLLOWER
        self.few, shown = _is_small(scene), _shown(scene)
        self.middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
        self.dot = min(max(0.5 * spacing(scene.raster) * canvas.scale, 1.2), 7.0)

    def draw(self) -> None:
        """From what lies below to what must be seen."""
        self._regions()
        self._obstacles()
        if self.few:
            self._tell(self.canvas.dots, self.X[~self.body], 0.6 * self.dot, FRAME_POINT, "frame")
        shown = self.body if self.few else edge_of(self.scene.raster)
        colour, said = (BODY, "body") if self.few else (OUTLINE, "edge of the body")
        self._tell(self.canvas.dots, self.X[shown], self.dot, colour, said)
        self._cuts()
        self._leaders()
        self._loads()

    def _tell(self, draw: Any, places: Floats, size: float, colour: str, said: str) -> None:
        if len(places):
            draw(places, size, colour)
            self._note(colour, said)

    def _note(self, colour: str, said: str) -> None:
        if (colour, said) not in self.legend:
            self.legend.append((colour, said))

    def _regions(self) -> None:
        cell = self.scene.raster.lattice.cell()
        at = self.X[self.body]
        for n, (name, shape) in enumerate(self.scene.experiment.regions.items()):
            inside = at[signed_distance(shape, cell, *at.T) <= 0.0]
            step = 1 + len(inside) // TINTED
            size = spacing(self.scene.raster) * self.canvas.scale * math.sqrt(step)
            colour = TINTS[n % len(TINTS)]
            self.canvas.dots(inside[::step], size, colour, square=True, opacity=0.45)
            self._note(colour, f"region {name}")

    def _obstacles(self) -> None:
        for barrier in self.scene.barriers:
            self.canvas.filled(
                _outlines(barrier.start, self.canvas.low, self.canvas.high), "#E3E3E3", STANDS
            )
            self._note(STANDS, "obstacle")

    def _cuts(self) -> None:
        experiment = self.scene.experiment
        for crack in getattr(experiment.fracture, "cracks", ()):
            self.canvas.line(np.array(crack), CUT, 2.2)
            self._note(CUT, "crack")
        for cut in experiment.cuts:
            self.canvas.line(np.array(cut.segment), CUT, 2.2, "5 4" if cut.at else "")
            self._note(CUT, f"cut at step {cut.at}" if cut.at else "cut")

    @property
    def _longest(self) -> float:
        """The longest way of a motion."""
        driven = self.scene.driven
        ways = [extreme(d.group.motion, d.reference, self.scene.experiment.steps) for d in driven]
        return max((float(np.hypot(*way.T).max()) for way in ways), default=0.0)

    def _leaders(self) -> None:
        longest = self._longest
        for barrier in self.scene.barriers:
            way = extreme(barrier.group.motion, barrier.reference, self.scene.experiment.steps)
            ring = np.concatenate(_outlines(barrier.start, self.canvas.low, self.canvas.high))
            nearest = ring[np.argmin(np.hypot(*(ring - self.middle).T))]
            self._arrows(nearest[None], way.mean(axis=0, keepdims=True), longest, DRIVEN)
        for leading in self.scene.leading:
            motion, held = leading.group.motion, isinstance(leading.group.motion, Hold)
            colour = HELD if held else LEADS
            said = "mass" if isinstance(motion, Newton) else "held" if held else "led"
            if leading.group.axes:
                said += f" along {' and '.join(leading.group.axes)} only"
            self.canvas.dots(leading.reference, max(1.4 * self.dot, 3.0), colour, square=held)
            self._note(colour, said)
            ways = np.zeros((len(leading.rows), 2)) + extreme(
                motion, leading.reference, self.scene.experiment.steps
            )
            free = [axis for axis in range(2) if axis not in leading.axes]
            ways[:, free] = 0.0
            self._arrows(leading.reference, ways, longest, colour)
            if isinstance(motion, Newton):
                force = np.array([greatest(f) for f in motion.force])
                self._arrows(leading.reference, force + 0.0 * ways, float(np.hypot(*force)), ACTS)

    def _loads(self) -> None:
        each = self.scene.loads.each if self.scene.loads else ()
        forces = [(loading, force_of(loading.load)) for loading in each]
        longest = max((float(np.hypot(*force)) for _, force in forces), default=0.0)
        for loading, force in forces:
            at = self.X[loading.rows]
            at = at.mean(axis=0, keepdims=True) if loading.load.body_force else at
            self._arrows(at, np.tile(force, (len(at), 1)), longest, ACTS)
            self._note(ACTS, "body force" if loading.load.body_force else "force")

    def _arrows(self, at: Floats, ways: Floats, longest: float, colour: str) -> None:
        """At some of the places, from them outwards or, into the body, towards them."""
        extent = float(np.ptp(at, axis=0).max()) * self.canvas.scale
        count = min(max(int(extent / APART), 1), ARROWS)
        ends = np.linspace(0, len(at) - 1, count) if count > 1 else np.array([len(at) // 2])
        some = np.unique(ends.round().astype(int))
        for place, way in zip(at[some], ways[some], strict=True):
            pixels = _pixels(way, longest)
            inwards = float((self.middle - place) @ way) > 1e-9 * float(np.hypot(*way))
            tail = place - pixels / self.canvas.scale if inwards else place
            self.canvas.arrow(tail, pixels, colour)


def _pixels(way: Floats, longest: float) -> Floats:
    """An arrow for a way, the longest of all ARROW pixels long; none for none."""
    length = float(np.hypot(*way))
    if length <= 1e-12 * longest or longest == 0.0:
        return np.zeros(2)
    return np.asarray(way / length * max(ARROW * length / longest, LEAST))


def edge_of(raster: Raster) -> Rows:
    """The rows of the body's particles that have not all four beside them, of their sublattice."""
    places = []
    for kinds in raster.kind == FOLLOWER:
        around = np.pad(kinds, 1)
        inner = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
        places.append(kinds & ~inner)
    found = np.nonzero(np.stack(places))
    rows = raster.rows_at(found[0], *found[1:])
    return np.asarray(rows)


def _with_obstacles(
    barriers: Iterable[Barrier], low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    """The corners of what is to be seen with obstacles, as far as they are near."""
    room = BEYOND * float((high - low).max())
    for barrier in barriers:
        box = barrier.start.box
        low = np.minimum(low, np.maximum(box[:2], low - room))
        high = np.maximum(high, np.minimum(box[2:], high + room))
    return low, high


def _outlines(outline: Outline, low: Floats, high: Floats) -> list[Floats]:
    """Closed lines around an obstacle, of a half-plane as far as the picture goes."""
    if outline.kind == HALF_PLANE:
        point, normal = outline.points[0], outline.points[1] - outline.points[0]
        along, far = np.array([-normal[1], normal[0]]), 2.0 * float(np.hypot(*(high - low)))
        point = point + along * float(((low + high) / 2 - point) @ along)
        ends = [point - far * along, point + far * along]
        return [np.array([*ends, ends[1] - far * normal, ends[0] - far * normal])]
    if outline.kind == CIRCLES:
        turn = np.linspace(0.0, 2.0 * math.pi, 181)
        round_ = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        radii = [r for r in (outline.outer, outline.inner) if r > 0.0]
        return [outline.points[0] + r * round_ for r in radii]
    return [outline.points]
