"""How deep points lie within a body: their distance to its outline.

A body of given sites ends at the sides of its outermost cells; where such sites are cut out of
another body, the cells that touch them are gone.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pbdkit.experiment.body import Body, Disc, Dogbone, Grid, Polygon, Rectangle, Ring
from pbdkit.experiment.body_algebra import Composed, Difference, Intersection
from pbdkit.interfaces import Lattice
from pbdkit.scene.cells import tiling_of
from pbdkit.scene.cut_cells import margin_of
from pbdkit.scene.sites import sites_from, sublattices_from, tolerance_of
from pbdkit.stepping.state import Floats

CORNERS = 1024
"""Straight parts of a quarter of a circle, which are within 3e-7 radii of it."""


def deeper(body: Body, lattice: Lattice, points: Floats, margin: float) -> NDArray[np.bool_]:
    """The points of a body, (point,), whose distance to its outline is at least that of a margin,
    but for rounding."""
    rounding = tolerance_of(body, lattice)
    return np.asarray(depths(body, lattice, points) >= margin - 2.0 * rounding)


def depths(body: Body, lattice: Lattice, points: Floats) -> Floats:
    """The distance of points to the outline of a body, (point,), below 0 outside of it."""
    region = _region(body, lattice, tolerance_of(body, lattice))
    if region.is_empty:
        return np.zeros(len(points))
    rings = shapely.get_parts(region.boundary)
    coordinates, ring = shapely.get_coordinates(rings, return_index=True)
    follows = ring[1:] == ring[:-1]
    sides = shapely.linestrings(np.stack([coordinates[:-1], coordinates[1:]], axis=1)[follows])
    at = shapely.points(points)
    (_, _), distance = shapely.STRtree(sides).query_nearest(
        at, return_distance=True, all_matches=False
    )
    shapely.prepare(region)
    return np.asarray(np.where(shapely.intersects(region, at), distance, -distance))


def _region(body: Body, lattice: Lattice, rounding: float, removed: bool = False) -> Any:
    """The region of a body, or of one that is removed from another; sides within `rounding` of
    each other are one."""
    if isinstance(body, Grid):
        return _of_sites(body, lattice, removed)
    if isinstance(body, Composed):
        others = removed != isinstance(body, Difference)
        parts = [
            _region(part, lattice, rounding, removed if n == 0 else others)
            for n, part in enumerate(body.of)
        ]
        if isinstance(body, Difference):
            join = shapely.difference
        else:
            join = shapely.intersection if isinstance(body, Intersection) else shapely.union
        return reduce(lambda a, b: join(a, b, grid_size=rounding), parts)
    return _of_outline(body)


def _of_outline(body: Body) -> Any:
    """The region within an outline."""
    if isinstance(body, Rectangle):
        (x, y), width, height = body.origin, body.width, body.height
        return shapely.box(x, y, x + width, y + height)
    if isinstance(body, Disc):
        return _disc(body.centre, body.radius)
    if isinstance(body, Ring):
        return shapely.difference(_disc(body.centre, body.outer), _disc(body.centre, body.inner))
    if isinstance(body, Polygon):
        return shapely.Polygon(body.vertices)
    assert isinstance(body, Dogbone)
    return _dogbone(body)


def _disc(centre: tuple[float, ...], radius: float) -> Any:
    return shapely.Point(centre).buffer(radius, quad_segs=CORNERS)


def _dogbone(body: Dogbone) -> Any:
    """Its upper right quarter, mirrored."""
    rise = min((body.width - body.gauge_width) / 2.0, body.radius)
    angle = np.linspace(0.0, np.arccos(1.0 - rise / body.radius), CORNERS)
    x = body.gauge_length / 2.0 + body.radius * np.sin(angle)
    y = body.gauge_width / 2.0 + body.radius * (1.0 - np.cos(angle))
    end, half = body.length / 2.0, body.width / 2.0
    quarter = np.vstack([np.c_[x, y], [[x[-1], half], [end, half]]])
    left = quarter[::-1] * (-1.0, 1.0)
    upper = np.vstack([left, quarter])
    outline = np.vstack([upper, upper[::-1] * (1.0, -1.0)])
    return shapely.Polygon(outline + np.add(body.origin, (end, half)))


def _of_sites(grid: Grid, lattice: Lattice, removed: bool) -> Any:
    """The cells whose corners all are sites of a grid; where these are removed, all that have a
    corner among them."""
    cell = lattice.cell()
    tiling = tiling_of(cell, ((),) * len(cell.sites))
    margin = margin_of(tiling)
    low, shape = (-margin, -margin), (grid.columns + 2 * margin, grid.rows + 2 * margin)
    sublattice = sublattices_from(cell, low, shape)
    inside = np.zeros(shape, bool)
    inside[margin:-margin, margin:-margin] = sublattice[margin:-margin, margin:-margin] >= 0
    sides = []
    for polygon in tiling.polygons:
        steps = np.array([corner.site for corner in polygon.corners])
        first = np.argwhere(sublattice == polygon.source)
        corners = first[:, None] + steps
        corners = corners[((corners >= 0) & (corners < shape)).all(axis=(1, 2))]
        numbers = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape)
        among = inside.ravel()[numbers]
        chosen = numbers[among.any(axis=1) if removed else among.all(axis=1)]
        sides.append(np.stack([chosen, np.roll(chosen, -1, axis=1)], axis=-1).reshape(-1, 2))
    every = np.concatenate(sides)
    count = inside.size
    outer = every[~np.isin(every @ (count, 1), every @ (1, count))]
    at = np.stack([plane.ravel() for plane in sites_from(lattice, low, shape).at], axis=1)
    faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(at[outer])))
    return shapely.union_all(faces)
