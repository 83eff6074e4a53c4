"""Notices a run that leaves all bounds, within a hundred steps of where it does."""

from __future__ import annotations

import numpy as np

from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

EVERY = 100
"""Steps between two looks, at most; recorded steps are looked at too."""
BEYOND = 1e6
"""How many times the size of the body and the way of its leaders a displacement may be."""


class Guard:
    """Looks at states, at two passes over the displacements a look."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        ends = scene.raster.reference(scene.raster.body_rows[[0, -1]])
        self._size = float(np.abs(ends[1] - ends[0]).max())
        self._spacing = max(abs(s.rest.x) + abs(s.rest.y) for s in scene.neighbourhood.slots[0])
        self.next_look = EVERY
        """The step at which to look at the latest."""

    def look(self, state: State) -> None:
        """Raises FloatingPointError, with particle and step, where a displacement is not finite or
        beyond all bounds."""
        self.next_look = state.step + EVERY
        most = max(float(state.u.max()), -float(state.u.min()))
        if most <= BEYOND * (self._size + self._spacing):
            return
        led = [leading.place for leading in self._scene.leading if leading.group.leads(state.step)]
        flat = state.u.reshape(2, -1)
        way = max((float(np.abs(flat[:, place]).max()) for place in led), default=0.0)
        if most <= BEYOND * (self._size + self._spacing + way):
            return
        u = self._scene.raster.table(state.u)
        worst = int(np.argmax(np.abs(u).max(axis=1)))  # a NaN counts as the largest
        raise FloatingPointError(f"particle {worst + 1}, found at step {state.step},")
