"""Obstacles on a lattice: where their outlines are at a step, which particles begin inside one, and
the distance and way out from a place.

`facing`, `way_out` and `clearance` are elementwise, and the same source runs on arrays and inside
kernels; `leave` and `way_between` treat single places in both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import Mask, Raster
from pbdkit.model.bodies import Disc, Polygon, Rectangle, Ring
from pbdkit.model.boundary_conditions import AnyShape, Facing, Obstacle
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Newton
from pbdkit.plugin import where
from pbdkit.plugin.frame import Indices
from pbdkit.scene.leaders import Leading

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating[Any]]
HALF_PLANE, CIRCLES, POLYGON = 0, 1, 2
NOTHING, LINE, SEGMENT, CIRCLE = 0, 1, 2, 3
"""Shapes of the faces of outlines."""
ROUNDING = 64 * float(np.finfo(float).eps)
"""Rounding of a gap, relative to coordinates and sizes of outlines."""
FLAT = 1e-12
"""Square of the sine of the angle below which two lines do not meet."""
TURNS = 8
"""Iterations of Newton's method for the nearest point of a circle."""
STRAIGHTEST, WIDEST = 0.1, 0.5
"""Smallest second derivative that serves these, relative to that of a straight face; largest turn
of the normal in one of them (radians)."""


class Face(NamedTuple):
    """A smooth part of an outline before some places: their distances, its normals there, (axis,
    place), and its curvature, positive where it bulges into free space."""

    distance: Floats
    normal: Floats
    curvature: float


class Walls(NamedTuple):
    """Outlines as arrays: the kind of each, all points one after the other, where those of each
    begin, and (inner, outer, size)."""

    kinds: NDArray[np.int64]
    points: Floats
    first: NDArray[np.int64]
    radii: Floats

    @classmethod
    def of(cls, outlines: Sequence[Outline]) -> Walls:
        """Those of some outlines."""
        points = [np.empty((0, 2)), *(outline.points for outline in outlines)]
        return cls(
            np.array([outline.kind for outline in outlines], np.int64),
            np.concatenate(points),
            np.cumsum([len(own) for own in points]),
            np.array([(o.inner, o.outer, o.size) for o in outlines]).reshape(-1, 3),
        )

    def clearance(self, x: Any, y: Any) -> Any:
        """`clearance` of some places."""
        return clearance(x, y, self.kinds, self.points, self.first, self.radii)

    def way_between(self, at: AnyFloats, C: AnyFloats, led: int) -> tuple[Any, Any]:
        """`way_between` of a particle."""
        (x, y), (xx, xy, yy) = at, C
        wx, wy = way_between(x, y, xx, xy, yy, led, self.kinds, self.points, self.first, self.radii)
        return wx, wy


@dataclass(frozen=True)
class Outline:
    """An outline by its `kind` and `points`, (point, axis): of a half-plane a point and another
    one unit along its normal, of circles the centre, of a polygon its vertices counter-clockwise.
    What lies between the radii `inner` and `outer` is inside of circles."""

    kind: int
    points: Floats
    inner: float = -math.inf
    outer: float = 0.0

    def shifted(self, by: Floats) -> Outline:
        """The same with its points elsewhere, by one vector each or for all."""
        return Outline(self.kind, self.points + by, self.inner, self.outer)

    @property
    def box(self) -> Floats:
        """(low x, low y, high x, high y) of the rectangle around it, as far as it ends."""
        if self.kind == HALF_PLANE:
            box = np.array([-math.inf, -math.inf, math.inf, math.inf])
            for axis, along in enumerate(self.points[1] - self.points[0]):
                if abs(along) == 1.0:
                    box[axis + (2 if along > 0.0 else 0)] = self.points[0, axis]
            return box
        low, high = self.points.min(axis=0) - self.outer, self.points.max(axis=0) + self.outer
        return np.array([*low, *high])

    @property
    def size(self) -> float:
        """The largest coordinate on it, as far as rounding goes."""
        return float(np.abs(self.points).max()) + self.outer

    def facing(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """`facing` of some places."""
        whole = 0, len(self.points)
        with np.errstate(all="ignore"):
            found = facing(x, y, self.kind, self.points, *whole, self.inner, self.outer)
        gap, nx, ny = (np.broadcast_to(value, x.shape) for value in found)
        return gap, nx, ny

    def way_out(self, at: AnyFloats, C: AnyFloats) -> AnyFloats:
        """`way_out` of some places (axis, place), with C (xx xy yy, place)."""
        whole = self.points, 0, len(self.points), self.inner, self.outer
        found = way_out(at[0], at[1], C[0], C[1], C[2], self.kind, *whole)
        return np.stack([np.broadcast_to(way, at[0].shape) for way in found])

    def faces(self, x: Floats, y: Floats) -> Iterator[Face]:
        """Its faces before some places: of a half-plane one, of circles each, of a polygon its
        edges."""
        if self.kind == HALF_PLANE:
            gap, nx, ny = self.facing(x, y)
            yield Face(np.abs(gap), np.stack([nx, ny]), 0.0)
        elif self.kind == CIRCLES:
            way = np.stack([x, y]) - self.points[0][:, None]
            r = np.hypot(*way)
            u = np.where(r > 0.0, way / np.where(r > 0.0, r, 1.0), np.array([[1.0], [0.0]]))
            yield Face(np.abs(r - self.outer), u, 1.0 / self.outer)
            if self.inner > 0.0:
                yield Face(np.abs(r - self.inner), -u, -1.0 / self.inner)
        else:
            at = np.stack([x, y])
            for a, b in zip(self.points, np.roll(self.points, -1, axis=0), strict=True):
                edge = b - a
                d = at - a[:, None]
                t = np.clip(edge @ d / (edge @ edge), 0.0, 1.0)
                normal = np.array([edge[1], -edge[0]]) / math.hypot(*edge)
                off = np.hypot(*(d - t * edge[:, None]))
                yield Face(off, np.repeat(normal[:, None], len(x), axis=1), 0.0)


def outline_of(shape: AnyShape) -> Outline:
    """The outline of an obstacle's shape."""
    if isinstance(shape, Facing):
        point, normal = (np.array(v) for v in (shape.half_plane.point, shape.half_plane.normal))
        return Outline(HALF_PLANE, np.stack([point, point + normal / math.hypot(*normal)]))
    if isinstance(shape, Disc):
        return Outline(CIRCLES, np.array([shape.centre]), -math.inf, shape.radius)
    if isinstance(shape, Ring):
        return Outline(CIRCLES, np.array([shape.centre]), shape.inner, shape.outer)
    if isinstance(shape, Rectangle):
        (x, y), w, h = shape.origin, shape.width, shape.height
        return Outline(POLYGON, np.array([(x, y), (x + w, y), (x + w, y + h), (x, y + h)]))
    assert isinstance(shape, Polygon)
    return Outline(POLYGON, _counter_clockwise(shape.vertices))


def _counter_clockwise(vertices: Sequence[tuple[float, float]]) -> Floats:
    points: Floats = np.array(vertices)
    ways = np.roll(points, -1, axis=0) - points
    points = points[ways.any(axis=1)]
    x, y = (points - points.mean(axis=0)).T
    doubled = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    return points if doubled > 0.0 else points[::-1].copy()


def facing(
    x: Any, y: Any, kind: Any, points: Any, first: Any, last: Any, inner: Any, outer: Any
) -> Any:
    """(gap, n_x, n_y) of places (x, y) before an outline whose points are those from `first` to
    `last`: the distance from it, negative inside, and the normal into free space where it is
    nearest."""
    if kind == HALF_PLANE:
        return _before_half_plane(x, y, points, first)
    if kind == CIRCLES:
        return _before_circles(x, y, points, first, inner, outer)
    return _before_polygon(x, y, points, first, last)


def way_out(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, kind: Any, points: Any, first: Any, last: Any,
    inner: Any, outer: Any,
) -> Any:  # fmt: skip
    """(w_x, w_y) from places inside an outline to the nearest point of it, in the metric S = C⁻¹ of
    particles with a compliance C = (xx, xy, yy): the way which a push along the normal n there
    makes, w ∥ C n. That is along n where C is a multiple of 1."""
    if kind == HALF_PLANE:
        gap, nx, ny = _before_half_plane(x, y, points, first)
        sx, sy = xx * nx + xy * ny, xy * nx + yy * ny
        over = sx * nx + sy * ny
        return -(gap * sx / over), -(gap * sy / over)
    if kind == CIRCLES:
        dx, dy = x - points[first, 0], y - points[first, 1]
        r = np.sqrt(dx * dx + dy * dy)
        return _to_circle(dx, dy, where(r - outer > inner - r, outer, inner), xx, xy, yy)
    nearest, wx, wy = math.inf, 0.0, 0.0
    for e in range(first, last):
        f = e + 1 if e + 1 < last else first
        ax, ay = points[e, 0], points[e, 1]
        vx, vy = _to_segment(
            ax - x, ay - y, points[f, 0] - ax, points[f, 1] - ay, xx, xy, yy, 0.0, 1.0
        )
        d = _square(vx, vy, xx, xy, yy)
        closer = d < nearest
        nearest = where(closer, d, nearest)
        wx, wy = where(closer, vx, wx), where(closer, vy, wy)
    return wx, wy


def clearance(x: Any, y: Any, kinds: Any, points: Any, first: Any, radii: Any) -> Any:
    """0 where places are in none of some outlines, else minus the depth in the deepest. `kinds`,
    `first` and `radii` (inner, outer, size) have a row an outline; `points` are those of all."""
    found = 0.0
    for w in range(len(kinds)):
        inner, outer = radii[w, 0], radii[w, 1]
        gap = facing(x, y, kinds[w], points, first[w], first[w + 1], inner, outer)[0]
        gap = gap + ROUNDING * (np.abs(x) + np.abs(y) + radii[w, 2])
        found = where(gap < found, gap, found)
    return found


def leave(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, led: Any,
    kinds: Any, points: Any, first: Any, radii: Any,
) -> Any:  # fmt: skip
    """(w_x, w_y) of one particle to the nearest place outside of all outlines, in its metric, zero
    where it is in none. By `led` it is free (0), led along x (1) or y (2), or along both (3)."""
    count, one = 0, 0
    for w in range(len(kinds)):
        inner, outer = radii[w, 0], radii[w, 1]
        gap = facing(x, y, kinds[w], points, first[w], first[w + 1], inner, outer)[0]
        if gap < 0.0:
            count, one = count + 1, w
    if count == 0 or led == 3:
        return 0.0, 0.0
    if count == 1 and led == 0:
        wx, wy = way_out(
            x, y, xx, xy, yy,
            kinds[one], points, first[one], first[one + 1], radii[one, 0], radii[one, 1],
        )  # fmt: skip
        if clearance(x + wx, y + wy, kinds, points, first, radii) >= 0.0:
            return wx, wy
    return way_between(x, y, xx, xy, yy, led, kinds, points, first, radii)


def way_between(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, led: Any,
    kinds: Any, points: Any, first: Any, radii: Any,
) -> Any:  # fmt: skip
    """The same of one particle that lies inside several outlines, or comes into another on its way
    out of one: the nearest of all points on faces, and where two faces meet, that are in none. Of
    a particle that is led along an axis those on the line along the other. Where none of them is
    free, that which is least deep; where there is none at all, it stays."""
    best, far, bx, by = -math.inf, math.inf, 0.0, 0.0
    for w in range(len(kinds)):
        for e in range(_faces(kinds[w], first[w], first[w + 1])):
            one = _face(x, y, kinds[w], points, first[w], first[w + 1], radii[w, 0], radii[w, 1], e)
            ends = _nearest_on(one, xx, xy, yy)
            if led > 0:
                line = (0.0, 0.0, 1.0 if led == 2 else 0.0, 1.0 if led == 1 else 0.0, LINE)
                ends = _meeting(line, one)
            for n in range(2):
                qx, qy = ends[2 * n], ends[2 * n + 1]
                free = clearance(x + qx, y + qy, kinds, points, first, radii)
                d = _square(qx, qy, xx, xy, yy)
                if d < math.inf and (free > best or (free == best and d < far)):
                    best, far, bx, by = free, d, qx, qy
            for v in range(w + 1, len(kinds) if led == 0 else 0):
                for f in range(_faces(kinds[v], first[v], first[v + 1])):
                    other = _face(
                        x, y, kinds[v], points, first[v], first[v + 1], radii[v, 0], radii[v, 1], f
                    )
                    ends = _meeting(one, other)
                    for n in range(2):
                        qx, qy = ends[2 * n], ends[2 * n + 1]
                        free = clearance(x + qx, y + qy, kinds, points, first, radii)
                        d = _square(qx, qy, xx, xy, yy)
                        if d < math.inf and (free > best or (free == best and d < far)):
                            best, far, bx, by = free, d, qx, qy
    return bx, by


def _faces(kind: Any, first: Any, last: Any) -> Any:
    """How many faces an outline has: lines, segments or circles."""
    if kind == HALF_PLANE:
        return 1
    return 2 if kind == CIRCLES else last - first


def _face(
    x: Any, y: Any, kind: Any, points: Any, first: Any, last: Any, inner: Any, outer: Any, e: Any
) -> Any:
    """(a, b, c, d, shape) of the e-th face, from (x, y): a point and a way, or the centre and the
    radius of a circle."""
    if kind == HALF_PLANE:
        px, py = points[first, 0], points[first, 1]
        return px - x, py - y, py - points[first + 1, 1], points[first + 1, 0] - px, LINE
    if kind == CIRCLES:
        radius = outer if e == 0 else inner
        shape = CIRCLE if radius > 0.0 else NOTHING
        return points[first, 0] - x, points[first, 1] - y, radius, 0.0, shape
    at, to = first + e, first + e + 1 if first + e + 1 < last else first
    ax, ay = points[at, 0], points[at, 1]
    return ax - x, ay - y, points[to, 0] - ax, points[to, 1] - ay, SEGMENT


def _nearest_on(face: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """The ways to the nearest point of a face, twice; NaN where it has none."""
    a, b, c, d, shape = face
    wx, wy = math.nan, math.nan
    if shape == CIRCLE:
        wx, wy = _to_circle(-a, -b, c, xx, xy, yy)
    elif shape == SEGMENT:
        wx, wy = _to_segment(a, b, c, d, xx, xy, yy, 0.0, 1.0)
    elif shape == LINE:
        wx, wy = _to_segment(a, b, c, d, xx, xy, yy, -math.inf, math.inf)
    return wx, wy, wx, wy


def _meeting(one: Any, other: Any) -> Any:
    """The ways to the two points at most in which two faces meet; NaN where they do not."""
    a, b, c, d, shape = one
    p, q, r, s, like = other
    if shape == NOTHING or like == NOTHING:
        return math.nan, math.nan, math.nan, math.nan
    if shape != CIRCLE and like != CIRCLE:
        across, ux, uy = c * s - d * r, p - a, q - b
        if across * across <= FLAT * ((c * c + d * d) * (r * r + s * s)):
            return math.nan, math.nan, math.nan, math.nan
        t, k = (ux * s - uy * r) / across, (ux * d - uy * c) / across
        if _is_off(t, shape) or _is_off(k, like):
            return math.nan, math.nan, math.nan, math.nan
        return a + t * c, b + t * d, a + t * c, b + t * d
    if shape == CIRCLE and like == CIRCLE:  # on the line through both points
        ux, uy = p - a, q - b
        squared = ux * ux + uy * uy
        if squared == 0.0:
            return math.nan, math.nan, math.nan, math.nan
        t = (squared + c * c - r * r) / (2.0 * squared)
        p, q, r, s, like = a + t * ux, b + t * uy, -uy, ux, LINE
    elif like == CIRCLE:
        a, b, c, d, shape, p, q, r, s, like = p, q, r, s, like, a, b, c, d, shape
    ux, uy = p - a, q - b
    squared, half, power = r * r + s * s, ux * r + uy * s, ux * ux + uy * uy - c * c
    root = half * half - squared * power
    if root < 0.0:
        return math.nan, math.nan, math.nan, math.nan
    root = np.sqrt(root)
    t, k = (-half - root) / squared, (root - half) / squared
    t, k = math.nan if _is_off(t, like) else t, math.nan if _is_off(k, like) else k
    return p + t * r, q + t * s, p + k * r, q + k * s


def _is_off(t: Any, shape: Any) -> Any:
    """Whether a point lies beyond the ends of a segment, by its share of the way."""
    return shape == SEGMENT and (t < -ROUNDING or t > 1.0 + ROUNDING)


def _square(wx: Any, wy: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """w·S w times det C."""
    return yy * wx * wx - 2.0 * xy * wx * wy + xx * wy * wy


def _to_segment(
    a: Any, b: Any, c: Any, d: Any, xx: Any, xy: Any, yy: Any, least: Any, most: Any
) -> Any:
    """The way to the nearest point of those that lie `least` to `most` of (c, d) from (a, b)."""
    sx, sy = yy * c - xy * d, xx * d - xy * c
    t = -(a * sx + b * sy) / (c * sx + d * sy)
    t = where(t < least, least, where(t > most, most, t))
    return a + t * c, b + t * d


def _to_circle(dx: Any, dy: Any, radius: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """The way to the nearest point of a circle from the place (dx, dy) from its centre: by Newton's
    method for the angle of its normal (u_x, u_y), a fixed number of times, so that single numbers
    and arrays go through the same operations."""
    r = np.sqrt(dx * dx + dy * dy)
    off = r > 0.0
    over = where(off, r, 1.0)
    ux, uy = where(off, dx / over, 1.0), where(off, dy / over, 0.0)
    for _ in range(TURNS):
        wx, wy = radius * ux - dx, radius * uy - dy
        sx, sy = yy * wx - xy * wy, xx * wy - xy * wx
        stiff = radius * (xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy)
        bend = stiff - (ux * sx + uy * sy)
        turn = (uy * sx - ux * sy) / where(bend > STRAIGHTEST * stiff, bend, stiff)
        turn = where(turn > WIDEST, WIDEST, where(turn < -WIDEST, -WIDEST, turn))
        ux, uy = ux - turn * uy, uy + turn * ux
        size = np.sqrt(ux * ux + uy * uy)
        ux, uy = ux / size, uy / size
    return radius * ux - dx, radius * uy - dy


def _before_half_plane(x: Any, y: Any, points: Any, first: Any) -> Any:
    px, py = points[first, 0], points[first, 1]
    nx, ny = points[first + 1, 0] - px, points[first + 1, 1] - py
    return (x - px) * nx + (y - py) * ny, nx, ny


def _before_circles(x: Any, y: Any, points: Any, first: Any, inner: Any, outer: Any) -> Any:
    dx, dy = x - points[first, 0], y - points[first, 1]
    r = np.sqrt(dx * dx + dy * dy)
    off = r > 0.0
    over = where(off, r, 1.0)
    ux, uy = where(off, dx / over, 1.0), where(off, dy / over, 0.0)
    out = r - outer > inner - r
    gap, sign = where(out, r - outer, inner - r), where(out, 1.0, -1.0)
    return gap, sign * ux, sign * uy


def _before_polygon(x: Any, y: Any, points: Any, first: Any, last: Any) -> Any:
    inside, corner, nearest = False, False, math.inf
    wx, wy, mx, my, level = 0.0, 0.0, 1.0, 0.0, 0.0
    for e in range(first, last):
        f = e + 1 if e + 1 < last else first
        ax, ay = points[e, 0], points[e, 1]
        ex, ey = points[f, 0] - ax, points[f, 1] - ay
        dx, dy = x - ax, y - ay
        rises = ey if ey != 0.0 else 1.0
        inside = inside != (((ay > y) != (points[f, 1] > y)) & (dx < ex * dy / rises))
        squared = ex * ex + ey * ey
        t = (dx * ex + dy * ey) / squared
        t = where(t < 0.0, 0.0, where(t > 1.0, 1.0, t))
        qx, qy = dx - t * ex, dy - t * ey
        d = qx * qx + qy * qy
        closer, size = d < nearest, np.sqrt(squared)
        nearest = where(closer, d, nearest)
        wx, wy = where(closer, qx, wx), where(closer, qy, wy)
        mx, my = where(closer, ey / size, mx), where(closer, -ex / size, my)
        level = where(closer, (dx * ey - dy * ex) / size, level)
        corner = where(closer, (t <= 0.0) | (t >= 1.0), corner)
    distance = np.sqrt(nearest)
    tip, sign = corner & (distance > 0.0), where(inside, -1.0, 1.0)
    over = where(tip, distance, 1.0)
    gap = where(tip, sign * distance, level)
    nx, ny = where(tip, sign * wx / over, mx), where(tip, sign * wy / over, my)
    return gap, nx, ny


SLACK = 1e-9
"""Of a lattice constant: so far inside a particle may begin, as one on the outline does."""


@dataclass(frozen=True)
class Barrier:
    """An obstacle with the outline that it starts with, in coordinates; `origin` is where the
    lattice's site (0, 0) lies."""

    group: Obstacle
    start: Outline
    origin: Floats

    @property
    def reference(self) -> Floats:
        """The points that its motion moves, (point, axis)."""
        return self.start.points

    def offset(self, n: float) -> Floats:
        """Of the motion, (point or 1, axis)."""
        return np.atleast_2d(self.group.motion.offset(n, self.reference))

    def at(self, moment: float) -> Outline | None:
        """The outline at the end of a step, or at a moment within it, from the lattice's site
        (0, 0); None where the obstacle is not there then."""
        if not self.group.leads(math.ceil(moment)):
            return None
        offset = self.group.motion.offset(moment - self.group.from_ + 1, self.reference)
        return self.start.shifted(offset - self.origin)


def outlines_at(barriers: Sequence[Barrier], moment: float) -> list[tuple[int, Outline]]:
    """Those that are there, with their place among the experiment's obstacles."""
    found = ((n, barrier.at(moment)) for n, barrier in enumerate(barriers))
    return [(n, outline) for n, outline in found if outline is not None]


def build_obstacles(raster: Raster, experiment: Experiment) -> tuple[Barrier, ...]:
    """Every obstacle with its outline.

    Raises ExperimentError in space, for motions that leave the finite numbers, and where a body
    at rest begins inside an obstacle.
    """
    if not experiment.obstacles:
        return ()
    if len(raster.lattice.cell().vectors) != 2:
        raise ExperimentError("obstacles lie in a plane, and the lattice does not", ("obstacles",))
    origin, found = np.array(raster.lattice.origin, float), list[Barrier]()
    for n, obstacle in enumerate(experiment.obstacles):
        barrier = Barrier(obstacle, outline_of(obstacle.shape), origin)
        _refuse_infinite(barrier, experiment.steps, n)
        if obstacle.from_ == 1 and experiment.initial.at_rest:
            _refuse_body_inside(raster, barrier.start, n)
        found.append(barrier)
    return tuple(found)


def _refuse_infinite(barrier: Barrier, steps: int, n: int) -> None:
    group = barrier.group
    last = group.last(steps) - group.from_ + 1
    for k in sorted({1, last, *(k for k in group.motion.knots() if k <= last)}):
        with np.errstate(all="ignore"):  # that it overflows is said below
            finite = k < 1 or np.isfinite(group.motion.offset(k, barrier.reference)).all()
        if not finite:
            where = ("obstacles", n, "motion")
            raise ExperimentError(f"leaves the finite numbers at its step {k}", where)


def _refuse_body_inside(raster: Raster, outline: Outline, n: int) -> None:
    rows = raster.body_rows
    gap = outline.facing(*raster.reference(rows).T)[0]
    if gap.min() < -SLACK * math.hypot(*raster.lattice.cell().vectors[0]):
        worst = int(np.argmin(gap))
        x, y = raster.reference(rows[worst : worst + 1])[0]
        raise ExperimentError(
            f"particle {rows[worst] + 1} at ({x:.6g}, {y:.6g}) begins {-gap[worst]:.3g} inside of "
            "it; let the obstacle begin outside the body and move there, or begin at a later step",
            ("obstacles", n, "shape"),
        )


def collisions(
    raster: Raster, leading: Sequence[Leading], barriers: Sequence[Barrier], steps: int
) -> list[str]:
    """Warnings about leaders that are driven into an obstacle, which does not touch them: as they
    stand where motions change, from rest. Those that move by Newton's law are stopped; guided ones
    may make way along the axis along which they follow."""
    slack = SLACK * math.hypot(*raster.lattice.cell().vectors[0])
    found = []
    for k, led in enumerate(leading):
        if isinstance(led.group.motion, Newton):
            continue
        for n, barrier in enumerate(barriers):
            for step in _moments(led, barrier, steps):
                at = led.reference + led.group.motion.offset(
                    step - led.group.from_ + 1, led.reference
                )
                outline = barrier.at(step)
                assert outline
                places = (at - barrier.origin).T
                gap = outline.facing(*places)[0]
                if len(led.axes) < len(places):
                    gap = np.where(_makes_way(outline, places, led.axes[0]), np.inf, gap)
                own = np.array([gap.min(initial=np.inf)])
                deepest = float(raster.communicator.smallest(own)[0])
                if deepest < -slack:
                    number = raster.communicator.first(_number(raster, led.rows, gap == deepest))
                    found.append(
                        f"leaders.{k}: drives particle {number} into obstacles.{n} by step {step}; "
                        "obstacles stop followers, not leaders"
                    )
                    break
    return found


def _makes_way(outline: Outline, places: Floats, axis: int) -> Mask:
    """Which places (axis, place) are in free space somewhere along the other axis."""
    walls, found = Walls.of([outline]), np.zeros(places.shape[1], bool)
    with np.errstate(all="ignore"):
        for k, at in enumerate(places.T):
            x, y = at + walls.way_between(at, np.array([1.0, 0.0, 1.0]), axis + 1)
            found[k] = walls.clearance(x, y) >= 0.0
    return found


def _moments(led: Leading, barrier: Barrier, steps: int) -> Iterator[int]:
    """The steps in which both are there, at their ends and where a motion changes."""
    groups = led.group, barrier.group
    begin = max(group.from_ for group in groups)
    end = min(group.last(steps) for group in groups)
    knots = (group.from_ - 1 + k for group in groups for k in group.motion.knots())
    yield from sorted({step for step in (begin, end, *knots) if begin <= step <= end})


def _number(raster: Raster, rows: Indices, those: Mask) -> int | None:
    """That of the first of those, if there is any."""
    return raster.before + int(rows[np.argmax(those)]) + 1 if those.any() else None
