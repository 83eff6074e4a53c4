"""One step of the model (model.md, section 5) on whole arrays of numpy."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.following import Followers
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.gathering import GatheringFollowers
from pbdkit.stepping.slots import SlotFollowers
from pbdkit.stepping.state import Floats, State


class Stepper:
    """Steps the states of one scene. It holds what is constant and no state of its own."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._rule = scene.experiment.rule
        self._fracturing = Fracturing(scene) if scene.has_fracture else None
        near = scene.experiment.neighbours.nearness()
        self._followers: Followers = (
            GatheringFollowers(scene, near) if near else SlotFollowers(scene, self._fracturing)
        )

    def advance(self, state: State) -> State:
        """The state one step on. It takes over the arrays of `state`, which is void afterwards."""
        step, u, new = state.step + 1, state.u, state.previous
        led, starts = self._prescribe(state, step)
        before = [u.reshape(2, -1)[:, place].copy() for place, _ in led]
        _place(u, led)
        if self._fracturing and state.broken_step is not None:
            self._fracturing.break_bonds(u, state.broken_step, step)
        # What leaves the finite numbers is found at recording.
        with np.errstate(all="ignore"), blaming(self._rule, f"at step {step}"):
            self._followers.move(u, new, state.broken_step)
        _place(new, led)
        _place(u, [(place, x) for (place, _), x in zip(led, before, strict=True)])
        self._move_frame(u, new)
        return State(step, new, u, state.broken_step, starts)

    def _prescribe(
        self, state: State, step: int
    ) -> tuple[list[tuple[Any, Floats]], tuple[Floats | None, ...]]:
        """(place, u) of the leaders of this step, and where each motion started."""
        led: list[tuple[Any, Floats]] = []
        starts = list(state.starts)
        for n, leading in enumerate(self._scene.leading):
            if not leading.group.leads(step):
                continue
            begun = starts[n]
            if begun is None:
                starts[n] = begun = state.u.reshape(2, -1)[:, leading.place].copy()
            n_th = step - leading.group.from_ + 1
            offset = leading.group.motion.offset(n_th, leading.reference + begun.T)
            led.append((leading.place, begun + np.atleast_2d(offset).T))
        return led, tuple(starts)

    def _move_frame(self, old: Floats, new: Floats) -> None:
        """u of every frame point from the body's, of this step or, with lag, of the last."""
        if self._scene.frame:
            body = old if self._scene.frame.map.lag else new
            self._scene.frame.follow(body.reshape(2, -1), new.reshape(2, -1))


def _place(u: Floats, led: list[tuple[Any, Floats]]) -> None:
    flat = u.reshape(2, -1)
    for place, values in led:
        flat[:, place] = values
