"""Algebraic multigrid for sparse matrices of particles with known places, with scipy alone.

The functions of a coarser grid are hats, bilinear in the plane and trilinear in space, around
points twice as far apart; where a crack cuts a hat, each connected piece is a function of its own.
Matrices of coarser grids are Galerkin products. docs/decisions/0010 compares it with pyamg.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask

COARSEST = 400
"""Unknowns up to which a grid is solved with its inverse."""
MOST_GRIDS = 20
STRONG = 0.01
"""Relative size from which on a bond connects."""
ROUNDS, MARGIN, BAND = 12, 1.1, 5.0
"""Turns to find the largest eigenvalue, what it is multiplied with, and by how much smaller those
are that relaxation does not look at."""
SINGULAR = 1e-9


@dataclass(frozen=True)
class _Level:
    """`prolongs` takes a grid's values to this one's; `own` are the inverses of the blocks on the
    diagonal, `largest` the largest eigenvalue of the matrix times them."""

    matrix: Any
    own: Any
    largest: float
    prolongs: Any
    restricts: Any

    def relaxed(self, b: Floats, x: Floats | None = None) -> Floats:
        """Two steps of Chebyshev's iteration for the upper part of the spectrum."""
        high, low = self.largest, self.largest / BAND
        middle, half = (high + low) / 2, (high - low) / 2
        share = half / middle
        r = b if x is None else b - self.matrix @ x
        way = (self.own @ r) / middle
        x = way if x is None else x + way
        further = 1.0 / (2.0 / share - share)
        way = further * share * way + 2.0 * further / half * (self.own @ (b - self.matrix @ x))
        return np.asarray(x + way)


class SparseGrids:
    """Approximates A⁻¹ r by a V-cycle in single precision. Of the matrix there are `axes` unknowns
    a particle, one after the other; `places` (particle, axis of space) says where particles lie,
    `led` where the leaders do, `held` which unknowns stand alone, and are not interpolated to."""

    def __init__(
        self, matrix: Any, axes: int, places: Floats, led: Floats, held: Mask | None = None
    ) -> None:
        self._levels: list[_Level] = []
        A, spacing = matrix.astype(np.float32).tocsr(), _spacing(np.concatenate([places, led]))
        origin = places.min(axis=0, initial=np.inf)
        while A.shape[0] > COARSEST and len(self._levels) < MOST_GRIDS:
            spacing = np.where(spacing <= 1.5 * spacing.min(), 2.0 * spacing, spacing)
            hats, points = _hats(A, axes, (places - origin) / spacing, (led - origin) / spacing)
            if hats.shape[1] > 0.8 * hats.shape[0]:
                continue
            if held is not None:
                hats, held = _free(hats, held)
            own = _own_inverses(A, axes)
            restricts = hats.T.tocsr()
            self._levels.append(_Level(A, own, MARGIN * _largest(A, own), hats, restricts))
            A, places = (restricts @ (A @ hats)).tocsr(), points * spacing + origin
            if held is not None:
                A = A + _chosen(held)
        self._coarsest = np.linalg.pinv(A.toarray().astype(float), rcond=SINGULAR).astype(
            np.float32
        )

    def __call__(self, r: Floats) -> Floats:
        """One cycle from zero; r is scaled, for it may be tiny in single precision."""
        scale = float(np.abs(r).max(initial=0.0))
        if not 0.0 < scale < np.inf:
            return r.copy()
        found = self._cycled(0, (r * (1.0 / scale)).astype(np.float32))
        return np.asarray(found.astype(float) * scale)

    def _cycled(self, depth: int, b: Floats) -> Floats:
        if depth == len(self._levels):
            return np.asarray(self._coarsest @ b)
        level = self._levels[depth]
        x = level.relaxed(b)
        coarse = self._cycled(depth + 1, level.restricts @ (b - level.matrix @ x))
        return level.relaxed(b, x + level.prolongs @ coarse)


def _spacing(places: Floats) -> Floats:
    """How far apart rows of particles lie along each axis."""
    found = []
    for along in places.T:
        apart = np.diff(np.unique(along.round(9)))
        found.append(float(apart.min(initial=np.inf)))
    spacing = np.array(found)
    return np.where(
        np.isfinite(spacing), spacing, spacing.min(initial=1.0, where=np.isfinite(spacing))
    )


def _hats(A: Any, axes: int, at: Floats, led: Floats) -> tuple[Any, Floats]:
    """(unknown, unknown of the next grid) the hats, and the points that they are around; `at` and
    `led` in units of the next grid. Around points to which a leader is nearer than any particle
    there is none."""
    from scipy.sparse import csr_array, eye_array, kron

    low = np.floor(np.minimum(at.min(axis=0), led.min(axis=0, initial=0.0))).astype(int) - 1
    shape = tuple(
        (np.ceil(np.maximum(at.max(axis=0), led.max(axis=0, initial=0.0))) - low + 2).astype(int)
    )
    near, near_led = (_nearest(points, low, shape) for points in (at, led))
    kept = near <= near_led
    rows, points, values = [], [], []
    cell = np.floor(at)
    for corner in product((0, 1), repeat=at.shape[1]):
        weight = np.abs(1.0 - np.array(corner) - (at - cell)).prod(axis=1)
        point = np.ravel_multi_index(tuple((cell + corner - low).astype(int).T), shape)
        some = np.flatnonzero((weight > 1e-9) & kept[point])
        rows.append(some)
        points.append(point[some])
        values.append(weight[some])
    row, point, value = (np.concatenate(part) for part in (rows, points, values))
    count, piece = _pieces(A, axes, row, point, len(at))
    around = np.zeros(count, np.intp)
    around[piece] = point
    hats = csr_array((value.astype(np.float32), (row, piece)), (len(at), count))
    places = np.stack(np.unravel_index(around, shape), axis=1) + low
    return kron(hats, eye_array(axes, dtype=np.float32), format="csr"), places.astype(float)


def _free(hats: Any, held: Mask) -> tuple[Any, Mask]:
    """The hats of what is free, and which unknowns of the next grid are held: those to which one
    that is held is nearer than any other."""
    led, free = (_chosen(some) @ hats for some in (held, ~held))
    below = (led.max(axis=0).toarray() > free.max(axis=0).toarray()).ravel()
    return (free @ _chosen(~below)).tocsr(), below


def _chosen(some: Mask) -> Any:
    """1 on the diagonal of some."""
    from scipy.sparse import diags_array

    return diags_array(some.astype(np.float32), format="csr")


def _nearest(at: Floats, low: Indices, shape: tuple[int, ...]) -> Floats:
    """How far each point of the next grid is from the nearest of some places, as far as these lie
    in a cell beside it."""
    found = np.full(int(np.prod(shape)), np.inf)
    cell = np.floor(at)
    for corner in product((0, 1), repeat=at.shape[1]):
        point = np.ravel_multi_index(tuple((cell + corner - low).astype(int).T), shape)
        np.minimum.at(found, point, np.linalg.norm(at - cell - corner, axis=1))
    return found


def _pieces(A: Any, axes: int, row: Indices, point: Indices, count: int) -> tuple[int, Indices]:
    """(count, piece) of the entries of hats: those around one point whose particles are bonded to
    each other are one piece."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import connected_components

    a, b = _bonds(A, axes)
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(count + 1))
    most = int(np.diff(first).max(initial=0))
    slots = np.full((count, most), -1, np.intp)
    slots[row[order], np.arange(len(row)) - first[row[order]]] = order
    pairs = []
    for m, n in product(range(most), repeat=2):
        one, other = slots[a, m], slots[b, n]
        same = (one >= 0) & (other >= 0) & (point[one] == point[other])
        pairs.append(np.stack([one[same], other[same]]))
    one, other = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(one), np.int8), (one, other)), (len(row),) * 2)
    number, label = connected_components(csr_array(graph), directed=False)
    return int(number), label


def _bonds(A: Any, axes: int) -> tuple[Indices, Indices]:
    """The pairs of particles that pull at each other, one way or the other."""
    entries = A.tocoo()
    diagonal = np.abs(A.diagonal()).reshape(-1, axes).max(axis=1)
    a, b = entries.row // axes, entries.col // axes
    strong = np.abs(entries.data) > STRONG * np.sqrt(diagonal[a] * diagonal[b])
    return a[strong & (a != b)], b[strong & (a != b)]


def _own_inverses(A: Any, axes: int) -> Any:
    """The inverses of the blocks on the diagonal, as a matrix."""
    from scipy.sparse import bsr_array

    count = A.shape[0] // axes
    blocks = np.zeros((count, axes, axes))
    entries = A.tocoo()
    same = entries.row // axes == entries.col // axes
    row, column = entries.row[same], entries.col[same]
    blocks[row // axes, row % axes, column % axes] = entries.data[same]
    inverse = np.linalg.pinv(blocks, rcond=SINGULAR).astype(np.float32)
    return bsr_array((inverse, np.arange(count), np.arange(count + 1)), A.shape).tocsr()


def _largest(A: Any, own: Any) -> float:
    """About the largest eigenvalue of D⁻¹ A."""
    x, size = np.random.default_rng(0).normal(size=A.shape[0]).astype(np.float32), 1.0
    for _ in range(ROUNDS):
        x = own @ (A @ x)
        size = float(np.linalg.norm(x))
        x /= size
    return size
