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

from pbdkit.analysis.stencil import derivatives
from pbdkit.interfaces import Components, Slot, Softens
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.places import Places, slot_step
from pbdkit.scene.raster import EMPTY
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Contributions, Evaluator, summed
from pbdkit.stepping.state import State
from pbdkit.stepping.surroundings import Surroundings

Floats = NDArray[np.float64]
Present = NDArray[np.bool_]
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
        if not state.u.any() and not all(np.isfinite(v).all() for v in values):
            raise ValueError("its move at rest, or a derivative of it, is not finite")
    return response


def _respond(scene: Scene, state: State, sublattice: int, place: Indices) -> Response:
    slots = scene.neighbourhood.slots[sublattice]
    steps = {slot: slot_step(scene.raster.shape, slot) for slot in slots}
    kinds = np.arange(len(place))
    same = not scene.experiment.rule.uses_reference and not _differ(scene, state)
    if same and not state.u.any():
        kinds, place = _alike(scene, state, sublattice, place)
    some = _Followers(scene, state, sublattice, place)
    answers = some.derivatives()
    neighbours = {slot: answers[slot] for slot in slots}
    return Response(neighbours, answers[None], some.move(), kinds, steps)


def has_neighbours(scene: Scene, sublattice: int, place: Indices) -> Present:
    """Which particles have any; others stay, whatever the rule makes of nothing."""
    found = np.zeros(len(place), bool)
    for slot in scene.neighbourhood.slots[sublattice]:
        found |= scene.raster.kind.ravel()[place + slot_step(scene.raster.shape, slot)] != EMPTY
    return found


def _differ(scene: Scene, state: State) -> bool:
    """Whether what is remembered of bonds or particles, and reaches the rule, is not the same
    everywhere."""
    of_bonds = state.bond_values if isinstance(scene.experiment.fracture, Softens) else ()
    return any((values != values.flat[0]).any() for values in (*of_bonds, *state.particle_values))


def _alike(scene: Scene, state: State, sublattice: int, place: Indices) -> tuple[Indices, Indices]:
    """(kind, place): which kind each place is of, and one place of each; those of a kind have the
    same neighbours, the same shares of cells around them and the same broken bonds."""
    code = np.zeros(len(place), np.int64)
    around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
    neighbours = around.neighbours(state)
    if scene.cells:
        left = np.array([np.broadcast_to(to.w.left, place.shape) for to in neighbours])
        cut = (left != 1.0).any(axis=0)
        code[cut] = 1 + np.unique(left[:, cut], axis=1, return_inverse=True)[1].ravel()
    differing = [mask for to in neighbours for mask in (to.present, to.broken) if mask is not None]
    for mask in differing:
        code = 2 * code + mask
    if len(code) and (code == code[0]).all():
        return np.zeros(len(place), np.intp), place[:1]
    # More than fits a number, leaving 20 bits for the cut cells around a particle.
    if len(differing) > 42:
        return np.arange(len(place)), place
    _, first, kind = np.unique(code, return_index=True, return_inverse=True)
    return kind, place[first]


class _Followers:
    """The rule on some places, with differences that can be nudged."""

    def __init__(self, scene: Scene, state: State, sublattice: int, place: Indices) -> None:
        self._evaluator = Evaluator(scene)
        around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
        u = state.u.astype(float, copy=False)
        self._slots, self._axes = around.slots, scene.axes
        self._here = around.here(u, state)
        d = around.differences(u)
        self._d = dict(zip(self._slots, d, strict=True))
        to = around.neighbours(state)
        self._neighbours = dict(zip(self._slots, to, strict=True))
        with np.errstate(all="ignore"):
            self._still = {slot: self._contribution(slot, self._here.u) for slot in self._slots}

    def move(self) -> Floats:
        """(place, axis)."""
        moved = self._applied(self._still, self._here.u)
        return np.stack([np.broadcast_to(m, self._here.u.x.shape) for m in moved], axis=-1)

    def derivatives(self) -> dict[Slot | None, Floats]:
        """∂move/∂u_k through every slot and, under None, ∂move/∂u_j with all neighbours where they
        are; (place, axis of the move, axis of u). Few places are asked for many at once."""
        movers, axes, shape = (*self._slots, None), self._axes, self._here.u.x.shape
        at_once = max(1, VALUES_AT_ONCE // (axes * self._here.u.x.size))
        found = {}
        for first in range(0, len(movers), at_once):
            some = movers[first : first + at_once]
            moved = partial(self._moved, _Nudges(some, self._slots, axes))
            answers = derivatives(moved, axes * len(some), shape)
            for n, mover in enumerate(some):
                found[mover] = np.moveaxis(answers[axes * n : axes * (n + 1)], (0, 1), (2, 1))
        return found

    def _moved(self, nudges: _Nudges, step: complex) -> Any:
        """The moves (direction, place) after steps of neighbours, or of one's own."""
        here, contributions = self._here.u, dict(self._still)
        if nudges.own:
            here = here + step * nudges.own
        for slot, nudge in nudges.along.items():
            contributions[slot] = self._contribution(slot, here, step * nudge)
        return self._applied(contributions, here)

    def _contribution(
        self, slot: Slot, here: Components, nudge: Components | None = None
    ) -> Contributions:
        d = self._d[slot] if nudge is None else self._d[slot] + nudge
        return self._evaluator.contribution(d, here, self._neighbours[slot])

    def _applied(self, contributions: dict[Slot, Contributions], here: Components) -> Any:
        parts = [(contributions[slot], to.present) for slot, to in self._neighbours.items()]
        with np.errstate(all="ignore"):
            return self._evaluator.move(summed(parts), self._here._replace(u=here))


class _Nudges:
    """What unit steps of some neighbours, by slot, or of oneself (None) along each axis do: to
    oneself, `own`, and to the differences `along` slots, (direction, 1) each. What stays as it is
    has none."""

    def __init__(self, movers: Sequence[Slot | None], slots: Sequence[Slot], axes: int) -> None:
        def unit(n: int, length: float) -> Any:
            planes = np.zeros((axes, axes * len(movers), 1))
            for axis in range(axes):
                planes[axis, axes * n + axis] = length
            return vector(planes)

        self.own = unit(movers.index(None), 1.0) if None in movers else None
        self.along = {slot: unit(n, 1.0) for n, slot in enumerate(movers) if slot is not None}
        if self.own:
            back = unit(movers.index(None), -1.0)
            for slot in slots:
                self.along[slot] = back + self.along[slot] if slot in self.along else back
