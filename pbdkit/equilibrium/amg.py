"""Algebraic multigrid for sparse matrices of particles with known positions. It uses scipy only.

The points of a coarser grid have twice the spacing. Around each point is a basis function, a hat,
which is bilinear in the plane and trilinear in space. Where a crack cuts a hat, each connected
piece of the hat is a basis function of its own. Matrices of coarser grids are Galerkin products.
docs/decisions/0010 compares the result with pyamg.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask

COARSEST = 400
"""Number of unknowns up to which a grid is solved by its inverse."""
MAX_GRIDS = 20
"""Maximum number of grids."""
STRONG = 0.01
"""Ratio of an off-diagonal entry to the geometric mean of both diagonal entries, above which two
particles are strongly coupled."""
ROUNDS = 12
"""Number of power iterations that estimate the largest eigenvalue."""
MARGIN = 1.1
"""Safety factor by which the estimated largest eigenvalue is multiplied."""
BAND = 5.0
"""Ratio of the largest eigenvalue to the smallest eigenvalue of the modes that relaxation damps."""
SINGULAR = 1e-9
"""Relative singular value below which pseudo-inverses discard a mode."""


@dataclass(frozen=True)
class _Level:
    """One grid. `prolongs` is the matrix that interpolates values of the next coarser grid to this
    one. `own` contains the inverses of the diagonal blocks of the matrix, and `largest` is the
    largest eigenvalue of the product of `own` and the matrix."""

    matrix: Any
    own: Any
    largest: float
    prolongs: Any
    restricts: Any

    def relaxed(self, b: Floats, x: Floats | None = None) -> Floats:
        """Return x after two steps of Chebyshev's iteration for the upper part of the spectrum."""
        high, low = self.largest, self.largest / BAND
        middle, half = (high + low) / 2, (high - low) / 2
        share = half / middle
        r = b if x is None else b - self.matrix @ x
        correction = (self.own @ r) / middle
        x = correction if x is None else x + correction
        further = 1.0 / (2.0 / share - share)
        correction = further * share * correction + 2.0 * further / half * (
            self.own @ (b - self.matrix @ x)
        )
        return np.asarray(x + correction)


class SparseGrids:
    """Approximation of A⁻¹ r by one V-cycle in single precision. For each particle the matrix has
    `axes` unknowns, which are stored next to each other. The arrays `places` and `led` of shape
    (particle, axis of space) are the positions of the particles and of the leaders. `held` marks
    prescribed unknowns, which are not interpolated."""

    def __init__(
        self, matrix: Any, axes: int, places: Floats, led: Floats, held: Mask | None = None
    ) -> None:
        self._levels: list[_Level] = []
        A, spacing = matrix.astype(np.float32).tocsr(), _spacing(np.concatenate([places, led]))
        origin = places.min(axis=0, initial=np.inf)
        while A.shape[0] > COARSEST and len(self._levels) < MAX_GRIDS:
            spacing = np.where(spacing <= 1.5 * spacing.min(), 2.0 * spacing, spacing)
            hats, points = _hats(A, axes, (places - origin) / spacing, (led - origin) / spacing)
            if hats.shape[1] > 0.8 * hats.shape[0]:
                continue
            if held is not None:
                hats, held = _free(hats, held)
            block_inverses = _own_inverses(A, axes)
            restricts = hats.T.tocsr()
            self._levels.append(
                _Level(A, block_inverses, MARGIN * _largest(A, block_inverses), hats, restricts)
            )
            A, places = (restricts @ (A @ hats)).tocsr(), points * spacing + origin
            if held is not None:
                A = A + _chosen(held)
        self._coarsest = np.linalg.pinv(A.toarray().astype(float), rcond=SINGULAR).astype(
            np.float32
        )

    def __call__(self, r: Floats) -> Floats:
        """Return the result of one cycle that starts from zero. r is scaled first, since tiny
        values would underflow in single precision."""
        scale = float(np.abs(r).max(initial=0.0))
        if not 0.0 < scale < np.inf:
            return r.copy()
        x = self._cycled(0, (r * (1.0 / scale)).astype(np.float32))
        return np.asarray(x.astype(float) * scale)

    def _cycled(self, depth: int, b: Floats) -> Floats:
        if depth == len(self._levels):
            return np.asarray(self._coarsest @ b)
        level = self._levels[depth]
        x = level.relaxed(b)
        coarse = self._cycled(depth + 1, level.restricts @ (b - level.matrix @ x))
        return level.relaxed(b, x + level.prolongs @ coarse)


def _spacing(places: Floats) -> Floats:
    """Return the distance between rows of particles along each axis."""
    spacings = []
    for along in places.T:
        gaps = np.diff(np.unique(along.round(9)))
        spacings.append(float(gaps.min(initial=np.inf)))
    spacing = np.array(spacings)
    return np.where(
        np.isfinite(spacing), spacing, spacing.min(initial=1.0, where=np.isfinite(spacing))
    )


def _hats(A: Any, axes: int, at: Floats, led: Floats) -> tuple[Any, Floats]:
    """Return the hats as a matrix of shape (unknown, unknown of the next grid), and the points at
    which the hats are centred. The positions `at` of the particles and `led` of the leaders are in
    units of the spacing of the next grid. A point has no hat if a leader is nearer to it than any
    other particle."""
    from scipy.sparse import csr_array, eye_array, kron

    low = np.floor(np.minimum(at.min(axis=0), led.min(axis=0, initial=0.0))).astype(int) - 1
    shape = tuple(
        (np.ceil(np.maximum(at.max(axis=0), led.max(axis=0, initial=0.0))) - low + 2).astype(int)
    )
    near, near_led = (_nearest(points, low, shape) for points in (at, led))
    is_particle_nearer = near <= near_led
    rows, points, values = [], [], []
    cell = np.floor(at)
    for corner in product((0, 1), repeat=at.shape[1]):
        weight = np.abs(1.0 - np.array(corner) - (at - cell)).prod(axis=1)
        point = np.ravel_multi_index(tuple((cell + corner - low).astype(int).T), shape)
        entries = np.flatnonzero((weight > 1e-9) & is_particle_nearer[point])
        rows.append(entries)
        points.append(point[entries])
        values.append(weight[entries])
    row, point, value = (np.concatenate(part) for part in (rows, points, values))
    count, piece = _pieces(A, axes, row, point, len(at))
    around = np.zeros(count, np.intp)
    around[piece] = point
    hats = csr_array((value.astype(np.float32), (row, piece)), (len(at), count))
    places = np.stack(np.unravel_index(around, shape), axis=1) + low
    return kron(hats, eye_array(axes, dtype=np.float32), format="csr"), places.astype(float)


def _free(hats: Any, held: Mask) -> tuple[Any, Mask]:
    """Return the hats of free unknowns, and a mask of the held unknowns of the next grid. An
    unknown of the next grid is held if the nearest unknown of this grid is held."""
    led_weights, free_weights = (_chosen(mask) @ hats for mask in (held, ~held))
    below = (led_weights.max(axis=0).toarray() > free_weights.max(axis=0).toarray()).ravel()
    return (free_weights @ _chosen(~below)).tocsr(), below


def _chosen(mask: Mask) -> Any:
    """Return a diagonal matrix with 1 where the mask is true."""
    from scipy.sparse import diags_array

    return diags_array(mask.astype(np.float32), format="csr")


def _nearest(at: Floats, low: Indices, shape: tuple[int, ...]) -> Floats:
    """Return the distance of each point of the next grid from the nearest of the positions `at` in
    the cells around the point."""
    distances = np.full(int(np.prod(shape)), np.inf)
    cell = np.floor(at)
    for corner in product((0, 1), repeat=at.shape[1]):
        point = np.ravel_multi_index(tuple((cell + corner - low).astype(int).T), shape)
        np.minimum.at(distances, point, np.linalg.norm(at - cell - corner, axis=1))
    return distances


def _pieces(A: Any, axes: int, row: Indices, point: Indices, count: int) -> tuple[int, Indices]:
    """Return the number of pieces into which cracks divide the hats, and the piece to which each
    entry of the hats belongs. The entries of a hat belong to one piece if their particles are
    connected by bonds."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import connected_components

    a, b = _bonds(A, axes)
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(count + 1))
    width = int(np.diff(first).max(initial=0))
    slots = np.full((count, width), -1, np.intp)
    slots[row[order], np.arange(len(row)) - first[row[order]]] = order
    pairs = []
    for m, n in product(range(width), repeat=2):
        first_entries, second_entries = slots[a, m], slots[b, n]
        same = (
            (first_entries >= 0)
            & (second_entries >= 0)
            & (point[first_entries] == point[second_entries])
        )
        pairs.append(np.stack([first_entries[same], second_entries[same]]))
    first_entries, second_entries = np.concatenate(pairs, axis=1)
    graph = coo_array(
        (np.ones(len(first_entries), np.int8), (first_entries, second_entries)), (len(row),) * 2
    )
    number, label = connected_components(csr_array(graph), directed=False)
    return int(number), label


def _bonds(A: Any, axes: int) -> tuple[Indices, Indices]:
    """Return the pairs of particles that are coupled in at least one direction."""
    entries = A.tocoo()
    diagonal = np.abs(A.diagonal()).reshape(-1, axes).max(axis=1)
    a, b = entries.row // axes, entries.col // axes
    strong = np.abs(entries.data) > STRONG * np.sqrt(diagonal[a] * diagonal[b])
    return a[strong & (a != b)], b[strong & (a != b)]


def _own_inverses(A: Any, axes: int) -> Any:
    """Return the inverses of the diagonal blocks as a matrix."""
    from scipy.sparse import bsr_array

    count = A.shape[0] // axes
    blocks = np.zeros((count, axes, axes))
    entries = A.tocoo()
    same = entries.row // axes == entries.col // axes
    row, column = entries.row[same], entries.col[same]
    blocks[row // axes, row % axes, column % axes] = entries.data[same]
    inverse = np.linalg.pinv(blocks, rcond=SINGULAR).astype(np.float32)
    return bsr_array((inverse, np.arange(count), np.arange(count + 1)), A.shape).tocsr()


def _largest(A: Any, block_inverses: Any) -> float:
    """Estimate the largest eigenvalue of D⁻¹ A by power iteration."""
    x, size = np.random.default_rng(0).normal(size=A.shape[0]).astype(np.float32), 1.0
    for _ in range(ROUNDS):
        x = block_inverses @ (A @ x)
        size = float(np.linalg.norm(x))
        x /= size
    return size
