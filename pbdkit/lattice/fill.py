"""Fill the outline of a body with sites, frame points, whole cells and cut cells.

A cut cell is weighted by the fraction of its area inside the outline. Cells that would connect the
two sides of a narrow void are omitted. These are, first, cells in which the region inside the
outline is disconnected. Second, if a particle lies in the void, the cells around it are connected
only on the same side of the void; the cells of one side are kept, and the others are omitted.
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

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells
from pbdkit.lattice.raster import (
    CHUNK_ROWS,
    EMPTY,
    FOLLOWER,
    FRAME,
    OmittedCells,
    Raster,
    bounds,
    cells_of_sites,
    distinct,
    hull,
    positions,
)
from pbdkit.model.bodies import Body, Box, Sites
from pbdkit.plugin import Cell, Lattice, Vector
from pbdkit.plugin.lattice import CellPolygon, Index, Offset, Tiling

Lines = tuple[int, int]
"""Type of a range of lines of sites. It contains the indices i from the first number to the second,
which is excluded."""


@dataclass(frozen=True)
class Filling:
    """Sites of a body on a window of site indices.

    Parameters
    ----------
    body
        Mask of the particles of the body, (i, j).
    first
        Site index of the first entry of `body`.
    share
        Area fractions of the cells inside the outline, at the site of their first corner, (kind, i,
        j). It is None if cells are not weighted.
    left_out
        Cells omitted at narrow voids, given by the sites of their first corners, (cell, axis).
    """

    body: Mask
    first: Index
    share: Floats | None = None
    left_out: Indices | None = None

    @property
    def box(self) -> tuple[Index, Index] | None:
        """Smallest window of site indices that contains all particles of the body, (low, high).
        The result is None if there is no particle."""
        if not (ends := bounds(self.body)):
            return None
        low, high = (tuple(map(add, self.first, end)) for end in ends)
        return low, high

    def left_out_on(self, lines: Lines | None = None) -> OmittedCells:
        """Return those cells omitted at narrow voids that have their first corner on the lines."""
        if self.left_out is None:
            return OmittedCells()
        line = self.left_out[:, 0]
        low, high = lines or (line.min(initial=0), line.max(initial=0) + 1)
        return OmittedCells.of(self.left_out[(line >= low) & (line < high)])

    def within(self, low: Index, high: Index) -> Filling:
        """Return the part of the filling from site `low` to site `high`; `high` is excluded."""
        ends = (
            [n - first for n, first in zip(end, self.first, strict=True)] for end in (low, high)
        )
        inside = tuple(map(slice, *ends))
        share = None if self.share is None else self.share[(slice(None), *inside)]
        return Filling(self.body[inside], low, share)

    def on(self, raster: Raster, tiling: Tiling) -> WeighedCells | None:
        """Return the weighted cells on a raster, or None if cells are not weighted."""
        if self.share is None:
            return None
        out = np.zeros((len(self.share), *raster.shape))
        body = raster.table_kind == FOLLOWER
        for chunk in raster.chunks():
            rows = chunk[body[chunk]]
            place, sites = raster.place_of(rows), tuple((raster.site_of(rows) - self.first).T)
            for target, share in zip(out, self.share, strict=True):
                target.ravel()[place] = share[sites]
        return WeighedCells(tiling, out, out)


def framed(lattice: Lattice, filling: Filling, layers: int) -> tuple[Index, NDArray[np.int8]]:
    """Compute the kind of each site of the body and of its frame.

    The frame consists of the sites outside the body with an index distance of at most `layers` from
    a site of the body.

    Returns
    -------
    tuple
        First site index, and kinds, (i, j).
    """
    if not layers:
        return filling.first, np.where(filling.body, np.int8(FOLLOWER), np.int8(EMPTY))
    inside = np.pad(filling.body, layers)
    low = tuple(n - layers for n in filling.first)
    occupied = dilated(inside, layers) & has_sites(lattice.cell(), low, inside.shape)
    sites = np.where(occupied, np.int8(FRAME), np.int8(EMPTY))
    sites[inside] = FOLLOWER
    return low, sites


def build_raster(lattice: Lattice, low: Index, sites: NDArray[np.int8], reach: Index) -> Raster:
    """Build the raster of sites.

    Parameters
    ----------
    lattice
        The lattice.
    low
        First site index.
    sites
        Kind of each site, (i, j).
    reach
        Number of repeat cells along each axis by which the raster is padded: the reach of the
        slots.
    """
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
    """Return the sublattice of each site of a window that begins at the site `low`; -1 for an index
    without a site."""
    return _repeated(cell.sublattices, low, shape)


def has_sites(cell: Cell, low: Index, shape: Index) -> Mask:
    """Return a mask of the indices of a window, which begins at `low`, that are sites."""
    return _repeated(cell.sublattices >= 0, low, shape)


def _repeated(values: NDArray[Any], low: Index, shape: Index) -> NDArray[Any]:
    """Repeat the values of the repeat cell over a window."""
    window = zip(low, shape, values.shape, strict=True)
    return values[np.ix_(*(np.arange(n, n + size) % p for n, size, p in window))]


def dilated(mask: Mask, layers: int) -> Mask:
    """Dilate a mask by `layers` places along each axis, including the diagonal directions."""
    for axis in range(mask.ndim):
        result = mask.copy()
        target, source = np.moveaxis(result, axis, 0), np.moveaxis(mask, axis, 0)
        for k in range(1, layers + 1):
            target[k:] |= source[:-k]
            target[:-k] |= source[k:]
        mask = result
    return mask


def window(body: Body, lattice: Lattice, lines: Lines | None = None) -> tuple[Index, Index]:
    """Return the smallest and the largest site index that may belong to the body. With `lines`, the
    first index is restricted to this range."""
    low, high = hull(_indices(box, lattice) for box in body.boxes())
    if lines:
        first = max(low[0], lines[0])
        last = max(first, min(high[0] + 1, lines[1])) - 1
        low, high = (first, *low[1:]), (last, *high[1:])
    return low, high


def sites_from(lattice: Lattice, low: Index, shape: Index) -> Sites:
    """Return the site indices of a window that begins at the site `low`, and the positions of the
    sites."""
    index = [n + first for n, first in zip(np.indices(shape), low, strict=True)]
    cell = lattice.cell()
    at = positions(cell, *cells_of_sites(cell, *index))
    return Sites(index, at.each(add, lattice.origin))


def fill(body: Body, lattice: Lattice, lines: Lines | None = None) -> Filling:
    """Find the sites inside or on the outline of a body.

    Parameters
    ----------
    body
        The outline.
    lattice
        The lattice.
    lines
        Lines of sites to fill; all by default.

    Raises
    ------
    ExperimentError
        If site indices exceed 32 bits.
    """
    low, high = window(body, lattice, lines)
    cell = lattice.cell()
    if max(map(abs, (*low, *high))) > 2**31 - 100:
        raise ExperimentError(
            "site indices exceed 32 bits; move the body nearer to the origin of the lattice",
            ("body",),
        )
    shape = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
    inside, tolerance = has_sites(cell, low, shape), tolerance_of(body, lattice)
    line_count = max(1, CHUNK_ROWS // math.prod(shape[1:]))
    for begin in range(0, len(inside), line_count):
        part = inside[begin : begin + line_count]
        sites = sites_from(lattice, (low[0] + begin, *low[1:]), part.shape)
        part &= body.distance(sites) <= tolerance
    return Filling(inside, low)


def tolerance_of(body: Body, lattice: Lattice) -> float:
    """Return the distance from the outline up to which a site in the window of a body counts as
    lying on the outline."""
    corners = np.array([*product(*zip(*window(body, lattice), strict=True))]).T
    cell = lattice.cell()
    at = positions(cell, *cells_of_sites(cell, *corners))
    return float(rounding_of(cell, *at.each(add, lattice.origin)).max())


def rounding_of(cell: Cell, *at: Floats) -> Floats:
    """Return, for each point, the distance from the outline up to which it counts as lying on the
    outline."""
    farthest = np.maximum.reduce([np.abs(x) for x in at])
    minimum, rounding = 1e-9 * math.hypot(*cell.vectors[0]), 4 * np.finfo(float).eps
    return np.asarray(np.maximum(minimum, rounding * farthest))


def has_narrow_slot(body: Mask, layers: int) -> bool:
    """Return whether two faces of the body are closer than the frame requires.

    The result is true if, in two adjacent lines, fewer than 2·layers + 1 empty sites lie between
    two faces. Frame points between these faces then belong to both of them.
    """
    axes = range(body.ndim)
    return any(_narrow(np.moveaxis(body, axis, -1), 2 * layers + 1) for axis in axes)


def _narrow(body: Mask, width: int) -> bool:
    """Apply the criterion of `has_narrow_slot` along the last axis. Several lines are processed at
    once. Each part also includes the first line of the next part, so that every pair of adjacent
    lines is compared."""
    lines = max(1, CHUNK_ROWS // body[0].size)
    parts = (body[begin : begin + lines + 1] for begin in range(0, len(body), lines))
    return any(_narrow_lines(part, width) for part in parts)


def _narrow_lines(body: Mask, width: int) -> bool:
    place = np.arange(body.shape[-1])
    previous = np.maximum.accumulate(np.where(body, place, -body.size - 1), axis=-1)
    far = np.where(body, place, 2 * body.size + 1)[..., ::-1]
    following = np.minimum.accumulate(far, axis=-1)[..., ::-1]
    in_gap = ~body & (following - previous - 1 < width)
    return bool((in_gap[1:] & in_gap[:-1]).any())


def _indices(box: Box, lattice: Lattice) -> tuple[Index, Index]:
    """Return the range of site indices that covers a box."""
    if box.in_sites:
        return tuple(map(int, box.low)), tuple(map(int, box.high))
    cell = lattice.cell()
    corners = product(*zip(box.low, box.high, strict=True))
    points = np.array(list(corners)) - lattice.origin
    cells = np.linalg.solve(np.array(cell.vectors).T, points.T)
    # A basis site can lie up to one cell away from the corner of its repeat cell.
    low = [(math.floor(n.min()) - 1) * p for n, p in zip(cells, cell.period, strict=True)]
    high = [(math.ceil(n.max()) + 2) * p - 1 for n, p in zip(cells, cell.period, strict=True)]
    return tuple(low), tuple(high)


Window = tuple[slice, ...]
"""Type of a window of an array."""
FINE = 8
"""Number of parts into which each edge of a triangle in a cut cell is divided. The outline is
assumed to be straight in each of the small triangles."""
SITES_AT_ONCE = 2**18
"""Number of sites that are processed together, rounded to whole lines. It limits the size of
temporary arrays."""
CELLS_AT_ONCE = 512
"""Number of cut cells processed together, so that memory does not grow with the body."""
NEAREST = 0.6
"""Upper bound on the distance between an outline that crosses a cell and the nearest corner of the
cell, relative to the width of the cell.

No point of a triangle is farther from its nearest corner than 1/√3 of the longest side."""
MIN_SHARE = 0.02
"""Area fraction below which a cell is omitted. If only a sliver of a cell belongs to the body, its
corners have almost no stiffness, and their displacements do not represent the displacement of the
body."""
CURVATURE_TOLERANCE = 1e-3
"""Deviation of the signed distance from linearity, relative to the width of a triangle, above which
the triangle is divided.

The distance is not linear near a corner of the outline, or between two sides of the outline."""
MAX_HALVINGS = 8
"""Maximum number of subdivisions of triangles in which the distance is not linear."""
FAR = 1e100
"""Finite substitute for infinite distances, such as those from bodies of given sites, so that
differences of distances are defined."""
KINK = 1 / 32
"""If the slope of the signed distance changes by more than this along a side of a cell, more than
one line of the outline may cross the cell."""
FINER = 2 * FINE
"""Number of parts into which each edge of a triangle is divided, for cells in which the region
inside the outline may be disconnected."""
NOTICEABLE_SHARE = 0.1
"""Area fraction above which cells that are omitted at a void are counted. Smaller cells are also
omitted in the corners of wide voids, and are as negligible as cells below `MIN_SHARE`."""
INWARD = 1e-3
"""Fraction by which points on the border of a cell are moved towards its centre."""
NEAR_END = 1 / 64
"""At each end of a segment, this fraction of its length is not searched for a void."""
TIE_RTOL = 1e-9
"""Relative difference up to which the areas of two groups of cells count as equal."""


def fill_with_cells(
    body: Body, lattice: Lattice, tiling: Tiling, lines: Lines | None = None
) -> Filling:
    """Find the cells that lie partly or wholly inside the outline. The body consists of all corners
    of these cells.

    Parameters
    ----------
    body
        The outline. If the body is given by its sites, it has the whole cells between these sites.
    lattice
        The lattice.
    tiling
        Cells of the lattice.
    lines
        Lines of sites to fill; all by default.

    Returns
    -------
    Filling
        Sites, with the area fractions of cells.
    """
    low, high = window(body, lattice)
    margin = margin_of(tiling)
    low, high = tuple(n - margin for n in low), tuple(n + margin + 1 for n in high)
    if lines:
        first = max(low[0], lines[0])
        low, high = (first, *low[1:]), (max(first, min(high[0], lines[1])), *high[1:])
    shape = tuple(b - a for a, b in zip(low, high, strict=True))
    share = np.zeros((1 + max(polygon.kind for polygon in tiling.polygons), *shape))
    corner, line_count = np.zeros(shape, bool), max(1, SITES_AT_ONCE // math.prod(shape[1:]))
    tolerance, left_out = tolerance_of(body, lattice), []
    # Whether a particle belongs to the body depends on its cells. Whether these are omitted depends
    # on the cells that share a corner with them, and the area fractions of those depend on the
    # distance from the outline at their corners.
    padding = 4 * _reach_of(tiling)
    for begin in range(low[0], high[0], line_count):
        end = min(begin + line_count, high[0])
        ends = (begin - padding, *low[1:]), (end + padding, *high[1:])
        cutter = _Cutter(body, lattice, *ends, tolerance)
        inner, target = slice(padding, -padding), slice(begin - low[0], end - low[0])
        shares, corners, omitted = cutter.connected(tiling)
        for polygon, whole in zip(tiling.polygons, shares, strict=True):
            share[polygon.kind][target] += whole[inner]
        corner[target] = corners[inner]
        left_out.append(omitted[(omitted[:, 0] >= begin) & (omitted[:, 0] < end)])
    return Filling(corner, low, share, np.concatenate(left_out))


def margin_of(tiling: Tiling) -> int:
    """Return the maximum number of layers of sites outside an outline that belong to cells cut by
    it."""
    return max(2, _reach_of(tiling))


def _reach_of(tiling: Tiling) -> int:
    """Return the largest difference of site indices between corners of a cell."""
    return max(abs(n) for cell in tiling.polygons for corner in cell.corners for n in corner.site)


class _Cutter:
    """Compute the signed distance from the outline at the sites of a window, and the shares of
    cells. The share of a cell is the fraction of its area inside the outline."""

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
        """Compute the shares of cells. Cells that would connect two sides of a void are omitted.

        Returns
        -------
        tuple
            Three results. The shares of the cells of each shape, at the place of their first
            corner. A mask of the places that are corners of cells. The sites of the first corners
            of omitted cells with a noticeable share, (cell, axis).
        """
        parts = [self._shares(polygon) for polygon in tiling.polygons]
        shares, left_out = [share for share, _ in parts], [places for _, places in parts]
        corners = self._corners(tiling, shares)
        bridges = self._bridges(tiling, shares, corners)
        if any(map(len, bridges)):
            for share, bridging in zip(shares, bridges, strict=True):
                left_out.append(bridging[share[tuple(bridging.T)] > NOTICEABLE_SHARE])
                share[tuple(bridging.T)] = 0.0
            corners = self._corners(tiling, shares)
        sites: Indices = np.concatenate(left_out) + np.array(self.low)
        return shares, corners, sites

    def _corners(self, tiling: Tiling, shares: list[Floats]) -> Mask:
        """Return a mask of the places that are corners of cells with a share."""
        marked = np.zeros(self.shape, bool)
        for polygon, share in zip(tiling.polygons, shares, strict=True):
            window = self.first_corners(polygon)
            exists = share[window] > 0.0
            for corner in polygon.corners:
                marked[_shifted(window, corner.site)] |= exists
        return marked

    def first_corners(self, polygon: CellPolygon) -> Window:
        """Return the part of the window in which the first corner of a cell can lie, so that all
        corners lie in the window."""
        steps = [corner.site for corner in polygon.corners]
        low, high = np.min(steps, axis=0), np.max(steps, axis=0)
        return tuple(map(slice, -low, np.array(self.shape) - high))

    def _shares(self, polygon: CellPolygon) -> tuple[Floats, Indices]:
        """Compute the shares of all cells of a shape.

        Returns
        -------
        tuple
            Shares at the place of the first corner, 0 where there is no cell; and the places
            of shape (cell, axis) of cells with a noticeable share that are omitted because the
            region inside the outline is disconnected in them.
        """
        steps, first_corners = (
            [corner.site for corner in polygon.corners],
            self.first_corners(polygon),
        )
        low = np.array([part.start for part in first_corners])
        whole = np.zeros(self.shape)
        share = whole[first_corners]
        share[...] = self._sublattice[first_corners] == polygon.source
        nearest, disconnected = np.full(share.shape, np.inf), [np.zeros((0, len(low)), int)]
        for step in steps:
            distance = self._distance[_shifted(first_corners, step)]
            share[distance > 0.0] = 0.0
            np.minimum(nearest, np.abs(distance), out=nearest)
        if not self._of_sites:
            reach = (1.0 if self._body.exaggerates() else NEAREST) * _width(polygon)
            near = (nearest <= reach) & (self._sublattice[first_corners] == polygon.source)
            cut = np.stack(np.nonzero(near), axis=1)
            for cells in np.split(cut, range(CELLS_AT_ONCE, len(cut), CELLS_AT_ONCE)):
                corners = [tuple((cells + low + step).T) for step in steps]
                x, y = (np.array([plane[corner] for corner in corners]) for plane in self._at)
                inside, bent = shares_inside(self._at_places, x, y)
                share[tuple(cells.T)] = inside
                (rest,) = np.nonzero(bent & (inside > MIN_SHARE))
                if rest.size:
                    is_disconnected = has_pieces(self._at_places, x[:, rest], y[:, rest])
                    disconnected.append(cells[rest[is_disconnected]])
        share[share <= MIN_SHARE] = 0.0
        left_out = np.concatenate(disconnected)
        large = left_out[share[tuple(left_out.T)] > NOTICEABLE_SHARE]
        share[tuple(left_out.T)] = 0.0
        return whole, large + low

    def _bridges(self, tiling: Tiling, shares: list[Floats], corners: Mask) -> list[Indices]:
        """Find the cells that are connected to other cells only by a particle outside the outline.

        Around such a particle two neighbouring cells are connected if part of the edge between them
        is inside. The cells around the particle form connected groups; only the group with the
        largest area is retained. If several groups have the largest area, none is retained;
        otherwise mirror images of a body would not have mirror images of its cells.

        Returns
        -------
        list
            Places of the cells to be omitted, for each shape, (cell, axis).
        """
        bridges = [[np.zeros((0, len(self.low)), int)] for _ in shares]
        outside = corners & (self._distance > 0.0)
        particles = np.argwhere(outside)
        sublattice = self._sublattice[outside]
        for source in distinct(sublattice):
            around, at = _cells_around(tiling, int(source)), particles[sublattice == source]
            share = np.array(
                [_values(shares[n], at - tiling.polygons[n].corners[k].site) for n, k in around]
            )
            # The edge between a cell and the previous cell, counterclockwise.
            ends = [
                np.subtract(_next(tiling.polygons[n], k).site, tiling.polygons[n].corners[k].site)
                for n, k in around
            ]
            inside = np.array([self._joined(at, at + end) for end in ends])
            (rest,) = np.nonzero(_group_count(share > 0.0, inside) > 1)
            for k, end in enumerate(ends):
                both = (share[k, rest] > 0.0) & (share[k - 1, rest] > 0.0) & ~inside[k, rest]
                open_edges = rest[both]
                start = at[open_edges]
                inside[k, open_edges] = self._partly_inside(start, start + end)
            rest = rest[_group_count(share[:, rest] > 0.0, inside[:, rest]) > 1]
            smaller = _smaller_groups(share[:, rest], inside[:, rest])
            for (n, k), is_bridge in zip(around, smaller, strict=True):
                bridges[n].append(at[rest[is_bridge]] - tiling.polygons[n].corners[k].site)
        return [_distinct_rows(np.concatenate(places)) for places in bridges]

    def _joined(self, start: Indices, end: Indices) -> Mask:
        """Return whether edges that start at places outside the outline end inside the outline or
        on it, (place,).

        An end on the outline does not count if it is the tip of a void with an angle of less than
        90°.
        """
        near, far = _values(self._distance, start), _values(self._distance, end)
        is_in_window = ((end >= 0) & (end < self.shape)).all(axis=1)
        a, b = (np.stack([_values(plane, at) for plane in self._at]) for at in (start, end))
        is_wide = near >= (1.0 - TIE_RTOL) * math.sqrt(0.5) * np.hypot(*(b - a))
        return np.asarray(is_in_window & ((far < 0.0) | (far == 0.0) & is_wide))

    def _partly_inside(self, start: Indices, end: Indices) -> Mask:
        """Return whether part of the segments between places is inside. The shape of places is
        (place, axis)."""
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
    """Compute the shares of cells inside an outline.

    Parameters
    ----------
    signed
        Signed distance from the outline as a function of coordinates.
    x, y
        Corners of the cells, (corner, cell).

    Returns
    -------
    tuple
        Shares of shape (cell,); and a mask of the cells in which the outline may be something other
        than one straight line or a wide arc.

    Notes
    -----
    A cell is divided into triangles, and the triangles into small triangles on which the distance
    is assumed to be linear.
    """
    points, small = _points_within(x, y)
    distance = np.clip(signed(*points), -FAR, FAR)
    share = (distance <= 0.0).all(axis=(0, 1)).astype(float)
    cut = (distance < 0.0).any(axis=(0, 1)) & (distance > 0.0).any(axis=(0, 1))
    a, b, c = (distance[corner][..., cut] for corner in small.T)
    parts = _negative_share(a, b, c).reshape(len(small) * distance.shape[1], -1)
    # Sums are sequential, so that the result for a cell does not depend on the other cells of the
    # call.
    share[cut] = reduce(np.add, parts) / len(parts)
    sides = distance[_sides(len(x))]  # Axes: side, point, cell.
    length = np.hypot(*(np.roll(c, -1, axis=0) - c for c in (x, y)))[:, None]
    kinks = np.abs(sides[:, 2:] - 2 * sides[:, 1:-1] + sides[:, :-2]) > KINK * length / FINE
    inside = sides[:, :-1] <= 0.0
    runs = (inside & (sides[:, 1:] > 0.0)).sum(axis=(0, 1))
    return share, kinks.any(axis=(0, 1)) | (runs > 1)


def has_pieces(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """Return whether the region inside the outline is disconnected in each cell.

    Parameters
    ----------
    signed
        Signed distance from the outline as a function of coordinates.
    x, y
        Corners of the cells, (corner, cell).
    """
    n = len(x)
    part = np.arange(FINER)[:, None, None] / FINER
    # Axes: part, side, corner.
    sides = (1.0 - part) * np.eye(n) + part * np.roll(np.eye(n), 1, axis=1)
    weights = _inward(sides.swapaxes(0, 1).reshape(-1, n))
    border = np.stack([weights @ x, weights @ y])
    distance = signed(*border)
    next_border, next_distance = np.roll(border, -1, axis=1), np.roll(distance, -1, axis=0)
    inside = distance <= 0.0
    is_separated = _is_separated(signed, border, next_border, distance, next_distance)
    # If the region inside the outline is connected and has no holes, its points on the border of
    # the cell are consecutive. They include the points next to each corner that lies inside.
    runs = (inside & (next_distance > 0.0)).sum(axis=0)
    is_isolated = (signed(x, y) <= 0.0) & ~inside[::FINER]
    (candidates,) = np.nonzero((runs > 1) | is_separated.any(axis=0) | is_isolated.any(axis=0))
    result = np.zeros(x.shape[1], bool)
    if candidates.size:
        result[candidates] = _is_disconnected(signed, x[:, candidates], y[:, candidates])
    return result


def _is_disconnected(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """Return whether the region inside the outline is disconnected in cells. The connected
    components of a mesh of each cell are determined."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    weights, edges = _mesh(len(x))
    points = np.stack([weights @ x, weights @ y])
    distance = signed(*points)
    inside = distance <= 0.0
    a, b = edges.T
    joined = inside[a] & inside[b]
    joined &= ~_is_separated(signed, points[:, a], points[:, b], distance[a], distance[b])
    place = np.arange(inside.size).reshape(inside.shape)
    # If a sliver of the body, or the outline, lies along a side of the cell, the corners of this
    # side are connected.
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
    # Components that consist of points on the outline do not count, unless the points are corners
    # of the cell.
    piece = inside & (count[label] > 0)
    piece[: len(x)] |= inside[: len(x)]
    high, low = (np.where(piece, label, at) for at in (-1, len(count)))
    return np.asarray(high.max(axis=0) > low.min(axis=0))


def _along_sides(signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats) -> Mask:
    """Return whether sides of cells, from each corner to the next, are connected inside the
    outline.

    A connected side lies inside the outline, except that it may lie on the outline near one of its
    ends. No tip of a void touches it.
    """
    a = np.stack([x, y])
    part = np.arange(FINER + 1)[:, None, None] / FINER
    at = _between(a, np.roll(a, -1, axis=1), part)
    distance = signed(*at)
    inside = distance < 0.0
    starts = (inside[1:] & ~inside[:-1]).sum(axis=0) + inside[0]
    ends = at[:, :-1], at[:, 1:], distance[:-1], distance[1:]
    is_touched = inside[1:] & inside[:-1] & _is_separated(signed, *ends, touching=True)
    is_cut = is_touched | _is_separated(signed, *ends)
    return np.asarray((distance <= 0.0).all(axis=0) & (starts <= 1) & ~is_cut.any(axis=0))


def _is_separated(
    signed: Callable[[Floats, Floats], Floats],
    a: Floats,
    b: Floats,
    near: Floats,
    far: Floats,
    *,
    touching: bool = False,
) -> Mask:
    """Return whether a void lies between points a and b inside the outline, (axis, ...).

    `near` and `far` are the signed distances at a and b. A few points between a and b are tested.
    One of these points divides the segment in the ratio of the two distances. If the void has
    parallel sides and no other outline is nearer, this point lies in the void even if the void is
    very narrow. With `touching`, points on the outline count as points in the void.
    """
    total = np.abs(near) + np.abs(far)
    candidates = (near <= 0.0) & (far <= 0.0) & (total < np.hypot(*(b - a)))
    if not candidates.any():
        return np.asarray(candidates)
    near, total = np.abs(near[candidates]), total[candidates]
    proportional = np.divide(near, total, out=np.full(near.shape, 0.5), where=total > 0.0)
    part = np.stack([proportional, *(np.full(near.shape, quarter / 4) for quarter in (1, 2, 3))])
    part = part.clip(NEAR_END, 1.0 - NEAR_END)
    distance = signed(*_between(a[:, candidates], b[:, candidates], part))
    candidates[candidates] = (distance >= 0.0 if touching else distance > 0.0).any(axis=0)
    return np.asarray(candidates)


def _between(a: Floats, b: Floats, part: Floats) -> Floats:
    """Return the points at the fraction `part` of the segment from a to b, (axis, ...)."""
    return np.stack([start + part * (end - start) for start, end in zip(a, b, strict=True)])


def _cells_around(tiling: Tiling, source: int) -> list[tuple[int, int]]:
    """Return the cells around a site of a sublattice, counterclockwise. Each is given by its
    polygon and by the corner at which the site lies."""
    cells = [
        (n, k)
        for n, polygon in enumerate(tiling.polygons)
        for k, corner in enumerate(polygon.corners)
        if corner.target == source
    ]

    def direction(cell: tuple[int, int]) -> float:
        polygon, k = tiling.polygons[cell[0]], cell[1]
        x, y = map(sub, _next(polygon, k).rest, polygon.rest[k])
        return math.atan2(y, x)

    return sorted(cells, key=direction)


def _next(polygon: CellPolygon, corner: int) -> Offset:
    """Return the next corner, counterclockwise."""
    return polygon.corners[(corner + 1) % len(polygon.corners)]


def _distinct_rows(at: Indices) -> Indices:
    """Return the distinct places, sorted, (place, axis)."""
    rows: Indices = np.array(sorted(set(map(tuple, at.tolist()))), int).reshape(-1, at.shape[1])
    return rows


def _values(plane: NDArray[Any], at: Indices) -> NDArray[Any]:
    """Return the values at places, given in an array of shape (place, axis); 0 outside the
    plane."""
    inside = ((at >= 0) & (at < plane.shape)).all(axis=1)
    values = np.zeros(len(at), plane.dtype)
    values[inside] = plane[tuple(at[inside].T)]
    return values


def _group_count(exists: Mask, joined: Mask) -> Indices:
    """Count the connected groups of cells around particles, (cell, particle).

    `joined` marks cells that are connected to the previous cell.
    """
    links = exists & np.roll(exists, 1, axis=0) & joined
    count = exists.sum(axis=0) - links.sum(axis=0)
    return np.asarray(np.maximum(count, exists.any(axis=0)))


def _smaller_groups(share: Floats, joined: Mask) -> Mask:
    """Return a mask of shape (cell, particle) of the cells around particles that do not belong to
    the largest connected group."""
    exists = share > 0.0
    links = exists & np.roll(exists, 1, axis=0) & joined
    number = np.broadcast_to(np.arange(len(share))[:, None], share.shape).copy()
    for _ in share:
        previous = np.roll(number, 1, axis=0)
        number = np.where(links, np.minimum(number, previous), number)
        following, link = np.roll(number, -1, axis=0), np.roll(links, -1, axis=0)
        number = np.where(link, np.minimum(number, following), number)
    numbers = range(len(share))
    total = np.stack([reduce(np.add, np.where(number == n, share, 0.0)) for n in numbers])
    largest = total >= (1.0 - TIE_RTOL) * total.max(axis=0, initial=0.0)
    single = largest & (largest.sum(axis=0) == 1)
    is_largest = np.take_along_axis(single, number, axis=0)
    return np.asarray(exists & ~is_largest)


def cut_by_border(
    signed: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, *, exaggerates: bool = False
) -> tuple[Floats, Floats]:
    """Compute shares of cells inside an outline, and the orientation of the outline in each cell.

    Parameters
    ----------
    signed
        Signed distance from the outline as a function of coordinates. Its magnitude must not be
        larger than the distance from the outline, unless `exaggerates` is true.
    x, y
        Corners of the cells, (corner, cell).
    exaggerates
        Whether the magnitude of the signed distance can be larger than the distance from the
        outline.

    Returns
    -------
    tuple
        Shares of shape (cell,); and an array of shape (cell, 2, 2) with the integral of n nᵀ over
        the outline in each cell, where n is the normal of the outline. Both sides of a thin layer
        make the same contribution to the integral.

    Notes
    -----
    The method is that of `shares_inside`, but triangles in which the distance is not linear are
    divided further. For this reason, layers that are far thinner than a cell are resolved.
    """
    points, small = _points_within(x, y)
    distance, count = signed(*points)[small], len(small) * points[0].shape[1]
    width = max(float(np.hypot(x - x[k], y - y[k]).max(initial=0.0)) for k in range(len(x))) / FINE
    near = (np.abs(distance).min(axis=1) <= width) | exaggerates
    share = (~near & (distance[:, 0] < 0.0)).sum(axis=(0, 1)) / count
    facing = np.zeros((2, 2, len(share)))
    part, triangle, cell = np.nonzero(near)
    # Axes: axis, corner, triangle.
    at = np.array([c[small[part].T, triangle, cell] for c in points])
    distance = distance[part, :, triangle, cell].T
    for level in range(MAX_HALVINGS + 1):
        is_linear = np.abs(distance).min(axis=0) > (np.inf if exaggerates else width)
        if level == MAX_HALVINGS:
            is_linear[:] = True
        else:
            centre, mean = at[..., ~is_linear].mean(axis=1), distance[:, ~is_linear].mean(axis=0)
            error = np.abs(signed(*centre) - mean)
            is_linear[~is_linear] = error <= CURVATURE_TOLERANCE * width
        linear, cells = distance[:, is_linear], cell[is_linear]
        inside = 0.25**level / count * _negative_share(*linear)
        share += np.bincount(cells, inside, len(share))
        across = _across(at[..., is_linear], linear)
        length = np.hypot(*across)
        length[length == 0.0] = 1.0
        for row, column in ((0, 0), (0, 1), (1, 1)):
            product = across[row] * across[column] / length
            facing[row, column] += np.bincount(cells, product, len(share))
        if is_linear.all():
            break
        at, cell, width = _in_four(at[..., ~is_linear]), np.tile(cell[~is_linear], 4), width / 2
        distance = signed(*at)
    facing[1, 0] = facing[0, 1]
    return share, np.moveaxis(facing, -1, 0)


def _across(at: Floats, distance: Floats) -> Floats:
    """Return the segments of an outline in triangles, rotated by a right angle, (axis, triangle).
    In a triangle the outline is a straight segment.

    `at` is (axis, corner, triangle). The result is 0 for a triangle that the outline does not
    cross.
    """
    inside = distance < 0.0
    odd = np.where(inside.sum(axis=0) == 1, inside, ~inside)
    apex, indices = odd.argmax(axis=0), np.arange(at.shape[-1])
    cut = inside.any(axis=0) & ~inside.all(axis=0)
    tip, ends = distance[apex, indices], []
    for turn in (1, 2):
        other = (apex + turn) % 3
        rise = np.where(cut, tip - distance[other, indices], 1.0)
        ends.append(tip / rise * (at[:, other, indices] - at[:, apex, indices]))
    x, y = np.where(cut, ends[1] - ends[0], 0.0)
    return np.stack([-y, x])


def _in_four(at: Floats) -> Floats:
    """Divide each triangle into four triangles of half its width. The shape of triangles is (axis,
    corner, triangle)."""
    a, b, c = at.swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.concatenate([np.stack(three, axis=1) for three in corners], axis=-1)


def _points_within(x: Floats, y: Floats) -> tuple[tuple[Floats, Floats], Indices]:
    """Return the points into which cells are divided, and for each small triangle the indices of
    its points.

    Points are (x, y), each (point, triangle, cell), for cells with corners (corner, cell).
    """
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
    """Return the window shifted by a number of sites."""
    return tuple(slice(s.start + n, s.stop + n) for s, n in zip(window, step, strict=True))


def _width(polygon: CellPolygon) -> float:
    """Return the largest distance between corners of a cell."""
    return max(math.dist(a, b) for a in polygon.rest for b in polygon.rest)


@cache
def _sides(n: int) -> tuple[Indices, Indices]:
    """Return indices of the points along the sides of a cell with n corners.

    The indices are a pair (point, triangle); both arrays are (side, point).
    """
    weights, _ = _small_triangles()
    _, k, m = (weights.T * FINE).round().astype(int).tolist()
    number = {place: index for index, place in enumerate(zip(k, m, strict=True))}
    along = range(FINE + 1)
    first = [number[t, 0] for t in along]
    if n > 3:
        return np.array([first] * n), np.repeat(np.arange(n)[:, None], FINE + 1, axis=1)
    second, third = [number[FINE - t, t] for t in along], [number[0, FINE - t] for t in along]
    points = np.array([first, second, third])
    return points, np.zeros_like(points)


@cache
def _mesh(n: int) -> tuple[Floats, Indices]:
    """Build a mesh of a cell with n corners.

    Returns
    -------
    tuple
        Array of shape (point, corner) with the weights of the corners at each point, and array of
        shape (edge, end) with the points at the ends of each edge. The first points are the corners
        of the cell. All other points on the border are moved slightly inward.
    """
    fine, small = _small_triangles(FINER)
    corners = np.concatenate([np.eye(n), np.full((1, n), 1 / n)])
    triangles = [(k, (k + 1) % n, n) for k in range(n)] if n > 3 else [(0, 1, 2)]
    points = np.concatenate([fine @ corners[list(three)] for three in triangles]).round(9)
    number: dict[tuple[float, ...], int] = {}
    point = [number.setdefault(tuple(row), len(number)) for row in points.tolist()]
    small_triangles = np.reshape(point, (len(triangles), -1))[:, small].reshape(-1, 3)
    pairs = {(a, b) for three in small_triangles.tolist() for a, b in permutations(three, 2)}
    images = [number[tuple(row)] for row in np.eye(n).tolist()]
    edges = [(n + a, n + b) for a, b in sorted(pairs) if a < b]
    for k, image in enumerate(images):
        edges += [(k, n + image), *((k, n + b) for a, b in sorted(pairs) if a == image)]
    weights = np.concatenate([np.eye(n), _inward(np.array(list(number)))])
    return weights, np.array(edges)


def _inward(weights: Floats) -> Floats:
    """Move points slightly towards the centre of a cell, given the weights of the corners.

    As a result, parts of the body that are connected only along the border of a cell do not count
    as connected in its interior.
    """
    return np.asarray((1.0 - INWARD) * weights + INWARD / weights.shape[-1])


@cache
def _small_triangles(fine: int = FINE) -> tuple[Floats, Indices]:
    """Divide a triangle into small triangles.

    Returns
    -------
    tuple
        Array of shape (point, corner) with the barycentric coordinates of the points, and array of
        shape (triangle, corner) with the points at the corners of each small triangle.
    """
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
    """Return the fraction of the area of triangles in which a linear function is negative, given
    the values of the function at the corners.
    """
    small, large = np.minimum(a, b), np.maximum(a, b)
    low, middle = np.minimum(small, c), np.maximum(small, np.minimum(large, c))
    high = np.maximum(large, c)
    with np.errstate(invalid="ignore", divide="ignore"):
        one_negative = low * low / ((low - middle) * (low - high))
        two_negative = 1.0 - high * high / ((high - low) * (high - middle))
    share = np.where(middle >= 0.0, one_negative, two_negative)
    return np.where(high <= 0.0, 1.0, np.where(low >= 0.0, 0.0, share))
