"""Displacements at points between particles: bilinear in a lattice's cells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.scene.raster import FOLLOWER, Raster
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats

ON_EDGE = 1e-9
"""By what share of a cell a point beside it counts as within."""
OUTSIDE = "they lie in no whole cell of the body"
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
        three of Delaunay's triangles. A point that lacks one of them is left out."""
        one = len(scene.raster.lattice.cell().sites) == 1
        return _in_cells(scene, points) if one else _in_triangles(scene, points)

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
    sides = np.ptp(mesh.points[mesh.simplices], axis=1).max(axis=1)
    found = mesh.find_simplex(points, tol=ON_EDGE)
    bridging = sides > 1.5 * np.median(sides)
    inside = (found >= 0) & ~bridging[found]
    there = found[inside]
    transform = mesh.transform[there]
    part = np.einsum("pab,pb->pa", transform[:, :2], points[inside] - transform[:, 2])
    shares = np.concatenate([part, 1.0 - part.sum(axis=1, keepdims=True)], axis=1)
    return Interpolation(inside, body[mesh.simplices[there]], shares)
