"""Displacements at points between particles: bilinear in a lattice's cells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.results.grid import polygons_of
from pbdkit.scene.raster import FOLLOWER, Raster
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats, initial_state

ON_EDGE = 1e-9
"""By what share of a cell a point beside it counts as within."""
OUTSIDE = "they lie in no whole cell of the body, or in one that is torn from the start"
"""The reason to leave a point out."""


@dataclass(frozen=True)
class Interpolation:
    """Points within cells of a body: which of those asked for (point,), the rows of the particles
    around each (point, corner), and the share that each has (point, corner)."""

    inside: NDArray[np.bool_]
    rows: Indices
    shares: Floats

    @classmethod
    def at(cls, scene: Scene, points: Floats) -> Interpolation:
        """The corners of a cell with one site are the four around a point; of others the nearest
        three of a cell of the lattice. A point that lacks one of them, as in a hole, is left out,
        and one between particles whose bond is broken from the start."""
        one = len(scene.raster.lattice.cell().sites) == 1
        found = _in_cells(scene, points) if one else _in_triangles(scene, points)
        return found._where(~_is_torn(scene, found)) if scene.has_fracture else found

    def _where(self, chosen: NDArray[np.bool_]) -> Interpolation:
        """With some of the points inside alone, True for each; the others count as outside."""
        inside = self.inside.copy()
        inside[self.inside] = chosen
        return replace(self.part(chosen), inside=inside)

    def part(self, chosen: NDArray[Any]) -> Interpolation:
        """Of some of the points inside: by their numbers among these, or True for each."""
        return replace(self, rows=self.rows[chosen], shares=self.shares[chosen])

    @cached_property
    def _places(self) -> dict[str, tuple[Raster, Indices]]:
        """Where the rows lie on the last raster that was asked for."""
        return {}

    def of(self, planes: Floats, scene: Scene) -> Floats:
        """(point, axis): the values of planes at the points inside."""
        known, place = self._places.get("last", (None, self.rows))
        if known is not scene.raster:
            place = scene.raster.place_of(self.rows.ravel()).reshape(self.rows.shape)
            self._places["last"] = scene.raster, place
        flat = planes.reshape(len(planes), -1)
        found: Floats = np.einsum("apc,pc->pa", flat[:, place], self.shares)
        return found


def _in_cells(scene: Scene, points: Floats) -> Interpolation:
    raster = scene.raster
    cell = raster.lattice.cell()
    vectors = np.array(cell.vectors, float)
    along = np.linalg.solve(vectors.T, (points - raster.lattice.origin).T).T
    low = np.floor(along + ON_EDGE)
    part = np.clip(along - low, 0.0, 1.0)
    low = low.astype(np.intp)
    x, y = part.T
    corners, shares = [], [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        corners.append(raster.rows_of_sites((low + step) * cell.period))
    rows, weights = np.stack(corners, axis=1), np.stack(shares, axis=1)
    unused = weights <= ON_EDGE  # on a side of the cell, or in its corner
    body = np.append(raster.table_kind == FOLLOWER, False)
    inside = np.asarray((body[rows] | unused).all(axis=1))
    rows = np.where(unused | ~inside[:, None], 0, rows)
    return Interpolation(inside, rows[inside], np.where(unused, 0.0, weights)[inside])


def _in_triangles(scene: Scene, points: Floats) -> Interpolation:
    from scipy.spatial import Delaunay

    body = scene.raster.body_rows
    mesh: Any = Delaunay(scene.raster.reference(body))
    found = mesh.find_simplex(points, tol=ON_EDGE)
    whole = _within_cells(scene, body[mesh.simplices])
    inside = (found >= 0) & whole[found]
    there = found[inside]
    transform = mesh.transform[there]
    part = np.einsum("pab,pb->pa", transform[:, :2], points[inside] - transform[:, 2])
    shares = np.concatenate([part, 1.0 - part.sum(axis=1, keepdims=True)], axis=1)
    return Interpolation(inside, body[mesh.simplices[there]], shares)


def _within_cells(scene: Scene, triangles: Indices) -> NDArray[np.bool_]:
    """Whether the corners of each triangle, rows of particles, are corners of one whole cell of the
    lattice; others bridge holes and notches."""
    count = scene.raster.count
    threes = [
        np.sort(rows[:, corners], axis=1)
        for rows in polygons_of(scene)
        for corners in combinations(range(rows.shape[1]), 3)
    ]
    known = np.concatenate([*threes, np.zeros((0, 3), np.intp)])
    # Pairs are numbered, so that no number is larger than the square of how many there are.
    pairs, number = np.unique(known[:, :2] @ (count, 1), return_inverse=True)
    keys = number * count + known[:, 2]
    own = np.sort(triangles, axis=1)
    pair = own[:, :2] @ (count, 1)
    at = np.searchsorted(pairs, pair)
    there = np.append(pairs, -1)[at] == pair
    return np.asarray(there & np.isin(at * count + own[:, 2], keys))


def _is_torn(scene: Scene, found: Interpolation) -> NDArray[np.bool_]:
    """Whether a bond between particles around each point inside is broken from the start."""
    broken, bonds = initial_state(scene).broken_step, scene.bonds
    assert broken is not None
    torn = broken.reshape(len(broken), -1)[bonds.plane, bonds.place] >= 0
    keys = bonds.ends[torn] @ (scene.raster.count, 1)
    rows, used = found.rows, found.shares > 0.0
    is_torn = np.zeros(len(rows), bool)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (scene.raster.count, 1)
        is_torn |= used[:, a] & used[:, b] & np.isin(pair, keys)
    return is_torn
