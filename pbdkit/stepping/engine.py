"""The engine interface: what takes a state some steps further."""

from __future__ import annotations

from abc import ABC, abstractmethod

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
