"""What is known of the distance between a state and its equilibrium."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.guard import way_of
from pbdkit.stepping.state import Floats, State

WAYS = {
    "inverse": "the inverse of the step operator's system, entry by entry",
    "barrier": "a barrier: v > 0 with A v > 0 bounds the inverse of a matrix A without positive "
    "entries off its diagonal",
    "estimated norm of the inverse": "three times an estimate of the norm of the inverse",
    "nothing to solve": "nobody follows",
}
CORRECTION = "correction, "
"""Before the name of a way: it bounds only what a correction that was solved for leaves."""


@dataclass(frozen=True)
class Certificate:
    """`residual` is the largest move of the rule at the state; `distance` bounds how far any
    follower is from equilibrium, both lengths; `share` is the distance as a share of the largest
    prescribed displacement; `iterations` counts linearisations and `inner_iterations` those of the
    linear solvers; `bound` says how the distance was obtained; `linearised` whether the rule is not
    linear, so that it holds to first order, with a factor of 2."""

    method: str
    iterations: int
    inner_iterations: int
    residual: float
    distance: float
    share: float
    bound: str
    linearised: bool

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        way = WAYS[self.bound.removeprefix(CORRECTION)]
        if self.bound.startswith(CORRECTION):
            way = f"the correction to there; what it leaves is bounded by {way}"
        return (
            f"within {self.distance:.2g} of equilibrium ({self.share:.1g} of the largest "
            f"prescribed displacement), by {way}"
        )


def scale_of(scene: Scene, start: State) -> float:
    """The largest prescribed displacement: of the leaders, or of the start; the lattice's spacing
    where nothing is prescribed but rest."""
    ways = [way_of(leading, scene.experiment.steps) for leading in scene.leading]
    prescribed = max([float(abs(start.u).max()), *ways])
    return prescribed or spacing_of(scene)


def spacing_of(scene: Scene) -> float:
    """The length of the shortest bond."""
    return min(min(lengths) for lengths in scene.neighbourhood.shells())


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


def rounding(u: Floats) -> float:
    """How far rounding alone may put a move off at displacements u."""
    return ROUNDING * float(np.abs(u).max())
