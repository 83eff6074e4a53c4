"""Puts a body and its frame on rasters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from operator import add

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Body, Box, Floats, Sites
from pbdkit.interfaces import Cell, Lattice
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
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

Mask = NDArray[np.bool_]


def build_raster(
    lattice: Lattice, body: Mask, origin: Index, layers: int, reach_in_cells: Index
) -> Raster:
    """The raster of a body and its frame.

    `body` tells which sites of a window belong to it, `origin` is the site index of its first;
    the frame takes every other site within `layers` of index distance of the body.
    """
    cell = lattice.cell()
    inside = np.pad(body, layers)
    low = tuple(n - layers for n in origin)
    window = dilated(inside, layers) & existing(cell, low, inside.shape)
    sites = np.where(window, np.int8(FRAME), np.int8(EMPTY))
    sites[inside] = FOLLOWER
    first, shape = _extent(cell, low, sites.shape, reach_in_cells)
    kind = np.full(shape, EMPTY, np.int8)
    raster = Raster(lattice, shape, first, kind, low, sites)
    for rows in raster.chunks():
        kind.ravel()[raster.place_of(rows)] = raster.table_kind[rows]
    return raster


def existing(cell: Cell, low: Index, shape: tuple[int, ...]) -> Mask:
    """Which sites of a window of indices, from `low` on, the lattice has."""
    along = [np.arange(n, n + size) for n, size in zip(low, shape, strict=True)]
    there: Mask = sublattices(cell) >= 0
    return there[np.ix_(*(n % p for n, p in zip(along, cell.period, strict=True)))]


def dilated(mask: Mask, layers: int) -> Mask:
    """Every place within `layers` of a true one, along either axis or both."""
    for axis in range(mask.ndim):
        grown = mask.copy()
        for k in range(1, layers + 1):
            ahead, behind = [slice(None)] * mask.ndim, [slice(None)] * mask.ndim
            ahead[axis], behind[axis] = slice(k, None), slice(None, -k)
            grown[tuple(ahead)] |= mask[tuple(behind)]
            grown[tuple(behind)] |= mask[tuple(ahead)]
        mask = grown
    return mask


def _extent(
    cell: Cell, low: Index, window: tuple[int, ...], reach: Index
) -> tuple[Index, tuple[int, ...]]:
    """(first cell, shape) of the rasters: the window's cells and all that a slot can reach."""
    ends = np.array([low, np.add(low, window) - 1])
    _, *cells = cells_of_sites(cell, *ends.T)
    first = tuple(int(m[0]) - r for m, r in zip(cells, reach, strict=True))
    last = [int(m[1]) + r for m, r in zip(cells, reach, strict=True)]
    return first, (len(cell.sites), *(b + 1 - a for a, b in zip(first, last, strict=True)))


def window(body: Body, lattice: Lattice) -> tuple[Index, Index]:
    """The smallest and the largest site index (i, j) that may belong to the body."""
    corners = [_indices(box, lattice) for box in body.boxes()]
    low, high = zip(*corners, strict=True)
    return (
        tuple(map(min, zip(*low, strict=True))),
        tuple(map(max, zip(*high, strict=True))),
    )


def fill(body: Body, lattice: Lattice) -> tuple[Mask, Index]:
    """(mask, origin): which sites of a window belong to the body, and the index of its first.

    The window is as small as the body allows. Raises ExperimentError where no site belongs.
    """
    low, high = window(body, lattice)
    cell = lattice.cell()
    if max(map(abs, (*low, *high))) > 2**31 - 100:
        raise ExperimentError(
            "lies beyond the site indices of 32 bits; move it, or the lattice's origin, nearer",
            ("body",),
        )
    inside = existing(cell, low, tuple(b - a + 1 for a, b in zip(low, high, strict=True))).copy()
    lines = max(1, CHUNK_ROWS // inside[0].size)
    for begin in range(0, len(inside), lines):
        ends = [min(low[0] + begin + lines - 1, high[0]), *high[1:]]
        along = map(np.arange, [low[0] + begin, *low[1:]], np.add(ends, 1))
        inside[begin : begin + lines] &= _belongs(body, lattice, np.meshgrid(*along, indexing="ij"))
    if not inside.any():
        raise ExperimentError("holds no site of the lattice; make it larger, or move it", ("body",))
    places = np.nonzero(inside)
    first, last = ([int(end(n)) for n in places] for end in (np.min, np.max))
    trimmed = inside[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))]
    return trimmed, tuple(map(add, low, first))


def _belongs(body: Body, lattice: Lattice, index: Sequence[Indices]) -> Mask:
    """Whether the sites lie inside or on the outline."""
    cell = lattice.cell()
    at = positions(cell, *cells_of_sites(cell, *index)).each(add, lattice.origin)
    found: Mask = body.distance(Sites(index, at)) <= rounding_of(cell, *at)
    return found


def rounding_of(cell: Cell, *at: Floats) -> float:
    """The distance up to which points count as on the outline."""
    rounding = 4 * np.finfo(float).eps * max(np.abs(x).max() for x in at)
    return float(max(1e-9 * math.hypot(*cell.vectors[0]), rounding))


def has_narrow_slot(body: Mask, layers: int) -> bool:
    """Whether somewhere fewer than 2·layers + 1 empty sites lie between two faces of the body,
    in two lines side by side: frame points there belong to both faces."""
    axes = range(body.ndim)
    return any(_narrow(np.moveaxis(body, axis, -1), 2 * layers + 1) for axis in axes)


def _narrow(body: Mask, wide_enough: int) -> bool:
    """Looks along the last axis: distance to the nearest particle behind and ahead."""
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
    low = [math.floor(n.min()) - 1 for n in cells]
    high = [math.ceil(n.max()) + 1 for n in cells]
    return (
        tuple(n * p for n, p in zip(low, cell.period, strict=True)),
        tuple(n * p + p - 1 for n, p in zip(high, cell.period, strict=True)),
    )
