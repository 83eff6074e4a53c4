"""Notices a run that leaves all bounds, within a hundred steps of where it does."""

from __future__ import annotations

import numpy as np

from pbdkit.scene.leading import Leading
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

EVERY = 100
"""Steps between two looks, at most; recorded steps are looked at too."""
BEYOND = 1e6
"""How many times the size of the body, its start and its leaders' ways a displacement may be."""
SAMPLES = 64


class Guard:
    """Looks at states, at two passes over the displacements a look."""

    def __init__(self, scene: Scene, start: State) -> None:
        self._scene = scene
        ends = scene.raster.reference(scene.raster.body_rows[[0, -1]])
        spacing = max(abs(s.rest.x) + abs(s.rest.y) for s in scene.neighbourhood.slots[0])
        size = float(np.abs(ends[1] - ends[0]).max()) + spacing + _most(start)
        ways = [way_of(leading, scene.experiment.steps) for leading in scene.leading]
        self._limit = BEYOND * (size + sum(ways))
        self.next_look = EVERY
        """The step at which to look at the latest."""

    def look(self, state: State) -> None:
        """Raises FloatingPointError, with particle and step, where a displacement is not finite or
        beyond all bounds."""
        self.next_look = state.step + EVERY
        if _most(state) <= self._limit:
            return
        u = self._scene.raster.table(state.u)
        worst = int(np.argmax(np.abs(u).max(axis=1)))  # a NaN counts as the largest
        raise FloatingPointError(f"particle {worst + 1}, found at step {state.step},")


def _most(state: State) -> float:
    return max(float(state.u.max()), -float(state.u.min()))


def way_of(leading: Leading, steps: int) -> float:
    """How far a group gets from where it starts, looked at here and there."""
    group = leading.group
    last = group.last(steps) - group.from_ + 1
    if last < 1:
        return 0.0
    looks = {*np.linspace(1, last, SAMPLES).astype(int).tolist(), *group.motion.knots()}
    offsets = (group.motion.offset(n, leading.reference) for n in looks if n <= last)
    return max(float(np.abs(offset).max()) for offset in offsets)
