"""A body as a grid of vertices, lines and polygons, which programs for meshes understand."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray

    from pbdkit.scene.scene import Scene

Array = NDArray[Any]
PARTICLE, BOND, CELL = 0, 1, 2
"""What a cell of the grid stands for."""
VERTEX, LINE, TRIANGLE, POLYGON, QUAD = 1, 3, 5, 7, 9
"""The numbers that VTK gives to shapes."""


@dataclass(frozen=True)
class Grid:
    """First a vertex for each particle, then a line for each bond, then the polygons between
    particles: `connectivity` are rows of the particle table, those of cell n from offsets[n] to
    offsets[n + 1]; `types` are VTK's. `part` says what each is; `broken_step` the step in which a
    bond, or the first of a polygon's, broke, -1 where none did, None where none can."""

    connectivity: Array
    offsets: Array
    types: Array
    part: Array
    broken_step: Array | None

    def of_bonds(self, values: Array, elsewhere: Any) -> Array:
        """(cell,): values of bonds, and in all other cells that."""
        found = np.full(len(self.part), elsewhere, values.dtype)
        found[self.part == BOND] = values
        return found


def grid_of(dataset: xarray.Dataset, scene: Scene | None) -> Grid:
    """The grid of a dataset; without its scene, and on a lattice in space, without polygons."""
    count = dataset.sizes["particle"]
    has_bonds = "bond_ends" in dataset.variables
    bonds = dataset["bond_ends"].values - 1 if has_bonds else np.empty((0, 2), int)
    polygons = [] if scene is None else polygons_of(scene)
    kinds = [np.arange(count)[:, None], bonds, *polygons]
    sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in kinds])
    types = np.concatenate([np.full(len(rows), _type(rows), np.uint8) for rows in kinds])
    parts = [PARTICLE, BOND, *[CELL] * len(polygons)]
    part = np.repeat(np.array(parts, np.uint8), [len(rows) for rows in kinds])
    broken = None
    if "broken_step" in dataset.variables:
        steps = dataset["broken_step"].values
        own = [np.full(count, -1, steps.dtype), steps]
        broken = np.concatenate([*own, *(_torn(rows, bonds, steps, count) for rows in polygons)])
    connectivity = np.concatenate([rows.ravel() for rows in kinds]).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return Grid(connectivity, offsets, types, part, broken)


def polygons_of(scene: Scene) -> list[Array]:
    """The rows of the corners of the body's cells, (cell, corner), those of one shape together."""
    found: dict[int, list[Array]] = {}
    for patch in scene.patches:
        places = np.argwhere(patch.whole)
        corners = [
            scene.raster.rows_at(block.sublattice, *(places + block.start).T)
            for block in patch.corners
        ]
        found.setdefault(len(corners), []).append(np.stack(corners, axis=1))
    return [np.concatenate(rows) for rows in found.values()]


def _type(rows: Array) -> int:
    shapes = {1: VERTEX, 2: LINE, 3: TRIANGLE, 4: QUAD}
    return shapes.get(rows.shape[1], POLYGON)


def _torn(rows: Array, bonds: Array, steps: Array, count: int) -> Array:
    """(cell,): the step in which the first bond between two corners of a cell broke, else -1."""
    broken = np.flatnonzero(steps >= 0)
    key = bonds[broken] @ (count, 1)
    order = np.argsort(key)
    key, when = np.append(key[order], -1), np.append(steps[broken[order]], 0)
    never = np.iinfo(steps.dtype).max
    first = np.full(len(rows), never, steps.dtype)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (count, 1)
        at = np.searchsorted(key[:-1], pair)
        there = key[at] == pair
        first[there] = np.minimum(first[there], when[at[there]])
    return np.where(first == never, -1, first)
