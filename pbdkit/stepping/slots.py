"""Followers whose neighbours are fixed: one shifted view a slot, block of rows by block of rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces import FollowerRule, Here, Slot, Vector
from pbdkit.interfaces.answers import as_move, as_values
from pbdkit.scene.constants import WHOLE_CELLS
from pbdkit.scene.raster import FOLLOWER, Block
from pbdkit.scene.remembering import particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.following import Followers, target
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.remembering import changing, renew, shown
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.sums import (
    BLOCK_CELLS,
    Present,
    difference,
    planes,
    presence,
    read_only,
    sum_over_slots,
)


@dataclass(frozen=True)
class _Part:
    """What is constant on one block: its slots with the rule's weights and presence, X where the
    rule wants it, and where followers can move (None: everywhere)."""

    block: Block
    slots: tuple[Slot, ...]
    weights: dict[Slot, tuple[Any, ...]]
    present: list[Present]
    X: Vector
    movable: Present


def weights_on(scene: Scene, slot: Slot, block: Block) -> tuple[Any, ...]:
    """The rule's w of a slot on a block; the shares of cells are arrays where they differ."""
    weights = scene.constants.weights[slot]
    if scene.cells is None:
        return weights
    return (
        *weights[: -len(WHOLE_CELLS)],
        *scene.cells.beside(slot, block, scene.experiment.stepping.precision),
    )


class SlotFollowers(Followers):
    """Moves the followers of a scene whose neighbours stay as they are."""

    def __init__(
        self,
        scene: Scene,
        fracturing: Fracturing | None,
        solver: Stepping | None = None,
    ) -> None:
        self._scene = scene
        self._solver = solver or scene.experiment.stepping
        self._rule = scene.experiment.rule
        self._parameters = scene.constants.rule
        self._fracturing = fracturing
        self._inner = SlotFollowers(scene.inner, None, Stepping()) if scene.inner else None
        self._numbers = particle_numbers(scene.experiment)
        self._parts = [part for s in range(scene.raster.shape[0]) for part in self._cut(s)]

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Every block from m alone: their order does not matter."""
        for part, total, here in self._summed(m, state):
            move = as_move(self._rule.apply(total, here, self._parameters))
            self._place(part, move, m, new)
            if self._rule.remembers():
                own = [value[part.block.slices()] for value in state.particle_values]
                fresh = as_values(self._rule.remember(total, here, self._parameters), "remember")
                renew(changing(self._numbers, own), fresh, part.movable)

    def moves(self, m: Floats, state: State) -> Floats:
        """The rule's moves, leaders' too; zero where nobody can move."""
        out = np.zeros_like(m)
        for part, total, here in self._summed(m, state):
            _write(as_move(self._rule.apply(total, here, self._parameters)), part, out)
        return out

    def forces(self, m: Floats, state: State) -> Floats:
        """The rule's forces on body particles, leaders too, over Young's modulus and thickness;
        zero where there is no neighbour."""
        out = np.zeros_like(m)
        for part, total, here in self._summed(m, state):
            _write(self._rule.force(total, here, self._parameters), part, out)
        return out

    def energy(self, m: Floats, state: State) -> float:
        """The strain energy over Young's modulus and thickness: the rule's own, or -½ Σ u·force."""
        if self._rule.energy is FollowerRule.energy:
            return self._work(m, self.forces(m, state))
        seen, out = self._seen(m, state), np.zeros_like(m[:1])
        for part in self._parts:
            _write(self._sums(part, seen, state, self._energy_of_a_bond), part, out)
        return float(out.sum())

    def _work(self, u: Floats, forces: Floats) -> float:
        """-½ Σ u·force over the body. Where the forces have no resultant, u counts from its mean,
        so that no digit depends on where the body has gone."""
        place = self._scene.raster.place_of(self._scene.raster.body_rows)
        u, forces = u.reshape(2, -1)[:, place], forces.reshape(2, -1)[:, place]
        if self._scene.frame is None and self._fracturing is None:
            u = u - u.mean(axis=1, keepdims=True)
        return -0.5 * float((u * forces).sum())

    def _cut(self, sublattice: int) -> list[_Part]:
        whole = self._scene.raster.body_block(sublattice)
        return [self._part(block) for block in whole.rows(BLOCK_CELLS)] if whole else []

    def _part(self, block: Block) -> _Part:
        raster, slots = self._scene.raster, self._scene.neighbourhood.slots[block.sublattice]
        present = presence(raster, block, slots)
        neighbours = sum(1 if there is None else there.astype(int) for there in present)
        movable = (raster.kind[block.slices()] == FOLLOWER) & (neighbours > 0)
        return _Part(
            block,
            slots,
            {slot: weights_on(self._scene, slot, block) for slot in slots},
            present,
            raster.reference_planes(block) if self._rule.uses_reference else Vector(None, None),
            None if movable.all() else movable,
        )

    def _seen(self, m: Floats, state: State) -> Floats:
        """What the rule works on: displacements, or the moves of its inner rule."""
        return self._inner.moves(m, state) if self._inner else m

    def _summed(self, m: Floats, state: State) -> Iterator[tuple[_Part, tuple[Any, ...], Here]]:
        """Every block with the sums that `gather` makes and what stands there, as `apply` and
        `force` are given them."""
        seen = self._seen(m, state)
        for part in self._parts:
            own = [value[part.block.slices()] for value in state.particle_values]
            here = Here(read_only(planes(seen, part.block)), part.X, shown(own))
            yield part, self._sums(part, seen, state, self._rule.gather), here

    def _energy_of_a_bond(self, d: Vector, r: Vector, w: Any, p: Any) -> tuple[Any]:
        return (self._rule.energy(d, r, w, p),)

    def _sums(
        self,
        part: _Part,
        m: Floats,
        state: State,
        function: Callable[[Vector, Vector, Any, Any], tuple[Any, ...]],
    ) -> tuple[Any, ...]:
        """Σ function(d, r, w, p) over the neighbours, or what stands in for them."""
        u = read_only(planes(m, part.block))

        def contribution(slot: Slot) -> tuple[Any, ...]:
            d = difference(m, part.block, slot)
            if self._fracturing:
                d = self._fracturing.seen(d, u, part.block, slot, state)
            return function(d, slot.rest, part.weights[slot], self._parameters)

        return sum_over_slots(part.slots, part.present, contribution)

    def _place(self, part: _Part, move: tuple[Any, Any], m: Floats, new: Floats) -> None:
        """Writes where the particles of a block go."""
        u, out = planes(m, part.block), planes(new, part.block)
        for here, step, plane in zip(u, move, out, strict=True):
            moved = target(here, step, plane, self._solver)
            plane[...] = moved if part.movable is None else np.where(part.movable, moved, here)


def _write(values: tuple[Any, ...], part: _Part, out: Floats) -> None:
    """The values of the particles that have neighbours, a plane each."""
    _, rows, columns = part.block.slices()
    for value, plane in zip(values, out[:, part.block.sublattice, rows, columns], strict=True):
        plane[...] = value if part.movable is None else np.where(part.movable, value, 0.0)
