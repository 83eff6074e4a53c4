"""A rule's answer to small displacements, from the rule's own functions and nothing else.

Linear rules come out exactly, whatever the configuration; others linearised at a state. At rest,
particles with the same neighbours present answer alike, and one of each kind is asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.derivatives import derivative
from pbdkit.interfaces import Here, Slot, Vector, where
from pbdkit.interfaces.answers import as_move, as_vector
from pbdkit.interfaces.frame import Indices
from pbdkit.registry.blame import blaming
from pbdkit.scene.constants import WHOLE_CELLS
from pbdkit.scene.raster import EMPTY, positions
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.state import State
from pbdkit.stepping.sums import sum_over_slots

Floats = NDArray[np.float64]
Present = NDArray[np.bool_]
Contributions = tuple[Any, ...]


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
    neighbours = {slot: some.derivative(slot) for slot in slots}
    return Response(neighbours, some.derivative(None), some.move(), kinds, steps)


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
    code, bonds = np.zeros(len(place), np.int64), _Bonds(scene, state)
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


class _Bonds:
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


class _Followers:
    """The rule's chain of functions on some places, with differences that can be nudged."""

    def __init__(self, scene: Scene, state: State, steps: dict[Slot, int], place: Indices) -> None:
        self._rule, self._constants = scene.experiment.rule, scene.constants
        self._bonds = _Bonds(scene, state)
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

    def derivative(self, of: Slot | None) -> Floats:
        """∂move/∂u_k through a slot, or ∂move/∂u_j with all neighbours where they are."""
        columns = []
        for along in (Vector(1.0, 0.0), Vector(0.0, 1.0)):

            def moved(step: complex, along: Vector = along) -> Any:
                nudge = Vector(step * along.x, step * along.y)
                return self._moved_with_neighbour(of, nudge) if of else self._moved_by(nudge)

            columns.append(derivative(moved, self._u.x.shape))
        return np.moveaxis(np.array(columns), (0, 1), (2, 1))

    def _moved_with_neighbour(self, slot: Slot, nudge: Vector) -> Any:
        contributions = self._still | {slot: self._contribution(slot, self._u, nudge)}
        return self._applied(self._sum(contributions), self._u)

    def _moved_by(self, nudge: Vector) -> Any:
        here, back = Vector(self._u.x + nudge.x, self._u.y + nudge.y), Vector(-nudge.x, -nudge.y)
        contributions = {slot: self._contribution(slot, here, back) for slot in self._slots}
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
