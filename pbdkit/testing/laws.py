"""Laws of mechanics, measured: how far a scene is from each, as a share of its largest stiffness.

A body that is moved rigidly stores nothing; what particle a does to b, b does to a (Maxwell and
Betti); no deformation gives energy back; a broken bond makes nothing stiffer. All hang on the
stiffness matrix K = -∂force/∂u of the body's particles, leaders included, which is probed here by
the forces that the stepper finds: nothing of the rule is taken for granted.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import StoresEnergy
from pbdkit.results.recorder import Recorder
from pbdkit.results.sink import MemorySink
from pbdkit.runs.continuation import take_up
from pbdkit.runs.course import Run, record
from pbdkit.runs.processes import Processes
from pbdkit.runs.standing import standing_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state
from pbdkit.storage.standing import Standing
from pbdkit.testing.states import displacements, state_with

Floats = NDArray[np.float64]
SHARE_BROKEN = 0.2
"""The share of bonds that are broken in a pattern at random."""
NUDGE = 1e-5
"""By what share of the spacing a particle is moved where the rule is not linear: the error of a
central difference is its square."""


def whole_state(scene: Scene) -> State:
    """The scene at rest with every bond that cracks and cuts leave."""
    state = initial_state(scene)
    state.u[...] = state.previous[...] = 0.0
    return state


def torn_state(scene: Scene, seed: int, before: State) -> State:
    """A state at rest with bonds broken at random besides those that are broken."""
    state = before.copy()
    state.u[...] = state.previous[...] = 0.0
    if state.broken_step is not None:
        generator, bonds = np.random.default_rng(seed), scene.bonds
        chosen = generator.random(len(bonds.plane)) < SHARE_BROKEN
        planes = state.broken_step.reshape(len(state.broken_step), -1)
        planes[bonds.plane[chosen], bonds.place[chosen]] = 1
    return state


def softened_state(scene: Scene, seed: int) -> State:
    """The scene at rest after its particles were put elsewhere at random and back again, so that
    bonds have broken and softened as its fracture model has it, and with bonds broken besides."""
    state = Stepper(scene).advance(state_with(scene, displacements(scene, seed, share=0.3)), 1)
    return torn_state(scene, seed, state)


def stiffness(scene: Scene, state: State) -> Floats:
    """K over Young's modulus and thickness at rest with the bonds of a state, (2 particles of the
    body, 2 particles): x of the first, y of the first, ..."""
    followers, raster = SlotFollowers(scene), scene.raster
    place = raster.place_of(raster.body_rows)
    is_linear = not isinstance(scene.experiment.rule, StoresEnergy)
    unit = scene.neighbourhood.nudge_unit
    step = unit if is_linear else NUDGE * unit
    u = np.zeros_like(state.u, dtype=float)
    flat = u.reshape(len(u), -1)

    def pulled(particle: int, axis: int, way: float) -> Floats:
        flat[...] = 0.0
        if particle >= 0:
            flat[axis, place[particle]] = way
        if scene.frame:
            scene.frame.follow(flat, flat)
        forces = followers.forces(u, state).reshape(len(u), -1)[:, place]
        return np.asarray(forces.T.ravel(), float)

    still = pulled(-1, 0, 0.0)
    columns = []
    for particle in range(len(place)):
        for axis in range(len(u)):
            ahead = pulled(particle, axis, step)
            if is_linear:
                columns.append((still - ahead) / step)
            else:
                columns.append((pulled(particle, axis, -step) - ahead) / (2.0 * step))
    return np.array(columns).T


def pulls_at_rest(scene: Scene, state: State) -> bool:
    """Whether particles at rest exert forces, as where fictitious points stand off: these turn with
    the body, so that a rotation changes them."""
    u = np.zeros_like(state.u, dtype=float)
    return bool(np.abs(SlotFollowers(scene).forces(u, state)).max() > 0.0)


def rigid_motions(scene: Scene) -> Floats:
    """The translations and the small rotation about the middle, (2 particles, 3), of which the
    largest displacement is 1."""
    raster = scene.raster
    X = raster.reference(raster.body_rows)
    x, y = (X - X.mean(axis=0)).T
    one, none = np.ones(len(X)), np.zeros(len(X))
    motions = np.array([[one, none], [none, one], [-y, x]]).transpose(0, 2, 1)
    motions = motions.reshape(3, -1)
    largest = np.abs(motions).max(axis=1, keepdims=True)
    return np.asarray((motions / np.where(largest > 0.0, largest, 1.0)).T)


def resistance_to_rigid_motions(scene: Scene, K: Floats) -> float:
    """The largest force of a rigid motion. Where K is symmetric no deformation has a resultant or a
    moment, then."""
    return _share(np.abs(K @ rigid_motions(scene)).max(), K)


def asymmetry(K: Floats) -> float:
    """The largest difference of what a does to b and b to a."""
    return _share(np.abs(K - K.T).max(), K)


def energy_given_back(K: Floats) -> float:
    """By how much the smallest eigenvalue of the symmetric part is below 0."""
    return _share(-np.linalg.eigvalsh((K + K.T) / 2)[0], K)


def stiffening(before: Floats, after: Floats) -> float:
    """By how much some deformation costs more after than before."""
    more = after - before
    return _share(np.linalg.eigvalsh((more + more.T) / 2)[-1], before)


def _share(value: float, K: Floats) -> float:
    largest = np.abs(K).max()
    return max(0.0, float(value)) / float(largest) if largest > 0.0 else 0.0


def resumed(scene: Scene, again: Scene, step: int, start: State | None = None) -> Any:
    """The dataset of a run that is stopped at a step, kept as the run store keeps it, and gone on
    with in a scene made anew."""
    sink = MemorySink()
    left, recorder = Run(scene, start=start), Recorder(scene, sink)
    recorder.begin()
    for state in left:
        recorder.observe(state)
        if state.step >= step:
            break
    kept = standing_of(left.driver, recorder)
    facts = json.loads(json.dumps(kept.facts))
    rest, recorder = Run(again), Recorder(again, sink)
    standing = Standing(kept.about, facts, kept.copied().arrays)
    take_up(rest.driver, recorder, standing, Processes())
    record(rest, sink, recorder=recorder)
    return sink.dataset()
