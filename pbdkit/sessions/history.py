"""States that are kept, so that one can go back."""

from __future__ import annotations

from bisect import bisect_right
from copy import copy

from pbdkit.stepping.state import State

ROOM = 256 * 2**20
"""Bytes that kept states may take."""
FEWEST, MOST = 4, 200
"""Of states."""


class History:
    """The start, and later states ever farther apart the more there are: never more than fit."""

    def __init__(self, start: State) -> None:
        self._states = [start.copy()]
        self._apart = 1

    @property
    def steps(self) -> list[int]:
        """Those of which the state is kept."""
        return [state.step for state in self._states]

    def keep(self, state: State) -> None:
        """Notes a state, if it is far enough from the last."""
        if state.step < self._states[-1].step + self._apart:
            return
        self._states.append(state.copy())
        while not self._fits():
            self._apart *= 2
            self._thin()

    def copy(self) -> History:
        """The same states, kept on their own."""
        found = copy(self)
        found._states = [*self._states]
        return found

    def before(self, step: int) -> State:
        """A copy of the last state kept that is not after a step."""
        return self._states[max(0, bisect_right(self.steps, step) - 1)].copy()

    def cut_back(self, step: int) -> None:
        """Forgets the states after a step."""
        self._states = [state for state in self._states if state.step <= step] or self._states[:1]

    def _fits(self) -> bool:
        count = len(self._states)
        return count <= FEWEST or (count <= MOST and sum(map(_size, self._states)) <= ROOM)

    def _thin(self) -> None:
        kept = self._states[:1]
        for state in self._states[1:]:
            if state.step >= kept[-1].step + self._apart:
                kept.append(state)
        self._states = kept


def _size(state: State) -> int:
    """Its bytes, about."""
    more = (state.broken_step, state.broken_length, *state.bond_values, *state.particle_values)
    return 2 * state.u.nbytes + sum(array.nbytes for array in more if array is not None)
