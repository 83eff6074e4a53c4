"""The rule's own moves at a configuration: what is left to do until equilibrium."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.operator import StepOperator
from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.scene import Scene
from pbdkit.stepping.slots import SlotFollowers
from pbdkit.stepping.state import Floats, State

ROUNDING = 4 * float(np.finfo(float).eps)


class Moves:
    """Evaluates the moves of a scene's followers, relaxed as in its steps but without memory, the
    frame standing where the body tells it to."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._followers = SlotFollowers(
            scene, Stepping(relaxation=scene.experiment.stepping.relaxation)
        )
        self._after: Floats | None = None

    def at(self, state: State, place: Indices) -> NDArray[np.float64]:
        """(follower, axis) at the flat places; brings the state's frame into line."""
        u = state.u
        flat = u.reshape(len(u), -1)
        if self._scene.frame:
            self._scene.frame.follow(flat, flat)
        if self._after is None:
            self._after = np.empty_like(u)
        self._after[...] = u
        with np.errstate(all="ignore"):
            self._followers.move(u, self._after, state)
        moved = (self._after.reshape(len(self._after), -1)[:, place] - flat[:, place]).T
        return moved.astype(float)


def owed_by(operator: StepOperator, state: State, place: Indices) -> NDArray[np.float64] | None:
    """What followers at their flat places have yet to get, (follower, axis), where the step looks
    back: before · (u(t-1) - u(t)), None elsewhere."""
    if not operator.couplings_before.parts:
        return None
    u, previous = (p.reshape(len(p), -1)[:, place] for p in (state.u, state.previous))
    return operator.couplings_before.times((previous - u).T.astype(float))


def rounding(u: Floats) -> float:
    """How far rounding alone may put a move off at displacements u."""
    return ROUNDING * float(np.abs(u).max())
