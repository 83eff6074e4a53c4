"""Detection of divergence at most a hundred steps after it occurs, and recovery of the last good
state."""

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
"""Number of steps between two checks; recorded steps are checked, too."""
COPY_INTERVAL = 5000
"""Minimum number of steps between two copies of the state. Steps after a copy are repeated to find
the last good state."""
MAX_RELATIVE_SIZE = 1e6
"""Limit of displacements, relative to `size`. A run with a larger displacement is reported as
diverging."""
SAMPLES = 64
"""Number of moments at which the motion of a leader group is evaluated."""


@dataclass
class Guard:
    """Check of states for divergence. A check needs two passes over the displacements.

    A state is good if no displacement exceeds `size`, the sum of the size of the body, its initial
    displacements and its leaders' motions. The next check is made at the step `next_look` or
    before. `good_step` is the last step with a good state, and `good_copy` a copy of an earlier
    good state.
    """

    size: float
    good_step: int
    next_look: int
    good_copy: State | None

    @classmethod
    def of(cls, scene: Scene, start: State) -> Guard:
        """Create the guard of a run from a state."""
        copy = start.copy() if start.step else None
        return cls(
            size_of(scene) + largest_displacement(start),
            start.step,
            next_multiple(start.step),
            copy,
        )

    def look(self, scene: Scene, state: State, *, note: bool = True) -> None:
        """Raise FloatingPointError, with particle and step, if a displacement is not finite or
        exceeds the limit. With `note` false the result is not stored. This is necessary for checks
        at steps that depend on the length of the run, because stored results must not depend on
        it."""
        largest = self.largest_displacement(state)
        if note:
            self.next_look = next_multiple(state.step)
            self._note(state, largest)
        if largest <= MAX_RELATIVE_SIZE * self.size:
            return
        worst = self.worst(scene, state)
        raise FloatingPointError(f"particle {worst}, found at step {state.step},")

    def _note(self, state: State, largest: float) -> None:
        if largest <= self.size:
            self.good_step = state.step
            if state.step >= COPY_INTERVAL + (self.good_copy.step if self.good_copy else 0):
                self.good_copy = state.copy(self.good_copy)

    def largest_displacement(self, state: State) -> float:
        """Return the largest displacement along an axis."""
        return largest_displacement(state)

    def worst(self, scene: Scene, state: State) -> int:
        """Return the number of the particle with the largest displacement."""
        table = scene.raster.table(state.u)
        return (
            scene.raster.particle_offset + int(np.argmax(np.abs(table).max(axis=1))) + 1
        )  # NaN counts as largest.

    def last_good(
        self, scene: Scene, engine: Engine, before: int, patience: int, stopping: Callable[[], bool]
    ) -> State | None:
        """Return the last good state before a step; None if `stopping` returns true. The steps
        after the stored copy of a good state are repeated, at most `patience` of them in one call
        of the engine."""
        state, self.good_copy = self.good_copy or initial_state(scene), None
        while state.step < self.good_step and not stopping():
            state = engine.advance(state, min(patience, self.good_step - state.step))
        good = state.copy()
        while state.step + 1 < before and not stopping():
            state = engine.advance(state)
            if not self.largest_displacement(state) <= self.size:
                break
            good = state.copy(good)
        return None if stopping() else good


def next_multiple(step: int) -> int:
    """Return the first multiple of `EVERY` after a step."""
    return (step // EVERY + 1) * EVERY


def size_of(scene: Scene) -> float:
    """Return the size of the body plus the largest distances of its leaders' motions."""
    ends = scene.raster.body_ends()
    spacing = max(sum(map(abs, s.rest)) for s in scene.neighbourhood.slots[0])
    local = [largest_offset(leading, scene.experiment.steps) for leading in scene.driven]
    offsets: list[float] = np.max(scene.raster.communicator.allgather(local), axis=0).tolist()
    width = float(np.abs(ends[1] - ends[0]).max())
    return width + float(spacing) + sum(offsets)


def largest_displacement(state: State) -> float:
    """Return the largest displacement along an axis."""
    return max(float(state.u.max()), -float(state.u.min()))


def largest_offset(leading: Leading | Barrier, steps: int) -> float:
    """Return the largest distance of a group from its start, at `SAMPLES` moments of its motion."""
    group = leading.group
    last, rests = group.last(steps) - group.from_ + 1, group.motion.rests_after()
    # The moments do not depend on the length of the run.
    last = last if rests is None else min(last, rests)
    if last < 1:
        return 0.0
    looks = {*np.linspace(1, last, SAMPLES).astype(int).tolist(), *group.motion.knots()}
    offsets = (leading.offset(n) for n in looks if n <= last)
    return max(float(np.abs(offset).max(initial=0.0)) for offset in offsets)
