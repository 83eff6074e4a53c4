"""The engine interface, and the numpy engine: the oracle of every faster one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Literal

from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import MoveFollowers
from pbdkit.stepping.program import program_of
from pbdkit.stepping.state import State
from pbdkit.stepping.step import Step


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
    """The numpy engine: it applies the operations of a step, and holds no state."""

    name = "numpy"

    def __init__(
        self, scene: Scene, sweep: MoveFollowers | None = None, *, strict: bool = False
    ) -> None:
        """With `strict` the first operation of the rule that gives NaN raises
        FloatingPointError."""
        self._scene = scene
        self._invalid: Literal["raise", "ignore"] = "raise" if strict else "ignore"
        self._program = program_of(scene, sweep)
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
        step = Step(state.step + 1, state.u, state.previous, state, self._invalid)
        for operation in self._program:
            operation.apply(step)
        starts = step.starts or state.starts
        return replace(state, step=step.number, u=step.new, previous=step.u, starts=starts)
