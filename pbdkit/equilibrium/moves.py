"""The rule's own moves at a configuration: what is left to do until equilibrium."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.slots import SlotFollowers
from pbdkit.stepping.state import Floats, State

ROUNDING = 4 * float(np.finfo(float).eps)


class Moves:
    """Evaluates the moves of a scene's followers, without relaxation and memory, the frame standing
    where the body tells it to."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        fracturing = Fracturing(scene) if scene.has_fracture else None
        self._followers = SlotFollowers(scene, fracturing, Stepping())
        self._after: Floats | None = None

    def at(self, state: State, place: Indices) -> NDArray[np.float64]:
        """(follower, axis) at the flat places; brings the state's frame into line."""
        u = state.u
        flat = u.reshape(2, -1)
        if self._scene.frame:
            self._scene.frame.follow(flat, flat)
        if self._after is None:
            self._after = np.empty_like(u)
        self._after[...] = u
        with np.errstate(all="ignore"):
            self._followers.move(u, self._after, state)
        moved = (self._after.reshape(2, -1)[:, place] - flat[:, place]).T
        return moved.astype(float)


def rounding(u: Floats) -> float:
    """How far rounding alone may put a move off at displacements u."""
    return ROUNDING * float(np.abs(u).max())
