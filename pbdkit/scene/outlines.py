"""The outlines of obstacles: how far a place is from one, and which way is out.

`facing` is elementwise, and the same source runs on arrays and inside kernels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.body import Disc, Polygon, Rectangle, Ring
from pbdkit.experiment.obstacles import AnyShape, Facing
from pbdkit.interfaces import where

Floats = NDArray[np.float64]
HALF_PLANE, CIRCLES, POLYGON = 0, 1, 2


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

    def facing(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """`facing` of some places."""
        whole = 0, len(self.points)
        with np.errstate(all="ignore"):
            found = facing(x, y, self.kind, self.points, *whole, self.inner, self.outer)
        gap, nx, ny, spread = (np.broadcast_to(value, x.shape) for value in found)
        return gap, nx, ny, spread


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
    """(gap, n_x, n_y, spread) of places (x, y) before an outline whose points are those from
    `first` to `last`: the distance from it, negative inside, the normal into free space where it
    is nearest, and by how much the nearest point goes along where the place goes along."""
    if kind == HALF_PLANE:
        return _before_half_plane(x, y, points, first)
    if kind == CIRCLES:
        return _before_circles(x, y, points, first, inner, outer)
    return _before_polygon(x, y, points, first, last)


def slide(gap: Any, nx: Any, ny: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """The way off an outline, up to a sign, gap · C n / (n·C n): that which a particle takes that
    gives way as C says where it is pushed along n. Along n where C is a multiple of 1."""
    sx, sy = xx * nx + xy * ny, xy * nx + yy * ny
    over = sx * nx + sy * ny
    return gap * sx / over, gap * sy / over


def _before_half_plane(x: Any, y: Any, points: Any, first: Any) -> Any:
    px, py = points[first, 0], points[first, 1]
    nx, ny = points[first + 1, 0] - px, points[first + 1, 1] - py
    return (x - px) * nx + (y - py) * ny, nx, ny, 1.0


def _before_circles(x: Any, y: Any, points: Any, first: Any, inner: Any, outer: Any) -> Any:
    dx, dy = x - points[first, 0], y - points[first, 1]
    r = np.sqrt(dx * dx + dy * dy)
    off = r > 0.0
    over = where(off, r, 1.0)
    ux, uy = where(off, dx / over, 1.0), where(off, dy / over, 0.0)
    out = r - outer > inner - r
    gap, sign = where(out, r - outer, inner - r), where(out, 1.0, -1.0)
    return gap, sign * ux, sign * uy, where(out, outer, inner) / over


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
    return gap, nx, ny, where(tip, 0.0, 1.0)
