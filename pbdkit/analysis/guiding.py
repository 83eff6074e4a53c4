"""Guided particles among the couplings: their moves, and what they do as leaders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import Couplings, some_of
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.scene import Scene
from pbdkit.stepping.guidance import Guidance

Floats = NDArray[np.floating[Any]]


class Guiding:
    """The guided particles of a step, looked up by their flat place. `turns` takes the moves of
    each to those that it makes, (particle, axis, axis): T = 1 along free axes, and shares there of
    the move along others (stepping/guidance.py)."""

    def __init__(self, scene: Scene, step: int) -> None:
        guidance = Guidance(scene)
        self.guided = guided = guidance.at(step)
        self.free = np.eye(scene.axes) * ~guided.led.T[:, None]
        """(particle, axis, axis): 1 along free axes."""
        self.turns = self.free + guidance.shares(guided)

    def __bool__(self) -> bool:
        return len(self.guided.place) > 0

    def numbers(self, place: Indices) -> Indices:
        """Of those at flat places, -1 where nobody is guided."""
        if not self:
            return np.full(len(place), -1)
        order = np.argsort(self.guided.place)
        at = np.searchsorted(self.guided.place, place, sorter=order).clip(max=len(order) - 1)
        return np.where(self.guided.place[order[at]] == place, order[at], -1)

    def turned(self, place: Indices, values: Floats) -> Floats:
        """The moves, or blocks, (particle, axis, ...), of particles at flat places."""
        own = self.numbers(place)
        if not (some := np.flatnonzero(own >= 0)).size:
            return values
        turned = values.copy()
        turned[some] = np.einsum("eab,eb...->ea...", self.turns[own[some]], values[some])
        return turned

    def put(
        self, free: Couplings, led: Couplings, rows: Indices, there: Indices,
        unknown: tuple[NDArray[np.int32], NDArray[np.int32]], blocks: Floats,
    ) -> None:  # fmt: skip
        """Adds what particles at flat places do as followers, and what guided ones do as leaders,
        by the numbers `unknown` that each flat place has among both."""
        own = self.numbers(there)
        others, some = own < 0, np.flatnonzero(own >= 0)
        free.add(rows[others], unknown[0][there[others]], some_of(blocks, others))
        kept = np.einsum("eab,ebc->eac", blocks[some], self.free[own[some]])
        free.add(rows[some], unknown[0][there[some]], kept)
        led.add(rows[some], unknown[1][there[some]], blocks[some] - kept)
