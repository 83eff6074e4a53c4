"""Fills an outline with the sites of a lattice, and looks at what came out."""

from __future__ import annotations

import math

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
    return (min(i for i, _ in low), min(j for _, j in low)), (
        max(i for i, _ in high),
        max(j for _, j in high),
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
    inside = existing(cell, low, (high[0] - low[0] + 1, high[1] - low[1] + 1)).copy()
    lines = max(1, CHUNK_ROWS // inside.shape[1])
    for begin in range(0, len(inside), lines):
        i = np.arange(low[0] + begin, min(low[0] + begin + lines, high[0] + 1))
        j = np.arange(low[1], high[1] + 1)
        inside[begin : begin + lines] &= _belongs(body, lattice, *np.meshgrid(i, j, indexing="ij"))
    if not inside.any():
        raise ExperimentError("holds no site of the lattice; make it larger, or move it", ("body",))
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    first = (int(rows[0]), int(columns[0]))
    trimmed = inside[first[0] : rows[-1] + 1, first[1] : columns[-1] + 1]
    return trimmed, (low[0] + first[0], low[1] + first[1])


def _belongs(body: Body, lattice: Lattice, i: Indices, j: Indices) -> Mask:
    """Whether the sites (i, j) lie inside or on the outline."""
    cell = lattice.cell()
    x, y = positions(cell, *cells_of_sites(cell, i, j))
    x, y = x + lattice.origin[0], y + lattice.origin[1]
    found: Mask = body.distance(Sites(i, j, x, y)) <= rounding_of(cell, x, y)
    return found


def rounding_of(cell: Cell, x: Floats, y: Floats) -> float:
    """The distance up to which a point at (x, y) counts as on the outline."""
    rounding = 4 * np.finfo(float).eps * max(np.abs(x).max(), np.abs(y).max())
    return float(max(1e-9 * math.hypot(*cell.vectors[0]), rounding))


def has_narrow_slot(body: Mask, layers: int) -> bool:
    """Whether somewhere fewer than 2·layers + 1 empty sites lie between two faces of the body,
    in two lines side by side: frame points there belong to both faces."""
    return any(_narrow(line_by_line, 2 * layers + 1) for line_by_line in (body, body.T))


def _narrow(body: Mask, wide_enough: int) -> bool:
    """Looks along the second axis: distance to the nearest particle behind and ahead."""
    place = np.arange(body.shape[1])
    behind = np.maximum.accumulate(np.where(body, place, -body.size - 1), axis=1)
    ahead = np.minimum.accumulate(np.where(body, place, 2 * body.size + 1)[:, ::-1], axis=1)[
        :, ::-1
    ]
    in_gap = ~body & (ahead - behind - 1 < wide_enough)
    return bool((in_gap[1:] & in_gap[:-1]).any())


def _indices(box: Box, lattice: Lattice) -> tuple[Index, Index]:
    """The site indices that cover a box."""
    if box.in_sites:
        (i, j), (k, m) = box.low, box.high
        return (int(i), int(j)), (int(k), int(m))
    cell = lattice.cell()
    cells = [_cells(cell, x, y) for x in _sides(box, lattice, 0) for y in _sides(box, lattice, 1)]
    across, along = zip(*cells, strict=True)
    # A basis site lies up to one cell from the corner of its own.
    low = (math.floor(min(across)) - 1, math.floor(min(along)) - 1)
    high = (math.ceil(max(across)) + 1, math.ceil(max(along)) + 1)
    p, q = cell.period
    return (low[0] * p, low[1] * q), (high[0] * p + p - 1, high[1] * q + q - 1)


def _sides(box: Box, lattice: Lattice, axis: int) -> tuple[float, float]:
    return box.low[axis] - lattice.origin[axis], box.high[axis] - lattice.origin[axis]


def _cells(cell: Cell, x: float, y: float) -> tuple[float, float]:
    """(x, y) in units of the cell vectors."""
    a, b = cell.vectors
    det = a.x * b.y - a.y * b.x
    return (x * b.y - y * b.x) / det, (a.x * y - a.y * x) / det
