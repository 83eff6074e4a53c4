"""The cells of a body at rest, which a field fills: quadrilaterals, or triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
BRIDGE = 1.35
"""A reference triangle longer than so many usual ones bridges a hole or a notch."""


def cells_of(site: Array, reference: Array) -> Array:
    """The rows of the corners of each cell, (cell, 4), in turn; of triangles the last one twice.

    `site` (particle, 2) are whole numbers. Where the places of sites (i, j) repeat along i, as on
    Bravais lattices, cells are Delaunay's of the lattice: squares and rectangles, else triangles.
    Elsewhere they are Delaunay's triangles without those that bridge gaps. None where all particles
    are in line.
    """
    found = _of_sites(site, reference) if len(site) else None
    if found is None:
        triangles = triangles_of(reference)
        found = triangles[:, [0, 1, 2, 2]]
    return found


def triangles_of(reference: Array) -> Array:
    """Delaunay's triangles, (triangle, 3), without those that bridge gaps; none where all places
    are in line."""
    from scipy.spatial import Delaunay, QhullError

    try:
        triangles = Delaunay(reference).simplices
    except (QhullError, ValueError):
        return np.empty((0, 3), np.intp)
    corners = reference[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.hypot(sides[..., 0], sides[..., 1]).max(axis=1)
    return np.asarray(triangles[longest <= BRIDGE * np.median(longest)])


def _of_sites(site: Array, reference: Array) -> Array | None:
    """The cells between sites (i, j), (i+1, j), (i+1, j+1), (i, j+1), whole or halved along the
    shorter diagonal; None where the places of sites do not repeat."""
    low = site.min(axis=0)
    shape = site.max(axis=0) - low + 1
    if shape.min() < 2 or shape.prod() > 20 * len(site):
        return None
    rows = np.full(shape, -1, np.int32)
    rows[tuple((site - low).T)] = np.arange(len(site))
    along, up = _steps(rows, reference, 0), _steps(rows, reference, 1)
    if (rows >= 0).sum() < len(site) or not len(along) or not len(up):
        return None
    # How far row j + 1 is shifted against row j is the same all along them, on a Bravais lattice.
    j = np.nonzero((rows[:, :-1] >= 0) & (rows[:, 1:] >= 0))[1]
    of_row = np.full((shape[1] - 1, 2), np.nan)
    of_row[j] = up
    slack = 1e-6 * np.abs(along[0]).max()
    if max(np.abs(along - along[0]).max(), np.abs(up - of_row[j]).max()) > slack:
        return None
    a, b = rows[:-1, :-1].ravel(), rows[1:, :-1].ravel()
    c, d = rows[1:, 1:].ravel(), rows[:-1, 1:].ravel()
    rise = np.broadcast_to(of_row, (shape[0] - 1, *of_row.shape)).reshape(-1, 2)
    rising = np.hypot(*(along[0] + rise).T)  # a to c
    falling = np.hypot(*(along[0] - rise).T)  # b to d
    equal = np.abs(rising - falling) <= 1e-6 * rising
    quads = np.stack([a, b, c, d], axis=1)[equal]
    shorter = ~equal & (rising < falling)
    longer = ~equal & (rising > falling)
    triangles = [np.stack([a, b, c, c], 1)[shorter], np.stack([a, c, d, d], 1)[shorter],
                 np.stack([a, b, d, d], 1)[longer], np.stack([b, c, d, d], 1)[longer]]  # fmt: skip
    found = np.concatenate([quads, *triangles])
    there = np.bitwise_or.reduce([found[:, k] for k in range(4)]) >= 0  # -1 has the sign bit
    return found if there.all() else found[there]


def _steps(rows: Array, reference: Array, axis: int) -> Array:
    """From each site to the next along an index, (pair, 2), where both are."""
    count = rows.shape[axis]
    here, there = rows.take(range(count - 1), axis), rows.take(range(1, count), axis)
    both = (here >= 0) & (there >= 0)
    return np.asarray(reference[there[both]] - reference[here[both]])


def whole(cells: Array, pairs: Array, particles: int) -> Array:
    """Which cells, (cell,), have none of these pairs of rows, (pair, 2), as a side or diagonal."""
    kept = np.ones(len(cells), np.bool_)
    if not len(pairs):
        return kept
    touched = np.zeros(particles, np.bool_)
    touched[pairs] = True
    near = np.flatnonzero(touched[cells].sum(axis=1) >= 2)
    gone = np.unique(_codes(pairs, particles))
    ends = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]
    sides = np.stack([_codes(cells[near][:, end], particles) for end in ends], axis=1)
    kept[near[np.isin(sides, gone).any(axis=1)]] = False
    return kept


def outline(cells: Array, particles: int) -> Array:
    """The sides of one cell only, as pairs of rows, (side, 2)."""
    sides = np.concatenate([cells[:, [k, (k + 1) % 4]] for k in range(4)])
    sides = sides[sides[:, 0] != sides[:, 1]]
    codes, counts = np.unique(_codes(sides, particles), return_counts=True)
    return np.stack(np.divmod(codes[counts == 1], particles), axis=1)


def _codes(pairs: Array, particles: int) -> Array:
    """One number for each pair, whichever comes first."""
    low, high = np.sort(pairs.astype(np.int64), axis=1).T
    return np.asarray(low * particles + high)
