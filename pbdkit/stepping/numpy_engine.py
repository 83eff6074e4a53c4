"""The engine interface: what takes a state some steps further."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Literal

import numpy as np

from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaker import Fracturing
from pbdkit.stepping.clamps import Clamps
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.cutting import cut_bonds
from pbdkit.stepping.followers import Followers, GatheringFollowers, SlotFollowers
from pbdkit.stepping.guidance import Guidance
from pbdkit.stepping.newton_forces import NewtonForces
from pbdkit.stepping.prescription import place, placed, prescribe
from pbdkit.stepping.state import State


class Engine(ABC):
    """Steps the states of one scene. All engines give the same numbers, to the last bit where
    rules keep to + - × ÷ and square roots."""

    name: str
    threads: int = 1

    @abstractmethod
    def advance(self, state: State, steps: int = 1) -> State:
        """The state so many steps on. It takes over the arrays of `state`, which is void
        afterwards."""

    def renewed(self, state: State, rows: slice) -> None:
        """Takes note that somebody has written these rows of cells of the state that it gave out
        last; an engine that keeps nothing beside the state has nothing to do."""
        return


class Stepper(Engine):
    """The numpy engine: the oracle of every faster one. It holds what is constant and no state."""

    name = "numpy"

    def __init__(
        self, scene: Scene, followers: Followers | None = None, *, strict: bool = False
    ) -> None:
        """With `strict` the first operation of the rule that gives NaN raises
        FloatingPointError."""
        self._scene = scene
        self._invalid: Literal["raise", "ignore"] = "raise" if strict else "ignore"
        self._rule = scene.experiment.rule
        self._fracturing = Fracturing.of(scene)
        self._contact = Contact(scene) if scene.barriers else None
        self._clamps = Clamps(scene)
        kind = GatheringFollowers if scene.experiment.neighbours.nearness() else SlotFollowers
        self._followers = followers or kind(scene)
        self._guidance, self._newton = Guidance(scene), NewtonForces(scene)
        self._now = self
        """With the numbers of the last step."""

    def advance(self, state: State, steps: int = 1) -> State:
        """One step after the other, each with the numbers that hold at its end."""
        for _ in range(steps):
            now = self._scene.at(state.step + 1)
            if now is not self._scene and now is not self._now._scene:
                self._now = Stepper(now, strict=self._invalid == "raise")
            state = (self if now is self._scene else self._now)._step(state)
        return state

    def _step(self, state: State) -> State:
        step, u, new = state.step + 1, state.u, state.previous
        cut_bonds(self._scene, state.broken_step, step)
        led, starts = prescribe(self._scene, state, step, self._newton)
        before = placed(u, led)
        place(u, led)
        if self._guidance.some:  # who leads along an axis makes no way along it that could go on
            place(new, led)
        if self._fracturing:
            self._fracturing.break_bonds(u, state, step)
        clamped = self._clamps.turn(state, step)
        kept = [(values, values[clamped]) for values in self._clamps.directions(state)]
        # What leaves the finite numbers is found at recording.
        quiet = np.errstate(all="ignore", invalid=self._invalid)
        with quiet, blaming(self._rule, f"at step {step}"):
            self._followers.move(u, new, state)
            self._guidance.correct(new, u, step)
        for values, prescribed in kept:
            values[clamped] = prescribed
        if self._contact:
            if self._guidance.some:
                place(new, led)
            self._contact.push_out(new, step)
        place(new, led)
        place(u, before)
        if self._scene.frame:
            body = u if self._scene.frame.map.lag else new
            self._scene.frame.follow(body.reshape(len(u), -1), new.reshape(len(u), -1))
        return replace(state, step=step, u=new, previous=u, starts=starts)
