"""What a particle does in a step, given its neighbours: told once, for every room that asks.

Stepping, analysis, identity, diagnostics of a material and the conformance suite evaluate rule and
fracture model here and nowhere else; kernels are generated from the same functions and tested
against this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Calibrated,
    Components,
    FollowerRule,
    Here,
    RenewsBonds,
    RenewsParticles,
    Slot,
    Softens,
    StoresEnergy,
    where,
)
from pbdkit.interfaces.answers import as_values, as_vector, as_verdict
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.raster import EMPTY, FOLLOWER, Raster, Where
from pbdkit.scene.remembering import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.remembering import changing, renew, shown
from pbdkit.stepping.state import State

BLOCK_CELLS = 16384
"""Places a block: small enough for its temporaries to stay in the cache."""
Mask = NDArray[np.bool_]
Contributions = tuple[Any, ...]


@dataclass(frozen=True)
class Neighbour:
    """One neighbour of some particles, or of one: its rest offset r and the rule's weights w; where
    it is `present` and where the bond is `broken` (None: everywhere, nowhere); with fracture the
    constants c of the bond, what is remembered of it included."""

    r: Components
    w: Any
    present: Mask | None = None
    broken: Mask | None = None
    c: Any = None


@dataclass(frozen=True)
class Around:
    """What stays as it is around some particles: their slots with weights and presence, X and its
    distance from the middle of the body where the rule asks for them, and where particles of the
    body have a neighbour (None: everywhere)."""

    where: Where
    slots: tuple[Slot, ...]
    weights: tuple[Any, ...]
    present: tuple[Mask | None, ...]
    X: Any
    centred: Any
    movable: Mask | None


class Evaluator:
    """The rule and the fracture model of a scene, with the numbers that they are called with."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.rule: FollowerRule = scene.experiment.rule
        self._model = scene.experiment.fracture if scene.has_fracture else None
        self._softens = self._model if isinstance(self._model, Softens) else None
        self._p, self._q = scene.constants.rule, scene.constants.fracture

    # What one particle does.

    def contribution(self, d: Components, u: Components, to: Neighbour) -> Contributions:
        """What a neighbour contributes, or what stands in for it."""
        seen = self.seen(d, u, to)
        return as_values(self.rule.gather(seen, to.r, to.w, self._p), "gather")

    def energy(self, d: Components, u: Components, to: Neighbour) -> Contributions:
        """The half of the bond's energy that falls to this end."""
        assert isinstance(self.rule, StoresEnergy)
        return (self.rule.energy(self.seen(d, u, to), to.r, to.w, self._p),)

    def seen(self, d: Components, u: Components, to: Neighbour) -> Components:
        """The difference that the rule sees: softened, or that of the fictitious point where the
        bond broke."""
        model = self._model
        if model is None or (to.broken is None and to.c is None):
            return d
        with blaming(model, "to place a fictitious point"):
            lost = as_vector(model.fictitious(u, to.r, self._q), "fictitious", u)
        if self._softens and to.c is not None:
            with blaming(model, "to soften a bond"):
                d = as_vector(self._softens.seen(d, lost, to.r, to.c, self._q), "seen", u)
        chosen: Components = d if to.broken is None else where(to.broken, lost, d)
        return chosen

    def move(self, total: Contributions, here: Here) -> Any:
        """From where the particle stands to its target."""
        return as_vector(self.rule.apply(total, here, self._p), "apply", here.u)

    def force(self, total: Contributions, here: Here) -> Any:
        """The force of the neighbours over Young's modulus and thickness."""
        assert isinstance(self.rule, Calibrated)
        return as_vector(self.rule.force(total, here, self._p), "force", here.u)

    def remember(self, total: Contributions, here: Here) -> Contributions:
        """The new values of the particle's numbers that change; none where the rule has none."""
        if not isinstance(self.rule, RenewsParticles):
            return ()
        return as_values(self.rule.remember(total, here, self._p), "remember")

    def renew_bonds(
        self, d: Components, r: Components, limits: Any, own: Sequence[Any], intact: Mask
    ) -> None:
        """Writes the new values over what is remembered of bonds, in place, where they hold."""
        if isinstance(self._model, RenewsBonds):
            numbers = bond_numbers(self._scene.experiment)
            renew(changing(numbers, own), self.update(d, r, limits, own), intact)

    def update(self, d: Any, r: Any, limits: Any, own: Sequence[Any]) -> Contributions:
        """The new values of the bonds' numbers that change."""
        assert isinstance(self._model, RenewsBonds)
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_values(self._model.update(d, r, c, self._q), "update")

    def breaks(self, d: Components, r: Components, limits: Any, own: Sequence[Any]) -> Any:
        """Whether bonds break that remember these numbers."""
        assert self._model
        c = self._scene.constants.of_bond(*limits, *shown(own))
        return as_verdict(self._model.breaks(d, r, c, self._q))

    # Particles of a scene.

    def around(self, place: Where, sublattice: int) -> Around:
        """The surroundings of particles of one sublattice."""
        raster, slots = self._scene.raster, self._scene.neighbourhood.slots[sublattice]
        present = presence(raster, place, slots)
        neighbours = sum(1 if there is None else there.astype(int) for there in present)
        movable = (place.of(raster.kind) == FOLLOWER) & (neighbours > 0)
        X = centred = None
        if self.rule.uses_reference:
            local, scene = raster.reference_planes(place), self._scene
            X = local.each(np.add, raster.lattice.origin)
            centred = local.each(np.subtract, scene.middle)
        weights = tuple(self._weights(slot, place) for slot in slots)
        everywhere = None if movable.all() else movable
        return Around(place, slots, weights, tuple(present), X, centred, everywhere)

    def blocks(self) -> list[Around]:
        """The surroundings of the body, block by block."""
        raster = self._scene.raster
        whole = ((s, raster.body_block(s)) for s in range(raster.shape[0]))
        return [
            self.around(part, s) for s, block in whole if block for part in block.rows(BLOCK_CELLS)
        ]

    def differences(self, around: Around, u: NDArray[Any]) -> list[Components]:
        """u_k - u_j along each slot."""
        here = around.where.of(u)
        seen = (around.where.seen_through(slot) for slot in around.slots)
        return [vector(there.of(plane) - own for plane, own in zip(u, here, strict=True))
                for there in seen]  # fmt: skip

    def neighbours(self, around: Around, state: State) -> list[Neighbour]:
        """The neighbours through each slot, as they are in a state."""
        parts = zip(around.slots, around.weights, around.present, strict=True)
        return [
            Neighbour(slot.rest, w, present, *self._bond(around.where, slot, state))
            for slot, w, present in parts
        ]

    def everywhere(self, slots: Iterable[Slot]) -> list[Neighbour]:
        """The neighbours in the middle of a body: all are there, and no bond has broken."""
        weights = self._scene.constants.weights
        return [Neighbour(slot.rest, weights[slot]) for slot in slots]

    def here(self, around: Around, u: NDArray[Any], state: State) -> Here:
        """What stands at the particles."""
        return Here(
            read_only(vector(around.where.of(u))),
            around.X,
            around.centred,
            self._scene.constants.of_particle(*shown(self.own(around, state))),
        )

    def own(self, around: Around, state: State) -> list[NDArray[Any]]:
        """What is remembered of the particles; of a block, views into the state."""
        return [around.where.of(value) for value in state.particle_values]

    def sums(
        self,
        around: Around,
        u: NDArray[Any],
        state: State,
        function: Callable[[Components, Components, Neighbour], Contributions] | None = None,
    ) -> Contributions:
        """Σ of the contributions, or of another function of d, u and the neighbour."""
        function = function or self.contribution
        own = read_only(vector(around.where.of(u)))
        parts = zip(self.differences(around, u), self.neighbours(around, state), strict=True)
        return summed((function(d, own, to), to.present) for d, to in parts)

    def at_rest(self, slots: Sequence[Slot]) -> Any:
        """The move of a particle at rest with all these neighbours."""
        u = vector(np.zeros(self._scene.axes))
        parts = [self.contribution(u, u, to) for to in self.everywhere(slots)]
        return self.move(summed((part, None) for part in parts), Here(u, own=self.initial_own()))

    def initial_own(self) -> Any:
        """What a particle remembers at the start, unless it is drawn."""
        numbers = particle_numbers(self._scene.experiment)
        return self._scene.constants.of_particle(*(number.initial for number in numbers))

    def _weights(self, slot: Slot, place: Where) -> Any:
        """w of a slot; the shares of cells are arrays where they differ."""
        weights, cells = self._scene.constants.weights[slot], self._scene.cells
        if cells is None:
            return weights
        left, right = cells.beside(slot, place, self._scene.experiment.solver.precision)
        return weights._replace(left=left, right=right)

    def _bond(self, place: Where, slot: Slot, state: State) -> tuple[Mask | None, Any]:
        """Where the bond along a slot is broken, and its constants."""
        if state.broken_step is None:
            return None, None
        plane, at_this_end = self._scene.neighbourhood.home[slot]
        home = place if at_this_end else place.seen_through(slot)
        broken = home.within(state.broken_step[plane]) >= 0
        c = None
        if self._softens:
            own = shown([home.within(value[plane]) for value in state.bond_values])
            c = self._scene.constants.of_bond(*self._scene.constants.limits[slot], *own)
        return (broken if broken.any() else None), c


def read_only(v: Any) -> Any:
    """The same, as components hand it to a rule: nobody writes to the state but the stepper."""
    for plane in v:
        plane.flags.writeable = False
    return v


def presence(raster: Raster, place: Where, slots: Sequence[Slot]) -> list[Mask | None]:
    """For each slot, where the neighbour exists, None where it does everywhere; only places with a
    particle count."""
    nobody = place.of(raster.kind) == EMPTY
    found: list[Mask | None] = []
    for slot in slots:
        present = place.seen_through(slot).of(raster.kind) != EMPTY
        found.append(None if (present | nobody).all() else present)
    return found


def summed(parts: Iterable[tuple[Contributions, Mask | None]]) -> Contributions:
    """Σ of contributions where the neighbours are present, in their order.

    What a neighbour contributes equally everywhere may be a plain number, and stays one.
    """
    total: Contributions | None = None
    for part, there in parts:
        if there is not None:
            part = tuple(where(there, value, _nothing(value)) for value in part)
        total = part if total is None else tuple(a + b for a, b in zip(total, part, strict=True))
    return total or ()


def _nothing(like: Any) -> Any:
    return like.each(lambda _: 0.0) if isinstance(like, Components) else 0.0
