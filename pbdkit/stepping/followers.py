"""Followers: a rule's move, then relaxation and memory. Their neighbours stay as they are, or are
found anew at every step, by distance (model.md, section 4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from operator import add
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.lattice.neighbourhood import Neighbourhood
from pbdkit.lattice.raster import positions
from pbdkit.model.solver import Stepping
from pbdkit.plugin import Here, StoresEnergy, Vector
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.rule_evaluation import (
    Contributions,
    Evaluator,
    Neighbour,
    Surroundings,
    blocks,
)
from pbdkit.stepping.state import State, shown
from pbdkit.stepping.step import Hindrance, Mode, Operation, Step

REAL = "fiub"
"""The kinds of numpy's types that are numbers a particle can move by."""


class Followers(ABC):
    """The followers of a scene, and how they find their neighbours."""

    @abstractmethod
    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Writes the displacements of all body particles into `new`, from the intermediate
        configuration m; `new` comes holding those of the step before. Particles without any
        neighbour stay. What it writes for leaders is overwritten. Of the state, at the end of the
        step before, it takes what bonds and particles remember, and renews, in place, what
        particles do."""


def target(here: Any, move: Any, before: Any, solver: Stepping) -> Any:
    """u + relaxation · move + memory · (u - before), elementwise for one component.

    Raises ValueError where the move is not one real number a particle.
    """
    if np.shape(move) not in ((), np.shape(here)):
        raise ValueError(
            f"it returned the shape {np.shape(move)} for particles of shape {np.shape(here)}: "
            "it is not elementwise"
        )
    if not isinstance(move, float) and np.asarray(move).dtype.kind not in REAL:
        raise ValueError(f"it returned values of {np.asarray(move).dtype}, not real numbers")
    there = here + (move if solver.relaxation == 1.0 else solver.relaxation * move)
    return there + solver.memory * (here - before) if solver.memory != 0.0 else there


Summed = tuple[Surroundings, Evaluator, Contributions, Here]


class SlotFollowers(Followers):
    """Moves the followers of a scene whose neighbours stay as they are."""

    def __init__(self, scene: Scene, solver: Stepping | None = None) -> None:
        self._scene = scene
        self._solver = solver or scene.experiment.stepping
        self._inner = SlotFollowers(scene.inner, Stepping()) if scene.inner else None
        self._blocks = blocks(scene)
        evaluator = Evaluator(scene)
        varies = scene.constants.by_particle
        self._evaluators = [
            evaluator.given(b.parameters) if varies else evaluator for b in self._blocks
        ]

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Every block from m alone: their order does not matter."""
        loads = self._scene.loads
        acting = loads.at(state.step + 1, m.dtype) if loads else None
        for around, evaluator, total, here in self._summed(m, state):
            load = None if acting is None else vector(shown(around.where.of(acting)))
            moved = evaluator.move(total, here, load)
            planes = around.where.of(m), moved, around.where.of(new)
            for u, move, plane in zip(*planes, strict=True):
                _write(plane, target(u, move, plane, self._solver), around.movable, u)
            evaluator.renew_particles(total, here, around.own(state), around.movable)

    def moves(self, m: Floats, state: State) -> Floats:
        """The rule's moves, leaders' too; zero where nobody can move."""
        return self._of_all(Evaluator.move, m, state)

    def forces(self, m: Floats, state: State) -> Floats:
        """The rule's forces on body particles, leaders too, over Young's modulus and thickness;
        zero where there is no neighbour."""
        return self._of_all(Evaluator.force, m, state)

    def _of_all(self, function: Callable[..., Any], m: Floats, state: State) -> Floats:
        """What a function makes of the sums of contributions, zero where there is none."""
        out = np.zeros_like(m)
        for around, evaluator, total, here in self._summed(m, state):
            values = function(evaluator, total, here)
            for value, plane in zip(values, around.where.of(out), strict=True):
                _write(plane, value, around.movable, 0.0)
        return out

    def energy(self, m: Floats, state: State) -> float:
        """The strain energy over Young's modulus and thickness: the rule's own, or -½ Σ u·force."""
        if not isinstance(self._scene.experiment.rule, StoresEnergy):
            return self._work(m, self.forces(m, state))
        seen, out = self._seen(m, state), np.zeros_like(m[0])
        for around, evaluator in zip(self._blocks, self._evaluators, strict=True):
            (value,) = around.sums(evaluator.energy, seen, state)
            _write(around.where.of(out), value, around.movable, 0.0)
        return float(out.sum())

    def _work(self, u: Floats, forces: Floats) -> float:
        """-½ Σ u·force over the body. Where the forces have no resultant, u counts from its mean,
        so that no digit depends on where the body has gone."""
        place = self._scene.raster.place_of(self._scene.raster.body_rows)
        u, forces = u.reshape(len(u), -1)[:, place], forces.reshape(len(u), -1)[:, place]
        if self._scene.frame is None:
            u = u - u.mean(axis=1, keepdims=True)
        return -0.5 * float((u * forces).sum())

    def _seen(self, m: Floats, state: State) -> Floats:
        """What the rule works on: displacements, or the moves of its inner rule."""
        if self._inner is None:
            return m
        z = self._inner.moves(m, state)
        if self._scene.frame:
            flat = z.reshape(len(z), -1)
            self._scene.frame.follow(flat, flat)
        return z

    def _summed(self, m: Floats, state: State) -> Iterator[Summed]:
        """Every block with the sums of its neighbours' contributions and what stands there."""
        seen, before = self._seen(m, state), state
        if shares_particles(self._scene.experiment.rule):
            # Neighbours see what was before the step, also where a block has been renewed.
            before = replace(state, particle_values=tuple(v.copy() for v in state.particle_values))
        for around, evaluator in zip(self._blocks, self._evaluators, strict=True):
            total = around.sums(evaluator.contribution, seen, before)
            yield around, evaluator, total, around.here(seen, state)


def _write(plane: Floats, value: Any, where_: Mask | None, otherwise: Any) -> None:
    plane[...] = value if where_ is None else np.where(where_, value, otherwise)


class GatheringFollowers(Followers):
    """Moves the followers of a scene in which neighbours come and go.

    The same `gather` and `apply` run on tables: a row a pair of neighbours, a row a particle.
    Neighbours of the reference configuration are summed first, in the order of their slots and with
    the rest offsets of these, so that a body at rest stays as it is, exactly.
    """

    def __init__(self, scene: Scene) -> None:
        raster, near = scene.raster, scene.experiment.neighbours.nearness()
        assert near
        self._scene, self._evaluator = scene, Evaluator(scene)
        self._none = next(iter(scene.constants.weights.values()))
        everybody = np.arange(raster.count)
        self.place, self.body = raster.place_of(everybody), raster.body_rows
        self._site = raster.cells_of(everybody)
        local = positions(raster.cell, *self._site)
        self.X = np.stack(local)
        self._at = local.each(np.add, raster.lattice.origin)
        self._centred = local.each(np.subtract, scene.middle)
        self._rank, self._rest = _tables(scene.neighbourhood)
        self._scale = np.sqrt(np.array(near.weights))
        self._radius = near.radius * (1 + 1e-9)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Bonds do not last here, so that none can be broken."""
        flat, count = new.reshape(len(new), -1), len(self.place)
        u, before = m.reshape(len(m), -1)[:, self.place], flat[:, self.place]
        j, k, rest = self.pairs(m)
        own = [value.ravel()[self.place] for value in state.particle_values]
        of_particle = self._scene.constants.of_particle
        shared: tuple[Any, ...] = ()
        if shares_particles(self._evaluator.rule):
            shared = tuple(of_particle(*(value[rows] for value in own)) for rows in (j, k))
        to = Neighbour(vector(rest), self._none, shared=shared)
        d = vector(u[:, k] - u[:, j])
        parts = self._evaluator.contribution(d, vector(u[:, j]), to)
        total = tuple(_summed(part, j, count) for part in parts)
        here = Here(vector(u), self._at, self._centred, of_particle(*own))
        move = self._evaluator.move(total, here)
        movable = self.body[np.bincount(j, minlength=count)[self.body] > 0]
        place = self.place[movable]
        self._evaluator.renew_particles(total, here, own, None)
        for values, renewed in zip(state.particle_values, own, strict=True):
            values.reshape(-1)[place] = renewed[movable]
        flat[:, self.place[self.body]] = u[:, self.body]
        solver = self._scene.experiment.stepping
        for plane, here_, step, was in zip(flat, u, move, before, strict=True):
            plane[place] = target(here_, step, was, solver)[movable]

    def pairs(self, m: Floats) -> tuple[Indices, Indices, Floats]:
        """(j, k, rest): in the configuration m every body particle j with each of its neighbours k
        and the rest offset, (axis, pair), sorted by j, by slot and by k."""
        from scipy.spatial import cKDTree

        x = self.X + m.reshape(len(m), -1)[:, self.place]
        tree = cKDTree(x.T * self._scale)
        pairs = tree.query_pairs(self._radius, output_type="ndarray").astype(np.intp)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        j, k = both[np.isin(both[:, 0], self.body)].T
        rank, rest = self._of_slots(j, k)
        # One key for (j, slot, k) sorts faster than three.
        order = np.argsort((j * (len(self._rest[0]) + 1) + rank) * len(self.place) + k)
        return j[order], k[order], rest[:, order]

    def _of_slots(self, j: Indices, k: Indices) -> tuple[Indices, Floats]:
        """The number of each pair's slot, the largest of all where it is none, and the rest offset,
        (axis, pair)."""
        s, *cells = self._site
        sizes = np.array(self._rank.shape[2:])[:, None]
        step = np.stack([n[k] - n[j] for n in cells]) + sizes // 2
        near = ((step >= 0) & (step < sizes)).all(axis=0)
        rank, rest = np.full(len(j), len(self._rest[0])), self.X[:, k] - self.X[:, j]
        rank[near] = self._rank[(s[j[near]], s[k[near]], *step[:, near])]
        known = rank < len(self._rest[0])
        rest[:, known] = self._rest[:, rank[known]]
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
    if isinstance(part, Vector):
        return part.each(lambda values: _summed(values, owner, count))
    return np.bincount(owner, np.broadcast_to(part, owner.shape), count)


class MoveFollowers(Operation):
    """Move the particles of the body by the rule, leaders and guided particles too."""

    makes_moves = True

    def __init__(self, scene: Scene, followers: Followers | None = None) -> None:
        super().__init__(scene)
        self._known = followers

    @cached_property
    def _followers(self) -> Followers:
        nearness = self.scene.experiment.neighbours.nearness()
        return self._known or (GatheringFollowers if nearness else SlotFollowers)(self.scene)

    def apply(self, step: Step) -> None:
        """From the intermediate configuration. What leaves the finite numbers is found at
        recording."""
        quiet = np.errstate(all="ignore", invalid=step.invalid)
        with quiet, blaming(self.scene.experiment.rule, f"at step {step.number}"):
            self._followers.move(step.u, step.new, step.state)

    def emit(self, kernel: KernelWriter) -> None:
        """A sweep for each rule that works on the moves of another, and for these."""
        level, scene = 0, self.scene
        while inner := scene.inner:
            kernel.sweep(level)
            for frame in FollowFrame.of(self.scene):
                frame.emit_for(kernel, f"flat_z{level}")
            level, scene = level + 1, inner
        kernel.sweep(level)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Neighbours found anew are a list that is made on the host in every step."""
        if self.scene.experiment.neighbours.nearness():
            changing = "numbers change in time, and neighbours are found anew"
            reasons = {
                Mode.RANKS: "neighbours are found anew in every step",
                Mode.COURSES: changing,
                Mode.SOLVER_COURSES: changing,
            }
            return Hindrance(reasons.get(mode, "neighbours are found anew"), "neighbours")
        if mode is Mode.PASSES and self.scene.inner and self.scene.inner.inner:
            return Hindrance("the rule moves by the moves of one that moves by another's", "rule")
        return None
