"""What neighbours exert on leaders that move by Newton's law: at their single places, by numpy in
every engine."""

from __future__ import annotations

import numpy as np

from pbdkit.experiment.newton import Newton
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.places import Places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.surroundings import Surroundings

TURNS = 60
"""Of the power iteration that finds the stiffest way."""


class NewtonForces:
    """The forces on the particles of a scene's groups, by the group's number."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._evaluator = scene, Evaluator(scene)
        groups = enumerate(scene.leading)
        some = {n: each for n, each in groups if isinstance(each.group.motion, Newton)}
        self.numbers = tuple(some)
        """Of the groups that move so."""
        self._parts = {n: _parts(scene, each.place) for n, each in some.items()}
        self._contact = Contact(scene) if some and scene.barriers else None
        # A rule that works on the moves of another is asked everywhere.
        self._whole = SlotFollowers(scene) if some and scene.inner else None

    def share(self, n: int) -> Floats:
        """(particle,): of the force in all."""
        share = self._scene.leading[n].share
        assert share is not None
        return share

    def on(self, n: int, state: State) -> Floats:
        """(particle, axis), over Young's modulus and thickness."""
        place = self._scene.leading[n].place
        if self._whole:
            whole = self._whole.forces(state.u, state)
            return np.asarray(whole.reshape(len(whole), -1)[:, place].T, float)
        found = np.zeros((len(place), self._scene.axes))
        for some, around in self._parts[n]:
            total = around.sums(self._evaluator.contribution, state.u, state)
            force = self._evaluator.force(total, around.here(state.u, state))
            movable = True if around.movable is None else around.movable
            for axis, component in enumerate(force):
                found[some, axis] = np.where(movable, component, 0.0)
        return found

    def stopped(self, n: int, velocity: Floats, u: Floats, step: int) -> tuple[Floats, Floats]:
        """Return the velocities of a group's particles and their displacements at the end of a
        step, (axis, particle), out of the obstacles: what they go less they lose of their velocity,
        unless an obstacle appears where they are."""
        leading = self._scene.leading[n]
        if self._contact is None or len(leading.axes) < self._scene.axes:
            return velocity, u
        way = self._contact.ways_of_masses(u, leading.place, step)
        if not any(barrier.group.from_ == step for barrier in self._scene.barriers):
            velocity = velocity + way
        return velocity, u + way

    def stiffness(self, n: int, state: State, nudge: float) -> float:
        """By how much the force on the group grows, at most, for a unit way of its particles, along
        the axes along which they lead, others standing still."""
        leading, here = self._scene.leading[n], state.copy()
        flat, still, found = here.u.reshape(len(here.u), -1), self.on(n, state), 0.0
        way = np.random.default_rng(0).uniform(-1.0, 1.0, still.shape)
        for _ in range(TURNS):
            way[:, [a for a in range(self._scene.axes) if a not in leading.axes]] = 0.0
            way /= np.linalg.norm(way)
            flat[:, leading.place] += nudge * way.T
            pull = (still - self.on(n, here)) / nudge
            flat[:, leading.place] = state.u.reshape(len(flat), -1)[:, leading.place]
            found, way = float((way * pull).sum()), pull
            if not way.any():
                break
        return found


def _parts(scene: Scene, place: Indices) -> list[tuple[Indices, Surroundings]]:
    """By sublattice the numbers of its particles, with what is around them."""
    each = scene.raster.kind.size // len(scene.raster.kind)
    found = []
    for s in np.unique(place // each).tolist():
        some = np.flatnonzero(place // each == s)
        found.append((some, Surroundings(scene, Places(scene.raster.shape, place[some]), s)))
    return found
