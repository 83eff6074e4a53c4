"""Evaluation of rules and fracture models for given neighbours.

Stepping, stability analysis, identification, diagnostics and the conformance suite evaluate the
functions of rules and fracture models only by means of this module. Kernels are generated from the
same functions; tests compare the results of kernels with those of this module.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Mask
from pbdkit.errors import AnswerError
from pbdkit.lattice.cells import CellBond, WeighedCells
from pbdkit.lattice.raster import EMPTY, FOLLOWER, Raster, Where
from pbdkit.plugin import (
    BreaksAtStrain,
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
    UsesAngles,
    Vector,
    where,
)
from pbdkit.plugin.component import as_values, as_vector, as_verdict
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, renew, shown

Contributions = tuple[Any, ...]
Cells = tuple[CellStress, ...]


@dataclass(frozen=True)
class Neighbour:
    """Neighbours of particles along one slot, with the arguments of the rule's functions.

    `r` is the rest offset, and `w` are the weights of the rule. `present` is true where the
    neighbour exists; None means everywhere. `broken` is true where the bond is broken; None means
    nowhere. With fracture, `c` are the constants and state variables of the bond. `more` are the
    weights of cells that have a stiffness other than that of the rule; their contributions are
    added. `shared` are the state variables of the particle and of the neighbour, for rules that
    read both. `torn` is the damage beside the bond, for rules that compute the forces of torn
    cells; such rules receive the unchanged difference of the displacements. `sublattice` is that of
    the particles.
    """

    r: Vector
    w: Any
    present: Mask | None = None
    broken: Mask | None = None
    c: Any = None
    more: tuple[Any, ...] = ()
    shared: tuple[Any, ...] = ()
    torn: Torn | None = None
    sublattice: int = 0


class Evaluator:
    """Rule and fracture model of a scene, with the parameters of their functions."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.rule: FollowerRule = scene.experiment.rule
        self._model = scene.experiment.fracture
        self._softens = isinstance(self._model, Softens)
        self._uses_angles = isinstance(self.rule, UsesAngles)
        self._p, self._q = scene.constants.rule, scene.constants.fracture
        self.tears = scene.tears
        self._of_bond = bond_numbers(scene.experiment)
        self._of_particle = particle_numbers(scene.experiment)

    def given(self, p: Any) -> Evaluator:
        """Return a copy of the evaluator in which p, the parameters of the rule at particles,
        replaces its parameters."""
        evaluator = copy(self)
        evaluator._p = p
        return evaluator

    def contribution(self, d: Vector, u: Vector, to: Neighbour) -> Contributions:
        """Return the contribution of a neighbour or, at broken bonds, of its fictitious point."""
        difference = d if self.tears else self.seen(d, u, to)
        part = as_values(self._of_weights(difference, to, to.w), "gather")
        for w in to.more:
            other = as_values(self._of_weights(difference, to, w), "gather")
            part = tuple(a + b for a, b in zip(part, other, strict=True))
        return part

    def _of_weights(self, d: Vector, to: Neighbour, w: Any) -> Any:
        """Return the contribution of a neighbour for a given difference d and given weights w."""
        rule: Any = self.rule  # Functions of rules differ in their number of arguments.
        if to.torn is not None:
            return rule.torn(d, to.r, w, to.torn, self._p)
        return rule.gather(d, to.r, w, self._p, *to.shared)

    def total(
        self, d: Sequence[Vector], u: Vector, neighbours: Sequence[Neighbour]
    ) -> Contributions:
        """Return the sums of the contributions of all neighbours and, if the rule uses angles, of
        all pairs of neighbours."""
        along = list(zip(d, neighbours, strict=True))
        total = summed((self.contribution(one, u, to), to.present) for one, to in along)
        if not self._uses_angles:
            return total
        return total + summed(self.pair_contributions(d, u, neighbours))

    def pair_contributions(
        self, d: Sequence[Vector], u: Vector, neighbours: Sequence[Neighbour]
    ) -> Iterator[tuple[Contributions, Mask | None]]:
        """Generate the contribution of each pair of neighbours, with a mask that is true where both
        neighbours exist. The neighbours are those along all slots of a sublattice."""
        if not isinstance(self.rule, UsesAngles):
            return
        seen = [self.seen(one, u, to) for one, to in zip(d, neighbours, strict=True)]
        for k, n in self._scene.constants.pairs[neighbours[0].sublattice]:
            one, other = neighbours[k], neighbours[n]
            part = self.rule.gather_pair(seen[k], seen[n], one.r, other.r, one.w, other.w, self._p)
            yield as_values(part, "gather_pair"), _both(one.present, other.present)

    def energy(self, d: Vector, u: Vector, to: Neighbour) -> Contributions:
        """Return half the energy of a bond, the part that belongs to one end."""
        assert isinstance(self.rule, StoresEnergy)
        if self.tears:
            w, t = to.w, to.torn
            if t is not None:
                left_share, right_share = (
                    w.left * (1.0 - t.bond_left),
                    w.right * (1.0 - t.bond_right),
                )
                w = w._replace(left=left_share, right=right_share)
            return (self.rule.energy(d, to.r, w, self._p),)
        return (self.rule.energy(self.seen(d, u, to), to.r, to.w, self._p),)

    def seen(self, d: Vector, u: Vector, to: Neighbour) -> Vector:
        """Return the difference that the rule receives instead of d. At a broken bond it is the
        difference to the fictitious point, and at a softened bond a combination of both
        differences."""
        model: Any = self._model
        if to.broken is None and to.c is None:
            return d
        with errors_attributed_to(model, "to place a fictitious point"):
            lost = as_vector(model.fictitious(u, to.r, self._q), "fictitious", u)
        if self._softens and to.c is not None:
            with errors_attributed_to(model, "to soften a bond"):
                d = as_vector(model.seen(d, lost, to.r, to.c, self._q), "seen", u)
        return d if to.broken is None else where(to.broken, lost, d)

    def damage(self, r: Vector, c: Any) -> tuple[Any, Any]:
        """Return the lost fractions of the force of an intact bond with the constants c, in the
        cells to its left and to its right."""
        model: Any = self._model
        if isinstance(model, SoftensCells):
            return c.damage_left, c.damage_right
        ahead, nothing = (vector([x, *[0.0] * (len(r) - 1)]) for x in (1.0, 0.0))
        with errors_attributed_to(model, "to soften a bond"):
            difference = as_vector(model.seen(ahead, nothing, r, c, self._q), "seen", ahead)
        return (1.0 - difference[0],) * 2

    def move(self, total: Contributions, here: Here, load: Vector | None = None) -> Any:
        """Return the move from the position of the particle to its target, under a load if there is
        one."""
        if load is not None:
            assert isinstance(self.rule, Loadable)
            total = as_values(self.rule.loaded(total, load, self._p), "loaded")
        return as_vector(self.rule.apply(total, here, self._p), "apply", here.u)

    def force(self, total: Contributions, here: Here) -> Any:
        """Return the force of the neighbours divided by Young's modulus and thickness."""
        assert isinstance(self.rule, Calibrated)
        return as_vector(self.rule.force(total, here, self._p), "force", here.u)

    def remember(self, total: Contributions, here: Here) -> Contributions:
        """Return the new values of the state variables of particles that change."""
        assert isinstance(self.rule, RenewsParticles)
        return as_values(self.rule.remember(total, here, self._p), "remember")

    def renew_particles(
        self, total: Contributions, here: Here, own: Sequence[Any], where: Mask | None
    ) -> None:
        """Write the new values of state variables of particles in place, where a mask is true."""
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
        """Write the new values of state variables of bonds in place, where they are intact. `cells`
        are those beside the bonds, for a model that softens cells."""
        if isinstance(self._model, RenewsBonds):
            renew(self._of_bond, own, self.update(d, r, limits, own, cells), intact)

    def update(
        self, d: Any, r: Any, limits: Any, own: Sequence[Any], cells: Cells = ()
    ) -> Contributions:
        """Return the new values of the state variables of bonds that change."""
        assert isinstance(self._model, RenewsBonds)
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_values(self._model.update(d, r, c, self._q, *cells), "update")

    def load(self, cell: CellStress, r: Vector, limits: Any, own: Sequence[Any]) -> Any:
        """Return the ratio of the stress at a bond in a cell to that at which it softens."""
        assert isinstance(self._model, SoftensCells)
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return self._model.load(cell, r, c, self._q)

    def breaks(self, d: Vector, r: Vector, limits: Any, own: Sequence[Any]) -> Any:
        """Return whether bonds with the given state variables break."""
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_verdict(self._model.breaks(d, r, c, self._q))

    def breaking_strain(self, r: Vector, limits: Any, own: Sequence[Any]) -> Any:
        """Return the strains above which bonds with the given state variables break."""
        assert isinstance(self._model, BreaksAtStrain)
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return self._model.breaking_strain(r, c, self._q)

    def everywhere(self, slots: Iterable[Slot]) -> list[Neighbour]:
        """Return the neighbours in the interior of a body: all are present, no bond is broken, and
        state variables have their initial values."""
        weights = self._scene.constants.weights
        shared = (self.initial_own(),) * 2 if shares_particles(self.rule) else ()
        return [
            Neighbour(slot.rest, weights[slot], shared=shared, sublattice=slot.source)
            for slot in slots
        ]

    def at_rest(self, slots: Sequence[Slot]) -> Any:
        """Return the move, at rest, of a particle that has a neighbour along each of the slots and
        no broken bond."""
        u = vector(np.zeros(self._scene.axes))
        total = self.total([u] * len(slots), u, self.everywhere(slots))
        return self.move(total, Here(u, own=self.initial_own()))

    def initial_own(self) -> Any:
        """Return the initial state variables of a particle. They must not be drawn at random."""
        initial = (number.initial for number in self._of_particle)
        return self._scene.constants.of_particle(*initial)


def summed(parts: Iterable[tuple[Contributions, Mask | None]]) -> Contributions:
    """Return the sum of contributions of the neighbours that are present, in their order.

    The sum is a plain number if every contribution is a plain number and no neighbour is missing.
    """
    total: Contributions | None = None
    for part, present in parts:
        if present is not None:
            part = tuple([_masked(value, present) for value in part])
        if total is None:
            total = part
            continue
        refuse_other_count(part, total)
        total = tuple([a + b for a, b in zip(total, part, strict=True)])
    return total or ()


def refuse_other_count(part: Contributions, other: Contributions) -> None:
    """Raise AnswerError if two neighbours, or two pairs, have different numbers of
    contributions."""
    if len(part) != len(other):
        raise AnswerError(
            f"`gather` or `gather_pair` returned {len(other)} values for a neighbour and "
            f"{len(part)} for another; return equally many, for instance 0.0"
        )


def _both(one: Mask | None, other: Mask | None) -> Mask | None:
    """Return a mask that is true where two masks are; None is true everywhere."""
    if one is None or other is None:
        return other if one is None else one
    return one & other


def _masked(value: Any, present: Mask) -> Any:
    if isinstance(value, Vector):
        return vector([np.where(present, component, 0.0) for component in value])
    return np.where(present, value, 0.0)


BLOCK_CELLS = 16384
"""Number of places of a block, such that its temporary arrays fit in the cache."""
Contributing = Callable[[Vector, Vector, Neighbour], Contributions]
"""Type of functions that return the contribution of a neighbour from d and u."""


class Surroundings:
    """Particles of one sublattice with their neighbours.

    `slots` are the slots of the sublattice. `movable` is true where a particle of the body has a
    neighbour; None means everywhere.
    """

    def __init__(self, scene: Scene, where: Where, sublattice: int) -> None:
        self._scene, self.where, self._sublattice = scene, where, sublattice
        self._evaluator = Evaluator(scene)
        self._softens = isinstance(scene.experiment.fracture, (Softens, SoftensCells))
        self.slots = scene.neighbourhood.slots[sublattice]
        self._present = presence(scene.raster, where, self.slots)
        self._weights = [scene.constants.weights[slot] for slot in self.slots]
        self._more: list[tuple[Any, ...]] = [()] * len(self.slots)
        if scene.cells:
            self._weigh_cells(scene.cells)
        self._there = [where.seen_through(slot) for slot in self.slots]
        neighbours = sum(1 if present is None else present.astype(int) for present in self._present)
        movable = (where.of(scene.raster.kind) == FOLLOWER) & (neighbours > 0)
        self.movable: Mask | None = None if movable.all() else movable

    @cached_property
    def _constant_neighbours(self) -> list[Neighbour]:
        """Neighbours in a scene without fracture in which the rule reads no state variables of
        neighbours."""
        parts = zip(self.slots, self._weights, self._present, self._more, strict=True)
        s = self._sublattice
        return [
            Neighbour(slot.rest, w, present, more=extra, sublattice=s)
            for slot, w, present, extra in parts
        ]

    @cached_property
    def _reference(self) -> tuple[Any, Any]:
        """X and the distance of X from the middle of the body, if the rule uses them."""
        if not self._scene.experiment.rule.uses_reference:
            return None, None
        local = self._scene.raster.reference_planes(self.where)
        origin = self._scene.raster.lattice.origin
        return local.each(np.add, origin), local.each(np.subtract, self._scene.middle)

    def differences(self, u: NDArray[Any]) -> list[Vector]:
        """Return u_k - u_j along each slot."""
        center = self.where.of(u)
        return [vector(target.of(u) - center) for target in self._there]

    def neighbours(self, state: State) -> list[Neighbour]:
        """Return the neighbours along each slot in a state."""
        if state.broken_step is None and not shares_particles(self._scene.experiment.rule):
            return self._constant_neighbours
        parts = zip(self.slots, self._weights, self._present, self._more, strict=True)
        if self._scene.tears:
            torn = self._torn(state)
            return [
                Neighbour(slot.rest, w, present, more=extra, torn=torn[slot] if torn else None)
                for slot, w, present, extra in parts
            ]
        return [
            Neighbour(
                slot.rest,
                w,
                present,
                *self._bond(slot, *bonds, state),
                extra,
                self._shared(slot, state),
                sublattice=self._sublattice,
            )
            for (slot, w, present, extra), bonds in zip(parts, self._bonds, strict=True)
        ]

    @property
    def parameters(self) -> Any:
        """The parameters p of the rule."""
        return self._scene.constants.rule_at(self.where)

    def here(self, u: NDArray[Any], state: State) -> Here:
        """Return the values at the particles, which the rule receives as `here`."""
        numbers = self._remembered(self.where, state)
        return Here(vector(shown(self.where.of(u))), *self._reference, numbers)

    def own(self, state: State) -> list[NDArray[Any]]:
        """Return the state variables of the particles. If the particles are a block, these are
        views into the state."""
        return [self.where.of(value) for value in state.particle_values]

    def sums(self, function: Contributing, u: NDArray[Any], state: State) -> Contributions:
        """Return the sum of function(d, u, neighbour) over the neighbours. The function has the
        signature of `Evaluator.energy`."""
        u_own = vector(shown(self.where.of(u)))
        parts = zip(self.differences(u), self.neighbours(state), strict=True)
        return summed((function(d, u_own, to), to.present) for d, to in parts)

    def total(self, evaluator: Evaluator, u: NDArray[Any], state: State) -> Contributions:
        """Return the sums of the contributions that `apply` receives."""
        u_own = vector(shown(self.where.of(u)))
        return evaluator.total(self.differences(u), u_own, self.neighbours(state))

    def _weigh_cells(self, cells: WeighedCells) -> None:
        """Multiply the weights of each slot by the area fractions of the cells beside it. Add the
        weights of cells that have a stiffness other than that of the rule."""
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
        """Return the state variables of particles by name."""
        values = (where.of(value) for value in state.particle_values)
        return self._scene.constants.of_particle(*shown(values))

    def _shared(self, slot: Slot, state: State) -> tuple[Any, ...]:
        """Return the state variables of particles and their neighbours, for rules that use both."""
        if not shares_particles(self._scene.experiment.rule):
            return ()
        ends = self.where, self.where.seen_through(slot)
        return tuple(self._remembered(end, state) for end in ends)

    def _torn(self, state: State) -> dict[Slot, Torn] | None:
        """Return the damage beside each slot; None if nothing is damaged."""
        assert state.broken_step is not None
        if not self._softens and state.broken_step.max(initial=-1) < 0:
            return None
        around = self._scene.neighbourhood.cells_around[self._sublattice]
        damage = {
            key: self._damage(bond, owner, state)
            for key, (bond, owner) in self._bonds_of_cells.items()
        }
        if not any(np.any(values) for both in damage.values() for values in both):
            return None
        largest = [
            reduce(np.maximum, (damage[bond.plane, bond.owner][bond.side] for bond in cell))
            for cell in around.cells
        ]
        torn = {}
        for slot in self.slots:
            plane, at_this_end = self._scene.neighbourhood.owner[slot]
            bond_damage = damage[plane, None if at_this_end else slot]
            left_damage, right_damage = (largest[n] for n in around.beside[slot])
            torn[slot] = Torn(
                left_damage, right_damage, *(bond_damage if at_this_end else bond_damage[::-1])
            )
        return torn

    @cached_property
    def _bonds_of_cells(self) -> dict[tuple[int, Slot | None], tuple[CellBond, Where]]:
        """Bonds of the cells around the particles, with their places, by plane and owner."""
        cells = self._scene.neighbourhood.cells_around[self._sublattice].cells
        return {
            (bond.plane, bond.owner): (
                bond,
                self.where.seen_through(bond.owner) if bond.owner else self.where,
            )
            for cell in cells
            for bond in cell
        }

    def _damage(
        self, bond: CellBond, owner: Where, state: State
    ) -> tuple[NDArray[np.floating[Any]], ...]:
        """Return the lost fractions of the forces of bonds, one array for the cells to the left of
        the bonds and one for the cells to their right. The fractions are 1 for broken bonds."""
        assert state.broken_step is not None
        broken = owner.within(state.broken_step[bond.plane]) >= 0
        precision = self._scene.experiment.stepping.precision
        if not self._softens:
            lost = broken.astype(precision)
            return lost, lost
        constants = self._scene.constants
        numbers = shown([owner.within(value[bond.plane]) for value in state.bond_values])
        limits = constants.limits_at(bond.slot, bond.plane, owner)
        softened = self._evaluator.damage(bond.slot.rest, constants.of_bond(*limits, *numbers))
        return tuple(np.where(broken, 1.0, side).astype(precision) for side in softened)

    @cached_property
    def _bonds(self) -> list[tuple[int, Where]]:
        """For each slot the plane of its bonds, and the places of the bonds in this plane."""
        owners = map(self._scene.neighbourhood.owner.__getitem__, self.slots)
        ends = zip(owners, self._there, strict=True)
        return [
            (plane, self.where if at_this_end else there) for (plane, at_this_end), there in ends
        ]

    def _bond(self, slot: Slot, plane: int, owner: Where, state: State) -> tuple[Mask | None, Any]:
        """Return a mask of the broken bonds along a slot, and the constants of the bonds if the
        fracture model receives them."""
        if state.broken_step is None:
            return None, None
        broken = owner.within(state.broken_step[plane]) >= 0
        c = None
        if self._softens:
            constants = self._scene.constants
            numbers = shown([owner.within(value[plane]) for value in state.bond_values])
            c = constants.of_bond(*constants.limits_at(slot, plane, owner), *numbers)
        return (broken if broken.any() else None), c


def blocks(scene: Scene) -> list[Surroundings]:
    """Return the surroundings of the body's particles, block by block."""
    return [
        Surroundings(scene, part, s)
        for s in range(scene.raster.shape[0])
        if (block := scene.raster.body_block(s))
        for part in block.rows(BLOCK_CELLS)
    ]


def presence(raster: Raster, place: Where, slots: Sequence[Slot]) -> list[Mask | None]:
    """Return for each slot a mask of the places at which the neighbour exists. It is None if the
    neighbour exists at every place with a particle."""
    nobody = place.of(raster.kind) == EMPTY
    planes = (place.seen_through(slot).of(raster.kind) != EMPTY for slot in slots)
    return [None if (present | nobody).all() else present for present in planes]
