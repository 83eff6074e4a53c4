"""States made by hand, what a few steps make of them, and the numbers that a part remembers, as it
declares them, draws them and is asked about them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import PluginError
from pbdkit.interfaces import (
    Bonds,
    Component,
    Draws,
    FollowerRule,
    FractureModel,
    Particles,
    Remembered,
)
from pbdkit.interfaces.values import Drawn
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.remembered_values import describe_bonds, describe_particles, generator_for
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.property import Arrays, NotAskedError, Question

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


SHAPE = (4, 3)
"""The shape of the arrays with which elementwise functions are called."""
SEED = 7
"""Of the generators that parts are given to draw from."""


def numbers_of(part: Component, scene: Scene) -> tuple[Remembered, ...]:
    """What a fracture model remembers of each bond, or a rule of each particle.

    Raises NotAskedError where it remembers nothing.
    """
    is_rule = isinstance(part, FollowerRule)
    numbers = particle_numbers(scene.experiment) if is_rule else bond_numbers(scene.experiment)
    if not numbers:
        raise NotAskedError(f"it remembers nothing of {'particles' if is_rule else 'bonds'}")
    return numbers


def owners(part: Component, scene: Scene) -> Bonds | Particles:
    """Those of whom it remembers numbers, as `draw` is shown them."""
    is_of_bonds = isinstance(part, FractureModel)
    return describe_bonds(scene) if is_of_bonds else describe_particles(scene)


def drawn(part: Component, shown: Bonds | Particles, generator: np.random.Generator) -> Drawn:
    """What it draws for them."""
    assert isinstance(part, Draws)
    return part.draw(shown, generator)


def draws(part: FractureModel | FollowerRule, scene: Scene) -> list[Question]:
    """The question where its numbers start, if it draws them."""
    try:
        numbers_of(part, scene)
    except NotAskedError:
        return []
    if not isinstance(part, Draws):
        return []
    shown = owners(part, scene)

    def draw(arrays: Arrays) -> Arrays:
        generator = generator_for(SEED, "fracture")
        return dict(drawn(part, type(shown)(**arrays), generator))

    return [Question("draw", dict(vars(shown)), draw)]


def remembered_of_bonds(scene: Scene, seed: int) -> Arrays:
    """Numbers of some bonds that have not broken, as they are at the start or two steps later;
    those of one bond stand together."""
    if not bond_numbers(scene.experiment):
        return {}
    pools = []
    for state in _reached(scene, seed):
        assert state.broken_step is not None
        where = scene.bonds.plane, scene.bonds.place
        table = [v.reshape(len(v), -1)[where] for v in state.bond_values]
        intact = state.broken_step.reshape(len(state.broken_step), -1)[where] < 0
        pools.append([column[intact] for column in table])
    return _chosen(pools, seed)


def remembered_of_particles(scene: Scene, seed: int) -> Arrays:
    """The same of some of the body's particles."""
    if not particle_numbers(scene.experiment):
        return {}
    places = scene.raster.place_of(scene.raster.body_rows)
    states = _reached(scene, seed)
    return _chosen([[v.ravel()[places] for v in s.particle_values] for s in states], seed)


def own_of(arrays: Arrays) -> tuple[Any, ...]:
    """The numbers among the arrays of a question, in their order."""
    return tuple(arrays[f"own{n}"] for n in range(sum(k.startswith("own") for k in arrays)))


def _reached(scene: Scene, seed: int) -> list[State]:
    """The start, and where two steps lead if they can be made: what fails is asked about directly,
    and named there."""
    states = [initial_state(scene)]
    try:
        start = state_with(scene, displacements(scene, seed, share=0.1))
        states.append(Stepper(scene).advance(start, 2))
    except PluginError:
        pass
    return states


def _chosen(pools: list[list[NDArray[Any]]], seed: int) -> Arrays:
    columns = [np.concatenate(values) for values in zip(*pools, strict=True)]
    rows = np.random.default_rng(seed + 2).integers(0, len(columns[0]), SHAPE)
    return {f"own{n}": column[rows] for n, column in enumerate(columns)}
