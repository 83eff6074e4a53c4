"""Evaluation of rule and fracture model: what a particle does in a step, given its neighbours.

Stepping, analysis, identification, diagnostics of a material and the conformance suite evaluate
rule and fracture model here and nowhere else; kernels are generated from the same functions and
tested against this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Mask
from pbdkit.lattice.cells import CellBond, WeighedCells
from pbdkit.lattice.raster import EMPTY, FOLLOWER, Raster, Where
from pbdkit.plugin import (
    Calibrated,
    CellStress,
    FollowerRule,
    Here,
    Loadable,
    RenewsBonds,
    RenewsParticles,
    Slot,
    Softens,
    SoftensCells,
    StoresEnergy,
    Torn,
    Vector,
    where,
)
from pbdkit.plugin.component import as_values, as_vector, as_verdict
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, renew, shown

Contributions = tuple[Any, ...]
Cells = tuple[CellStress, ...]


@dataclass(frozen=True)
class Neighbour:
    """One neighbour of some particles, or of one: its rest offset r and the rule's weights w; where
    it is `present` and where the bond is `broken` (None: everywhere, nowhere); with fracture the
    constants c of the bond, what is remembered of it included. `more` are weights besides w, of
    cells that are of a stiffness of their own: what they contribute is added. For rules that see
    it, `shared` is what is remembered of the particle and of the neighbour. `torn` is the damage
    beside the bond, for rules that tear cells, where there is any; such rules see the difference
    as it is."""

    r: Vector
    w: Any
    present: Mask | None = None
    broken: Mask | None = None
    c: Any = None
    more: tuple[Any, ...] = ()
    shared: tuple[Any, ...] = ()
    torn: Torn | None = None


class Evaluator:
    """The rule and the fracture model of a scene, with the numbers that they are called with."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.rule: FollowerRule = scene.experiment.rule
        self._model = scene.experiment.fracture
        self._p, self._q = scene.constants.rule, scene.constants.fracture
        self.tears = scene.tears
        self._of_bond = bond_numbers(scene.experiment)
        self._of_particle = particle_numbers(scene.experiment)

    def given(self, p: Any) -> Evaluator:
        """The same with the rule's parameters of some particles."""
        found = copy(self)
        found._p = p
        return found

    def contribution(self, d: Vector, u: Vector, to: Neighbour) -> Contributions:
        """What a neighbour contributes, or what stands in for it."""
        seen = d if self.tears else self.seen(d, u, to)
        part = as_values(self._of_weights(seen, to, to.w), "gather")
        for w in to.more:
            other = as_values(self._of_weights(seen, to, w), "gather")
            part = tuple(a + b for a, b in zip(part, other, strict=True))
        return part

    def _of_weights(self, d: Vector, to: Neighbour, w: Any) -> Any:
        """What the rule makes of a difference with some weights."""
        rule: Any = self.rule  # some are given more than others
        if to.torn is not None:
            return rule.torn(d, to.r, w, to.torn, self._p)
        return rule.gather(d, to.r, w, self._p, *to.shared)

    def energy(self, d: Vector, u: Vector, to: Neighbour) -> Contributions:
        """The half of the bond's energy that falls to this end."""
        assert isinstance(self.rule, StoresEnergy)
        if self.tears:
            w, t = to.w, to.torn
            if t is not None:
                left, right = w.left * (1.0 - t.bond_left), w.right * (1.0 - t.bond_right)
                w = w._replace(left=left, right=right)
            return (self.rule.energy(d, to.r, w, self._p),)
        return (self.rule.energy(self.seen(d, u, to), to.r, to.w, self._p),)

    def seen(self, d: Vector, u: Vector, to: Neighbour) -> Vector:
        """The difference that the rule sees: softened, or that of the fictitious point where the
        bond broke."""
        model = self._model
        if to.broken is None and to.c is None:
            return d
        with blaming(model, "to place a fictitious point"):
            lost = as_vector(model.fictitious(u, to.r, self._q), "fictitious", u)
        if isinstance(model, Softens) and to.c is not None:
            with blaming(model, "to soften a bond"):
                d = as_vector(model.seen(d, lost, to.r, to.c, self._q), "seen", u)
        return d if to.broken is None else where(to.broken, lost, d)

    def damage(self, r: Vector, c: Any) -> tuple[Any, Any]:
        """The share of its pull that a bond with the constants c, which has not broken, has lost in
        the cells to its left and right."""
        model: Any = self._model
        if isinstance(model, SoftensCells):
            return c.damage_left, c.damage_right
        ahead, nothing = (vector([x, *[0.0] * (len(r) - 1)]) for x in (1.0, 0.0))
        with blaming(model, "to soften a bond"):
            seen = as_vector(model.seen(ahead, nothing, r, c, self._q), "seen", ahead)
        return (1.0 - seen[0],) * 2

    def move(self, total: Contributions, here: Here, load: Vector | None = None) -> Any:
        """From where the particle stands to its target, under a load if there is any."""
        if load is not None:
            assert isinstance(self.rule, Loadable)
            total = as_values(self.rule.loaded(total, load, self._p), "loaded")
        return as_vector(self.rule.apply(total, here, self._p), "apply", here.u)

    def force(self, total: Contributions, here: Here) -> Any:
        """The force of the neighbours over Young's modulus and thickness."""
        assert isinstance(self.rule, Calibrated)
        return as_vector(self.rule.force(total, here, self._p), "force", here.u)

    def remember(self, total: Contributions, here: Here) -> Contributions:
        """The new values of the particle's numbers that change."""
        assert isinstance(self.rule, RenewsParticles)
        return as_values(self.rule.remember(total, here, self._p), "remember")

    def renew_particles(
        self, total: Contributions, here: Here, own: Sequence[Any], where: Mask | None
    ) -> None:
        """Writes the new values over what is remembered of particles, in place, where asked for."""
        if isinstance(self.rule, RenewsParticles):
            renew(self._of_particle, own, self.remember(total, here), where)

    def renew_bonds(
        self,
        d: Vector,
        r: Vector,
        limits: Any,
        own: Sequence[Any],
        intact: Mask,
        cells: Cells = (),
    ) -> None:
        """Writes the new values over what is remembered of bonds, in place, where they hold;
        `cells` are those beside the bonds, for a model that softens cells."""
        if isinstance(self._model, RenewsBonds):
            renew(self._of_bond, own, self.update(d, r, limits, own, cells), intact)

    def update(
        self, d: Any, r: Any, limits: Any, own: Sequence[Any], cells: Cells = ()
    ) -> Contributions:
        """The new values of the bonds' numbers that change."""
        assert isinstance(self._model, RenewsBonds)
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_values(self._model.update(d, r, c, self._q, *cells), "update")

    def load(self, cell: CellStress, limits: Any, own: Sequence[Any]) -> Any:
        """How far the stress of a cell has come on the way to where it softens."""
        assert isinstance(self._model, SoftensCells)
        return self._model.load(cell, self._scene.constants.of_bond(*limits, *shown(own)), self._q)

    def breaks(self, d: Vector, r: Vector, limits: Any, own: Sequence[Any]) -> Any:
        """Whether bonds break that remember these numbers."""
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_verdict(self._model.breaks(d, r, c, self._q))

    def everywhere(self, slots: Iterable[Slot]) -> list[Neighbour]:
        """The neighbours in the middle of a body: all are there, no bond has broken, and what is
        remembered is as at the start."""
        weights = self._scene.constants.weights
        shared = (self.initial_own(),) * 2 if shares_particles(self.rule) else ()
        return [Neighbour(slot.rest, weights[slot], shared=shared) for slot in slots]

    def at_rest(self, slots: Sequence[Slot]) -> Any:
        """The move of a particle at rest with all these neighbours."""
        u = vector(np.zeros(self._scene.axes))
        parts = [self.contribution(u, u, to) for to in self.everywhere(slots)]
        return self.move(summed((part, None) for part in parts), Here(u, own=self.initial_own()))

    def initial_own(self) -> Any:
        """What a particle remembers at the start, unless it is drawn."""
        initial = (number.initial for number in self._of_particle)
        return self._scene.constants.of_particle(*initial)


def summed(parts: Iterable[tuple[Contributions, Mask | None]]) -> Contributions:
    """Σ of contributions where the neighbours are present, in their order.

    What a neighbour contributes equally everywhere may be a plain number, and stays one.
    """
    total: Contributions | None = None
    for part, there in parts:
        if there is not None:
            part = tuple(_masked(value, there) for value in part)
        total = part if total is None else tuple(a + b for a, b in zip(total, part, strict=True))
    return total or ()


def _masked(value: Any, present: Mask) -> Any:
    if isinstance(value, Vector):
        return value.each(lambda component: np.where(present, component, 0.0))
    return np.where(present, value, 0.0)


BLOCK_CELLS = 16384
"""Places a block: small enough for its temporaries to stay in the cache."""
Contributing = Callable[[Vector, Vector, Neighbour], Contributions]
"""What a neighbour contributes, given d and u."""


class Surroundings:
    """Some particles of one sublattice: their `slots` with what is constant of each neighbour, and
    where particles of the body have a neighbour, `movable` (None: everywhere)."""

    def __init__(self, scene: Scene, where: Where, sublattice: int) -> None:
        self._scene, self.where, self._sublattice = scene, where, sublattice
        self._evaluator = Evaluator(scene)
        self.slots = scene.neighbourhood.slots[sublattice]
        self._present = presence(scene.raster, where, self.slots)
        self._weights = [scene.constants.weights[slot] for slot in self.slots]
        self._more: list[tuple[Any, ...]] = [()] * len(self.slots)
        if scene.cells:
            self._weigh_cells(scene.cells)
        self._there = [where.seen_through(slot) for slot in self.slots]
        neighbours = sum(1 if there is None else there.astype(int) for there in self._present)
        movable = (where.of(scene.raster.kind) == FOLLOWER) & (neighbours > 0)
        self.movable: Mask | None = None if movable.all() else movable

    @cached_property
    def _constant_neighbours(self) -> list[Neighbour]:
        """The neighbours of a scene in which nothing about them changes."""
        parts = zip(self.slots, self._weights, self._present, self._more, strict=True)
        return [Neighbour(slot.rest, w, present, more=more) for slot, w, present, more in parts]

    @cached_property
    def _reference(self) -> tuple[Any, Any]:
        """X and its distance from the middle of the body, where the rule asks for them."""
        if not self._scene.experiment.rule.uses_reference:
            return None, None
        local = self._scene.raster.reference_planes(self.where)
        origin = self._scene.raster.lattice.origin
        return local.each(np.add, origin), local.each(np.subtract, self._scene.middle)

    def differences(self, u: NDArray[Any]) -> list[Vector]:
        """u_k - u_j along each slot."""
        here = vector(self.where.of(u))
        return [vector(there.of(u)) - here for there in self._there]

    def neighbours(self, state: State) -> list[Neighbour]:
        """The neighbours through each slot, as they are in a state."""
        if state.broken_step is None and not shares_particles(self._scene.experiment.rule):
            return self._constant_neighbours
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

    def _weigh_cells(self, cells: WeighedCells) -> None:
        """Put the shares of the cells beside each slot into its weights, and add the weights of
        cells that have a stiffness of their own."""
        precision = self._scene.experiment.stepping.precision
        beside = cells.beside_each(self.slots, self.where, precision)
        self._weights = [
            weights._replace(left=left, right=right)
            for weights, (left, right) in zip(self._weights, beside, strict=True)
        ]
        for weights, shares in zip(cells.weights, cells.mixed, strict=True):
            beside = cells.beside_each(self.slots, self.where, precision, shares)
            for n, (left, right) in enumerate(beside):
                if np.any(left) or np.any(right):
                    w = weights[self.slots[n]]._replace(left=left, right=right)
                    self._more[n] = (*self._more[n], w)

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
