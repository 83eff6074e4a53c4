"""Particles of a scene with what is around them, as the evaluator is asked about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Components, Here, Slot, Softens, SoftensCells, Torn
from pbdkit.interfaces.rule import shares_particles
from pbdkit.interfaces.vector import vector
from pbdkit.scene.cell_bonds import CellBond
from pbdkit.scene.places import Where
from pbdkit.scene.raster import EMPTY, FOLLOWER, Raster
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Contributions, Evaluator, Mask, Neighbour, summed
from pbdkit.stepping.state import State, shown

BLOCK_CELLS = 16384
"""Places a block: small enough for its temporaries to stay in the cache."""
Contributing = Callable[[Components, Components, Neighbour], Contributions]
"""What a neighbour contributes, given d and u."""


class Surroundings:
    """Some particles of one sublattice: their `slots` with what is constant of each neighbour, and
    where particles of the body have a neighbour, `movable` (None: everywhere)."""

    def __init__(self, scene: Scene, where: Where, sublattice: int) -> None:
        self._scene, self.where, self._sublattice = scene, where, sublattice
        self._evaluator = Evaluator(scene)
        self.slots = scene.neighbourhood.slots[sublattice]
        self._present = presence(scene.raster, where, self.slots)
        self._weights = [self._weights_of(slot) for slot in self.slots]
        self._more = [self._more_of(slot) for slot in self.slots]
        neighbours = sum(1 if there is None else there.astype(int) for there in self._present)
        movable = (where.of(scene.raster.kind) == FOLLOWER) & (neighbours > 0)
        self.movable: Mask | None = None if movable.all() else movable

    @cached_property
    def _reference(self) -> tuple[Any, Any]:
        """X and its distance from the middle of the body, where the rule asks for them."""
        if not self._scene.experiment.rule.uses_reference:
            return None, None
        local = self._scene.raster.reference_planes(self.where)
        origin = self._scene.raster.lattice.origin
        return local.each(np.add, origin), local.each(np.subtract, self._scene.middle)

    def differences(self, u: NDArray[Any]) -> list[Components]:
        """u_k - u_j along each slot."""
        here = vector(self.where.of(u))
        return [vector(self.where.seen_through(slot).of(u)) - here for slot in self.slots]

    def neighbours(self, state: State) -> list[Neighbour]:
        """The neighbours through each slot, as they are in a state."""
        parts = zip(self.slots, self._weights, self._present, self._more, strict=True)
        if self._scene.tears:
            torn = self._torn(state)
            return [
                Neighbour(slot.rest, w, present, more=more, torn=torn[slot] if torn else None)
                for slot, w, present, more in parts
            ]
        return [
            Neighbour(
                slot.rest, w, present, *self._bond(slot, state), more, self._shared(slot, state)
            )
            for slot, w, present, more in parts
        ]

    @property
    def parameters(self) -> Any:
        """p of the rule."""
        return self._scene.constants.rule_at(self.where)

    def here(self, u: NDArray[Any], state: State) -> Here:
        """What stands at the particles."""
        own = self._remembered(self.where, state)
        return Here(vector(shown(self.where.of(u))), *self._reference, own)

    def own(self, state: State) -> list[NDArray[Any]]:
        """What is remembered of the particles; of a block, views into the state."""
        return [self.where.of(value) for value in state.particle_values]

    def sums(self, function: Contributing, u: NDArray[Any], state: State) -> Contributions:
        """Σ function(d, u, neighbour), as the evaluator's `contribution` is."""
        own = vector(shown(self.where.of(u)))
        parts = zip(self.differences(u), self.neighbours(state), strict=True)
        return summed((function(d, own, to), to.present) for d, to in parts)

    def _weights_of(self, slot: Slot) -> Any:
        """w of a slot; the shares of cells are arrays where they differ."""
        weights, cells = self._scene.constants.weights[slot], self._scene.cells
        if cells is None:
            return weights
        left, right = cells.beside(slot, self.where, self._scene.experiment.stepping.precision)
        return weights._replace(left=left, right=right)

    def _more_of(self, slot: Slot) -> tuple[Any, ...]:
        """w of cells of a stiffness of their own, where any is beside the slot."""
        cells, precision = self._scene.cells, self._scene.experiment.stepping.precision
        found = list[Any]()
        if cells is None:
            return ()
        for weights, shares in zip(cells.weights, cells.mixed, strict=True):
            left, right = cells.beside(slot, self.where, precision, shares)
            if np.any(left) or np.any(right):
                found.append(weights[slot]._replace(left=left, right=right))
        return tuple(found)

    def _remembered(self, where: Where, state: State) -> Any:
        """What is remembered of the particles somewhere, by name."""
        values = (where.of(value) for value in state.particle_values)
        return self._scene.constants.of_particle(*shown(values))

    def _shared(self, slot: Slot, state: State) -> tuple[Any, ...]:
        """What is remembered of the particles and of their neighbours, for rules that see it."""
        if not shares_particles(self._scene.experiment.rule):
            return ()
        ends = self.where, self.where.seen_through(slot)
        return tuple(self._remembered(end, state) for end in ends)

    def _torn(self, state: State) -> dict[Slot, Torn] | None:
        """The damage beside each slot; None where nothing is damaged."""
        around = self._scene.neighbourhood.cells_around[self._sublattice]
        damage = {
            (bond.plane, bond.home): self._damage(bond, state)
            for cell in around.cells
            for bond in cell
        }
        if not any(np.any(one) for both in damage.values() for one in both):
            return None
        largest = [
            reduce(np.maximum, (damage[bond.plane, bond.home][bond.side] for bond in cell))
            for cell in around.cells
        ]
        found = {}
        for slot in self.slots:
            plane, at_this_end = self._scene.neighbourhood.home[slot]
            own = damage[plane, None if at_this_end else slot]
            left, right = (largest[n] for n in around.beside[slot])
            found[slot] = Torn(left, right, *(own if at_this_end else own[::-1]))
        return found

    def _damage(self, bond: CellBond, state: State) -> tuple[NDArray[np.floating[Any]], ...]:
        """The share of their pull that bonds have lost in the cells to their left and right, where
        they are kept: 1 where they are broken."""
        scene, home = self._scene, self.where
        if bond.home:
            home = home.seen_through(bond.home)
        assert state.broken_step is not None
        broken = home.within(state.broken_step[bond.plane]) >= 0
        softened: tuple[Any, Any] = 0.0, 0.0
        if isinstance(scene.experiment.fracture, (Softens, SoftensCells)):
            own = shown([home.within(value[bond.plane]) for value in state.bond_values])
            limits = scene.constants.limits_at(bond.slot, bond.plane, home)
            softened = self._evaluator.damage(
                bond.slot.rest, scene.constants.of_bond(*limits, *own)
            )
        precision = scene.experiment.stepping.precision
        return tuple(np.where(broken, 1.0, side).astype(precision) for side in softened)

    def _bond(self, slot: Slot, state: State) -> tuple[Mask | None, Any]:
        """Where the bond along a slot is broken, and its constants where they reach the rule."""
        if state.broken_step is None:
            return None, None
        scene = self._scene
        plane, at_this_end = scene.neighbourhood.home[slot]
        home = self.where if at_this_end else self.where.seen_through(slot)
        broken = home.within(state.broken_step[plane]) >= 0
        c = None
        if isinstance(scene.experiment.fracture, Softens):
            own = shown([home.within(value[plane]) for value in state.bond_values])
            c = scene.constants.of_bond(*scene.constants.limits_at(slot, plane, home), *own)
        return (broken if broken.any() else None), c


def blocks(scene: Scene) -> list[Surroundings]:
    """The surroundings of the body's particles, block by block."""
    return [
        Surroundings(scene, part, s)
        for s in range(scene.raster.shape[0])
        if (block := scene.raster.body_block(s))
        for part in block.rows(BLOCK_CELLS)
    ]


def presence(raster: Raster, place: Where, slots: Sequence[Slot]) -> list[Mask | None]:
    """For each slot, where the neighbour exists, None where it does everywhere; only places with a
    particle count."""
    nobody = place.of(raster.kind) == EMPTY
    there = (place.seen_through(slot).of(raster.kind) != EMPTY for slot in slots)
    return [None if (present | nobody).all() else present for present in there]
