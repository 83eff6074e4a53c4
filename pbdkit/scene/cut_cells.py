"""Fills an outline with whole and cut cells: which share of each lies inside."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, reduce

import numpy as np

from pbdkit.experiment.body import Body, Sites
from pbdkit.interfaces import Lattice, Vector
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.interfaces.polygons import Polygon, Tiling
from pbdkit.scene.places import Floats
from pbdkit.scene.sites import (
    Filling,
    Lines,
    sites_from,
    sublattices_from,
    tolerance_of,
    window,
)

Window = tuple[slice, ...]
FINE = 8
"""Parts along each edge of a triangle in a cut cell, in each of which the outline is straight."""
SITES_AT_ONCE = 2**18
"""So many are looked at together, whole lines of them, for the same reason."""
CELLS_AT_ONCE = 512
"""Cut cells that are looked at together: what that takes does not grow with the body."""
NEAREST = 0.6
"""No point of a triangle is farther from its nearest corner than 1/√3 of the longest side, so that
an outline that passes through a cell passes that near to a corner."""
SMALLEST = 0.02
"""Cells with a smaller share than this are left out: corners that hang on a sliver of the body move
as little else does, and say little about it."""

BENT = 1e-3
"""A distance that is off by more than this share of a triangle's width from a linear one in its
middle bends within: at a corner of the outline, or between two sides of it."""
HALVINGS = 8
"""So often triangles in which the distance bends are halved."""


def fill_with_cells(
    body: Body, lattice: Lattice, tiling: Tiling, lines: Lines | None = None
) -> Filling:
    """The cells with a share inside the outline, and as body all their corners, of those on some
    lines. A body of given sites has the whole cells between them."""
    low, high = window(body, lattice)
    margin = margin_of(tiling)
    low, high = tuple(n - margin for n in low), tuple(n + margin + 1 for n in high)
    if lines:
        first = max(low[0], lines[0])
        low, high = (first, *low[1:]), (max(first, min(high[0], lines[1])), *high[1:])
    shape = tuple(b - a for a, b in zip(low, high, strict=True))
    share = np.zeros((1 + max(polygon.kind for polygon in tiling.polygons), *shape))
    corner, some = np.zeros(shape, bool), max(1, SITES_AT_ONCE // math.prod(shape[1:]))
    tolerance = tolerance_of(body, lattice)
    for begin in range(low[0], high[0], some):
        # Cells reach so far from their first corner, and none begins as near to the window's end.
        end = min(begin + some, high[0])
        wider = (begin - 2 * margin, *low[1:]), (end + 2 * margin, *high[1:])
        cutter = _Cutter(body, lattice, *wider, tolerance)
        inner, here = slice(2 * margin, -2 * margin), slice(begin - low[0], end - low[0])
        for polygon in tiling.polygons:
            there, found = cutter.shares(polygon)
            whole, marked = np.zeros(cutter.shape), np.zeros(cutter.shape, bool)
            whole[there] = found
            for at in polygon.corners:
                marked[_shifted(there, at.site)] |= found > 0.0
            share[polygon.kind][here] += whole[inner]
            corner[here] |= marked[inner]
    return Filling(corner, low, share)


def margin_of(tiling: Tiling) -> int:
    """So many sites around an outline belong to cells that it cuts, at most."""
    corners = (corner for polygon in tiling.polygons for corner in polygon.corners)
    return max(2, *(abs(n) for corner in corners for n in corner.site))


class _Cutter:
    """The signed distance at all sites of a window, and within cells."""

    def __init__(
        self, body: Body, lattice: Lattice, low: Index, high: Index, tolerance: float
    ) -> None:
        self.shape = tuple(b - a for a, b in zip(low, high, strict=True))
        self._body, self._of_sites = body, any(box.in_sites for box in body.boxes())
        sites = sites_from(lattice, low, self.shape)
        self._at, self._tolerance = sites.at, tolerance
        self._sublattice = sublattices_from(lattice.cell(), low, self.shape)
        self._distance = self._signed(sites)

    def shares(self, polygon: Polygon) -> tuple[Window, Floats]:
        """(window, share) of all cells of that shape, by the place of their first corner: a part of
        the whole window, and shares there, 0 where there is no cell."""
        steps = [corner.site for corner in polygon.corners]
        low, high = np.min(steps, axis=0), np.max(steps, axis=0)
        there: Window = tuple(map(slice, -low, np.array(self.shape) - high))
        share = (self._sublattice[there] == polygon.source).astype(float)
        nearest = np.full(share.shape, np.inf)
        for step in steps:
            distance = self._distance[_shifted(there, step)]
            share[distance > 0.0] = 0.0
            np.minimum(nearest, np.abs(distance), out=nearest)
        if not self._of_sites:
            reach = (1.0 if self._body.exaggerates() else NEAREST) * _width(polygon)
            near = (nearest <= reach) & (self._sublattice[there] == polygon.source)
            cut = np.stack(np.nonzero(near), axis=1)
            for some in np.split(cut, range(CELLS_AT_ONCE, len(cut), CELLS_AT_ONCE)):
                at = [tuple((some - low + step).T) for step in steps]
                x, y = (np.array([plane[where] for where in at]) for plane in self._at)
                share[tuple(some.T)] = shares_inside(self._at_places, x, y)
        share[share <= SMALLEST] = 0.0
        return there, share

    def _at_places(self, x: Floats, y: Floats) -> Floats:
        nowhere = np.zeros(x.shape, int)
        return self._signed(Sites((nowhere, nowhere), Vector(x, y)))

    def _signed(self, at: Sites) -> Floats:
        distance = self._body.distance(at)
        return np.where(np.abs(distance) <= self._tolerance, 0.0, distance)


def shares_inside(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Floats:
    """The share inside of cells with corners (corner, cell), given the signed distance at places:
    the mean over its triangles, cut into small ones in which the distance is linear."""
    points, small = _points_within(x, y)
    distance = signed(*points)
    share = (distance <= 0.0).all(axis=(0, 1)).astype(float)
    cut = (distance < 0.0).any(axis=(0, 1)) & (distance > 0.0).any(axis=(0, 1))
    a, b, c = (distance[corner][..., cut] for corner in small.T)
    parts = _negative_share(a, b, c).reshape(len(small) * distance.shape[1], -1)
    # Added one after the other: what a cell comes to does not depend on who is looked at with it.
    share[cut] = reduce(np.add, parts) / len(parts)
    return share


def cut_by_border(
    signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, *, exaggerates: bool = False
) -> tuple[Floats, Floats]:
    """(share, facing): the share inside of cells with corners (corner, cell), (cell,), and where
    the border in each of them faces, (cell, 2, 2): the sum of n nᵀ over its length, with its
    normals n, of both sides of a thin layer alike.

    As `shares_inside`, with smaller triangles where the distance bends in one, so that layers far
    thinner than a cell are found; the distance is to be at most the way to the outline unless it
    `exaggerates`.
    """
    points, small = _points_within(x, y)
    distance, count = signed(*points)[small], len(small) * points[0].shape[1]
    width = max(float(np.hypot(x - x[k], y - y[k]).max(initial=0.0)) for k in range(len(x))) / FINE
    near = (np.abs(distance).min(axis=1) <= width) | exaggerates
    share = (~near & (distance[:, 0] < 0.0)).sum(axis=(0, 1)) / count
    facing = np.zeros((2, 2, len(share)))
    part, triangle, cell = np.nonzero(near)
    at = np.array([c[small[part].T, triangle, cell] for c in points])  # axis, corner, triangle
    distance = distance[part, :, triangle, cell].T
    for halved in range(HALVINGS + 1):
        plain = np.abs(distance).min(axis=0) > (np.inf if exaggerates else width)
        if halved == HALVINGS:
            plain[:] = True
        else:
            off = np.abs(signed(*at[..., ~plain].mean(axis=1)) - distance[:, ~plain].mean(axis=0))
            plain[~plain] = off <= BENT * width
        done, where = distance[:, plain], cell[plain]
        inside = 0.25**halved / count * _negative_share(*done)
        share += np.bincount(where, inside, len(share))
        across = _across(at[..., plain], done)
        length = np.hypot(*across)
        length[length == 0.0] = 1.0
        for row, column in ((0, 0), (0, 1), (1, 1)):
            product = across[row] * across[column] / length
            facing[row, column] += np.bincount(where, product, len(share))
        if plain.all():
            break
        at, cell, width = _in_four(at[..., ~plain]), np.tile(cell[~plain], 4), width / 2
        distance = signed(*at)
    facing[1, 0] = facing[0, 1]
    return share, np.moveaxis(facing, -1, 0)


def _across(at: Floats, distance: Floats) -> Floats:
    """The straight pieces of an outline in triangles, (axis, corner, triangle), turned by a right
    angle, (axis, triangle); 0 where there is none."""
    inside = distance < 0.0
    odd = np.where(inside.sum(axis=0) == 1, inside, ~inside)
    apex, every = odd.argmax(axis=0), np.arange(at.shape[-1])
    cut = inside.any(axis=0) & ~inside.all(axis=0)
    tip, ends = distance[apex, every], []
    for turn in (1, 2):
        other = (apex + turn) % 3
        rise = np.where(cut, tip - distance[other, every], 1.0)
        ends.append(tip / rise * (at[:, other, every] - at[:, apex, every]))
    x, y = np.where(cut, ends[1] - ends[0], 0.0)
    return np.stack([-y, x])


def _in_four(at: Floats) -> Floats:
    """Each of some triangles, (axis, corner, triangle), in four halved ones."""
    a, b, c = at.swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.concatenate([np.stack(three, axis=1) for three in corners], axis=-1)


def _points_within(x: Floats, y: Floats) -> tuple[tuple[Floats, Floats], Indices]:
    """((x, y), small): points of the triangles that cells with corners (corner, cell) consist of,
    (point, triangle, cell), and the points at the corners of each small triangle."""
    triangles, n = [(0, 1, 2)], len(x)
    if n > 3:
        x, y = (np.concatenate([c, c.mean(axis=0)[None]]) for c in (x, y))
        triangles = [(k, (k + 1) % n, n) for k in range(n)]
    corners = np.array(triangles).T
    weights, small = _small_triangles()
    a, b, c = weights.T[:, :, None, None]
    px, py = (a * at[corners[0]] + b * at[corners[1]] + c * at[corners[2]] for at in (x, y))
    return (px, py), small


def _shifted(window: Window, step: Index) -> Window:
    """The window so many sites on."""
    return tuple(slice(s.start + n, s.stop + n) for s, n in zip(window, step, strict=True))


def _width(polygon: Polygon) -> float:
    """The largest distance between corners of a cell."""
    return max(math.dist(a, b) for a in polygon.rest for b in polygon.rest)


@cache
def _small_triangles() -> tuple[Floats, Indices]:
    """(point, corner), the barycentric coordinates of the points at which a triangle is cut, and
    (small triangle, corner), the points at the corners of each part."""
    k, m = (n.ravel() for n in np.indices((FINE + 1, FINE + 1)))
    inside = k + m <= FINE
    k, m = k[inside], m[inside]
    number = {place: n for n, place in enumerate(zip(k.tolist(), m.tolist(), strict=True))}
    small = []
    for a, b in number:
        if a + b < FINE:
            small.append([number[a, b], number[a + 1, b], number[a, b + 1]])
        if a + b < FINE - 1:
            small.append([number[a + 1, b + 1], number[a + 1, b], number[a, b + 1]])
    return np.stack([FINE - k - m, k, m], axis=1) / FINE, np.array(small)


def _negative_share(a: Floats, b: Floats, c: Floats) -> Floats:
    """The share of triangles in which a linear function, given at their corners, is negative."""
    small, large = np.minimum(a, b), np.maximum(a, b)
    low, middle = np.minimum(small, c), np.maximum(small, np.minimum(large, c))
    high = np.maximum(large, c)
    with np.errstate(invalid="ignore", divide="ignore"):
        one = low * low / ((low - middle) * (low - high))
        two = 1.0 - high * high / ((high - low) * (high - middle))
    share = np.where(middle >= 0.0, one, two)
    return np.where(high <= 0.0, 1.0, np.where(low >= 0.0, 0.0, share))
