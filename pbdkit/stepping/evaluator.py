"""What a particle does in a step, given its neighbours: told once, for every room that asks.

Stepping, analysis, identity, diagnostics of a material and the conformance suite evaluate rule and
fracture model here and nowhere else; kernels are generated from the same functions and tested
against this.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Calibrated,
    CellStress,
    Components,
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
    where,
)
from pbdkit.interfaces.component import as_values, as_vector, as_verdict
from pbdkit.interfaces.rule import shares_particles
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import renew, shown

Mask = NDArray[np.bool_]
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

    r: Components
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

    def contribution(self, d: Components, u: Components, to: Neighbour) -> Contributions:
        """What a neighbour contributes, or what stands in for it."""
        seen = d if self.tears else self.seen(d, u, to)
        parts = (self._of_weights(seen, to, w) for w in (to.w, *to.more))
        return summed((as_values(part, "gather"), None) for part in parts)

    def _of_weights(self, d: Components, to: Neighbour, w: Any) -> Any:
        """What the rule makes of a difference with some weights."""
        rule: Any = self.rule  # some are given more than others
        if to.torn is not None:
            return rule.torn(d, to.r, w, to.torn, self._p)
        return rule.gather(d, to.r, w, self._p, *to.shared)

    def energy(self, d: Components, u: Components, to: Neighbour) -> Contributions:
        """The half of the bond's energy that falls to this end."""
        assert isinstance(self.rule, StoresEnergy)
        if self.tears:
            w, t = to.w, to.torn
            if t is not None:
                left, right = w.left * (1.0 - t.bond_left), w.right * (1.0 - t.bond_right)
                w = w._replace(left=left, right=right)
            return (self.rule.energy(d, to.r, w, self._p),)
        return (self.rule.energy(self.seen(d, u, to), to.r, to.w, self._p),)

    def seen(self, d: Components, u: Components, to: Neighbour) -> Components:
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

    def damage(self, r: Components, c: Any) -> tuple[Any, Any]:
        """The share of its pull that a bond with the constants c, which has not broken, has lost in
        the cells to its left and right."""
        model: Any = self._model
        if isinstance(model, SoftensCells):
            return c.damage_left, c.damage_right
        ahead, nothing = (vector([x, *[0.0] * (len(r) - 1)]) for x in (1.0, 0.0))
        with blaming(model, "to soften a bond"):
            seen = as_vector(model.seen(ahead, nothing, r, c, self._q), "seen", ahead)
        return (1.0 - seen[0],) * 2

    def move(self, total: Contributions, here: Here, load: Components | None = None) -> Any:
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
        d: Components,
        r: Components,
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

    def breaks(self, d: Components, r: Components, limits: Any, own: Sequence[Any]) -> Any:
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
            part = tuple(where(there, value, _nothing(value)) for value in part)
        total = part if total is None else tuple(a + b for a, b in zip(total, part, strict=True))
    return total or ()


def _nothing(like: Any) -> Any:
    return like.each(lambda _: 0.0) if isinstance(like, Components) else 0.0
