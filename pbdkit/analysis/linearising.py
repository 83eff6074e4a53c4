"""A rule's answer to small displacements, from the rule's own functions and nothing else.

Linear rules come out exactly, whatever the configuration; others linearised at a state. At rest,
particles with the same neighbours present answer alike, and one of each kind is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.changed_bonds import ChangedBonds
from pbdkit.analysis.derivatives import derivatives
from pbdkit.interfaces import Here, Slot, Vector
from pbdkit.interfaces.answers import as_move
from pbdkit.interfaces.frame import Indices
from pbdkit.registry.blame import blaming
from pbdkit.scene.constants import WHOLE_CELLS
from pbdkit.scene.raster import EMPTY, positions
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State
from pbdkit.stepping.sums import sum_over_slots

Floats = NDArray[np.float64]
Present = NDArray[np.bool_]
Contributions = tuple[Any, ...]
VALUES_AT_ONCE = 6000
"""Derivatives are taken in several directions at once for up to so many values together: fewer
calls, as long as what stands still costs nothing beside them."""


@dataclass(frozen=True)
class Response:
    """The move of some followers, linearised.

    ∂move/∂u_k for each slot and ∂move/∂u_j, (kind, axis of the move, axis of u), and the move
    itself, (kind, axis); `kind` says for each follower which of the kinds it is, and `steps` how
    far along the flat raster a slot reaches.
    """

    neighbours: dict[Slot, Floats]
    own: Floats
    move: Floats
    kind: Indices
    steps: dict[Slot, int]

    def of_each(self, values: Floats) -> Floats:
        """The values of the kinds, for each follower; a view where there is one kind only."""
        if len(values) == 1:
            return np.broadcast_to(values[0], (len(self.kind), *values.shape[1:]))
        return values[self.kind]


def respond(scene: Scene, state: State, sublattice: int, place: Indices) -> Response:
    """The response at a state of the followers at some flat places, all of one sublattice.

    Raises PluginError where the rule's functions fail, or are not finite at rest.
    """
    with blaming(scene.experiment.rule, "when linearised"):
        response = _respond(scene, state, sublattice, place)
        values = [response.move, response.own, *response.neighbours.values()]
        if response.move.shape[-1] != 2:
            raise ValueError(f"its move has {response.move.shape[-1]} components, not 2")
        if not state.u.any() and not all(np.isfinite(v).all() for v in values):
            raise ValueError("its move at rest, or a derivative of it, is not finite")
    return response


def _respond(scene: Scene, state: State, sublattice: int, place: Indices) -> Response:
    slots = scene.neighbourhood.slots[sublattice]
    steps = {slot: slot_step(scene, slot) for slot in slots}
    kinds = np.arange(len(place))
    same = not scene.experiment.rule.uses_reference and not _differ(scene, state)
    if same and not state.u.any():
        kinds, place = _alike(scene, state, steps, place)
    some = _Followers(scene, state, steps, place)
    answers = some.derivatives()
    neighbours = {slot: answers[slot] for slot in slots}
    return Response(neighbours, answers[None], some.move(), kinds, steps)


def slot_step(scene: Scene, slot: Slot) -> int:
    """From a flat place of the raster to that of the neighbour at a slot."""
    _, m, n = scene.raster.shape
    return ((slot.target - slot.source) * m + slot.cell[0]) * n + slot.cell[1]


def has_neighbours(scene: Scene, sublattice: int, place: Indices) -> Present:
    """Which particles have any; others stay, whatever the rule makes of nothing."""
    found = np.zeros(len(place), bool)
    for slot in scene.neighbourhood.slots[sublattice]:
        found |= scene.raster.kind.ravel()[place + slot_step(scene, slot)] != EMPTY
    return found


def _differ(scene: Scene, state: State) -> bool:
    """Whether what is remembered of bonds or particles, and reaches the rule, is not the same
    everywhere."""
    of_bonds = state.bond_values if scene.experiment.fracture.softens() else ()
    return any((values != values.flat[0]).any() for values in (*of_bonds, *state.particle_values))


def _alike(
    scene: Scene, state: State, steps: dict[Slot, int], place: Indices
) -> tuple[Indices, Indices]:
    """(kind, place): which kind each place is of, and one place of each; those of a kind have the
    same neighbours, the same shares of cells around them and the same broken bonds."""
    code, bonds = np.zeros(len(place), np.int64), ChangedBonds(scene, state)
    if scene.cells:
        left = np.array([_shares_beside(scene, slot, place)[0] for slot in steps])
        cut = (left != 1.0).any(axis=0)
        code[cut] = 1 + np.unique(left[:, cut], axis=1, return_inverse=True)[1].ravel()
    for slot, step in steps.items():
        code = 2 * code + (scene.raster.kind.ravel()[place + step] == EMPTY)
        if bonds.any_broken:
            code = 2 * code + bonds.broken(slot, step, place)
    if len(code) and (code == code[0]).all():
        return np.zeros(len(place), np.intp), place[:1]
    # More than fits a number, leaving 20 bits for the cut cells around a particle.
    if len(steps) * (1 + bonds.any_broken) > 42:
        return np.arange(len(place)), place
    _, first, kind = np.unique(code, return_index=True, return_inverse=True)
    return kind, place[first]


def _shares_beside(scene: Scene, slot: Slot, place: Indices) -> tuple[Floats, Floats]:
    """The shares of the cells to the left and the right of a slot at some flat places."""
    assert scene.cells
    found = []
    for side in scene.cells.tiling.beside[slot]:
        there = place + (slot_step(scene, side.first) if side.first else 0)
        found.append(scene.cells.share[side.kind].ravel()[there])
    return found[0], found[1]


class _Followers:
    """The rule's chain of functions on some places, with differences that can be nudged."""

    def __init__(self, scene: Scene, state: State, steps: dict[Slot, int], place: Indices) -> None:
        self._rule, self._constants = scene.experiment.rule, scene.constants
        self._bonds = ChangedBonds(scene, state)
        self._slots = tuple(steps)
        kind, u = scene.raster.kind.ravel(), state.u.reshape(2, -1)
        there = [kind[place + step] != EMPTY for step in steps.values()]
        self._present = [None if some.all() else some for some in there]
        self._weights: dict[Slot, tuple[Any, ...]] = dict(scene.constants.weights)
        if scene.cells:
            for slot in self._slots:
                sides = _shares_beside(scene, slot, place)
                self._weights[slot] = (*self._weights[slot][: -len(WHOLE_CELLS)], *sides)
        self._u = Vector(*u[:, place].astype(float))
        self._d = {slot: Vector(*(u[:, place + n] - u[:, place])) for slot, n in steps.items()}
        self._changed = {
            slot: (self._bonds.broken(slot, step, place), self._bonds.constants(slot, step, place))
            for slot, step in steps.items()
            if self._bonds.any_changed
        }
        self._own = tuple(value.ravel()[place] for value in state.particle_values)
        self._X = Vector(None, None)
        if self._rule.uses_reference:
            s, m, n = np.unravel_index(place, scene.raster.shape)
            first = scene.raster.first
            self._X = positions(scene.experiment.lattice.cell(), s, m + first[0], n + first[1])
        with np.errstate(all="ignore"):
            self._still = {slot: self._contribution(slot, self._u, None) for slot in self._slots}
            self._total = self._sum(self._still)

    def move(self) -> Floats:
        """(place, axis)."""
        moved = self._applied(self._total, self._u)
        return np.stack([np.broadcast_to(m, self._u.x.shape) for m in moved], axis=-1)

    def derivatives(self) -> dict[Slot | None, Floats]:
        """∂move/∂u_k through every slot and, under None, ∂move/∂u_j with all neighbours where they
        are; (place, axis of the move, axis of u). Few places are asked for many at once."""
        movers = (*self._slots, None)
        at_once = max(1, VALUES_AT_ONCE // (2 * self._u.x.size))
        found = {}
        for first in range(0, len(movers), at_once):
            some = movers[first : first + at_once]
            moved = partial(self._moved, _Nudges(some, self._slots))
            answers = derivatives(moved, 2 * len(some), self._u.x.shape)
            for n, mover in enumerate(some):
                found[mover] = np.moveaxis(answers[2 * n : 2 * n + 2], (0, 1), (2, 1))
        return found

    def _moved(self, nudges: _Nudges, step: complex) -> Any:
        """The moves (direction, place) after steps of neighbours, or of one's own."""
        here, contributions = self._u, dict(self._still)
        if nudges.own:
            here = Vector(self._u.x + step * nudges.own.x, self._u.y + step * nudges.own.y)
        for slot, nudge in nudges.along.items():
            steps = Vector(step * nudge.x, step * nudge.y)
            contributions[slot] = self._contribution(slot, here, steps)
        return self._applied(self._sum(contributions), here)

    def _contribution(self, slot: Slot, here: Vector, nudge: Vector | None) -> Contributions:
        d = self._d[slot]
        if nudge:
            d = Vector(d.x + nudge.x, d.y + nudge.y)
        if slot in self._changed:
            d = self._bonds.seen(d, here, slot, *self._changed[slot])
        return self._rule.gather(d, slot.rest, self._weights[slot], self._constants.rule)

    def _sum(self, contributions: dict[Slot, Contributions]) -> Contributions:
        return sum_over_slots(self._slots, self._present, contributions.__getitem__)

    def _applied(self, total: Contributions, here: Vector) -> Any:
        with np.errstate(all="ignore"):
            standing = Here(here, self._X, self._own)
            return as_move(self._rule.apply(total, standing, self._constants.rule))


class _Nudges:
    """What unit steps of some neighbours, by slot, or of oneself (None) along x and y do: to
    oneself, `own`, and to the differences `along` slots, (direction, 1) each. What stays as it is
    has none."""

    def __init__(self, movers: Sequence[Slot | None], slots: Sequence[Slot]) -> None:
        count = 2 * len(movers)

        def unit(n: int, length: float) -> Vector:
            planes = np.zeros((2, count, 1))
            planes[0, 2 * n] = planes[1, 2 * n + 1] = length
            return Vector(*planes)

        self.own = unit(movers.index(None), 1.0) if None in movers else None
        self.along = {slot: unit(n, 1.0) for n, slot in enumerate(movers) if slot is not None}
        if self.own:
            for slot in slots:
                back = unit(movers.index(None), -1.0)
                forth = self.along.get(slot, Vector(0.0, 0.0))
                self.along[slot] = Vector(back.x + forth.x, back.y + forth.y)
