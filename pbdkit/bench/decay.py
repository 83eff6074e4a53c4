"""How fast steps come near an equilibrium that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.certificate import scale_of
from pbdkit.equilibrium.system import System
from pbdkit.equilibrium.watch import Watch
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import initial_state

TURNS, ROUGH = 12, 1e-3
"""Of the inverse iteration for the slowest mode, and the accuracy of each."""


@dataclass(frozen=True)
class Decay:
    """What is left of the way to equilibrium after n steps, as a share of the largest prescribed
    displacement: `share` · `rate`ⁿ, in the end."""

    share: float
    rate: float

    def steps_to(self, tolerance: float) -> int | None:
        """Steps until less than `tolerance` is left; None where it never is."""
        if not 0.0 < self.rate < 1.0:
            return None
        return max(1, math.ceil(math.log(max(1.0, self.share / tolerance)) / -math.log(self.rate)))


def followers_of(scene: Scene) -> NDArray[np.intp]:
    """The flat places of those who follow in the last step."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    return scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))


def decay_of(scene: Scene, exact: NDArray[np.float64]) -> Decay:
    """Of the slowest mode that the start excites, by inverse iteration from the way that is to go
    to `exact`, (axis, follower): v ← A⁻¹ v, A = 1 - (step operator). Its share is the projection of
    that way onto it."""
    start = initial_state(scene)
    way = (exact - start.u.reshape(len(exact), -1)[:, followers_of(scene)]).T.astype(float)
    if not way.any():
        return Decay(0.0, 0.0)
    resting = initial_state(scene)
    resting.u[...] = 0.0
    system, mode, slowness = System(scene, resting, "auto", Watch()), way, 0.0
    for _ in range(TURNS):
        mode = mode / np.abs(mode).max()
        after = system.solve(mode, ROUGH)
        slowness = float((after * after).sum() / (after * mode).sum())
        mode = after
    along = float((way * mode).sum() / (mode * mode).sum())
    share = abs(along) * float(np.linalg.norm(mode, axis=1).max()) / scale_of(scene, start)
    return Decay(share, 1.0 - 1.0 / slowness)
