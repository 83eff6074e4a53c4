"""Bonds that are broken or softened, as the rule sees them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot, Vector, where
from pbdkit.interfaces.answers import as_vector
from pbdkit.interfaces.frame import Indices
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.state import State

Present = NDArray[np.bool_]


class ChangedBonds:
    """Which bonds are broken or softened, by the place of one end."""

    def __init__(self, scene: Scene, state: State) -> None:
        self._steps, self._values = state.broken_step, state.bond_values
        self.any_broken = self._steps is not None and bool((self._steps >= 0).any())
        self._model, self._parameters = scene.experiment.fracture, scene.constants.fracture
        self._limits, self._softens = scene.constants.limits, self._model.softens()
        self.any_changed = self.any_broken or (self._steps is not None and self._softens)
        self._fracturing = Fracturing(scene) if self.any_changed else None
        self._cells = scene.raster.shape[1] * scene.raster.shape[2]

    def broken(self, slot: Slot, step: int, place: Indices) -> Present:
        """Whether the bond along a slot is broken, for each place."""
        assert self._steps is not None
        broken: Present = self._at_home(self._steps, slot, step, place) >= 0
        return broken

    def constants(self, slot: Slot, step: int, place: Indices) -> tuple[Any, ...]:
        """The constants of the bonds along a slot and what is remembered of them."""
        own = (self._at_home(value, slot, step, place) for value in self._values)
        return (*self._limits[slot], *own)

    def seen(self, d: Vector, u: Vector, slot: Slot, broken: Present, c: Any) -> Vector:
        """The difference that the rule sees."""
        if not (broken.any() or self._softens):
            return d
        with blaming(self._model, "when linearised"):
            lost = as_vector(self._model.fictitious(u, slot.rest, self._parameters), "fictitious")
            d = as_vector(self._model.seen(d, lost, slot.rest, c, self._parameters), "seen")
        return Vector(where(broken, lost.x, d.x), where(broken, lost.y, d.y))

    def _at_home(self, planes: Any, slot: Slot, step: int, place: Indices) -> Any:
        assert self._fracturing is not None
        plane, positive = self._fracturing.plane_of(slot)
        start = place if positive else place + step
        return planes[plane].ravel()[start % self._cells]
