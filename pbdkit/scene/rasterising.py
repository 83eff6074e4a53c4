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
    low = (origin[0] - layers, origin[1] - layers)
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
    i, j = np.arange(low[0], low[0] + shape[0]), np.arange(low[1], low[1] + shape[1])
    there: Mask = sublattices(cell) >= 0
    return there[np.ix_(i % cell.period[0], j % cell.period[1])]


def dilated(mask: Mask, layers: int) -> Mask:
    """Every place within `layers` of a true one, along either axis or both."""
    for axis in (0, 1):
        grown = mask.copy()
        for k in range(1, layers + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(k, None), slice(None, -k)
            grown[tuple(ahead)] |= mask[tuple(behind)]
            grown[tuple(behind)] |= mask[tuple(ahead)]
        mask = grown
    return mask


def _extent(
    cell: Cell, low: Index, window: tuple[int, ...], reach: Index
) -> tuple[Index, tuple[int, int, int]]:
    """(first cell, shape) of the rasters: the window's cells and all that a slot can reach."""
    ends = np.array([[low[0], low[1]], [low[0] + window[0] - 1, low[1] + window[1] - 1]])
    _, m, n = cells_of_sites(cell, ends[:, 0], ends[:, 1])
    first = (int(m[0]) - reach[0], int(n[0]) - reach[1])
    shape = (
        len(cell.sites),
        int(m[1]) + reach[0] + 1 - first[0],
        int(n[1]) + reach[1] + 1 - first[1],
    )
    return first, shape
