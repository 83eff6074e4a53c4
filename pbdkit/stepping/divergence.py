"""Notices a run that leaves all bounds, within a hundred steps of where it does, and finds the last
state that was good."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.obstacles import Barrier
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import State, initial_state

EVERY = 100
"""The multiples of so many steps are looked at; recorded steps are, too."""
KEPT_EVERY = 5000
"""Steps between two copies of the state, at least; what comes after is stepped once more."""
BEYOND = 1e6
"""How many times the size of the body, its start and its leaders' ways a displacement may be."""
SAMPLES = 64


@dataclass
class Guard:
    """Looks at states, at two passes over the displacements a look.

    A state is good where no displacement is larger than `size`: the body, its start and its
    leaders' ways together. `next_look` is the step at which to look at the latest, `good_step` the
    last that was found good, `kept` a copy of a good state.
    """

    size: float
    good_step: int
    next_look: int
    kept: State | None

    @classmethod
    def of(cls, scene: Scene, start: State) -> Guard:
        """The guard of a run from that state."""
        kept = start.copy() if start.step else None
        return cls(size_of(scene) + most_of(start), start.step, next_multiple(start.step), kept)

    def look(self, scene: Scene, state: State, *, note: bool = True) -> None:
        """Raises FloatingPointError, with particle and step, where a displacement is not finite or
        beyond all bounds. A look at which longer runs make none is not to be noted."""
        most = self.most(state)
        if note:
            self.next_look = next_multiple(state.step)
            self._note(state, most)
        if most <= BEYOND * self.size:
            return
        worst = self.worst(scene, state)
        raise FloatingPointError(f"particle {worst}, found at step {state.step},")

    def _note(self, state: State, most: float) -> None:
        if most <= self.size:
            self.good_step = state.step
            if state.step >= KEPT_EVERY + (self.kept.step if self.kept else 0):
                self.kept = state.copy(self.kept)

    def most(self, state: State) -> float:
        """The largest displacement along an axis."""
        return most_of(state)

    def worst(self, scene: Scene, state: State) -> int:
        """The number of the particle that has it."""
        table = scene.raster.table(state.u)
        return (
            scene.raster.particle_offset + int(np.argmax(np.abs(table).max(axis=1))) + 1
        )  # NaN is largest

    def last_good(
        self, scene: Scene, engine: Engine, before: int, patience: int, stopping: Callable[[], bool]
    ) -> State | None:
        """The last good state before a step, found by stepping once more, `patience` steps a call,
        from where the guard kept a copy; None where `stopping` says so meanwhile."""
        state, self.kept = self.kept or initial_state(scene), None
        while state.step < self.good_step and not stopping():
            state = engine.advance(state, min(patience, self.good_step - state.step))
        good = state.copy()
        while state.step + 1 < before and not stopping():
            state = engine.advance(state)
            if not self.most(state) <= self.size:
                break
            good = state.copy(good)
        return None if stopping() else good


def next_multiple(step: int) -> int:
    """The first multiple of `EVERY` after a step."""
    return (step // EVERY + 1) * EVERY


def size_of(scene: Scene) -> float:
    """That of the body and its leaders' ways together."""
    ends = scene.raster.body_ends()
    spacing = max(sum(map(abs, s.rest)) for s in scene.neighbourhood.slots[0])
    own = [way_of(leading, scene.experiment.steps) for leading in scene.driven]
    ways: list[float] = np.max(scene.raster.communicator.allgather(own), axis=0).tolist()
    width = float(np.abs(ends[1] - ends[0]).max())
    return width + float(spacing) + sum(ways)


def most_of(state: State) -> float:
    """The largest displacement along an axis."""
    return max(float(state.u.max()), -float(state.u.min()))


def way_of(leading: Leading | Barrier, steps: int) -> float:
    """How far a group gets from where it starts, looked at here and there."""
    group = leading.group
    last, rests = group.last(steps) - group.from_ + 1, group.motion.rests_after()
    last = last if rests is None else min(last, rests)  # the same however long the run is
    if last < 1:
        return 0.0
    looks = {*np.linspace(1, last, SAMPLES).astype(int).tolist(), *group.motion.knots()}
    offsets = (leading.offset(n) for n in looks if n <= last)
    return max(float(np.abs(offset).max(initial=0.0)) for offset in offsets)
