"""Pictures of a scene before it runs: the body, its supports, loads, obstacles, cracks and cuts.

Shapes are drawn on a canvas, which is the SVG picture of a notebook or axes of matplotlib.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import Any, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.lattice.raster import FOLLOWER, Raster
from pbdkit.model.boundary_conditions import Load
from pbdkit.model.motions import Hold, Motion, Newton, Oscillation, Rotation
from pbdkit.scene.constants import signed_distance
from pbdkit.scene.obstacles import CIRCLES, HALF_PLANE, Barrier, Outline
from pbdkit.scene.scene import Scene
from pbdkit.scene.selection import spacing

ARROW_HEAD_PX = 7.0
"""Length of the head of an arrow in pixels."""


class Svg:
    """SVG picture of the region from the corner `low` to the corner `high`, with a `margin` around
    it. The width and the height are at most `limits`. Margin and limits are in pixels.

    The whole picture extends from `self.low` to `self.high`, with y upward. Shapes are drawn in the
    order in which they are added.
    """

    def __init__(
        self, low: Floats, high: Floats, limits: tuple[float, float], margin: float
    ) -> None:
        size = np.maximum(high - low, 1e-9 * max(1.0, *np.abs(high), *np.abs(low)))
        self.scale = float(((np.array(limits) - 2.0 * margin) / size).min())
        self.width, self.height = (float(s) for s in size * self.scale + 2.0 * margin)
        self._origin = np.array([margin - low[0] * self.scale, margin + high[1] * self.scale])
        self.low: Floats = self._origin * (-1.0, 1.0) / self.scale - (0.0, self.height / self.scale)
        self.high: Floats = self.low + np.array([self.width, self.height]) / self.scale
        self._shapes: list[str] = []

    def at(self, places: Floats) -> Floats:
        """Return the pixel coordinates of places, (..., axis)."""
        return np.asarray(self._origin + np.asarray(places) * (self.scale, -self.scale))

    def dots(
        self,
        places: Floats,
        size: float,
        colour: str,
        *,
        square: bool = False,
    ) -> None:
        """Draw dots of one size, in pixels. They are drawn as one path, because many elements would
        be slow."""
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in self.at(places))
        cap = "square" if square else "round"
        style = f'stroke="{colour}" stroke-width="{size:.2f}" stroke-linecap="{cap}"'
        self._add(f'<path d="{path}" {style}/>' if path else "")

    def line(self, places: Floats, colour: str, width: float, dashes: str = "") -> None:
        """Draw a polyline; `dashes` as in SVG."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in self.at(places))
        dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
        style = f'fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linecap="round"'
        self._add(f'<path d="{path}" {style}{dashed}/>')

    def filled(self, outlines: list[Floats], fill: str, edge: str, *, opacity: float = 1.0) -> None:
        """Fill the area between closed outlines: an inner one is a hole."""
        parts = ("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in self.at(o)) + "Z" for o in outlines)
        style = f'fill="{fill}" stroke="{edge}" fill-opacity="{opacity:g}" fill-rule="evenodd"'
        self._add(f'<path d="{"".join(parts)}" {style}/>')

    def arrow(self, tail: Floats, vector: Floats, colour: str) -> None:
        """Draw an arrow from a place, by a vector in pixels, y up."""
        (x, y), (dx, dy) = self.at(tail), (float(vector[0]), -float(vector[1]))
        length = math.hypot(dx, dy)
        if length < 1e-9:
            return
        ux, uy = dx / length, dy / length
        tip, neck = (x + dx, y + dy), max(length - ARROW_HEAD_PX, 0.0)
        a, b = (
            (
                tip[0] - ARROW_HEAD_PX * ux + s * 0.5 * ARROW_HEAD_PX * uy,
                tip[1] - ARROW_HEAD_PX * uy - s * 0.5 * ARROW_HEAD_PX * ux,
            )
            for s in (1.0, -1.0)
        )
        shaft = f"M{x:.1f} {y:.1f}L{x + neck * ux:.1f} {y + neck * uy:.1f}"
        head = "".join(f"{c}{p:.1f} {q:.1f}" for c, (p, q) in zip("MLL", (tip, a, b), strict=True))
        self._add(
            f'<path d="{shaft}" stroke="{colour}" stroke-width="1.6" fill="none"/>'
            f'<path d="{head}Z" fill="{colour}"/>'
        )

    def text(self, title: str) -> str:
        """Return the picture as an HTML element with a text for screen readers."""
        w, h = f"{self.width:.0f}", f"{self.height:.0f}"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}" height="{h}" '
            f'viewBox="0 0 {w} {h}" role="img" aria-label="{escape(title)}">'
            f'<rect width="{w}" height="{h}" fill="#FFFFFF"/>{"".join(self._shapes)}</svg>'
        )

    def _add(self, shape: str) -> None:
        self._shapes.append(shape)


def extreme(motion: Motion, reference: Floats, steps: int) -> Floats:
    """Return the largest displacement of a motion at the steps at which the motion changes, as an
    array of shape (particle or 1, axis). For a rotation, return the displacement in its first
    step."""
    if isinstance(motion, Rotation):
        return np.atleast_2d(motion.offset(1, reference))
    if isinstance(motion, Oscillation):
        return np.atleast_2d(motion.amplitude)
    if isinstance(motion, Newton):
        return np.atleast_2d(motion.velocity)
    moments = [n for n in (1, *motion.knots(), steps) if 1 <= n <= steps]
    vectors = [np.atleast_2d(motion.offset(n, reference)) for n in moments]
    return max(vectors, key=lambda vector: float(np.hypot(*vector.T).max()))


def greatest(force: Any) -> float:
    """Return a component of a force, or the largest value of its schedule."""
    values = getattr(force, "values", None)
    return float(max(values, key=abs)) if values is not None else float(force)


def force_of(load: Load) -> Floats:
    """Return the largest force of a load, (axis,). It is the total force, or the force per unit of
    area."""
    return np.array([greatest(f) for f in load.force or load.body_force or ()])


MAX_SIZE_PX = (480.0, 400.0)
"""Maximum width and height of the picture in pixels."""
MARGIN = 44.0
"""Margin around the body in pixels."""
MAX_ARROW_PX = 34.0
"""Length of the longest arrow in pixels."""
MIN_ARROW_PX = 14.0
"""Length of the shortest arrow in pixels."""
ARROW_SPACING_PX = 14.0
"""Distance between arrows in pixels."""
BODY_COLOUR = "#0072B2"
"""Colour of the body."""
BODY_FILL = "#E3EDF4"
"""Colour of the area of the body."""
OUTSIDE_COLOUR = "#99BFD9"
"""Colour of particles of the body that lie outside its outline, at corners of cut cells."""
REGION_OPACITY = 0.45
"""Opacity of the fill of a region."""
OUTLINE_COLOUR = "#5A87A8"
"""Colour of the edge of the body."""
FRAME_COLOUR = "#DCCB2E"
"""Colour of frame points."""
LEADER_COLOUR = "#D55E00"
"""Colour of moving leaders."""
HOLD_COLOUR = "#7A3300"
"""Colour of leaders that are held in place."""
LOAD_COLOUR = "#007A5A"
"""Colour of the arrows of loads."""
CRACK_COLOUR = "#C2185B"
"""Colour of cracks and cuts."""
OBSTACLE_COLOUR = "#9A9A9A"
"""Colour of the outlines of obstacles."""
OBSTACLE_ARROW_COLOUR = "#404040"
"""Colour of the arrows of moving obstacles."""
OUTSIDE = "body, outside the outline"
"""Meaning of the colour of particles outside the outline."""
REGION_COLOURS = ("#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#F0E442", "#0072B2")
"""Colours of the regions of a body."""
MAX_PARTICLES = 3000
"""Maximum number of particles up to which all particles of a body are drawn."""
OUTLINE_PX = 0.1
"""Distance in pixels by which a simplified outline may deviate from the true one."""
MAX_ARROWS = 5
"""Maximum number of arrows that are drawn for a group."""
OBSTACLE_MARGIN = 0.35
"""Margin for obstacles, relative to the size of the body."""
Rows = NDArray[np.intp]


SceneLegend = tuple[tuple[str, str], ...]
"""Meanings of colours: (colour, text)."""


class Canvas(Protocol):
    """Surface on which a scene is drawn. Places are in lattice units. Sizes and widths are in
    pixels; `scale` is the number of pixels in a lattice unit. The picture extends from the corner
    `low` to the corner `high`."""

    scale: float
    low: Floats
    high: Floats

    def dots(self, places: Floats, size: float, colour: str, *, square: bool = ...) -> None:
        """Draw dots of one size."""

    def line(self, places: Floats, colour: str, width: float, dashes: str = ...) -> None:
        """Draw a polyline through places."""

    def filled(self, outlines: list[Floats], fill: str, edge: str, *, opacity: float = ...) -> None:
        """Fill the area between closed outlines. The first contains the others, which are holes."""

    def arrow(self, tail: Floats, vector: Floats, colour: str) -> None:
        """Draw an arrow from a place, by a vector in pixels, y up."""


@dataclass(frozen=True)
class Picture:
    """SVG element, and the meanings of its colours as pairs (colour, text)."""

    svg: str
    legend: SceneLegend


def picture_of(scene: Scene) -> Picture | None:
    """Return the picture of a scene in the plane as SVG. Return None for a scene in space."""
    if scene.axes != 2:
        return None
    svg = Svg(*corners(scene), MAX_SIZE_PX, MARGIN)
    legend = draw_scene(scene, svg)
    return Picture(svg.text(f"the scene of {scene.experiment.name}"), legend)


def draw_scene(scene: Scene, canvas: Canvas) -> SceneLegend:
    """Draw a scene in the plane, and return the meanings of its colours. The lengths of arrows are
    proportional to displacements or forces, but have no relation to the size of the body."""
    drawing = _Drawing(scene, canvas)
    drawing.draw()
    return tuple(drawing.legend)


def corners(scene: Scene) -> tuple[Floats, Floats]:
    """Return the lower left and the upper right corner of the picture of a scene."""
    places = _shown(scene)
    return _with_obstacles(scene.barriers, places.min(axis=0), places.max(axis=0))


def _is_small(scene: Scene) -> bool:
    return int(np.count_nonzero(scene.raster.table_kind == FOLLOWER)) <= MAX_PARTICLES


def _shown(scene: Scene) -> Floats:
    """Return the particles to draw. These are body and frame if the body is small, otherwise only
    the body."""
    X = scene.raster.reference()
    return X if _is_small(scene) else X[scene.raster.table_kind == FOLLOWER]


class _Drawing:
    """State while one picture is drawn."""

    def __init__(self, scene: Scene, canvas: Canvas) -> None:
        self.scene, self.canvas, self.legend = scene, canvas, list[tuple[str, str]]()
        self.X = scene.raster.reference()
        self.body = scene.raster.table_kind == FOLLOWER
        self.area = scene.experiment.body.area()
        self.outside = np.zeros_like(self.body)
        if self.area is not None:
            outside = signed_distance(scene.experiment.body, scene.raster.cell, *self.X.T) > 0.0
            self.outside = self.body & outside
        self.few, places = _is_small(scene), _shown(scene)
        self.middle = (places.min(axis=0) + places.max(axis=0)) / 2
        self.dot = min(max(0.5 * spacing(scene.raster) * canvas.scale, 1.2), 7.0)

    def draw(self) -> None:
        """Draw from the lowest to the topmost layer."""
        self._areas()
        self._obstacles()
        if self.few:
            self._draw_named(self.X[~self.body], 0.6 * self.dot, FRAME_COLOUR, "frame")
            self._draw_named(self.X[self.outside], self.dot, OUTSIDE_COLOUR, OUTSIDE)
            self._draw_named(self.X[self.body & ~self.outside], self.dot, BODY_COLOUR, "body")
        elif self.area is None:
            edge = self.X[edge_of(self.scene.raster)]
            self._draw_named(edge, self.dot, OUTLINE_COLOUR, "edge of the body")
        self._cuts()
        self._leaders()
        self._loads()

    def _draw_named(self, places: Floats, size: float, colour: str, text: str) -> None:
        if len(places):
            self.canvas.dots(places, size, colour)
            self._note(colour, text)

    def _note(self, colour: str, text: str) -> None:
        if (colour, text) not in self.legend:
            self.legend.append((colour, text))

    def _areas(self) -> None:
        """Fill the body and its regions. A body without an outline has no area of its own, and its
        regions are cropped at its bounding box."""
        if self.area is not None:
            self._fill(self.area, BODY_FILL, OUTLINE_COLOUR)
            if not self.few:
                self._note(OUTLINE_COLOUR, "body")
        at, room = self.X[self.body], spacing(self.scene.raster) / 2
        whole = self.area or shapely.box(*at.min(axis=0) - room, *at.max(axis=0) + room)
        for n, (name, shape) in enumerate(self.scene.experiment.regions.items()):
            colour = REGION_COLOURS[n % len(REGION_COLOURS)]
            if (area := shape.area()) is not None:
                self._fill(area & whole, colour, colour, REGION_OPACITY)
            self._note(colour, f"region {name}")

    def _fill(self, area: shapely.Geometry, fill: str, edge: str, opacity: float = 1.0) -> None:
        """Fill each connected part of an area."""
        for part in shapely.get_parts(area.simplify(OUTLINE_PX / self.canvas.scale)):
            if part.geom_type == "Polygon":
                holes = (ring.coords[::-1] for ring in part.interiors)
                rings = [np.array(ring)[:, :2] for ring in (part.exterior.coords, *holes)]
                self.canvas.filled(rings, fill, edge, opacity=opacity)

    def _obstacles(self) -> None:
        for barrier in self.scene.barriers:
            self.canvas.filled(
                _outlines(barrier.start, self.canvas.low, self.canvas.high),
                "#E3E3E3",
                OBSTACLE_COLOUR,
            )
            self._note(OBSTACLE_COLOUR, "obstacle")

    def _cuts(self) -> None:
        experiment = self.scene.experiment
        for crack in getattr(experiment.fracture, "cracks", ()):
            self.canvas.line(np.array(crack), CRACK_COLOUR, 2.2)
            self._note(CRACK_COLOUR, "crack")
        for cut in experiment.cuts:
            self.canvas.line(np.array(cut.segment), CRACK_COLOUR, 2.2, "5 4" if cut.at else "")
            self._note(CRACK_COLOUR, f"cut at step {cut.at}" if cut.at else "cut")

    @property
    def _longest(self) -> float:
        """Longest displacement of a motion."""
        driven = self.scene.driven
        vectors = [
            extreme(d.group.motion, d.reference, self.scene.experiment.steps) for d in driven
        ]
        return max((float(np.hypot(*vector.T).max()) for vector in vectors), default=0.0)

    def _leaders(self) -> None:
        longest = self._longest
        for barrier in self.scene.barriers:
            vector = extreme(barrier.group.motion, barrier.reference, self.scene.experiment.steps)
            ring = np.concatenate(_outlines(barrier.start, self.canvas.low, self.canvas.high))
            nearest = ring[np.argmin(np.hypot(*(ring - self.middle).T))]
            self._arrows(
                nearest[None], vector.mean(axis=0, keepdims=True), longest, OBSTACLE_ARROW_COLOUR
            )
        for leading in self.scene.leading:
            motion, is_fixed = leading.group.motion, isinstance(leading.group.motion, Hold)
            colour = HOLD_COLOUR if is_fixed else LEADER_COLOUR
            text = "mass" if isinstance(motion, Newton) else "held" if is_fixed else "led"
            if leading.group.axes:
                text += f" along {' and '.join(leading.group.axes)}"
            self.canvas.dots(leading.reference, max(1.4 * self.dot, 3.0), colour, square=is_fixed)
            self._note(colour, text)
            vectors = np.zeros((len(leading.rows), 2)) + extreme(
                motion, leading.reference, self.scene.experiment.steps
            )
            free = [axis for axis in range(2) if axis not in leading.axes]
            vectors[:, free] = 0.0
            self._arrows(leading.reference, vectors, longest, colour)
            if isinstance(motion, Newton):
                force = np.array([greatest(f) for f in motion.force])
                self._arrows(
                    leading.reference, force + 0.0 * vectors, float(np.hypot(*force)), LOAD_COLOUR
                )

    def _loads(self) -> None:
        each = self.scene.loads.each if self.scene.loads else ()
        forces = [(loading, force_of(loading.load)) for loading in each]
        longest = max((float(np.hypot(*force)) for _, force in forces), default=0.0)
        for loading, force in forces:
            at = self.X[loading.rows]
            at = at.mean(axis=0, keepdims=True) if loading.load.body_force else at
            self._arrows(at, np.tile(force, (len(at), 1)), longest, LOAD_COLOUR)
            self._note(LOAD_COLOUR, "body force" if loading.load.body_force else "force")

    def _arrows(self, at: Floats, vectors: Floats, longest: float, colour: str) -> None:
        """Draw arrows at some of the places, or one arrow at their centre if they lie close
        together. An arrow starts at its place. If it would then point into the body, it ends at its
        place instead."""
        extent = float(np.ptp(at, axis=0).max()) * self.canvas.scale
        count = min(max(int(extent / ARROW_SPACING_PX), 1), MAX_ARROWS)
        selection = np.unique(np.linspace(0, len(at) - 1, count).round().astype(int))
        places = at[selection]
        if count == 1:
            selection, places = np.array([len(at) // 2]), at.mean(axis=0, keepdims=True)
        for place, vector in zip(places, vectors[selection], strict=True):
            pixels = _pixels(vector, longest)
            inwards = float((self.middle - place) @ vector) > 1e-9 * float(np.hypot(*vector))
            tail = place - pixels / self.canvas.scale if inwards else place
            self.canvas.arrow(tail, pixels, colour)


def _pixels(vector: Floats, longest: float) -> Floats:
    """Return the vector of an arrow for a displacement, in pixels. The longest arrow has a length
    of MAX_ARROW_PX. Without displacement the result is zero."""
    length = float(np.hypot(*vector))
    if length <= 1e-12 * longest or longest == 0.0:
        return np.zeros(2)
    return np.asarray(vector / length * max(MAX_ARROW_PX * length / longest, MIN_ARROW_PX))


def edge_of(raster: Raster) -> Rows:
    """Return the rows of those particles of the body that do not have all four neighbours in their
    sublattice."""
    places = []
    for kinds in raster.kind == FOLLOWER:
        around = np.pad(kinds, 1)
        inner = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
        places.append(kinds & ~inner)
    indices = np.nonzero(np.stack(places))
    rows = raster.rows_at(indices[0], *indices[1:])
    return np.asarray(rows)


def _with_obstacles(
    barriers: Iterable[Barrier], low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    """Extend the corners of the picture so that nearby obstacles are included."""
    room = OBSTACLE_MARGIN * float((high - low).max())
    for barrier in barriers:
        box = barrier.start.box
        low = np.minimum(low, np.maximum(box[:2], low - room))
        high = np.maximum(high, np.minimum(box[2:], high + room))
    return low, high


def _outlines(outline: Outline, low: Floats, high: Floats) -> list[Floats]:
    """Return closed outlines of an obstacle. A half-plane is cropped at the edge of the picture."""
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
