"""What moves followers: a rule's move, then relaxation and memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces import Here, RenewsParticles, StoresEnergy
from pbdkit.scene.declarations import particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Contributions, Evaluator
from pbdkit.stepping.remembered_values import changing, renew
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.surroundings import Surroundings, blocks

REAL = "fiub"
"""The kinds of numpy's types that are numbers a particle can move by."""


class Followers(ABC):
    """The followers of a scene, and how they find their neighbours."""

    @abstractmethod
    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Writes the displacements of all body particles into `new`, from the intermediate
        configuration m; `new` comes holding those of the step before. Particles without any
        neighbour stay. What it writes for leaders is overwritten. Of the state it takes what bonds
        and particles remember, and renews, in place, what particles do."""


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


Summed = tuple[Surroundings, Contributions, Here]


class SlotFollowers(Followers):
    """Moves the followers of a scene whose neighbours stay as they are."""

    def __init__(self, scene: Scene, solver: Stepping | None = None) -> None:
        self._scene = scene
        self._solver = solver or scene.experiment.stepping
        self._rule = scene.experiment.rule
        self._inner = SlotFollowers(scene.inner, Stepping()) if scene.inner else None
        self._numbers = particle_numbers(scene.experiment)
        self._evaluator = Evaluator(scene)
        self._blocks = blocks(scene)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Every block from m alone: their order does not matter."""
        for around, total, here in self._summed(m, state):
            self._place(around, self._evaluator.move(total, here), m, new)
            if isinstance(self._rule, RenewsParticles):
                own = changing(self._numbers, around.own(state))
                renew(own, self._evaluator.remember(total, here), around.movable)

    def moves(self, m: Floats, state: State) -> Floats:
        """The rule's moves, leaders' too; zero where nobody can move."""
        out = np.zeros_like(m)
        for around, total, here in self._summed(m, state):
            _write(self._evaluator.move(total, here), around, out)
        return out

    def forces(self, m: Floats, state: State) -> Floats:
        """The rule's forces on body particles, leaders too, over Young's modulus and thickness;
        zero where there is no neighbour."""
        out = np.zeros_like(m)
        for around, total, here in self._summed(m, state):
            _write(self._evaluator.force(total, here), around, out)
        return out

    def energy(self, m: Floats, state: State) -> float:
        """The strain energy over Young's modulus and thickness: the rule's own, or -½ Σ u·force."""
        if not isinstance(self._rule, StoresEnergy):
            return self._work(m, self.forces(m, state))
        seen, out = self._seen(m, state), np.zeros_like(m[:1])
        for around in self._blocks:
            _write(around.sums(self._evaluator.energy, seen, state), around, out)
        return float(out.sum())

    def _work(self, u: Floats, forces: Floats) -> float:
        """-½ Σ u·force over the body. Where the forces have no resultant, u counts from its mean,
        so that no digit depends on where the body has gone."""
        place = self._scene.raster.place_of(self._scene.raster.body_rows)
        u, forces = u.reshape(len(u), -1)[:, place], forces.reshape(len(u), -1)[:, place]
        if self._scene.frame is None and not self._scene.has_fracture:
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
        seen = self._seen(m, state)
        for around in self._blocks:
            total = around.sums(self._evaluator.contribution, seen, state)
            yield around, total, around.here(seen, state)

    def _place(self, around: Surroundings, move: Any, m: Floats, new: Floats) -> None:
        """Writes where the particles of a block go."""
        u, out = around.where.of(m), around.where.of(new)
        for here, step, plane in zip(u, move, out, strict=True):
            moved = target(here, step, plane, self._solver)
            plane[...] = moved if around.movable is None else np.where(around.movable, moved, here)


def _write(values: Any, around: Surroundings, out: Floats) -> None:
    """The values of the particles that have neighbours, a plane each."""
    for value, plane in zip(values, around.where.of(out), strict=True):
        plane[...] = value if around.movable is None else np.where(around.movable, value, 0.0)
