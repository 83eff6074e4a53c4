"""What is asked of rules whose particles have directions."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces import FollowerRule, TurnsParticles
from pbdkit.scene.directions import rotations_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State
from pbdkit.testing.states import Floats, displacements, spacing, state_with
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, place_of

ROUNDING = 1e-11
"""As a share of the spacing; rotations sum some hundred roundings of 1e-16."""
STEPS = 4
ANGLE = 2.0


@asked_of(FollowerRule)
def follows_rotations(subject: Subject) -> None:
    """A body without frame whose particles have directions moves as before, turned, where it is
    turned as a whole, its directions with it, to rounding."""
    anywhere = not subject.component.uses_reference
    if not isinstance(subject.component, TurnsParticles):
        raise NotAskedError("its particles have no directions")
    scenes = [scene for scene in subject.scenes if anywhere and scene.frame is None]
    if not scenes:
        raise NotAskedError("a frame, or where a particle stands, may tell directions apart")
    for scene in scenes:
        start = Stepper(scene).advance(state_with(scene, displacements(scene, 6)), 2)
        turned = _turned(scene, start.copy())
        expected = _positions(scene, _turned(scene, Stepper(scene).advance(start, STEPS)))
        found = _positions(scene, Stepper(scene).advance(turned, STEPS))
        if (off := np.abs(found - expected).max() / spacing(scene)) > ROUNDING:
            fault = f"a turned body moves otherwise, by {off:.3g} of the spacing"
            remedy = "count its neighbours' places from its own direction"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _turned(scene: Scene, state: State) -> State:
    """The state turned about the origin, its directions with it, in place."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    raster, rows = scene.raster, scene.raster.body_rows
    place, X = raster.place_of(rows), raster.reference(rows).T
    flat = state.u.reshape(2, -1)
    x, y = X + flat[:, place]
    flat[:, place] = np.stack([c * x - s * y, s * x + c * y]) - X
    state.previous[...] = state.u
    for pair in rotations_of(scene.experiment):
        cosine, sine = (state.particle_values[m].reshape(-1) for m in pair)
        cosine[...], sine[...] = c * cosine - s * sine, s * cosine + c * sine
    return state


def _positions(scene: Scene, state: State) -> Floats:
    rows = scene.raster.body_rows
    positions: Floats = scene.raster.reference(rows) + scene.raster.table(state.u)[rows]
    return positions
