"""Breaking bonds, and what the rule sees of those that are broken or softened."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import FractureModel, Slot, Vector, length, where
from pbdkit.registry.blame import blaming
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.scene.raster import Block
from pbdkit.scene.remembering import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.remembering import changing, renew, shown
from pbdkit.stepping.state import State
from pbdkit.stepping.sums import BLOCK_CELLS, difference

Steps = NDArray[np.int32]
Home = tuple[int, slice, slice]
"""Where bonds are kept: plane, rows and columns."""
DIRECTIONS = tuple(
    Vector(float(np.cos(angle)), float(np.sin(angle))) for angle in 2.0 * np.pi * np.arange(8) / 8
)


class Fracturing:
    """The fracture model of a scene on its planes of bonds."""

    def __init__(self, scene: Scene) -> None:
        self._model: FractureModel = scene.experiment.fracture
        self._parameters, self._limits = scene.constants.fracture, scene.constants.limits
        self._numbers = bond_numbers(scene.experiment)
        self._softens, self._updates = self._model.softens(), self._model.updates()
        self._breakable = []
        self._plane_of: dict[Slot, tuple[int, bool]] = {}
        frame_too = self._model.breaks_frame_bonds()
        for n, plane in enumerate(scene.neighbourhood.planes):
            self._plane_of |= {plane.slot: (n, True), plane.opposite: (n, False)}
            block = plane_block(scene.raster, plane)
            for part in block.rows(BLOCK_CELLS) if block else ():
                where_ = bonds_in(scene.raster, part, plane, frame_too)
                self._breakable.append((n, plane.slot, part, where_))

    def break_bonds(self, m: NDArray[Any], state: State, step: int) -> None:
        """Renews, in place, what is remembered of the bonds in the intermediate configuration m,
        and marks those that break, with their length."""
        assert state.broken_step is not None
        assert state.broken_length is not None
        for place, d, r, breaks in self._judged(m, state, f"at step {step}"):
            if breaks.any():
                state.broken_step[place][breaks] = step
                lengths = length(Vector(r.x + d.x[breaks], r.y + d.y[breaks]))
                state.broken_length[place][breaks] = lengths

    def may_break(self, u: NDArray[Any], state: State, within: float) -> bool:
        """Whether any bond breaks at u, or at a configuration in which one of its ends is less than
        `within` away from there as seen from the other.

        Looked for in eight directions, so far out that the octagon takes in the circle.
        """
        radius = within / np.cos(np.pi / len(DIRECTIONS))
        return any(
            bool(breaks.any())
            for along in (Vector(0.0, 0.0), *DIRECTIONS)
            for *_, breaks in self._judged(
                u, state, "near equilibrium", Vector(radius * along.x, radius * along.y)
            )
        )

    def _judged(
        self, m: NDArray[Any], state: State, when: str, nudge: Vector | None = None
    ) -> Iterator[tuple[Home, Vector, Vector, NDArray[np.bool_]]]:
        """Part by part of each slot's bonds where they are kept, their d and r, and which break.
        What is remembered is renewed in place; not where d is nudged, all alike, to see."""
        assert state.broken_step is not None
        for n, slot, block, breakable in self._breakable:
            _, rows, columns = block.slices()
            d, r = difference(m, block, slot), slot.rest
            intact = breakable & (state.broken_step[n, rows, columns] < 0)
            own = [value[n, rows, columns] for value in state.bond_values]
            if nudge:
                d = Vector(d.x + nudge.x, d.y + nudge.y)
                own = [value.copy() for value in own]
            c = (*self._limits[slot], *shown(own))
            with np.errstate(all="ignore"), blaming(self._model, when):
                if self._updates:
                    fresh = self._model.update(d, r, c, self._parameters)
                    renew(changing(self._numbers, own), fresh, intact)
                breaks = self._model.breaks(d, r, c, self._parameters)
            yield (n, rows, columns), d, r, intact & breaks

    def seen(self, d: Vector, u: Vector, block: Block, slot: Slot, state: State) -> Vector:
        """The difference that the rule sees: softened, or that of the fictitious point where the
        bond broke."""
        assert state.broken_step is not None
        n, rows, columns = self._home(block, slot)
        broken = state.broken_step[n, rows, columns] >= 0
        any_broken = bool(broken.any())
        if not (any_broken or self._softens):
            return d
        with blaming(self._model, "to place a fictitious point"):
            lost = self._model.fictitious(u, slot.rest, self._parameters)
        if self._softens:
            c = (*self._limits[slot], *(v[n, rows, columns] for v in shown(state.bond_values)))
            with blaming(self._model, "to soften a bond"):
                d = self._model.seen(d, lost, slot.rest, c, self._parameters)
        if not any_broken:
            return d
        return Vector(where(broken, lost.x, d.x), where(broken, lost.y, d.y))

    def plane_of(self, slot: Slot) -> tuple[int, bool]:
        """The plane of the bonds along a slot, and whether they live at this end."""
        return self._plane_of[slot]

    def broken(self, block: Block, slot: Slot, broken_step: Steps) -> NDArray[np.bool_]:
        """Where on the block the bond along a slot is broken."""
        broken: NDArray[np.bool_] = broken_step[self._home(block, slot)] >= 0
        return broken

    def _home(self, block: Block, slot: Slot) -> Home:
        """Where the bonds of a block along a slot live: on the plane of the positive slot, at this
        end or at the other."""
        n, positive = self._plane_of[slot]
        _, rows, columns = (block if positive else block.seen_through(slot)).slices()
        return n, rows, columns
