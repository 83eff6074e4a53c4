"""Search of the neighbours of each particle in the current configuration, by distance."""

from __future__ import annotations

from operator import add

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.lattice.neighbourhood import Neighbourhood
from pbdkit.lattice.raster import positions
from pbdkit.scene.scene import Scene


class NeighbourSearch:
    """Search of neighbours within the radius that a `pbdkit.plugin.Nearness` defines.

    Parameters
    ----------
    scene
        Scene in which neighbours are searched at every step.

    Attributes
    ----------
    place : (particle,)
        Flat places of all particles.
    body : (body particle,)
        Rows of the particles of the body.
    X : (axis, particle)
        Reference positions, relative to the origin of the lattice.
    """

    def __init__(self, scene: Scene) -> None:
        raster, near = scene.raster, scene.experiment.neighbours.nearness()
        assert near
        rows = np.arange(raster.count)
        self.place, self.body = raster.place_of(rows), raster.body_rows
        self._site = raster.cells_of(rows)
        self.X = np.stack(positions(raster.cell, *self._site))
        self._rank, self._rest = _tables(scene.neighbourhood)
        self._scale = np.sqrt(np.array(near.weights))
        self._radius = near.radius * (1 + 1e-9)

    def pairs(self, m: Floats) -> tuple[Indices, Indices, Floats]:
        """Return (j, k, rest) in the configuration m: every body particle j with each of its
        neighbours k, and an array of shape (axis, pair) with the rest offsets. Pairs are sorted by
        j, slot and k."""
        from scipy.spatial import cKDTree

        x = self.X + m.reshape(len(m), -1)[:, self.place]
        tree = cKDTree(x.T * self._scale)
        pairs = tree.query_pairs(self._radius, output_type="ndarray").astype(np.intp)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        j, k = both[np.isin(both[:, 0], self.body)].T
        rank, rest = self._of_slots(j, k)
        # Sorting by one combined key is faster than sorting by three keys.
        order = np.argsort((j * (len(self._rest[0]) + 1) + rank) * len(self.place) + k)
        return j[order], k[order], rest[:, order]

    def _of_slots(self, j: Indices, k: Indices) -> tuple[Indices, Floats]:
        """Return the slot of each pair, and its rest offset, (axis, pair). For a pair without a
        slot the number of slots is returned in place of the slot."""
        s, *cells = self._site
        sizes = np.array(self._rank.shape[2:])[:, None]
        step = np.stack([n[k] - n[j] for n in cells]) + sizes // 2
        near = ((step >= 0) & (step < sizes)).all(axis=0)
        rank, rest = np.full(len(j), len(self._rest[0])), self.X[:, k] - self.X[:, j]
        rank[near] = self._rank[(s[j[near]], s[k[near]], *step[:, near])]
        has_slot = rank < len(self._rest[0])
        rest[:, has_slot] = self._rest[:, rank[has_slot]]
        return rank, rest


def _tables(neighbourhood: Neighbourhood) -> tuple[Indices, Floats]:
    """Return two tables. The first contains the slot by (sublattice, sublattice, difference of
    cells along each axis), or the number of slots if there is no such slot. The second contains the
    rest offset by slot, (axis, slot)."""
    slots = [slot for each in neighbourhood.slots for slot in each]
    reach, size = neighbourhood.reach_in_cells, len(neighbourhood.slots)
    rank = np.full((size, size, *(2 * n + 1 for n in reach)), len(slots))
    for number, slot in enumerate(slots):
        rank[(slot.source, slot.target, *map(add, slot.cell, reach))] = number
    return rank, np.array([slot.rest for slot in slots]).T
