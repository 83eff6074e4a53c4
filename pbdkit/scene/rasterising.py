"""Puts a body and its frame on rasters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Cell, Lattice
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.raster import EMPTY, FOLLOWER, FRAME, Raster, cells_of_sites, sublattices

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
