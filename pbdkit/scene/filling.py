"""Fills an outline with the sites of a lattice, and looks at what came out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from operator import add

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Body, Box, Floats, Sites
from pbdkit.interfaces import Cell, Lattice
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.raster import CHUNK_ROWS, cells_of_sites, positions
from pbdkit.scene.rasterising import Mask, existing


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
