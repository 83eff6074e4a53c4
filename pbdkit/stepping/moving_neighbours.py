"""Followers whose neighbours are found anew at every step, by distance (model.md, section 4)."""

from __future__ import annotations

from operator import add
from typing import Any

import numpy as np

from pbdkit.interfaces import Components, Here, Nearness, RenewsParticles
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.vector import vector
from pbdkit.scene.declarations import particle_numbers
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.raster import positions
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, Neighbour
from pbdkit.stepping.followers import Followers, target
from pbdkit.stepping.remembered_values import changing, renew
from pbdkit.stepping.state import Floats, State


class GatheringFollowers(Followers):
    """Moves the followers of a scene in which neighbours come and go.

    The same `gather` and `apply` run on tables: a row a pair of neighbours, a row a particle.
    Neighbours of the reference configuration are summed first, in the order of their slots and with
    the rest offsets of these, so that a body at rest stays as it is, exactly.
    """

    def __init__(self, scene: Scene, near: Nearness) -> None:
        raster = scene.raster
        self._scene = scene
        self._evaluator = Evaluator(scene)
        self._none = next(iter(scene.constants.weights.values()))
        self._own = scene.constants.of_particle
        everybody = np.arange(raster.count)
        self._place, self._body = raster.place_of(everybody), raster.body_rows
        self._site = raster.cells_of(everybody)
        local = positions(raster.lattice.cell(), *self._site)
        self._X = np.stack(local)
        self._at = local.each(np.add, raster.lattice.origin)
        self._centred = local.each(np.subtract, scene.middle)
        self._rank, self._rest = _tables(scene.neighbourhood)
        self._scale = np.sqrt(np.array(near.weights))
        self._radius = near.radius * (1 + 1e-9)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Bonds do not last here, so that none can be broken."""
        u = m.reshape(len(m), -1)[:, self._place]
        j, k, rest = self.pairs(self._X + u)
        count = len(self._place)
        to = Neighbour(vector(rest), self._none)
        d = vector(u[:, k] - u[:, j])
        parts = self._evaluator.contribution(d, vector(u[:, j]), to)
        total = tuple(_summed(part, j, count) for part in parts)
        own = [value.ravel()[self._place] for value in state.particle_values]
        here = Here(vector(u), self._at, self._centred, self._own(*own))
        move = self._evaluator.move(total, here)
        movable = self._body[np.bincount(j, minlength=count)[self._body] > 0]
        place = self._place[movable]
        if isinstance(self._evaluator.rule, RenewsParticles):
            self._remember(total, here, state, movable)
        for u_here, step, plane in zip(u, move, new.reshape(len(new), -1), strict=True):
            before = plane[self._place]
            moved = target(u_here, step, before, self._scene.experiment.stepping)
            plane[self._place[self._body]] = u_here[self._body]
            plane[place] = moved[movable]

    def _remember(self, total: tuple[Any, ...], here: Here, state: State, movable: Indices) -> None:
        """`here` holds copies, so that what is written is not read again."""
        numbers, place = particle_numbers(self._scene.experiment), self._place[movable]
        fresh = changing(numbers, here.own)
        renew(fresh, self._evaluator.remember(total, here), None)
        for plane, values in zip(changing(numbers, state.particle_values), fresh, strict=True):
            plane.reshape(-1)[place] = values[movable]

    def pairs(self, x: Floats) -> tuple[Indices, Indices, Floats]:
        """(j, k, rest): every body particle j with each of its neighbours k and the rest offset,
        (axis, pair), sorted by j, by slot and by k."""
        from scipy.spatial import cKDTree

        tree = cKDTree(x.T * self._scale)
        pairs = tree.query_pairs(self._radius, output_type="ndarray").astype(np.intp)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        both = both[np.isin(both[:, 0], self._body)]
        j, k = both.T
        rank, rest = self._of_slots(j, k)
        # One key for (j, slot, k) sorts faster than three.
        order = np.argsort((j * (len(self._rest[0]) + 1) + rank) * len(self._place) + k)
        return j[order], k[order], rest[:, order]

    def _of_slots(self, j: Indices, k: Indices) -> tuple[Indices, Floats]:
        """The number of each pair's slot, the largest of all where it is none, and the rest offset,
        (axis, pair)."""
        s, *cells = self._site
        sizes = np.array(self._rank.shape[2:])[:, None]
        step = np.stack([n[k] - n[j] for n in cells]) + sizes // 2
        near = ((step >= 0) & (step < sizes)).all(axis=0)
        rank = np.full(len(j), len(self._rest[0]))
        rank[near] = self._rank[(s[j[near]], s[k[near]], *step[:, near])]
        slot = np.minimum(rank, len(self._rest[0]) - 1)
        known = rank < len(self._rest[0])
        rest: Floats = np.where(known, self._rest[:, slot], self._X[:, k] - self._X[:, j])
        return rank, rest


def _tables(neighbourhood: Neighbourhood) -> tuple[Indices, Floats]:
    """The number of a slot by (sublattice, sublattice, step of cells along each axis), the count of
    slots where there is none; and the rest offset by that number, (axis, slot)."""
    slots = [slot for own in neighbourhood.slots for slot in own]
    reach, size = neighbourhood.reach_in_cells, len(neighbourhood.slots)
    rank = np.full((size, size, *(2 * n + 1 for n in reach)), len(slots))
    for number, slot in enumerate(slots):
        rank[(slot.source, slot.target, *map(add, slot.cell, reach))] = number
    return rank, np.array([slot.rest for slot in slots]).T


def _summed(part: Any, owner: Indices, count: int) -> Any:
    """Σ over the pairs of each owner, in their order."""
    if isinstance(part, Components):
        return part.each(lambda values: _summed(values, owner, count))
    return np.bincount(owner, np.broadcast_to(part, owner.shape), count)
