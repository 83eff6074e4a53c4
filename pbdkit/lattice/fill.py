"""Fill the outline of a body with sites, frame points, whole cells and cut cells.

Each cut cell has the share of its area that lies inside the outline. Cells that would connect the
two sides of a narrow void are left out: those whose inside has several parts, and, at a particle in
the void, the cells of all sides but one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from itertools import permutations, product
from operator import add, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells
from pbdkit.lattice.raster import (
    CHUNK_ROWS,
    EMPTY,
    FOLLOWER,
    FRAME,
    LeftOut,
    Mask,
    Raster,
    bounds,
    cells_of_sites,
    distinct,
    hull,
    positions,
    sublattices,
)
from pbdkit.model.bodies import Body, Box, Floats, Sites
from pbdkit.plugin import Cell, Lattice, Vector
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.lattice import CellPolygon, Index, Offset, Tiling

Lines = tuple[int, int]
"""Lines of sites, of indices i from the first to below the second."""


@dataclass(frozen=True)
class Filling:
    """The sites of the body on a window whose first site index is `first`, (i, j), and where cells
    are weighed the shares of the cells by the site of their first corner, (kind, i, j), and those
    sites of the cells left out at narrow voids, (cell, axis)."""

    body: Mask
    first: Index
    share: Floats | None = None
    left_out: Indices | None = None

    @property
    def box(self) -> tuple[Index, Index] | None:
        """(low, high) of the smallest window of site indices that holds the body; None where there
        is none."""
        if not (found := bounds(self.body)):
            return None
        low, high = (tuple(map(add, self.first, end)) for end in found)
        return low, high

    def left_out_on(self, lines: Lines | None = None) -> LeftOut:
        """The cells left out at narrow voids whose first corner is on some lines."""
        if self.left_out is None:
            return LeftOut()
        line = self.left_out[:, 0]
        low, high = lines or (line.min(initial=0), line.max(initial=0) + 1)
        return LeftOut.of(self.left_out[(line >= low) & (line < high)])

    def within(self, low: Index, high: Index) -> Filling:
        """The same on a window within its own, from the site `low` on, to below `high`."""
        ends = (
            [n - first for n, first in zip(end, self.first, strict=True)] for end in (low, high)
        )
        inside = tuple(map(slice, *ends))
        share = None if self.share is None else self.share[(slice(None), *inside)]
        return Filling(self.body[inside], low, share)

    def on(self, raster: Raster, tiling: Tiling) -> WeighedCells | None:
        """The shares by place of a raster."""
        if self.share is None:
            return None
        out = np.zeros((len(self.share), *raster.shape))
        body = raster.table_kind == FOLLOWER
        for some in raster.chunks():
            rows = some[body[some]]
            place, sites = raster.place_of(rows), tuple((raster.site_of(rows) - self.first).T)
            for own, share in zip(out, self.share, strict=True):
                own.ravel()[place] = share[sites]
        return WeighedCells(tiling, out, out)


def framed(lattice: Lattice, filling: Filling, layers: int) -> tuple[Index, NDArray[np.int8]]:
    """(low, kind): the kind of each site of the body and its frame, from the site `low` on.

    The frame takes every site within `layers` of index distance of the body that is none of it.
    """
    inside = np.pad(filling.body, layers)
    low = tuple(n - layers for n in filling.first)
    there = dilated(inside, layers) & has_sites(lattice.cell(), low, inside.shape)
    sites = np.where(there, np.int8(FRAME), np.int8(EMPTY))
    sites[inside] = FOLLOWER
    return low, sites


def build_raster(lattice: Lattice, low: Index, sites: NDArray[np.int8], reach: Index) -> Raster:
    """The raster of sites of some kinds, and of all that a slot can `reach`, in repeat cells."""
    cell = lattice.cell()
    first = np.floor_divide(low, cell.period) - reach
    last = (np.add(low, sites.shape) - 1) // cell.period + reach
    shape = (len(cell.sites), *(last + 1 - first).tolist())
    kind = np.full(shape, EMPTY, np.int8)
    raster = Raster(lattice, shape, tuple(first.tolist()), kind, low, sites)
    for rows in raster.chunks():
        kind.ravel()[raster.place_of(rows)] = raster.table_kind[rows]
    return raster


def sublattices_from(cell: Cell, low: Index, shape: Index) -> Indices:
    """The sublattice of each site of a window of indices, from `low` on; -1 at a hole."""
    return _repeated(sublattices(cell), low, shape)


def has_sites(cell: Cell, low: Index, shape: Index) -> Mask:
    """Which indices of such a window are sites, and no holes."""
    return _repeated(sublattices(cell) >= 0, low, shape)


def _repeated(values: NDArray[Any], low: Index, shape: Index) -> NDArray[Any]:
    """Values of the repeat cell over a window."""
    window = zip(low, shape, values.shape, strict=True)
    return values[np.ix_(*(np.arange(n, n + size) % p for n, size, p in window))]


def dilated(mask: Mask, layers: int) -> Mask:
    """Every place within `layers` of a true one, along either axis or both."""
    for axis in range(mask.ndim):
        grown = mask.copy()
        wider, narrower = np.moveaxis(grown, axis, 0), np.moveaxis(mask, axis, 0)
        for k in range(1, layers + 1):
            wider[k:] |= narrower[:-k]
            wider[:-k] |= narrower[k:]
        mask = grown
    return mask


def window(body: Body, lattice: Lattice, lines: Lines | None = None) -> tuple[Index, Index]:
    """The smallest and the largest site index (i, j) that may belong to the body, on some lines."""
    low, high = hull(_indices(box, lattice) for box in body.boxes())
    if lines:
        first = max(low[0], lines[0])
        last = max(first, min(high[0] + 1, lines[1])) - 1
        low, high = (first, *low[1:]), (last, *high[1:])
    return low, high


def sites_from(lattice: Lattice, low: Index, shape: Index) -> Sites:
    """All indices of a window from the site `low` on, and where such sites lie or would lie."""
    index = [n + first for n, first in zip(np.indices(shape), low, strict=True)]
    at = positions(lattice.cell(), *cells_of_sites(lattice.cell(), *index))
    return Sites(index, at.each(add, lattice.origin))


def fill(body: Body, lattice: Lattice, lines: Lines | None = None) -> Filling:
    """The sites inside or on the outline, of those on some lines."""
    low, high = window(body, lattice, lines)
    cell = lattice.cell()
    if max(map(abs, (*low, *high))) > 2**31 - 100:
        raise ExperimentError(
            "lies beyond the site indices of 32 bits; move it, or the lattice's origin, nearer",
            ("body",),
        )
    shape = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
    inside, tolerance = has_sites(cell, low, shape), tolerance_of(body, lattice)
    some = max(1, CHUNK_ROWS // math.prod(shape[1:]))
    for begin in range(0, len(inside), some):
        part = inside[begin : begin + some]
        sites = sites_from(lattice, (low[0] + begin, *low[1:]), part.shape)
        part &= body.distance(sites) <= tolerance
    return Filling(inside, low)


def tolerance_of(body: Body, lattice: Lattice) -> float:
    """The distance up to which any site of a body's window counts as on the outline."""
    corners = np.array([*product(*zip(*window(body, lattice), strict=True))]).T
    at = positions(lattice.cell(), *cells_of_sites(lattice.cell(), *corners))
    return float(rounding_of(lattice.cell(), *at.each(add, lattice.origin)).max())


def rounding_of(cell: Cell, *at: Floats) -> Floats:
    """The distance up to which each point counts as on the outline."""
    farthest = np.maximum.reduce([np.abs(x) for x in at])
    least, rounding = 1e-9 * math.hypot(*cell.vectors[0]), 4 * np.finfo(float).eps
    return np.asarray(np.maximum(least, rounding * farthest))


def has_narrow_slot(body: Mask, layers: int) -> bool:
    """Whether somewhere fewer than 2·layers + 1 empty sites lie between two faces of the body,
    in two lines side by side: frame points there belong to both faces."""
    axes = range(body.ndim)
    return any(_narrow(np.moveaxis(body, axis, -1), 2 * layers + 1) for axis in axes)


def _narrow(body: Mask, wide_enough: int) -> bool:
    """Looks along the last axis, at some lines at a time and the next one."""
    lines = max(1, CHUNK_ROWS // body[0].size)
    parts = (body[begin : begin + lines + 1] for begin in range(0, len(body), lines))
    return any(_narrow_lines(part, wide_enough) for part in parts)


def _narrow_lines(body: Mask, wide_enough: int) -> bool:
    """By the distance to the nearest particle behind and ahead."""
    place = np.arange(body.shape[-1])
    behind = np.maximum.accumulate(np.where(body, place, -body.size - 1), axis=-1)
    far = np.where(body, place, 2 * body.size + 1)[..., ::-1]
    ahead = np.minimum.accumulate(far, axis=-1)[..., ::-1]
    in_gap = ~body & (ahead - behind - 1 < wide_enough)
    return bool((in_gap[1:] & in_gap[:-1]).any())


def _indices(box: Box, lattice: Lattice) -> tuple[Index, Index]:
    """The site indices that cover a box."""
    if box.in_sites:
        return tuple(map(int, box.low)), tuple(map(int, box.high))
    cell = lattice.cell()
    corners = product(*zip(box.low, box.high, strict=True))
    from_origin = np.array(list(corners)) - lattice.origin
    cells = np.linalg.solve(np.array(cell.vectors).T, from_origin.T)
    # A basis site lies up to one cell from the corner of its own.
    low = [(math.floor(n.min()) - 1) * p for n, p in zip(cells, cell.period, strict=True)]
    high = [(math.ceil(n.max()) + 2) * p - 1 for n, p in zip(cells, cell.period, strict=True)]
    return tuple(low), tuple(high)


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
FAR = 1e100
"""Distance from an outline that counts as infinite, as that of bodies of given sites: differences
of such distances are numbers."""
KINK = 1 / 32
"""Change of the slope of the signed distance between two parts of a cell's side from which on more
than one line of the outline may pass through the cell."""
FINER = 2 * FINE
"""Parts along each edge of a triangle in a cell whose inside may fall in pieces."""
NOTICED = 0.1
"""Cells with a larger share than this that are left out at a void are counted: smaller ones also
lie at wide voids, in their corners, and matter as little as those below `SMALLEST`."""
INWARD = 1e-3
"""Share of the way to the middle of a cell by which points on its border are moved inward."""
NEAR_END = 1 / 64
"""Share of a segment at either end in which no void is looked for."""
TIE = 1e-9
"""Relative difference up to which the shares of two groups of cells count as equal."""


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
    tolerance, left_out = tolerance_of(body, lattice), []
    # A particle depends on cells, these on cells with which they share a corner, and these on the
    # distance at their corners.
    beyond = max(2 * margin, 4 * _reach_of(tiling))
    for begin in range(low[0], high[0], some):
        end = min(begin + some, high[0])
        wider = (begin - beyond, *low[1:]), (end + beyond, *high[1:])
        cutter = _Cutter(body, lattice, *wider, tolerance)
        inner, here = slice(beyond, -beyond), slice(begin - low[0], end - low[0])
        shares, corners, apart = cutter.connected(tiling)
        for polygon, whole in zip(tiling.polygons, shares, strict=True):
            share[polygon.kind][here] += whole[inner]
        corner[here] = corners[inner]
        left_out.append(apart[(apart[:, 0] >= begin) & (apart[:, 0] < end)])
    return Filling(corner, low, share, np.concatenate(left_out))


def margin_of(tiling: Tiling) -> int:
    """So many sites around an outline belong to cells that it cuts, at most."""
    corners = (corner for polygon in tiling.polygons for corner in polygon.corners)
    return max(2, *(abs(n) for corner in corners for n in corner.site))


def _reach_of(tiling: Tiling) -> int:
    """The largest difference of site indices between the first corner of a cell and another."""
    return max(abs(n) for cell in tiling.polygons for corner in cell.corners for n in corner.site)


class _Cutter:
    """The signed distance at all sites of a window, and within cells."""

    def __init__(
        self, body: Body, lattice: Lattice, low: Index, high: Index, tolerance: float
    ) -> None:
        self.low, self.shape = low, tuple(b - a for a, b in zip(low, high, strict=True))
        self._body, self._of_sites = body, any(box.in_sites for box in body.boxes())
        sites = sites_from(lattice, low, self.shape)
        self._at, self._tolerance = sites.at, tolerance
        self._sublattice = sublattices_from(lattice.cell(), low, self.shape)
        self._distance = self._signed(sites)

    def connected(self, tiling: Tiling) -> tuple[list[Floats], Mask, Indices]:
        """(shares, corners, left out): the shares of the cells of each shape by the place of their
        first corner, without those that would connect two sides of a void; which places are corners
        of cells; and the sites of the first corners of the large ones left out, (cell, axis)."""
        every = [self._shares(polygon) for polygon in tiling.polygons]
        shares, left_out = [share for share, _ in every], [where for _, where in every]
        corners = self._corners(tiling, shares)
        bridges = self._bridges(tiling, shares, corners)
        if any(map(len, bridges)):
            for share, bridging in zip(shares, bridges, strict=True):
                left_out.append(bridging[share[tuple(bridging.T)] > NOTICED])
                share[tuple(bridging.T)] = 0.0
            corners = self._corners(tiling, shares)
        sites: Indices = np.concatenate(left_out) + np.array(self.low)
        return shares, corners, sites

    def _corners(self, tiling: Tiling, shares: list[Floats]) -> Mask:
        """Which places are corners of cells with a share."""
        marked = np.zeros(self.shape, bool)
        for polygon, share in zip(tiling.polygons, shares, strict=True):
            there = self.first_corners(polygon)
            exists = share[there] > 0.0
            for corner in polygon.corners:
                marked[_shifted(there, corner.site)] |= exists
        return marked

    def first_corners(self, polygon: CellPolygon) -> Window:
        """The part of the window where all corners of a cell lie in the window."""
        steps = [corner.site for corner in polygon.corners]
        low, high = np.min(steps, axis=0), np.max(steps, axis=0)
        return tuple(map(slice, -low, np.array(self.shape) - high))

    def _shares(self, polygon: CellPolygon) -> tuple[Floats, Indices]:
        """(share, in pieces): the shares of all cells of a shape, by the place of their first
        corner, 0 where there is no cell; and the places of the large ones left out because their
        inside falls in pieces, (cell, axis)."""
        steps, there = [corner.site for corner in polygon.corners], self.first_corners(polygon)
        low = np.array([window.start for window in there])
        whole = np.zeros(self.shape)
        share = whole[there]
        share[...] = self._sublattice[there] == polygon.source
        nearest, in_pieces = np.full(share.shape, np.inf), [np.zeros((0, len(low)), int)]
        for step in steps:
            distance = self._distance[_shifted(there, step)]
            share[distance > 0.0] = 0.0
            np.minimum(nearest, np.abs(distance), out=nearest)
        if not self._of_sites:
            reach = (1.0 if self._body.exaggerates() else NEAREST) * _width(polygon)
            near = (nearest <= reach) & (self._sublattice[there] == polygon.source)
            cut = np.stack(np.nonzero(near), axis=1)
            for some in np.split(cut, range(CELLS_AT_ONCE, len(cut), CELLS_AT_ONCE)):
                at = [tuple((some + low + step).T) for step in steps]
                x, y = (np.array([plane[where] for where in at]) for plane in self._at)
                own, bent = shares_inside(self._at_places, x, y)
                share[tuple(some.T)] = own
                (rest,) = np.nonzero(bent & (own > SMALLEST))
                if rest.size:
                    apart = has_pieces(self._at_places, x[:, rest], y[:, rest])
                    in_pieces.append(some[rest[apart]])
        share[share <= SMALLEST] = 0.0
        left_out = np.concatenate(in_pieces)
        large = left_out[share[tuple(left_out.T)] > NOTICED]
        share[tuple(left_out.T)] = 0.0
        return whole, large + low

    def _bridges(self, tiling: Tiling, shares: list[Floats], corners: Mask) -> list[Indices]:
        """The places of the cells of each shape, (cell, axis), that are left out because they are
        connected to others by nothing but a particle outside the outline.

        Around such a particle two neighbouring cells belong together where part of the edge between
        them is inside. The groups but the one of the largest share are left out, and all that are
        largest where several are: mirror images of a body stay mirror images.
        """
        found = [[np.zeros((0, len(self.low)), int)] for _ in shares]
        outside = corners & (self._distance > 0.0)
        particles = np.argwhere(outside)
        sublattice = self._sublattice[outside]
        for source in distinct(sublattice):
            around, at = _cells_around(tiling, int(source)), particles[sublattice == source]
            own = np.array(
                [_values(shares[n], at - tiling.polygons[n].corners[k].site) for n, k in around]
            )
            # The edge between a cell and the one before it, counter-clockwise.
            ends = [
                np.subtract(_next(tiling.polygons[n], k).site, tiling.polygons[n].corners[k].site)
                for n, k in around
            ]
            inside = np.array([self._joined(at, at + end) for end in ends])
            (rest,) = np.nonzero(_group_count(own > 0.0, inside) > 1)
            for k, end in enumerate(ends):
                both = (own[k, rest] > 0.0) & (own[k - 1, rest] > 0.0) & ~inside[k, rest]
                some = rest[both]
                inside[k, some] = self._partly_inside(at[some], at[some] + end)
            rest = rest[_group_count(own[:, rest] > 0.0, inside[:, rest]) > 1]
            smaller = _smaller_groups(own[:, rest], inside[:, rest])
            for (n, k), bridging in zip(around, smaller, strict=True):
                found[n].append(at[rest[bridging]] - tiling.polygons[n].corners[k].site)
        return [_distinct_rows(np.concatenate(each)) for each in found]

    def _joined(self, start: Indices, end: Indices) -> Mask:
        """Whether edges from places outside end inside, or on the outline where it is not the tip
        of a void of less than a right angle, (place,)."""
        near, far = _values(self._distance, start), _values(self._distance, end)
        there = ((end >= 0) & (end < self.shape)).all(axis=1)
        a, b = (np.stack([_values(plane, at) for plane in self._at]) for at in (start, end))
        wide = near >= (1.0 - TIE) * math.sqrt(0.5) * np.hypot(*(b - a))
        return np.asarray(there & ((far < 0.0) | (far == 0.0) & wide))

    def _partly_inside(self, start: Indices, end: Indices) -> Mask:
        """Whether the segments between some places, (place, axis), are inside between them."""
        ends = tuple(start.T), tuple(end.T)
        a, b = (np.stack([plane[place] for plane in self._at]) for place in ends)
        part = np.arange(1, FINER)[:, None] / FINER
        return np.asarray((self._at_places(*_between(a, b, part)) <= 0.0).any(axis=0))

    def _at_places(self, x: Floats, y: Floats) -> Floats:
        nowhere = np.zeros(x.shape, int)
        return self._signed(Sites((nowhere, nowhere), Vector(x, y)))

    def _signed(self, at: Sites) -> Floats:
        distance = self._body.distance(at)
        return np.where(np.abs(distance) <= self._tolerance, 0.0, distance)


def shares_inside(
    signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats
) -> tuple[Floats, Mask]:
    """(share, bent): the share inside of cells with corners (corner, cell), given the signed
    distance at places: the mean over its triangles, cut into small ones in which the distance is
    linear; and in which cells more than one straight line, or a wide arc, can be the outline."""
    points, small = _points_within(x, y)
    distance = np.clip(signed(*points), -FAR, FAR)
    share = (distance <= 0.0).all(axis=(0, 1)).astype(float)
    cut = (distance < 0.0).any(axis=(0, 1)) & (distance > 0.0).any(axis=(0, 1))
    a, b, c = (distance[corner][..., cut] for corner in small.T)
    parts = _negative_share(a, b, c).reshape(len(small) * distance.shape[1], -1)
    # Added one after the other: what a cell comes to does not depend on who is looked at with it.
    share[cut] = reduce(np.add, parts) / len(parts)
    sides = distance[_sides(len(x))]  # side, point, cell
    length = np.hypot(*(np.roll(c, -1, axis=0) - c for c in (x, y)))[:, None]
    kinks = np.abs(sides[:, 2:] - 2 * sides[:, 1:-1] + sides[:, :-2]) > KINK * length / FINE
    inside = sides[:, :-1] <= 0.0
    runs = (inside & (sides[:, 1:] > 0.0)).sum(axis=(0, 1))
    return share, kinks.any(axis=(0, 1)) | (runs > 1)


def has_pieces(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """Whether the inside of cells with corners (corner, cell) falls in pieces, given the signed
    distance at places."""
    n = len(x)
    part = np.arange(FINER)[:, None, None] / FINER
    sides = (1.0 - part) * np.eye(n) + part * np.roll(np.eye(n), 1, axis=1)  # part, side, corner
    weights = _inward(sides.swapaxes(0, 1).reshape(-1, n))
    border = np.stack([weights @ x, weights @ y])
    distance = signed(*border)
    after = np.roll(border, -1, axis=1), np.roll(distance, -1, axis=0)
    inside = distance <= 0.0
    parted = _parted(signed, border, after[0], distance, after[1])
    # A connected inside without holes meets the border of the cell in one run, and near each of
    # its corners there is more of it.
    runs = (inside & (after[1] > 0.0)).sum(axis=0)
    alone = (signed(x, y) <= 0.0) & ~inside[::FINER]
    (several,) = np.nonzero((runs > 1) | parted.any(axis=0) | alone.any(axis=0))
    result = np.zeros(x.shape[1], bool)
    if several.size:
        result[several] = _falls_apart(signed, x[:, several], y[:, several])
    return result


def _falls_apart(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """The same by the pieces of a mesh of each cell."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    weights, edges = _mesh(len(x))
    points = np.stack([weights @ x, weights @ y])
    distance = signed(*points)
    inside = distance <= 0.0
    a, b = edges.T
    joined = inside[a] & inside[b]
    joined &= ~_parted(signed, points[:, a], points[:, b], distance[a], distance[b])
    place = np.arange(inside.size).reshape(inside.shape)
    # Slivers along a side, and outlines on it, connect its corners.
    corner = place[: len(x)]
    slivers = _along_sides(signed, x, y)
    links = tuple(
        np.concatenate([ends[joined], on_side[slivers]])
        for ends, on_side in ((place[a], corner), (place[b], np.roll(corner, -1, axis=0)))
    )
    graph = coo_array((np.ones(len(links[0]), bool), links), shape=(inside.size, inside.size))
    _, label = connected_components(graph, directed=False)
    label = label.reshape(inside.shape)
    count = np.bincount(label[distance < 0.0], minlength=label.max() + 1)
    # Points on the outline alone are no piece, unless they are corners.
    piece = inside & (count[label] > 0)
    piece[: len(x)] |= inside[: len(x)]
    high, low = (np.where(piece, label, at) for at in (-1, len(count)))
    return np.asarray(high.max(axis=0) > low.min(axis=0))


def _along_sides(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """Whether sides of cells with corners (corner, cell), from each corner to the next, lie inside,
    or on the outline towards one of their ends: not where the tip of a void touches them."""
    a = np.stack([x, y])
    part = np.arange(FINER + 1)[:, None, None] / FINER
    at = _between(a, np.roll(a, -1, axis=1), part)
    distance = signed(*at)
    within = distance < 0.0
    starts = (within[1:] & ~within[:-1]).sum(axis=0) + within[0]
    ends = at[:, :-1], at[:, 1:], distance[:-1], distance[1:]
    touched = within[1:] & within[:-1] & _parted(signed, *ends, touching=True)
    parted = touched | _parted(signed, *ends)
    return np.asarray((distance <= 0.0).all(axis=0) & (starts <= 1) & ~parted.any(axis=0))


def _parted(
    signed: Callable[[Floats, Floats], Floats],
    a: Floats,
    b: Floats,
    near: Floats,
    far: Floats,
    *,
    touching: bool = False,
) -> Mask:
    """Whether a void lies between the points a and b, (axis, ...), both of which are inside, with
    these signed distances: whether one of a few points between them is outside. If the void has
    parallel sides and no other outline is nearer, the point that divides the segment as the
    distances lies in it, however narrow it is. If `touching`, the outline counts as void."""
    total = np.abs(near) + np.abs(far)
    some = (near <= 0.0) & (far <= 0.0) & (total < np.hypot(*(b - a)))
    if not some.any():
        return np.asarray(some)
    near, total = np.abs(near[some]), total[some]
    divided = np.divide(near, total, out=np.full(near.shape, 0.5), where=total > 0.0)
    part = np.stack([divided, *(np.full(near.shape, quarter / 4) for quarter in (1, 2, 3))])
    part = part.clip(NEAR_END, 1.0 - NEAR_END)
    distance = signed(*_between(a[:, some], b[:, some], part))
    some[some] = (distance >= 0.0 if touching else distance > 0.0).any(axis=0)
    return np.asarray(some)


def _between(a: Floats, b: Floats, part: Floats) -> Floats:
    """The points at some part of the way from a to b, (axis, ...)."""
    return np.stack([start + part * (end - start) for start, end in zip(a, b, strict=True)])


def _cells_around(tiling: Tiling, source: int) -> list[tuple[int, int]]:
    """(polygon, corner) of the cells around a site of a sublattice, counter-clockwise."""
    found = [
        (n, k)
        for n, polygon in enumerate(tiling.polygons)
        for k, corner in enumerate(polygon.corners)
        if corner.target == source
    ]

    def direction(one: tuple[int, int]) -> float:
        polygon, k = tiling.polygons[one[0]], one[1]
        x, y = map(sub, _next(polygon, k).rest, polygon.rest[k])
        return math.atan2(y, x)

    return sorted(found, key=direction)


def _next(polygon: CellPolygon, corner: int) -> Offset:
    """The corner after one, counter-clockwise."""
    return polygon.corners[(corner + 1) % len(polygon.corners)]


def _distinct_rows(at: Indices) -> Indices:
    """The places that occur, (place, axis)."""
    rows: Indices = np.array(sorted(set(map(tuple, at.tolist()))), int).reshape(-1, at.shape[1])
    return rows


def _values(plane: NDArray[Any], at: Indices) -> NDArray[Any]:
    """The values at some places, (place, axis); 0 beyond the ends."""
    there = ((at >= 0) & (at < plane.shape)).all(axis=1)
    values = np.zeros(len(at), plane.dtype)
    values[there] = plane[tuple(at[there].T)]
    return values


def _group_count(exists: Mask, joined: Mask) -> Indices:
    """The number of groups of cells around particles, (cell, particle): those that exist, a cell in
    one group with the one before it where they are joined."""
    links = exists & np.roll(exists, 1, axis=0) & joined
    count = exists.sum(axis=0) - links.sum(axis=0)
    return np.asarray(np.maximum(count, exists.any(axis=0)))


def _smaller_groups(share: Floats, joined: Mask) -> Mask:
    """The cells around particles, (cell, particle), that are not of the one group of the largest
    share."""
    exists = share > 0.0
    links = exists & np.roll(exists, 1, axis=0) & joined
    number = np.broadcast_to(np.arange(len(share))[:, None], share.shape).copy()
    for _ in share:
        before = np.roll(number, 1, axis=0)
        number = np.where(links, np.minimum(number, before), number)
        after, link = np.roll(number, -1, axis=0), np.roll(links, -1, axis=0)
        number = np.where(link, np.minimum(number, after), number)
    every = range(len(share))
    total = np.stack([reduce(np.add, np.where(number == n, share, 0.0)) for n in every])
    largest = total >= (1.0 - TIE) * total.max(axis=0, initial=0.0)
    single = largest & (largest.sum(axis=0) == 1)
    kept = np.take_along_axis(single, number, axis=0)
    return np.asarray(exists & ~kept)


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


def _width(polygon: CellPolygon) -> float:
    """The largest distance between corners of a cell."""
    return max(math.dist(a, b) for a in polygon.rest for b in polygon.rest)


@cache
def _sides(n: int) -> tuple[Indices, Indices]:
    """(point, triangle), each (side, point): the points along the sides of a cell with n corners,
    of those in its triangles."""
    weights, _ = _small_triangles()
    _, k, m = (weights.T * FINE).round().astype(int).tolist()
    number = {place: each for each, place in enumerate(zip(k, m, strict=True))}
    along = range(FINE + 1)
    first = [number[t, 0] for t in along]
    if n > 3:
        return np.array([first] * n), np.repeat(np.arange(n)[:, None], FINE + 1, axis=1)
    second, third = [number[FINE - t, t] for t in along], [number[0, FINE - t] for t in along]
    points = np.array([first, second, third])
    return points, np.zeros_like(points)


@cache
def _mesh(n: int) -> tuple[Floats, Indices]:
    """(weights, edges) of a mesh of a cell with n corners: the weights of the corners at each
    point, (point, corner), and the points at the ends of each edge, (edge, end). The first points
    are the corners; all others are moved inward a little."""
    fine, small = _small_triangles(FINER)
    corners = np.concatenate([np.eye(n), np.full((1, n), 1 / n)])
    triangles = [(k, (k + 1) % n, n) for k in range(n)] if n > 3 else [(0, 1, 2)]
    every = np.concatenate([fine @ corners[list(three)] for three in triangles]).round(9)
    number: dict[tuple[float, ...], int] = {}
    point = [number.setdefault(tuple(row), len(number)) for row in every.tolist()]
    each = np.reshape(point, (len(triangles), -1))[:, small].reshape(-1, 3)
    pairs = {(a, b) for three in each.tolist() for a, b in permutations(three, 2)}
    images = [number[tuple(row)] for row in np.eye(n).tolist()]
    edges = [(n + a, n + b) for a, b in sorted(pairs) if a < b]
    for k, image in enumerate(images):
        edges += [(k, n + image), *((k, n + b) for a, b in sorted(pairs) if a == image)]
    weights = np.concatenate([np.eye(n), _inward(np.array(list(number)))])
    return weights, np.array(edges)


def _inward(weights: Floats) -> Floats:
    """The weights of the corners at points, (..., corner), a little nearer to the middle: what is
    connected on the border of a cell alone is not connected within."""
    return np.asarray((1.0 - INWARD) * weights + INWARD / weights.shape[-1])


@cache
def _small_triangles(fine: int = FINE) -> tuple[Floats, Indices]:
    """(point, corner), the barycentric coordinates of the points at which a triangle is cut, and
    (small triangle, corner), the points at the corners of each part."""
    k, m = (n.ravel() for n in np.indices((fine + 1, fine + 1)))
    inside = k + m <= fine
    k, m = k[inside], m[inside]
    number = {place: n for n, place in enumerate(zip(k.tolist(), m.tolist(), strict=True))}
    small = []
    for a, b in number:
        if a + b < fine:
            small.append([number[a, b], number[a + 1, b], number[a, b + 1]])
        if a + b < fine - 1:
            small.append([number[a + 1, b + 1], number[a + 1, b], number[a, b + 1]])
    return np.stack([fine - k - m, k, m], axis=1) / fine, np.array(small)


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
