"""States made by hand, and what a few steps make of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state
from pbdkit.stepping.stepper import Stepper

Floats = NDArray[np.float64]


def spacing(scene: Scene) -> float:
    """The smallest rest length."""
    return min(math.hypot(*slot.rest) for own in scene.neighbourhood.slots for slot in own)


def displacements(scene: Scene, seed: int, share: float = 0.2) -> Floats:
    """u of the body at random, (body particle, axis), up to a share of the spacing."""
    size = share * spacing(scene)
    return np.random.default_rng(seed).uniform(-size, size, (len(scene.raster.body_rows), 2))


def state_with(scene: Scene, u: Any) -> State:
    """The state whose body has displacements u, (body particle, axis), and stands still; the frame
    follows by its map. It is that of step 1: what an engine knows of step 0 is the experiment's own
    start."""
    state = initial_state(scene)
    raster, flat = scene.raster, state.u.reshape(2, -1)
    flat[:, raster.place_of(raster.body_rows)] = np.asarray(u).T
    if scene.frame:
        scene.frame.follow(flat, flat)
    state.previous[...] = state.u
    state.step = 1
    return state


def body_of(scene: Scene, state: State) -> Floats:
    """u of the body, (body particle, axis), of a state."""
    places = scene.raster.place_of(scene.raster.body_rows)
    return state.u.reshape(2, -1)[:, places].T.astype(float)


def advanced(scene: Scene, u: Any, steps: int) -> Floats:
    """The body's displacements some steps after those given, (step, body particle, axis)."""
    stepper, state = Stepper(scene), state_with(scene, u)
    history = [body_of(scene, state)]
    for _ in range(steps):
        state = stepper.advance(state)
        history.append(body_of(scene, state))
    return np.array(history)
