"""Breaking bonds, and what stands in for the lost neighbours."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import FractureModel, Slot, Vector, where
from pbdkit.registry.blame import blaming
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.scene.raster import Block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.sums import difference

Steps = NDArray[np.int32]
DIRECTIONS = tuple(
    Vector(float(np.cos(angle)), float(np.sin(angle))) for angle in 2.0 * np.pi * np.arange(8) / 8
)


class Fracturing:
    """The fracture model of a scene on its planes of bonds."""

    def __init__(self, scene: Scene) -> None:
        self._model: FractureModel = scene.experiment.fracture
        self._parameters = scene.constants.fracture
        self._breakable = []
        self._plane_of: dict[Slot, tuple[int, bool]] = {}
        frame_too = self._model.breaks_frame_bonds()
        for n, plane in enumerate(scene.neighbourhood.planes):
            self._plane_of |= {plane.slot: (n, True), plane.opposite: (n, False)}
            if block := plane_block(scene.raster, plane):
                where_ = bonds_in(scene.raster, block, plane, frame_too)
                constants = scene.constants.limits[plane.slot]
                self._breakable.append((n, plane.slot, block, where_, constants))

    def break_bonds(self, m: NDArray[Any], broken_step: Steps, step: int) -> None:
        """Marks, in place, the bonds that break in the intermediate configuration m."""
        for plane, breaks in self._breaking(m, broken_step, f"at step {step}"):
            plane[breaks] = step

    def may_break(self, u: NDArray[Any], broken_step: Steps, within: float) -> bool:
        """Whether any bond breaks at u, or at a configuration in which one of its ends is less than
        `within` away from there as seen from the other.

        Looked for in eight directions, so far out that the octagon takes in the circle.
        """
        radius = within / np.cos(np.pi / len(DIRECTIONS))
        return any(
            bool(breaks.any())
            for along in (Vector(0.0, 0.0), *DIRECTIONS)
            for _, breaks in self._breaking(
                u, broken_step, "near equilibrium", Vector(radius * along.x, radius * along.y)
            )
        )

    def _breaking(
        self, m: NDArray[Any], broken_step: Steps, when: str, nudge: Vector | None = None
    ) -> Iterator[tuple[Steps, NDArray[np.bool_]]]:
        """For each slot the breaking steps of its bonds, and which break, all differences nudged
        alike."""
        for n, slot, block, breakable, constants in self._breakable:
            _, rows, columns = block.slices()
            plane = broken_step[n, rows, columns]
            d = difference(m, block, slot)
            if nudge:
                d = Vector(d.x + nudge.x, d.y + nudge.y)
            with np.errstate(all="ignore"), blaming(self._model, when):
                breaks = self._model.breaks(d, slot.rest, constants, self._parameters)
            yield plane, breakable & (plane < 0) & breaks

    def seen(self, d: Vector, u: Vector, block: Block, slot: Slot, broken_step: Steps) -> Vector:
        """The difference that the rule sees: that of the fictitious point where the bond broke."""
        broken = self.broken(block, slot, broken_step)
        if not broken.any():
            return d
        with blaming(self._model, "to place a fictitious point"):
            lost = self._model.fictitious(u, slot.rest, self._parameters)
        return Vector(where(broken, lost.x, d.x), where(broken, lost.y, d.y))

    def plane_of(self, slot: Slot) -> tuple[int, bool]:
        """The plane of the bonds along a slot, and whether they live at this end."""
        return self._plane_of[slot]

    def broken(self, block: Block, slot: Slot, broken_step: Steps) -> NDArray[np.bool_]:
        """Where on the block the bond along a slot is broken.

        A bond lives on the plane of its positive slot: at this end or at the other.
        """
        n, positive = self.plane_of(slot)
        _, rows, columns = (block if positive else block.seen_through(slot)).slices()
        broken: NDArray[np.bool_] = broken_step[n, rows, columns] >= 0
        return broken
