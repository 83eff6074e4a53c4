"""What an equilibrium is measured against: the exact answer, and how fast steps come near it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.operator import step_operator
from pbdkit.equilibrium.certificate import scale_of
from pbdkit.equilibrium.finding import UnconvergedError
from pbdkit.equilibrium.increments import settle
from pbdkit.equilibrium.moves import Moves, rounding
from pbdkit.equilibrium.system import System
from pbdkit.equilibrium.watch import Watch
from pbdkit.scene.leading import kinds_at
from pbdkit.scene.raster import EMPTY, FOLLOWER, FRAME
from pbdkit.scene.scene import Scene
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import State, initial_state

Vectors = NDArray[np.float64]
TURNS, ROUGH = 12, 1e-3
"""Of the inverse iteration for the slowest mode, and the accuracy of each."""


@dataclass(frozen=True)
class Exact:
    """Followers' displacements at equilibrium, (axis, follower); `how` they are known, and the
    share of the largest prescribed displacement within which they are."""

    u: Vectors
    how: str
    within: float


def followers_of(scene: Scene) -> NDArray[np.intp]:
    """The flat places of those who follow in the last step."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    return scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))


def exact_answer(scene: Scene) -> Exact:
    """The affine answer where it is one, else that of the solver, as good as it gets.

    The scene's solver is to be `equilibrium`; its tolerance says how good that is.
    """
    state, followers = initial_state(scene), followers_of(scene)
    if _is_affine(scene, state, followers):
        u = state.u.reshape(2, -1)[:, followers].astype(float)
        return Exact(u, "affine", float(rounding(u)))
    state = initial_state(scene)
    try:
        known = settle(scene, state)
    except UnconvergedError as error:
        known = error.certificate
    u = state.u.reshape(2, -1)[:, followers].astype(float)
    return Exact(u, known.method, known.share)


def _is_affine(scene: Scene, state: State, followers: NDArray[np.intp]) -> bool:
    """Continues the leaders' displacements over the body as an affine map, in place; whether
    nobody moves there."""
    step = scene.experiment.steps
    led, state.starts = prescribe(scene, state, step)
    place(state.u, led)
    kinds = kinds_at(scene.raster, scene.leading, step)
    leaders = np.flatnonzero((kinds != FOLLOWER) & (kinds != FRAME) & (kinds != EMPTY))
    if not len(leaders):
        return False
    X = scene.raster.reference()
    size = max(1.0, float(np.ptp(X)))
    terms = np.column_stack([(X - X.mean(axis=0)) / size, np.ones(len(X))])
    u = state.u.reshape(2, -1)
    there = scene.raster.place_of(leaders)
    map_, *_ = np.linalg.lstsq(terms[leaders], u[:, there].T, rcond=1e-12)
    allowed = 4 * rounding(u)
    if np.abs(terms[leaders] @ map_ - u[:, there].T).max() > allowed:
        return False
    u[:, followers] = (terms[kinds == FOLLOWER] @ map_).T
    moves = Moves(scene).at(state, followers)
    return bool(np.abs(moves).max(initial=0.0) <= allowed)


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


def decay_of(scene: Scene, exact: Exact) -> Decay:
    """Of the slowest mode that the start excites, by inverse iteration from the way that is to go:
    v ← A⁻¹ v, A = 1 - (step operator). Its share is the projection of that way onto it."""
    start = initial_state(scene)
    at = followers_of(scene)
    way = (exact.u - start.u.reshape(2, -1)[:, at]).T.astype(float)
    if not way.any():
        return Decay(0.0, 0.0)
    resting = initial_state(scene)
    resting.u[...] = 0.0
    operator = step_operator(scene, resting, scene.experiment.steps)
    X = scene.raster.reference(operator.followers)
    system, mode, slowness = System(operator, "auto", X, Watch()), way, 0.0
    for _ in range(TURNS):
        mode = mode / np.abs(mode).max()
        after = system.solve(mode, ROUGH)
        slowness = float((after * after).sum() / (after * mode).sum())
        mode = after
    along = float((way * mode).sum() / (mode * mode).sum())
    share = abs(along) * float(np.hypot(*mode.T).max()) / scale_of(scene, start)
    return Decay(share, 1.0 - 1.0 / slowness)
