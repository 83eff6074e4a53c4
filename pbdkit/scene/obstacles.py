"""Obstacles on a lattice: their outlines at a moment, and the shortest displacement that moves a
particle out of them.

`facing`, `outline_correction` and `clearance` are elementwise: the same source is evaluated on
arrays and inside kernels. `contact_correction` and `overlap_correction` are evaluated for one
particle at a time, by numpy and in kernels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import Raster
from pbdkit.model.bodies import Disc, Polygon, Rectangle, Ring
from pbdkit.model.boundary_conditions import AnyShape, Facing, Obstacle
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Newton
from pbdkit.plugin import where
from pbdkit.scene.leader_groups import Leading

HALF_PLANE = 0
"""Kind of the outline of a half-plane."""
CIRCLES = 1
"""Kind of an outline of one or two concentric circles."""
POLYGON = 2
"""Kind of the outline of a polygon."""
NOTHING = 0
"""Shape code of a missing face."""
LINE = 1
"""Shape of a face that is a line."""
SEGMENT = 2
"""Shape of a face that is a segment."""
CIRCLE = 3
"""Shape of a face that is a circle."""
ROUNDING = 64 * float(np.finfo(float).eps)
"""Rounding error of the distance between a particle and an outline, relative to the coordinates and
to the size of the outline."""
FLAT = 1e-12
"""Two lines count as parallel if the squared sine of their angle is smaller than this number."""
TURNS = 8
"""Number of iterations of Newton's method for the nearest point of a circle."""
STRAIGHTEST = 0.1
"""Lower bound on the second derivative in the iterations of Newton's method, relative to its value
for a straight face."""
WIDEST = 0.5
"""Upper bound on the rotation of the normal, in radians, in an iteration of Newton's method."""


class Face(NamedTuple):
    """Smooth part of an outline, described by its distance and direction from given places.

    Parameters
    ----------
    distance
        Distance of each place from the face, (place,).
    normal
        Outward normal at the nearest point, (axis, place).
    curvature
        Curvature, positive if the face is convex.
    """

    distance: Floats
    normal: Floats
    curvature: float


class Walls(NamedTuple):
    """Outlines as arrays.

    Parameters
    ----------
    kinds
        Kind of each outline.
    points
        Points of all outlines, (point, axis).
    first
        Index of the first point of each outline, and the number of points.
    radii
        Inner radius, outer radius and size of each outline, (outline, 3).
    """

    kinds: NDArray[np.int64]
    points: Floats
    first: NDArray[np.int64]
    radii: Floats

    @classmethod
    def of(cls, outlines: Sequence[Outline]) -> Walls:
        """Create the walls of outlines."""
        points = [np.empty((0, 2)), *(outline.points for outline in outlines)]
        return cls(
            np.array([outline.kind for outline in outlines], np.int64),
            np.concatenate(points),
            np.cumsum([len(part) for part in points]),
            np.array([(o.inner, o.outer, o.size) for o in outlines]).reshape(-1, 3),
        )

    def clearance(self, x: Any, y: Any) -> Any:
        """Evaluate `clearance` at places."""
        return clearance(x, y, self.kinds, self.points, self.first, self.radii)

    def overlap_correction(self, at: Floats, C: Floats, code: int) -> tuple[Any, Any]:
        """Evaluate `overlap_correction` for a particle."""
        (x, y), (xx, xy, yy) = at, C
        arrays = self.kinds, self.points, self.first, self.radii
        wx, wy = overlap_correction(x, y, xx, xy, yy, code, *arrays)
        return wx, wy


@dataclass(frozen=True)
class Outline:
    """Outline of an obstacle.

    Parameters
    ----------
    kind
        HALF_PLANE, CIRCLES or POLYGON.
    points
        Points, (point, axis). For a half-plane these are a point on its border and that point plus
        the unit normal. For circles, it is the centre. For a polygon these are the vertices,
        counterclockwise.
    inner, outer
        Radii of circles; the obstacle lies between them.
    """

    kind: int
    points: Floats
    inner: float = -math.inf
    outer: float = 0.0

    def shifted(self, by: Floats) -> Outline:
        """Return the outline with shifted points. All points are shifted by the same vector, or
        each point by a vector of its own."""
        return Outline(self.kind, self.points + by, self.inner, self.outer)

    @property
    def box(self) -> Floats:
        """Bounding box (low x, low y, high x, high y), infinite where the outline is unbounded."""
        if self.kind == HALF_PLANE:
            box = np.array([-math.inf, -math.inf, math.inf, math.inf])
            for axis, component in enumerate(self.points[1] - self.points[0]):
                if abs(component) == 1.0:
                    box[axis + (2 if component > 0.0 else 0)] = self.points[0, axis]
            return box
        low, high = self.points.min(axis=0) - self.outer, self.points.max(axis=0) + self.outer
        return np.array([*low, *high])

    @property
    def size(self) -> float:
        """Largest coordinate on the outline, for estimates of rounding errors."""
        return float(np.abs(self.points).max()) + self.outer

    def facing(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Evaluate `facing` at places."""
        whole = 0, len(self.points)
        with np.errstate(all="ignore"):
            result = facing(x, y, self.kind, self.points, *whole, self.inner, self.outer)
        gap, nx, ny = (np.broadcast_to(value, x.shape) for value in result)
        return gap, nx, ny

    def outline_correction(self, at: Floats, C: Floats) -> Floats:
        """Call the function `outline_correction` with the data of this outline. `at` has the shape
        (axis, place), and the compliance C has the shape (xx xy yy, place)."""
        whole = self.points, 0, len(self.points), self.inner, self.outer
        result = outline_correction(at[0], at[1], C[0], C[1], C[2], self.kind, *whole)
        return np.stack([np.broadcast_to(component, at[0].shape) for component in result])

    def faces(self, x: Floats, y: Floats) -> Iterator[Face]:
        """Generate the faces of the outline, with the distances and normals at given places.

        A half-plane has one face, each circle is one face, and a polygon has a face for each edge.
        """
        if self.kind == HALF_PLANE:
            gap, nx, ny = self.facing(x, y)
            yield Face(np.abs(gap), np.stack([nx, ny]), 0.0)
        elif self.kind == CIRCLES:
            offset = np.stack([x, y]) - self.points[0][:, None]
            r = np.hypot(*offset)
            u = np.where(r > 0.0, offset / np.where(r > 0.0, r, 1.0), np.array([[1.0], [0.0]]))
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
    """Return the outline of the shape of an obstacle."""
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
    edges = np.roll(points, -1, axis=0) - points
    points = points[edges.any(axis=1)]
    x, y = (points - points.mean(axis=0)).T
    doubled = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    return points if doubled > 0.0 else points[::-1].copy()


def facing(
    x: Any, y: Any, kind: Any, points: Any, first: Any, last: Any, inner: Any, outer: Any
) -> Any:
    """Return the signed distance of places from an outline, and the normal of the outline at the
    nearest point.

    Parameters
    ----------
    x, y
        Coordinates of the places.
    kind
        Kind of the outline.
    points
        Points of outlines, (point, axis).
    first, last
        Indices of the first point of the outline, and of the end of its points.
    inner, outer
        Radii of the outline.

    Returns
    -------
    tuple
        Signed distance, negative inside, and the components of the normal, which points outward.
    """
    if kind == HALF_PLANE:
        return _before_half_plane(x, y, points, first)
    if kind == CIRCLES:
        return _before_circles(x, y, points, first, inner, outer)
    return _before_polygon(x, y, points, first, last)


def outline_correction(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, kind: Any, points: Any, first: Any, last: Any,
    inner: Any, outer: Any,
) -> Any:  # fmt: skip
    """Return the displacement from places inside an outline to its nearest point.

    Distances are measured in the metric S = C⁻¹ of particles with the compliance C = (xx, xy, yy).
    The displacement w has the direction of C n, as a displacement that is caused by a force along
    the normal n. If C is a multiple of the identity, w is parallel to n. The parameters are those
    of `facing`.
    """
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
    """Return 0 at places outside all outlines, and the negative depth at places inside. If outlines
    overlap, the largest depth is used.

    `kinds`, `first` and `radii` (inner, outer, size) have a row for each outline. `points` are the
    points of all outlines.
    """
    depth = 0.0
    for w in range(len(kinds)):
        inner, outer = radii[w, 0], radii[w, 1]
        gap = facing(x, y, kinds[w], points, first[w], first[w + 1], inner, outer)[0]
        gap = gap + ROUNDING * (np.abs(x) + np.abs(y) + radii[w, 2])
        depth = where(gap < depth, gap, depth)
    return depth


def contact_correction(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, code: Any,
    kinds: Any, points: Any, first: Any, radii: Any,
) -> Any:  # fmt: skip
    """Return the displacement of one particle to the nearest place outside all outlines.

    The displacement is (w_x, w_y); it is zero if the particle is outside. The nearest place is
    determined in the metric of the particle. `code` is 0 for a particle that is free along both
    axes, 1 if it is led along x only, 2 if it is led along y only, and 3 if it is led along both.
    """
    count, n = 0, 0
    for w in range(len(kinds)):
        inner, outer = radii[w, 0], radii[w, 1]
        gap = facing(x, y, kinds[w], points, first[w], first[w + 1], inner, outer)[0]
        if gap < 0.0:
            count, n = count + 1, w
    if count == 0 or code == 3:
        return 0.0, 0.0
    if count == 1 and code == 0:
        wx, wy = outline_correction(
            x, y, xx, xy, yy,
            kinds[n], points, first[n], first[n + 1], radii[n, 0], radii[n, 1],
        )  # fmt: skip
        if clearance(x + wx, y + wy, kinds, points, first, radii) >= 0.0:
            return wx, wy
    return overlap_correction(x, y, xx, xy, yy, code, kinds, points, first, radii)


def overlap_correction(
    x: Any, y: Any, xx: Any, xy: Any, yy: Any, code: Any,
    kinds: Any, points: Any, first: Any, radii: Any,
) -> Any:  # fmt: skip
    """Return the displacement of one particle inside several outlines to a place outside all of
    them.

    Candidates for the place are the nearest points of faces and the points where two faces meet.
    For a particle that is led along one axis, they are the points at which its line along the free
    axis crosses faces. The nearest candidate outside all outlines is chosen. If all candidates are
    inside some outline, the one with the smallest depth is chosen. If there is no candidate, the
    displacement is zero.
    """
    best, far, bx, by = -math.inf, math.inf, 0.0, 0.0
    for w in range(len(kinds)):
        for e in range(_faces(kinds[w], first[w], first[w + 1])):
            face = _face(
                x, y, kinds[w], points, first[w], first[w + 1], radii[w, 0], radii[w, 1], e
            )
            ends = _nearest_on(face, xx, xy, yy)
            if code > 0:
                line = (0.0, 0.0, 1.0 if code == 2 else 0.0, 1.0 if code == 1 else 0.0, LINE)
                ends = _meeting(line, face)
            for n in range(2):
                qx, qy = ends[2 * n], ends[2 * n + 1]
                free = clearance(x + qx, y + qy, kinds, points, first, radii)
                d = _square(qx, qy, xx, xy, yy)
                if d < math.inf and (free > best or (free == best and d < far)):
                    best, far, bx, by = free, d, qx, qy
            for v in range(w + 1, len(kinds) if code == 0 else 0):
                for f in range(_faces(kinds[v], first[v], first[v + 1])):
                    other = _face(
                        x, y, kinds[v], points, first[v], first[v + 1], radii[v, 0], radii[v, 1], f
                    )
                    ends = _meeting(face, other)
                    for n in range(2):
                        qx, qy = ends[2 * n], ends[2 * n + 1]
                        free = clearance(x + qx, y + qy, kinds, points, first, radii)
                        d = _square(qx, qy, xx, xy, yy)
                        if d < math.inf and (free > best or (free == best and d < far)):
                            best, far, bx, by = free, d, qx, qy
    return bx, by


def _faces(kind: Any, first: Any, last: Any) -> Any:
    """Return the number of faces of an outline."""
    if kind == HALF_PLANE:
        return 1
    return 2 if kind == CIRCLES else last - first


def _face(
    x: Any, y: Any, kind: Any, points: Any, first: Any, last: Any, inner: Any, outer: Any, e: Any
) -> Any:
    """Return the e-th face of an outline relative to (x, y), as (a, b, c, d, shape).

    For a line or a segment, (a, b) is a point and (c, d) a direction. For a circle (a, b) is the
    centre and c the radius.
    """
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
    """Return the displacements to the nearest points of a face. There are at most two such points;
    the displacement to a missing one is NaN."""
    a, b, c, d, shape = face
    wx, wy = math.nan, math.nan
    if shape == CIRCLE:
        wx, wy = _to_circle(-a, -b, c, xx, xy, yy)
    elif shape == SEGMENT:
        wx, wy = _to_segment(a, b, c, d, xx, xy, yy, 0.0, 1.0)
    elif shape == LINE:
        wx, wy = _to_segment(a, b, c, d, xx, xy, yy, -math.inf, math.inf)
    return wx, wy, wx, wy


def _meeting(face: Any, other: Any) -> Any:
    """Return the displacements to the points where two faces meet. There are at most two such
    points; the displacement to a missing one is NaN."""
    a, b, c, d, shape = face
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
    if shape == CIRCLE and like == CIRCLE:  # Both intersections of circles lie on this line.
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
    """Return whether a point of a line lies beyond the ends of a segment. The point is given by its
    distance from the first end, as a fraction t of the segment.
    """
    return shape == SEGMENT and (t < -ROUNDING or t > 1.0 + ROUNDING)


def _square(wx: Any, wy: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """Return w·S w multiplied by det C."""
    return yy * wx * wx - 2.0 * xy * wx * wy + xx * wy * wy


def _to_segment(
    a: Any, b: Any, c: Any, d: Any, xx: Any, xy: Any, yy: Any, low: Any, high: Any
) -> Any:
    """Return the displacement to the nearest point of the segment (a, b) + t (c, d) with t in [low,
    high]."""
    sx, sy = yy * c - xy * d, xx * d - xy * c
    t = -(a * sx + b * sy) / (c * sx + d * sy)
    t = where(t < low, low, where(t > high, high, t))
    return a + t * c, b + t * d


def _to_circle(dx: Any, dy: Any, radius: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """Return the displacement to the nearest point of a circle from (dx, dy) relative to its
    centre.

    The angle of the normal (u_x, u_y) is computed by Newton's method. The number of iterations is
    fixed, so that the operations are the same for numbers and arrays.
    """
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
"""Depth inside an outline, relative to the lattice constant, up to which a particle counts as
outside at the start."""


@dataclass(frozen=True)
class Barrier:
    """Obstacle of a scene.

    Parameters
    ----------
    group
        The obstacle in the experiment.
    start
        Outline at the start, in the coordinates of the experiment.
    origin
        Position of site (0, 0) of the lattice.
    spacing
        Lattice constant.
    """

    group: Obstacle
    start: Outline
    origin: Floats
    spacing: float

    @property
    def reference(self) -> Floats:
        """Points of the outline at the start, (point, axis).

        The second point of a half-plane is one lattice constant away from the first.
        """
        points = self.start.points
        if self.start.kind == HALF_PLANE:
            return np.stack([points[0], points[0] + self.spacing * (points[1] - points[0])])
        return points

    def offset(self, n: float) -> Floats:
        """Return the displacement of the motion, (point or 1, axis)."""
        return np.atleast_2d(self.group.motion.offset(n, self.reference))

    def at(self, moment: float) -> Outline | None:
        """Return the outline at the end of a step, or at a moment within it.

        Coordinates are relative to site (0, 0) of the lattice. Returns None if the obstacle does
        not exist at that moment.
        """
        if not self.group.leads(math.ceil(moment)):
            return None
        offset = self.group.motion.offset(moment - self.group.from_ + 1, self.start.points)
        return self.start.shifted(offset - self.origin)


def outlines_at(barriers: Sequence[Barrier], moment: float) -> list[tuple[int, Outline]]:
    """Return the outlines at a moment, with the indices of their obstacles in the experiment."""
    outlines = ((n, barrier.at(moment)) for n, barrier in enumerate(barriers))
    return [(n, outline) for n, outline in outlines if outline is not None]


def build_obstacles(raster: Raster, experiment: Experiment) -> tuple[Barrier, ...]:
    """Create the obstacles of an experiment.

    Raises
    ------
    ExperimentError
        If the lattice is not plane, a motion is not finite, or a body at rest overlaps an obstacle.
    """
    if not experiment.obstacles:
        return ()
    if len(raster.cell.vectors) != 2:
        raise ExperimentError(
            "obstacles require a plane lattice; remove them, or use a plane lattice",
            ("obstacles",),
        )
    origin, barriers = np.array(raster.lattice.origin, float), list[Barrier]()
    spacing = math.hypot(*raster.cell.vectors[0])
    for n, obstacle in enumerate(experiment.obstacles):
        barrier = Barrier(obstacle, outline_of(obstacle.shape), origin, spacing)
        _refuse_infinite(barrier, experiment.steps, n)
        if obstacle.from_ == 1 and experiment.initial.at_rest:
            _refuse_body_inside(raster, barrier.start, n)
        barriers.append(barrier)
    return tuple(barriers)


def _refuse_infinite(barrier: Barrier, steps: int, n: int) -> None:
    group = barrier.group
    last = group.last(steps) - group.from_ + 1
    for k in sorted({1, last, *(k for k in group.motion.knots() if k <= last)}):
        with np.errstate(all="ignore"):  # Overflow is reported below.
            finite = k < 1 or np.isfinite(group.motion.offset(k, barrier.reference)).all()
        if not finite:
            raise ExperimentError(
                f"the displacement at step {k} of the motion is not finite; reduce it",
                ("obstacles", n, "motion"),
            )


def _refuse_body_inside(raster: Raster, outline: Outline, n: int) -> None:
    rows = raster.body_rows
    gap = outline.facing(*raster.reference(rows).T)[0]
    if gap.min() < -SLACK * math.hypot(*raster.cell.vectors[0]):
        worst = int(np.argmin(gap))
        x, y = raster.reference(rows[worst : worst + 1])[0]
        raise ExperimentError(
            f"particle {rows[worst] + 1} at ({x:.6g}, {y:.6g}) starts at a depth of "
            f"{-gap[worst]:.3g} lattice units inside it; start the obstacle outside the body and "
            "move it there, or start it at a later step",
            ("obstacles", n, "shape"),
        )


def collisions(
    raster: Raster, leading: Sequence[Leading], barriers: Sequence[Barrier], steps: int
) -> list[str]:
    """Return a warning for each leader group that moves into an obstacle.

    The warning is issued because obstacles do not act on leaders. Positions are compared at the
    knots of motions, for a body at rest. Groups that move by Newton's law are not considered,
    because obstacles stop them. Guided particles are not considered if they can evade along their
    free axis.
    """
    slack = SLACK * math.hypot(*raster.cell.vectors[0])
    warnings = []
    for k, leaders in enumerate(leading):
        if isinstance(leaders.group.motion, Newton):
            continue
        for n, barrier in enumerate(barriers):
            for step in _moments(leaders, barrier, steps):
                at = leaders.reference + leaders.group.motion.offset(
                    step - leaders.group.from_ + 1, leaders.reference
                )
                outline = barrier.at(step)
                assert outline
                places = (at - barrier.origin).T
                gap = outline.facing(*places)[0]
                if len(leaders.axes) < len(places):
                    gap = np.where(_can_evade(outline, places, leaders.axes[0]), np.inf, gap)
                deepest = float(
                    raster.communicator.smallest(np.array([gap.min(initial=np.inf)]))[0]
                )
                if deepest < -slack:
                    number = _number(raster, leaders.rows, gap == deepest)
                    warnings.append(
                        f"leaders.{k}: moves particle {raster.communicator.first(number)} into "
                        f"obstacles.{n} by step {step}; obstacles stop followers, not leaders"
                    )
                    break
    return warnings


def _can_evade(outline: Outline, places: Floats, axis: int) -> Mask:
    """Return a mask of the places at which a particle that is led along `axis` can be moved out of
    the outline along its other axis."""
    walls, result = Walls.of([outline]), np.zeros(places.shape[1], bool)
    with np.errstate(all="ignore"):
        for k, at in enumerate(places.T):
            x, y = at + walls.overlap_correction(at, np.array([1.0, 0.0, 1.0]), axis + 1)
            result[k] = walls.clearance(x, y) >= 0.0
    return result


def _moments(leaders: Leading, barrier: Barrier, steps: int) -> Iterator[int]:
    """Generate steps at which both the leader group and the obstacle are active: the first and the
    last of these steps, and the knots of both motions."""
    groups = leaders.group, barrier.group
    begin = max(group.from_ for group in groups)
    end = min(group.last(steps) for group in groups)
    knots = (group.from_ - 1 + k for group in groups for k in group.motion.knots())
    yield from sorted({step for step in (begin, end, *knots) if begin <= step <= end})


def _number(raster: Raster, rows: Indices, mask: Mask) -> int | None:
    """Return the number of the first particle for which the mask is true, or None if there is no
    such particle."""
    return raster.particle_offset + int(rows[np.argmax(mask)]) + 1 if mask.any() else None
