"""Clamped leaders: their directions are prescribed as their places are."""

from __future__ import annotations

import math

import numpy as np

from pbdkit.interfaces.frame import Indices
from pbdkit.scene.directions import rotations_of
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Array, State


class Clamps:
    """Those of a scene, which may have none; `numbers` are the places of the numbers that they
    prescribe among those that are remembered."""

    def __init__(self, scene: Scene) -> None:
        self._leading = [leading for leading in scene.leading if leading.group.clamped]
        self._rotations = rotations_of(scene.experiment) if self._leading else ()
        self.numbers = tuple(m for rotation in self._rotations for m in rotation)

    def turn(self, state: State, step: int) -> Indices:
        """Turns the directions of those who are clamped in a step, in place, by what their motion
        turns in it; returns their flat places."""
        found = [np.zeros(0, np.intp)]
        for leading in self._leading:
            if leading.group.leads(step):
                fresh = np.setdiff1d(leading.place, np.concatenate(found))
                found.append(fresh)
                self._turn(state, fresh, _angle(leading, step))
        return np.concatenate(found)

    def turning(self, step: int) -> bool:
        """Whether anybody who is clamped in a step turns in it."""
        return any(_angle(each, step) != 0.0 for each in self._leading if each.group.leads(step))

    def directions(self, state: State) -> list[Array]:
        """Flat views of what they prescribe."""
        return [state.particle_values[m].reshape(-1) for m in self.numbers]

    def _turn(self, state: State, place: Indices, angle: float) -> None:
        if angle == 0.0:
            return
        c, s = math.cos(angle), math.sin(angle)
        flat = self.directions(state)
        for cosine, sine in zip(flat[::2], flat[1::2], strict=True):
            x, y = cosine[place], sine[place]
            cosine[place], sine[place] = c * x - s * y, s * x + c * y


def _angle(leading: Leading, step: int) -> float:
    """By what a group's motion turns in a step."""
    motion, n_th = leading.group.motion, step - leading.group.from_ + 1
    return motion.turned(n_th) - motion.turned(n_th - 1)
