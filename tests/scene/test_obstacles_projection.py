"""The nearest place outside obstacles, against dense samples of their outlines.

The samples of all outlines that lie outside every obstacle are places to which the particle could
be moved. None of them may be nearer, in the metric of the particle, than the computed place.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest

from pbdkit.model.boundary_conditions import Obstacle
from pbdkit.scene.obstacles import (
    CIRCLE,
    LINE,
    SEGMENT,
    Outline,
    Walls,
    _meeting,
    contact_correction,
    outline_of,
)

SHAPES: dict[str, dict[str, Any]] = {
    "disc": {"type": "disc", "radius": 2.0, "centre": [0.2, 0.1]},
    "second disc": {"type": "disc", "radius": 1.5, "centre": [2.0, 2.2]},
    "half-plane": {"half_plane": {"point": [0.0, -1.2], "normal": [0.3, 1.0]}},
    "rectangle": {"type": "rectangle", "width": 2.4, "height": 2.1, "origin": [1.1, -0.6]},
    "arrow": {"type": "polygon", "vertices": [[-3.0, 0.0], [0.5, 3.1], [-1.1, 0.2], [0.4, -2.0]]},
}
METRICS = {
    "isotropic": [1.0, 0.0, 1.0],
    "along x": [1.6, 0.0, 0.7],
    "inclined": [1.2, 0.45, 0.8],
}
"""Compliances (xx, xy, yy)."""
FAR, FINENESS = 8.0, 1e-2


def outline(name: str) -> Outline:
    return outline_of(Obstacle(shape=SHAPES[name]).shape)


def samples(name: str) -> Any:
    """Points of the outline, (point, axis), with a distance of at most FINENESS."""
    shape = SHAPES[name]
    if "half_plane" in shape:
        point, (a, b) = shape["half_plane"]["point"], shape["half_plane"]["normal"]
        t = np.arange(-FAR, FAR, FINENESS)
        return np.array(point) + t[:, None] * np.array([-b, a]) / np.hypot(a, b)
    if shape["type"] == "disc":
        angle = np.arange(0.0, 2 * np.pi, FINENESS / shape["radius"])
        return shape["centre"] + shape["radius"] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.array(shape.get("vertices", []))
    if shape["type"] == "rectangle":
        x, y = shape["origin"]
        w, h = shape["width"], shape["height"]
        corners = np.array([(x, y), (x + w, y), (x + w, y + h), (x, y + h)])
    t = np.arange(0.0, 1.0, FINENESS / 6.0)[:, None]
    edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.concatenate([a + t * (b - a) for a, b in edges])


def places(count: int) -> Any:
    return np.random.default_rng(7).uniform([-2.0, -2.0], [3.5, 3.0], (count, 2)).T


def squared(w: Any, C: Any) -> Any:
    """w·S w with S = C⁻¹, for displacements in the last axis."""
    S = np.linalg.inv([[C[0], C[1]], [C[1], C[2]]])
    return np.einsum("...a,ab,...b->...", w, S, w)


def tolerance(C: Any, square: Any) -> Any:
    """Largest difference between the square of the nearest place and that of the nearest sample."""
    worst = np.linalg.norm(np.linalg.inv([[C[0], C[1]], [C[1], C[2]]]), 2)
    return 2.0 * worst * FINENESS * np.sqrt(square) + FINENESS**2 * worst


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("name", SHAPES)
def test_no_point_of_an_outline_is_nearer(name: str, metric: str) -> None:
    wall, at, C = outline(name), places(300), np.array(METRICS[metric])
    depth = -wall.facing(*at)[0]
    # Near the centre of a disc, several points of its outline are nearly equally near.
    at = at[:, (depth > 0.0) & ~(depth > 0.3 * SHAPES[name].get("radius", np.inf))]
    w = wall.outline_correction(at, np.repeat(C[:, None], at.shape[1], axis=1)).T
    assert len(w) > 20
    np.testing.assert_allclose(wall.facing(*(at + w.T))[0], 0.0, atol=1e-9)
    nearest = np.array([squared(samples(name) - x, C).min() for x in at.T])
    assert (squared(w, C) <= nearest + 1e-9).all()
    assert (squared(w, C) >= nearest - tolerance(C, nearest)).all()


@pytest.mark.parametrize("metric", METRICS)
def test_no_free_point_of_several_outlines_is_nearer(metric: str) -> None:
    names = [*SHAPES]
    outlines, C = [outline(name) for name in names], np.array(METRICS[metric])
    walls = Walls.of(outlines)
    points = np.concatenate([samples(name) for name in names])
    points = points[np.min([o.facing(*points.T)[0] for o in outlines], axis=0) > -1e-9]
    several = 0
    with np.errstate(all="ignore"):
        for at in places(36).T:
            inside = sum(o.facing(*at[:, None])[0][0] < 0.0 for o in outlines)
            w = np.array(contact_correction(*at, *C, 0, *walls))
            if not inside:
                assert not w.any()
                continue
            several += inside > 1
            assert walls.clearance(*(at + w)) >= 0.0
            assert squared(w, C) <= squared(points - at, C).min() + 1e-9
    assert several > 4


@pytest.mark.parametrize("axis", [0, 1])
def test_a_guided_particle_moves_to_the_nearest_free_place_on_its_line(axis: int) -> None:
    """`axis` is led, and the particle is free along the other one."""
    outlines = [outline(name) for name in ("disc", "second disc", "rectangle", "arrow")]
    walls = Walls.of(outlines)
    along = np.arange(-FAR, FAR, FINENESS)
    step = np.zeros((2, len(along)))
    step[1 - axis] = along
    moved = 0
    with np.errstate(all="ignore"):
        for at in places(50).T:
            w = np.array(contact_correction(*at, 1.2, 0.45, 0.8, axis + 1, *walls))
            free = np.min([o.facing(*(at[:, None] + step))[0] for o in outlines], axis=0) >= 0.0
            assert w[axis] == 0.0
            assert walls.clearance(*(at + w)) >= 0.0
            nearest = np.abs(along[free]).min()
            assert abs(abs(w[1 - axis]) - nearest) <= FINENESS
            moved += w.any()
    assert moved > 20


def test_places_in_a_ring_move_to_the_nearer_circle() -> None:
    ring = outline_of(
        Obstacle(shape={"type": "ring", "inner": 1.0, "outer": 2.5, "centre": [0.5, 0.3]}).shape
    )
    at = places(200)
    r = np.hypot(*(at.T - (0.5, 0.3)).T)
    at, r = at[:, (r > 1.0) & (r < 2.5)], r[(r > 1.0) & (r < 2.5)]
    w = ring.outline_correction(at, np.repeat([[1.0], [0.0], [1.0]], len(r), axis=1))
    depth = np.minimum(r - 1.0, 2.5 - r)
    np.testing.assert_allclose(np.hypot(*w), depth, atol=1e-9)
    np.testing.assert_allclose(ring.facing(*at)[0], -depth, atol=1e-12)
    np.testing.assert_allclose(ring.facing(*(at + w))[0], 0.0, atol=1e-9)
    on_outer = 2.5 - r < r - 1.0
    assert 20 < on_outer.sum() < len(r) - 20


def test_vertices_of_polygons_are_distinct_and_counterclockwise() -> None:
    square = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]
    for vertices in (square, square[:2] + square[1:], [*square, square[0]], square[::-1]):
        points = outline_of(Obstacle(shape={"type": "polygon", "vertices": vertices}).shape).points
        assert sorted(map(tuple, points)) == sorted(map(tuple, square))
        x, y = points.T
        assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() == 8.0


def test_the_order_of_outlines_does_not_matter() -> None:
    names = [*SHAPES]
    walls = Walls.of([outline(name) for name in names])
    others = Walls.of([outline(name) for name in names[::-1]])
    with np.errstate(all="ignore"):
        for at in places(8).T:
            w = contact_correction(*at, 1.2, 0.45, 0.8, 0, *walls)
            np.testing.assert_allclose(
                contact_correction(*at, 1.2, 0.45, 0.8, 0, *others), w, atol=1e-12
            )


@pytest.mark.parametrize("size", [1e3, 1e6, 1e8])
@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0])
def test_corrections_by_large_outlines_leave_no_depth(size: float, angle: float) -> None:
    """The tolerance of a depth follows the rounding errors of the points of an outline."""
    c, s = np.cos(angle), np.sin(angle)
    square = np.array([[-0.7, 0.0], [0.9, 0.0], [0.9, -1.1], [-0.7, -1.1]]) * size
    vertices = square @ [[c, s], [-s, c]]
    big = outline_of(Obstacle(shape={"type": "polygon", "vertices": vertices.tolist()}).shape)
    walls, at = Walls.of([big]), places(100)
    inside = big.facing(*at)[0] < 0.0
    assert 10 < inside.sum() < 90
    C = np.repeat([[1.0], [0.0], [1.0]], 100, axis=1)
    moved = at + np.where(inside, big.outline_correction(at, C), 0.0)
    assert all(walls.clearance(x, y) == 0.0 for x, y in moved.T)
    normal = np.array([-s, c])
    np.testing.assert_allclose((normal @ moved)[inside], 0.0, atol=1e-14 * size)


def distance_from(face: Any, x: float, y: float) -> float:
    """Distance of a place from a circle, from a line, or from the ends of a segment."""
    a, b, c, d, shape = face
    if shape == CIRCLE:
        return abs(np.hypot(x - a, y - b) - c)
    t = ((x - a) * c + (y - b) * d) / (c * c + d * d)
    t = np.clip(t, 0.0, 1.0) if shape == SEGMENT else t
    return float(np.hypot(x - a - t * c, y - b - t * d))


def crossings(face: Any, other: Any) -> int:
    """Number of changes of sign of one face along the other one."""
    a, b, c, d, shape = other
    t = np.linspace(0.0 if shape != LINE else -60.0, 1.0 if shape != LINE else 60.0, 40001)
    x, y = a + t * c, b + t * d
    if shape == CIRCLE:
        x, y = a + c * np.cos(2 * np.pi * t), b + c * np.sin(2 * np.pi * t)
    p, q, r, s, like = face
    side = np.hypot(x - p, y - q) - r if like == CIRCLE else (x - p) * s - (y - q) * r
    along = ((x - p) * r + (y - q) * s) / (r * r + s * s)
    on = np.full(len(t), True) if like != SEGMENT else (along >= 0.0) & (along <= 1.0)
    return int((((side[1:] > 0.0) != (side[:-1] > 0.0)) & on[1:]).sum())


@pytest.mark.parametrize("shape", [LINE, SEGMENT, CIRCLE])
@pytest.mark.parametrize("like", [LINE, SEGMENT, CIRCLE])
def test_faces_meet_where_both_are(shape: int, like: int) -> None:
    rng, met = np.random.default_rng(10 * shape + like), 0
    for _ in range(12):
        face, other = (
            (*rng.uniform(-1.0, 1.0, 2), *rng.uniform(0.5, 3.0, 2) * rng.choice([1.0, -1.0], 2), k)
            for k in (shape, like)
        )
        face, other = ((a, b, abs(c), 0.0, k) if k == CIRCLE else (a, b, c, d, k)
                       for a, b, c, d, k in (face, other))  # fmt: skip
        with np.errstate(all="ignore"):
            points = np.reshape(_meeting(face, other), (2, 2))
        points = points[~np.isnan(points).any(axis=1)]
        for x, y in points:
            assert distance_from(face, x, y) < 1e-9
            assert distance_from(other, x, y) < 1e-9
        count = len(np.unique(points.round(9), axis=0))
        assert count == crossings(face, other)
        met += count
    assert met


def test_corners_of_a_triangle_may_have_any_order() -> None:
    """The circle of radius (3 + 4 - 5) / 2 touches all sides from inside."""
    at = np.array([[1.0, -1.0, 5.0], [1.0, 1.0, 0.0]])
    for corners in permutations([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]]):
        wall = outline_of(Obstacle(shape={"type": "polygon", "vertices": corners}).shape)
        np.testing.assert_allclose(wall.facing(*at)[0], [-1.0, 1.0, 1.0])


@pytest.mark.parametrize("name", SHAPES)
def test_the_nearest_face_is_that_of_the_outline(name: str) -> None:
    wall, at = outline(name), places(100)
    distances = [face.distance for face in wall.faces(*at)]
    np.testing.assert_allclose(np.min(distances, axis=0), np.abs(wall.facing(*at)[0]), atol=1e-12)
