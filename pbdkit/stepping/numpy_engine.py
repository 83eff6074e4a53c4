"""Interface of engines, and the numpy engine, which is the reference for all other engines."""

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
    """Base class of engines, which step the states of one scene. All engines give the same numbers,
    to the last bit if rules use only + - × ÷ and square roots."""

    name: str
    threads: int = 1

    @abstractmethod
    def advance(self, state: State, steps: int = 1) -> State:
        """Return the state after a number of steps. The arrays of `state` are reused; `state` is
        invalid afterwards."""

    def renewed(self, state: State, rows: slice) -> None:
        """Update the data that the engine stores in addition to the state, after some rows of cells
        of the state were overwritten."""
        return


class Stepper(Engine):
    """Engine that applies the operations of a step with numpy and stores no state."""

    name = "numpy"

    def __init__(
        self, scene: Scene, sweep: MoveFollowers | None = None, *, strict: bool = False
    ) -> None:
        """Create the engine. If `strict` is true, FloatingPointError is raised by the first
        operation of the rule that gives NaN."""
        self._scene = scene
        self._invalid: Literal["raise", "ignore"] = "raise" if strict else "ignore"
        self._program = program_of(scene, sweep)
        self._numbered = self
        """Engine with the parameters of the last step."""

    def advance(self, state: State, steps: int = 1) -> State:
        """Make the steps. Each step uses the values that the parameters have at its end."""
        for _ in range(steps):
            scene = self._scene.at(state.step + 1)
            if scene is not self._scene and scene is not self._numbered._scene:
                self._numbered = Stepper(scene, strict=self._invalid == "raise")
            state = (self if scene is self._scene else self._numbered)._step(state)
        return state

    def _step(self, state: State) -> State:
        step = Step(state.step + 1, state.u, state.previous, state, self._invalid)
        for operation in self._program:
            operation.apply(step)
        starts = step.starts or state.starts
        return replace(state, step=step.number, u=step.new, previous=step.u, starts=starts)
