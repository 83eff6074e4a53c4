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
from pbdkit.scene.places import Mask, bounds, hull
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


@dataclass(frozen=True)
class Filling:
    """The sites of the body on a window whose first site index is `first`, (i, j), and where cells
    are weighed the shares of the cells by the site of their first corner, (kind, i, j)."""

    body: Mask
    first: Index
    share: Floats | None = None

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


def trimmed(low: Index, body: Mask, share: Floats | None = None) -> Filling | None:
    """The same on a window as small as the body allows, from one that begins at the site `low`;
    None where there is no body."""
    if not (found := bounds(body)):
        return None
    inside = tuple(map(slice, *found))
    shares = None if share is None else share[(slice(None), *inside)]
    return Filling(body[inside], tuple(map(add, low, found[0])), shares)


def build_raster(lattice: Lattice, filling: Filling, layers: int, reach: Index) -> Raster:
    """The raster of a body and its frame, and of all that a slot can `reach`, in repeat cells.

    The frame takes every site within `layers` of index distance of the body that is none of it.
    """
    cell = lattice.cell()
    inside = np.pad(filling.body, layers)
    low = tuple(n - layers for n in filling.first)
    window = dilated(inside, layers) & has_sites(cell, low, inside.shape)
    sites = np.where(window, np.int8(FRAME), np.int8(EMPTY))
    sites[inside] = FOLLOWER
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


def window(body: Body, lattice: Lattice) -> tuple[Index, Index]:
    """The smallest and the largest site index (i, j) that may belong to the body."""
    return hull(_indices(box, lattice) for box in body.boxes())


def sites_from(lattice: Lattice, low: Index, shape: Index) -> Sites:
    """All indices of a window from the site `low` on, and where such sites lie or would lie."""
    index = [n + first for n, first in zip(np.indices(shape), low, strict=True)]
    at = positions(lattice.cell(), *cells_of_sites(lattice.cell(), *index))
    return Sites(index, at.each(add, lattice.origin))


def fill(body: Body, lattice: Lattice) -> Filling:
    """The sites inside or on the outline; ExperimentError where there is none."""
    low, high = window(body, lattice)
    cell = lattice.cell()
    if max(map(abs, (*low, *high))) > 2**31 - 100:
        raise ExperimentError(
            "lies beyond the site indices of 32 bits; move it, or the lattice's origin, nearer",
            ("body",),
        )
    shape = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
    inside = has_sites(cell, low, shape)
    lines = max(1, CHUNK_ROWS // inside[0].size)
    for begin in range(0, len(inside), lines):
        part = inside[begin : begin + lines]
        sites = sites_from(lattice, (low[0] + begin, *low[1:]), part.shape)
        part &= body.distance(sites) <= rounding_of(cell, *sites.at)
    if not (filling := trimmed(low, inside)):
        raise ExperimentError("holds no site of the lattice; make it larger, or move it", ("body",))
    return filling


def rounding_of(cell: Cell, *at: Floats) -> float:
    """The distance up to which points count as on the outline."""
    rounding = 4 * np.finfo(float).eps * max(np.abs(x).max(initial=0.0) for x in at)
    return float(max(1e-9 * math.hypot(*cell.vectors[0]), rounding))


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
