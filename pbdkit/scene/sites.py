"""Puts a body and its frame on rasters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Body, Box, Floats, Sites
from pbdkit.interfaces import Cell, Lattice
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.interfaces.polygons import Tiling
from pbdkit.scene.cells import WeighedCells
from pbdkit.scene.places import LeftOut, Mask, bounds, hull
from pbdkit.scene.raster import (
    CHUNK_ROWS,
    EMPTY,
    FOLLOWER,
    FRAME,
    Raster,
    cells_of_sites,
    positions,
    sublattices,
)

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
