"""The outline of the drawn part of a body as closed lines that move with the particles.

Fields are clipped to this outline, so that their edges are smooth at every resolution. The outline
consists of sides of cells and, in cells that are cut, of the zero line of the distance from the
outline of the body. Cells with broken bonds are left out, so that cracks belong to the outline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from matplotlib.path import Path

from pbdkit.array_types import Array
from pbdkit.plotting.data import CutCells, corner_weights, pair_codes

RESOLUTION = 1e-5
"""Distance at rest, relative to the size of a cell, below which two points are the same."""
OFFSET = 0.3137
"""Offset of the grid on which points are identified. With it, points of a lattice do not lie at the
border between two cells of this grid."""


@dataclass(frozen=True)
class Edges:
    """Directed edges along the boundary of cells, with the body on the left of a counterclockwise
    cell. The position of a point is the mean of the positions of four particles: `rows` and
    `weights` have the shape (edge, end, 4)."""

    rows: Array
    weights: Array

    def at(self, position: Array) -> Array:
        """Return the places of the ends, (edge, end, axis)."""
        return np.asarray(np.einsum("neka,nek->nea", position[self.rows], self.weights))

    def selected(self, chosen: Array, reverse: Array) -> Edges:
        """Return the chosen edges, of which some are reversed."""
        rows, weights = self.rows[chosen], self.weights[chosen]
        rows[reverse], weights[reverse] = rows[reverse, ::-1], weights[reverse, ::-1]
        return Edges(rows, weights)


@dataclass(frozen=True)
class OutlinePath:
    """Closed lines. A line consists of the first ends of some `edges`, in the order of `loops`."""

    edges: Edges
    loops: list[Array]

    @classmethod
    def of(cls, cells: Array, cut: CutCells | None, rows: Array, reference: Array) -> OutlinePath:
        """Compute the outline of some cells, (cell, 4). `rows` are those of the cells in the table
        of cut cells, and -1 for cells that are not cut."""
        sides, cut_cells = _sides(cells[rows < 0], len(reference)), cells[rows >= 0]
        beside_cut = np.isin(sides, cut_cells).all(axis=1)
        parts = [_divided(sides[~beside_cut], 1)]
        if cut is not None:
            parts += [_divided(sides[beside_cut], cut.parts)]
            parts += _cut_edges(cut_cells, cut.distance[rows[rows >= 0]])
        edges = Edges(*(np.concatenate(each) for each in zip(*map(_arrays, parts), strict=True)))
        size = np.ptp(reference[cells[:1]], axis=1).max(initial=0.0) or 1.0
        points = np.floor(edges.at(reference) / (RESOLUTION * size) + OFFSET).astype(np.int64)
        points -= points.reshape(-1, 2).min(axis=0, initial=0)
        codes = points[..., 0] * (1 + points[..., 1].max(initial=0)) + points[..., 1]
        chosen, reverse = _boundary(codes)
        codes = codes[chosen]
        codes[reverse] = codes[reverse, ::-1]
        return cls(edges.selected(chosen, reverse), [*_loops(codes)])

    def path(self, position: Array) -> Path:
        """Return the outline at some positions, (particle, axis)."""
        starts = self.edges.at(position)[:, 0]
        vertices, codes = [], []
        for loop in self.loops:
            vertices.append(np.concatenate([starts[loop], starts[loop[:1]]]))
            kinds = np.full(len(loop) + 1, Path.LINETO, Path.code_type)
            kinds[0], kinds[-1] = Path.MOVETO, Path.CLOSEPOLY
            codes.append(kinds)
        if not vertices:
            return Path(np.empty((0, 2)))
        return Path(np.concatenate(vertices), np.concatenate(codes))


def _arrays(edges: Edges) -> tuple[Array, Array]:
    return edges.rows, edges.weights


def _sides(cells: Array, particles: int) -> Array:
    """Return the sides that belong to one cell only, as pairs of rows, (side, 2)."""
    sides = np.concatenate([cells[:, [k, (k + 1) % 4]] for k in range(4)])
    sides = sides[sides[:, 0] != sides[:, 1]]
    codes = pair_codes(sides, particles)
    ordered = np.concatenate([[-1], np.sort(codes), [-1]])
    is_single = (ordered[1:-1] != ordered[:-2]) & (ordered[1:-1] != ordered[2:])
    return np.asarray(sides[np.isin(codes, ordered[1:-1][is_single])])


def _divided(sides: Array, parts: int) -> Edges:
    """Return sides, each divided into parts."""
    along = np.linspace(0.0, 1.0, parts + 1)
    shares = np.stack([along[:-1], along[1:]], axis=1)
    weights = np.zeros((parts, 2, 4))
    weights[..., 0], weights[..., 1] = 1.0 - shares, shares
    rows = np.broadcast_to(sides[:, None, None, [0, 1, 1, 1]], (len(sides), parts, 2, 4))
    weights = np.broadcast_to(weights, rows.shape)
    return Edges(rows.reshape(-1, 2, 4), weights.reshape(-1, 2, 4))


def _cut_edges(cells: Array, distance: Array) -> Iterator[Edges]:
    """Generate the edges of the parts of cut cells inside the outline. `distance` has the shape
    (cell, point, point)."""
    weights = corner_weights(np.linspace(0.0, 1.0, distance.shape[1]))
    low, high = slice(None, -1), slice(1, None)
    a, b, c, d = (low, low), (low, high), (high, high), (high, low)
    away = np.stack([distance[:, v, u] for v, u in (a, b, c, d)], axis=-1)
    whole, mixed = (away <= 0.0).all(axis=-1), (away <= 0.0).any(axis=-1)
    # Two neighbouring parts that are inside have no edge between them.
    for axis in (1, 2):
        padding = [(0, 0), (int(axis == 1),) * 2, (int(axis == 2),) * 2]
        change = np.diff(np.pad(whole, padding).astype(np.int8), axis=axis)
        ends = _lattice_edges(weights, axis)
        for sign in (1, -1):
            cell, v, u = np.nonzero(change == sign)
            chosen = ends[v, u][:, :: sign if axis == 1 else -sign]
            yield Edges(np.repeat(cells[cell][:, None], 2, axis=1), chosen)
    mixed &= ~whole
    for triangle in ((a, b, c), (a, c, d)):
        corners = np.stack([weights[v, u] for v, u in triangle], axis=2)
        depth = np.stack([distance[:, v, u] for v, u in triangle], axis=-1)
        cell, v, u = np.nonzero(mixed & (depth <= 0.0).any(axis=-1))
        yield _clipped(cells[cell], corners[v, u], depth[cell, v, u].astype(float))


def _lattice_edges(weights: Array, axis: int) -> Array:
    """Return the edges between the points of a cell, (v, u, end, 4), along u for `axis` 1, and
    along v for `axis` 2."""
    first, second = (weights[:, :-1], weights[:, 1:]) if axis == 1 else (weights[:-1], weights[1:])
    return np.stack([first, second], axis=2)


def _clipped(cells: Array, corners: Array, away: Array) -> Edges:
    """Return the edges of the parts of triangles where the distance is not positive. `corners` has
    the shape (triangle, corner, 4), and `away` the shape (triangle, corner)."""
    corners_next, away_next = np.roll(corners, -1, axis=1), np.roll(away, -1, axis=1)
    inside, inside_next = away <= 0.0, away_next <= 0.0
    crossed = inside != inside_next
    # Both triangles at a side compute the crossing in the same order, from inside to outside.
    near, far = (
        np.where(inside[..., None], first, second)
        for first, second in ((corners, corners_next), (corners_next, corners))
    )
    depth, height = np.where(inside, away, away_next), np.where(inside, away_next, away)
    share = np.where(crossed, depth / np.where(crossed, depth - height, 1.0), 0.0)
    crossing = near + share[..., None] * (far - near)
    start = np.where(inside[..., None], corners, crossing)
    end = np.where(inside_next[..., None], corners_next, crossing)
    along = inside | inside_next
    triangle, _ = np.nonzero(along)
    leaving, entering = inside & ~inside_next, ~inside & inside_next
    through = leaving.any(axis=1)
    closing = np.stack([crossing[leaving], crossing[entering]], axis=1)
    ends = np.concatenate([np.stack([start[along], end[along]], axis=1), closing])
    rows = np.concatenate([cells[triangle], cells[through]])
    return Edges(np.repeat(rows[:, None], 2, axis=1), ends)


def _boundary(codes: Array) -> tuple[Array, Array]:
    """Return the indices of the edges that remain when edges in opposite directions cancel, and
    which of them have to be reversed. `codes` (edge, end) identify the ends."""
    low, high = codes.min(axis=1), codes.max(axis=1)
    real = np.flatnonzero(low != high)
    order = real[np.lexsort((high[real], low[real]))]
    first = np.ones(len(order), bool)
    first[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    starts = np.flatnonzero(first)
    forward = np.where(codes[order, 0] == low[order], 1, -1)
    net = np.add.reduceat(forward, starts) if len(starts) else np.empty(0, int)
    kept = starts[net != 0]
    return order[kept], (net[net != 0] > 0) != (forward[kept] > 0)


def _loops(codes: Array) -> Iterator[Array]:
    """Generate the indices of the edges of each closed line."""
    following = dict[int, list[int]]()
    starts, ends = codes.T.tolist() if len(codes) else ([], [])
    for edge, start in enumerate(starts):
        following.setdefault(start, []).append(edge)
    for first in starts:
        code, loop = first, list[int]()
        while edges := following.get(code):
            loop.append(edges.pop())
            code = ends[loop[-1]]
        if len(loop) > 2:
            yield np.array(loop)
