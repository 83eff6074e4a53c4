"""Linear response of a rule to small displacements, computed from the rule's own functions.

For linear rules the response is exact in any configuration; other rules are linearised at a state.
At rest, particles with the same neighbourhood have the same response. It is therefore sufficient to
evaluate one particle for each kind of neighbourhood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.lattice.raster import EMPTY, Places, slot_step
from pbdkit.linear.stencil import SMALL, array_of, derivative
from pbdkit.plugin import Here, Slot, Softens, SoftensCells, UsesAngles, Vector
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import (
    Contributions,
    Evaluator,
    Surroundings,
    refuse_other_count,
    summed,
)
from pbdkit.stepping.state import State

Present = NDArray[np.bool_]
Answer = Callable[[Contributions, Here], Any]
CHUNK_SIZE = 8192
"""Number of places that are evaluated together. It limits the size of temporary arrays."""
FEW = 200
"""Number of places up to which every place is evaluated, because grouping equal places would take
longer."""


@dataclass(frozen=True)
class LinearResponse:
    """Linearised response of followers, stored once for each kind of follower.

    Parameters
    ----------
    kind : (follower,)
        Kind of each follower.
    centre : (kind, axis of the response, axis of u)
        Derivative with respect to the follower's own displacement.
    neighbours : (kind, axis of the response, axis of u) by slot
        Derivative with respect to the displacement of the neighbour along each slot.
    answer : (kind, axis)
        The response itself.
    """

    kind: Indices
    centre: Floats
    neighbours: dict[Slot, Floats]
    answer: Floats

    def of_each(self, values: Floats) -> Floats:
        """Expand values of each kind to values of all followers. The result is a broadcast view if
        all followers are of one kind."""
        if len(values) == 1:
            return np.broadcast_to(values[0], (len(self.kind), *values.shape[1:]))
        return values[self.kind]


def respond(
    scene: Scene, state: State, sublattice: int, place: Indices, answers: Sequence[str] = ("move",)
) -> list[LinearResponse]:
    """Linearise moves, or forces, of followers at a state.

    Parameters
    ----------
    sublattice
        Sublattice of all the followers.
    place
        Flat places of the followers.
    answers
        Quantities to linearise: "move", or "force" for rules with forces.

    Returns
    -------
    list of LinearResponse
        One response for each of `answers`.

    Raises
    ------
    PluginError
        If the rule's functions fail, or are not finite at rest.
    """
    kinds = np.arange(len(place))
    is_uniform = not scene.experiment.rule.uses_reference and not _varies(scene, state)
    at_rest = not state.u.any()
    with errors_attributed_to(scene.experiment.rule, "when linearised"):
        if is_uniform and at_rest and len(place) > FEW:
            kinds, place = _group_alike(scene, state, sublattice, place)
        parts = []
        for chunk in np.split(place, range(CHUNK_SIZE, len(place), CHUNK_SIZE)):
            followers = _Followers(scene, state, sublattice, chunk)
            parts.append([followers.response(answer, at_rest) for answer in answers])
        return [_concatenate(kinds, responses) for responses in zip(*parts, strict=True)]


def _concatenate(kinds: Indices, parts: Sequence[LinearResponse]) -> LinearResponse:
    """Concatenate the responses of chunks of kinds."""
    centre, answer = (
        np.concatenate([getattr(p, of) for p in parts]) for of in ("centre", "answer")
    )
    neighbours = {
        slot: np.concatenate([part.neighbours[slot] for part in parts])
        for slot in parts[0].neighbours
    }
    return LinearResponse(kinds, centre, neighbours, answer)


def by_sublattice(scene: Scene, place: Indices) -> Iterator[tuple[int, Indices]]:
    """Yield each sublattice that occurs among flat places, with the indices of its places."""
    sublattices = scene.raster.shape[0]
    sublattice = place // (scene.raster.kind.size // sublattices)
    for s in range(sublattices):
        members = np.flatnonzero(sublattice == s)
        if len(members):
            yield s, members


def has_neighbours(scene: Scene, place: Indices) -> Present:
    """Return which of the particles at flat places have at least one neighbour."""
    result, kind = np.zeros(len(place), bool), scene.raster.kind.ravel()
    for s, members in by_sublattice(scene, place):
        for slot in scene.neighbourhood.slots[s]:
            result[members] |= kind[place[members] + slot_step(scene.raster.shape, slot)] != EMPTY
    return result


def _varies(scene: Scene, state: State) -> bool:
    """Return whether state variables or constants that the rule reads vary between particles."""
    if scene.constants.by_particle:
        return True
    softens = isinstance(scene.experiment.fracture, (Softens, SoftensCells))
    bond_values = list(state.bond_values) if softens else []
    bond_values += scene.constants.by_bond.values() if bond_values else ()
    return any(
        (values != values.flat[0]).any() for values in (*bond_values, *state.particle_values)
    )


def _group_alike(
    scene: Scene, state: State, sublattice: int, place: Indices
) -> tuple[Indices, Indices]:
    """Group places by the response of their particles.

    Particles with the same response have the same neighbours, the same area fractions of the cells
    around them, and the same broken bonds.

    Returns
    -------
    kind : (place,)
        Kind of each place.
    place : (kind,)
        One place of each kind.
    """
    regular = _is_regular(scene, state, sublattice).ravel()[
        place % math.prod(scene.raster.shape[1:])
    ]
    irregular = np.flatnonzero(~regular)
    first = np.flatnonzero(regular)[:1] if len(irregular) < len(place) else irregular[:0]
    kind, places = np.zeros(len(place), np.intp), place[irregular]
    around = Surroundings(scene, Places(scene.raster.shape, places), sublattice)
    neighbours = around.neighbours(state)
    code = np.zeros(len(places), np.int64)
    numbers = [to.w.left - 1.0 for to in neighbours if scene.cells]
    numbers += [w.left for to in neighbours for w in to.more]
    numbers += [value for to in neighbours if to.torn for value in to.torn]
    if numbers:
        table = np.array([np.broadcast_to(value, places.shape) for value in numbers])
        modified = (table != 0.0).any(axis=0)
        code[modified] = 1 + np.unique(table[:, modified], axis=1, return_inverse=True)[1].ravel()
    differing = [mask for to in neighbours for mask in (to.present, to.broken) if mask is not None]
    for mask in differing:
        code = 2 * code + mask
    # With more masks the key would not fit in an integer of 64 bits. 20 bits of it are reserved for
    # the cut and torn cells around a particle.
    if len(differing) > 42:
        return np.arange(len(place)), place
    _, representatives, kind[irregular] = np.unique(code, return_index=True, return_inverse=True)
    kind[irregular] += len(first)
    return kind, place[np.concatenate([first, irregular[representatives]])]


def _is_regular(scene: Scene, state: State, sublattice: int) -> Present:
    """Return a mask of shape (cell, cell) of those places of a sublattice that have all neighbours,
    whole cells around them and no broken bond."""
    raster, around = scene.raster, scene.neighbourhood
    regular = np.zeros(raster.shape[1:], bool)
    if not (block := raster.body_block(sublattice)):
        return regular
    inside = block.within(regular)
    inside[...] = True
    occupied = raster.kind != EMPTY
    whole = scene.cells.weight == 1.0 if scene.cells else occupied
    for slot in around.slots[sublattice]:
        inside &= block.seen_through(slot).of(occupied)
        if state.broken_step is not None and not scene.tears:
            plane, at_this_end = around.owner[slot]
            owner = block if at_this_end else block.seen_through(slot)
            inside &= owner.within(state.broken_step[plane]) < 0
        for side in around.tiling.beside[slot] if scene.cells else ():
            first = block.seen_through(side.first) if side.first else block
            inside &= first.of(whole[side.kind])
    if scene.tears:
        assert state.broken_step is not None
        for cell in around.cells_around[sublattice].cells:
            for bond in cell:
                owner = block.seen_through(bond.owner) if bond.owner else block
                inside &= owner.within(state.broken_step[bond.plane]) < 0
    return regular


class _Followers:
    """Evaluate the rule at some places for a series of small displacements at once. Arrays are
    (axis, step, place).

    The first entry of the series is a displacement of zero. The next entries are displacements of
    the particle along each axis, with all neighbours fixed. They are followed by displacements of
    the neighbour along each slot.
    """

    def __init__(self, scene: Scene, state: State, sublattice: int, place: Indices) -> None:
        around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
        self._evaluator = Evaluator(scene).given(around.parameters)
        u = state.u.astype(float, copy=False)
        self._local, self._slots = around.here(u, state), around.slots
        self._neighbours = list(zip(around.differences(u), around.neighbours(state), strict=True))
        steps = 1 + scene.axes * (1 + len(around.slots))
        self._unit = scene.neighbourhood.nudge_unit
        self._shape, self._cache = (steps, len(place)), dict[complex, Contributions]()

    def response(self, name: str, finite: bool) -> LinearResponse:
        """Linearise one quantity; raise ValueError if `finite` is true and the result is not
        finite."""
        answer = {"move": self._evaluator.move, "force": self._evaluator.force}[name]
        evaluate = partial(self._evaluate, answer)
        if self._evaluator.rule.linear:
            answers = array_of(evaluate(self._unit), self._shape)
            value, derivatives = answers[:, 0], (answers - answers[:, :1]) / self._unit
        else:
            value = array_of(evaluate(SMALL * self._unit), self._shape)[:, 0]
            derivatives = derivative(evaluate, self._shape, self._unit)
        if np.iscomplexobj(value):
            raise ValueError(f"it returned values of the type {value.dtype}, not real numbers")
        if finite and not (np.isfinite(value).all() and np.isfinite(derivatives).all()):
            raise ValueError(f"its {name} at rest, or a derivative of it, is not finite")
        # Axes: displaced particle, place, axis of the response, axis of u.
        centre, *neighbours = np.moveaxis(
            derivatives[:, 1:].reshape(len(derivatives), -1, len(derivatives), self._shape[1]),
            0,
            -1,
        ).transpose(0, 2, 3, 1)
        kinds = np.arange(self._shape[1])
        return LinearResponse(
            kinds, centre, dict(zip(self._slots, neighbours, strict=True)), value.T
        )

    def _evaluate(self, answer: Answer, step: complex) -> Any:
        if step not in self._cache:
            self._cache[step] = self._totals(step)
        with np.errstate(all="ignore"):
            displacement = self._local.u + self._steps(step, 1, self._shape[0])
            return answer(self._cache[step], self._local._replace(u=displacement))

    def _totals(self, step: complex) -> Contributions:
        """Return the sums over the neighbours after each displacement.

        Only one contribution changes if one neighbour is displaced.
        """
        axes = len(self._local.u)
        if isinstance(self._evaluator.rule, UsesAngles):
            return self._totals_of_pairs(step)
        # The contribution of a slot is evaluated for no displacement, and for displacements of the
        # particle and of the neighbour.
        count = 1 + 2 * axes
        own_step, neighbour_step = self._steps(step, 1, count), self._steps(step, 1 + axes, count)
        displacement = self._local.u + own_step
        with np.errstate(all="ignore"):
            parts = [
                summed(
                    [
                        (
                            self._evaluator.contribution(
                                d + (neighbour_step - own_step), displacement, to
                            ),
                            to.present,
                        )
                    ]
                )
                for d, to in self._neighbours
            ]
            for part in parts:
                refuse_other_count(part, parts[0])
            return tuple(self._total(values, 1 + axes) for values in zip(*parts, strict=True))

    def _totals_of_pairs(self, step: complex) -> Contributions:
        """Return the sums over the neighbours and their pairs after each displacement. All
        contributions are evaluated for all displacements, because a displaced neighbour belongs to
        several pairs."""
        axes, steps = len(self._local.u), self._shape[0]
        own_step = self._steps(step, 1, steps)
        differences = [
            d + (self._steps(step, 1 + axes * (1 + n), steps) - own_step)
            for n, (d, _) in enumerate(self._neighbours)
        ]
        neighbours = [to for _, to in self._neighbours]
        with np.errstate(all="ignore"):
            return self._evaluator.total(differences, self._local.u + own_step, neighbours)

    def _total(self, by_slot: Sequence[Any], common: int) -> Any:
        """Return the totals of one number or vector, given its contributions for each slot."""
        if isinstance(by_slot[0], Vector):
            return vector(self._total(along, common) for along in zip(*by_slot, strict=True))
        if all(np.ndim(values) < 2 for values in by_slot):
            return sum(by_slot)  # These are weights, which no displacement changes.
        shape = (2 * common - 1, self._shape[1])
        by_slot = [
            values if np.shape(values) == shape else np.broadcast_to(values, shape)
            for values in by_slot
        ]
        whole = sum(values[:common] for values in by_slot)
        return np.concatenate(
            [whole, *(whole[:1] + (values[common:] - values[0]) for values in by_slot)]
        )

    def _steps(self, step: complex, first: int, count: int) -> Any:
        """Return `count` displacements, one along each axis from number `first` on, as a vector of
        (step, 1)."""
        steps = np.zeros((len(self._local.u), count, 1), type(step))
        for axis, component in enumerate(steps):
            component[first + axis] = step
        return vector(steps)
