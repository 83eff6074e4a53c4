"""Linear response of a rule to small displacements, computed from the rule's own functions.

Linear rules are exact in any configuration; others are linearised at a state. At rest, particles
with the same neighbours present respond alike, and one of each kind is evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.raster import EMPTY, Places, slot_step
from pbdkit.linear.stencil import SMALL, array_of, derivative
from pbdkit.plugin import Here, Slot, Softens, SoftensCells, Vector
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import Contributions, Evaluator, Surroundings, summed
from pbdkit.stepping.state import State

Floats = NDArray[np.float64]
Present = NDArray[np.bool_]
Answer = Callable[[Contributions, Here], Any]
AT_ONCE = 8192
"""Number of places that are evaluated together, so that temporaries stay small."""
FEW = 200
"""Number of places up to which each is evaluated: to find equal ones takes longer."""


@dataclass(frozen=True)
class Response:
    """The answer of some followers, linearised: it is of some kinds only. `kind` is that of each
    follower, `own` ∂answer/∂u_j and `neighbours` ∂answer/∂u_k by slot, (kind, axis of the answer,
    axis of u), `answer` the answer itself, (kind, axis)."""

    kind: Indices
    own: Floats
    neighbours: dict[Slot, Floats]
    answer: Floats

    def of_each(self, values: Floats) -> Floats:
        """The values of all followers; a view of one where all answer alike."""
        if len(values) == 1:
            return np.broadcast_to(values[0], (len(self.kind), *values.shape[1:]))
        return values[self.kind]


def respond(
    scene: Scene, state: State, sublattice: int, place: Indices, answers: Sequence[str] = ("move",)
) -> list[Response]:
    """The answers at a state of the followers at some flat places, all of one sublattice: the
    "move", and the "force" where the rule knows forces.

    Raises PluginError where the rule's functions fail, or are not finite at rest.
    """
    kinds = np.arange(len(place))
    same = not scene.experiment.rule.uses_reference and not _differ(scene, state)
    at_rest = not state.u.any()
    with blaming(scene.experiment.rule, "when linearised"):
        if same and at_rest and len(place) > FEW:
            kinds, place = _alike(scene, state, sublattice, place)
        parts = []
        for some in np.split(place, range(AT_ONCE, len(place), AT_ONCE)):
            followers = _Followers(scene, state, sublattice, some)
            parts.append([followers.response(answer, at_rest) for answer in answers])
        return [_joined(kinds, some) for some in zip(*parts, strict=True)]


def _joined(kinds: Indices, parts: Sequence[Response]) -> Response:
    """The answer of followers of these kinds, from those of the kinds."""
    own, answer = (np.concatenate([getattr(p, of) for p in parts]) for of in ("own", "answer"))
    neighbours = {
        slot: np.concatenate([part.neighbours[slot] for part in parts])
        for slot in parts[0].neighbours
    }
    return Response(kinds, own, neighbours, answer)


def by_sublattice(scene: Scene, place: Indices) -> Iterator[tuple[int, Indices]]:
    """Every sublattice with those of the flat places that are its, by their number."""
    sublattices = scene.raster.shape[0]
    of = place // (scene.raster.kind.size // sublattices)
    for s in range(sublattices):
        some = np.flatnonzero(of == s)
        if len(some):
            yield s, some


def has_neighbours(scene: Scene, place: Indices) -> Present:
    """Which particles at flat places have any."""
    found, kind = np.zeros(len(place), bool), scene.raster.kind.ravel()
    for s, some in by_sublattice(scene, place):
        for slot in scene.neighbourhood.slots[s]:
            found[some] |= kind[place[some] + slot_step(scene.raster.shape, slot)] != EMPTY
    return found


def _differ(scene: Scene, state: State) -> bool:
    """Whether what is remembered of bonds or particles, and reaches the rule, is not the same
    everywhere."""
    if scene.constants.by_particle:
        return True
    softens = isinstance(scene.experiment.fracture, (Softens, SoftensCells))
    of_bonds = list(state.bond_values) if softens else []
    of_bonds += scene.constants.by_bond.values() if of_bonds else ()
    return any((values != values.flat[0]).any() for values in (*of_bonds, *state.particle_values))


def _alike(scene: Scene, state: State, sublattice: int, place: Indices) -> tuple[Indices, Indices]:
    """(kind, place): which kind each place is of, and one place of each; those of a kind have the
    same neighbours, the same shares of cells around them and the same broken bonds."""
    plain = _plain(scene, state, sublattice).ravel()[place % math.prod(scene.raster.shape[1:])]
    others = np.flatnonzero(~plain)
    first = np.flatnonzero(plain)[:1] if len(others) < len(place) else others[:0]
    kind, some = np.zeros(len(place), np.intp), place[others]
    around = Surroundings(scene, Places(scene.raster.shape, some), sublattice)
    neighbours = around.neighbours(state)
    code = np.zeros(len(some), np.int64)
    numbers = [to.w.left - 1.0 for to in neighbours if scene.cells]
    numbers += [w.left for to in neighbours for w in to.more]
    numbers += [value for to in neighbours if to.torn for value in to.torn]
    if numbers:
        table = np.array([np.broadcast_to(value, some.shape) for value in numbers])
        odd = (table != 0.0).any(axis=0)
        code[odd] = 1 + np.unique(table[:, odd], axis=1, return_inverse=True)[1].ravel()
    differing = [mask for to in neighbours for mask in (to.present, to.broken) if mask is not None]
    for mask in differing:
        code = 2 * code + mask
    # More than fits a number, leaving 20 bits for the cut and torn cells around a particle.
    if len(differing) > 42:
        return np.arange(len(place)), place
    _, found, kind[others] = np.unique(code, return_index=True, return_inverse=True)
    kind[others] += len(first)
    return kind, place[np.concatenate([first, others[found]])]


def _plain(scene: Scene, state: State, sublattice: int) -> Present:
    """(cell, cell): around which particles of a sublattice all neighbours are there, all cells
    whole and no bonds broken."""
    raster, around = scene.raster, scene.neighbourhood
    plain = np.zeros(raster.shape[1:], bool)
    if not (block := raster.body_block(sublattice)):
        return plain
    here = block.within(plain)
    here[...] = True
    there = raster.kind != EMPTY
    whole = scene.cells.weight == 1.0 if scene.cells else there
    for slot in around.slots[sublattice]:
        here &= block.seen_through(slot).of(there)
        if state.broken_step is not None and not scene.tears:
            plane, at_this_end = around.home[slot]
            home = block if at_this_end else block.seen_through(slot)
            here &= home.within(state.broken_step[plane]) < 0
        for side in around.tiling.beside[slot] if scene.cells else ():
            first = block.seen_through(side.first) if side.first else block
            here &= first.of(whole[side.kind])
    if scene.tears:
        assert state.broken_step is not None
        for cell in around.cells_around[sublattice].cells:
            for bond in cell:
                home = block.seen_through(bond.home) if bond.home else block
                here &= home.within(state.broken_step[bond.plane]) < 0
    return plain


class _Followers:
    """The rule on some places, asked what small steps do: answers to all of them at once, (axis,
    step, place). The first step is none; then come a particle's own along each axis, with all
    neighbours where they are; then those of the neighbour at each slot.
    """

    def __init__(self, scene: Scene, state: State, sublattice: int, place: Indices) -> None:
        around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
        self._evaluator = Evaluator(scene).given(around.parameters)
        u = state.u.astype(float, copy=False)
        self._here, self._slots = around.here(u, state), around.slots
        self._neighbours = list(zip(around.differences(u), around.neighbours(state), strict=True))
        steps = 1 + scene.axes * (1 + len(around.slots))
        self._unit = scene.neighbourhood.nudge_unit
        self._shape, self._known = (steps, len(place)), dict[complex, Contributions]()

    def response(self, name: str, finite: bool) -> Response:
        """The answer of that name, `finite` or refused."""
        answer = {"move": self._evaluator.move, "force": self._evaluator.force}[name]
        ask = partial(self._asked, answer)
        if self._evaluator.rule.linear:
            answers = array_of(ask(self._unit), self._shape)
            still, changes = answers[:, 0], (answers - answers[:, :1]) / self._unit
        else:
            still = array_of(ask(SMALL * self._unit), self._shape)[:, 0]
            changes = derivative(ask, self._shape, self._unit)
        if np.iscomplexobj(still):
            raise ValueError(f"it returned values of {still.dtype}, not real numbers")
        if finite and not (np.isfinite(still).all() and np.isfinite(changes).all()):
            raise ValueError(f"its {name} at rest, or a derivative of it, is not finite")
        # (mover, place, axis of the answer, axis of u)
        own, *others = np.moveaxis(
            changes[:, 1:].reshape(len(changes), -1, len(changes), self._shape[1]), 0, -1
        ).transpose(0, 2, 3, 1)
        kinds = np.arange(self._shape[1])
        return Response(kinds, own, dict(zip(self._slots, others, strict=True)), still.T)

    def _asked(self, answer: Answer, step: complex) -> Any:
        if step not in self._known:
            self._known[step] = self._totals(step)
        with np.errstate(all="ignore"):
            here = self._here.u + self._steps(step, 1, self._shape[0])
            return answer(self._known[step], self._here._replace(u=here))

    def _totals(self, step: complex) -> Contributions:
        """What the neighbours contribute together after each step: those of the neighbours change
        one contribution."""
        axes = len(self._here.u)
        count = 1 + 2 * axes  # steps that a slot's own contribution knows: none, own, neighbour's
        own, other = self._steps(step, 1, count), self._steps(step, 1 + axes, count)
        here = self._here.u + own
        with np.errstate(all="ignore"):
            parts = [
                summed([(self._evaluator.contribution(d + (other - own), here, to), to.present)])
                for d, to in self._neighbours
            ]
            return tuple(self._total(values, 1 + axes) for values in zip(*parts, strict=True))

    def _total(self, parts: Sequence[Any], kept: int) -> Any:
        """Return the totals of one number or vector, given by slot."""
        if isinstance(parts[0], Vector):
            return vector(self._total(along, kept) for along in zip(*parts, strict=True))
        shape = (2 * kept - 1, self._shape[1])
        parts = [np.broadcast_to(part, shape) for part in parts]
        whole = sum(part[:kept] for part in parts)
        return np.concatenate([whole, *(whole[:1] + (part[kept:] - part[0]) for part in parts)])

    def _steps(self, step: complex, first: int, count: int) -> Any:
        """A step along each axis as the `first` of so many and those after it, as a vector of
        (step, 1)."""
        steps = np.zeros((len(self._here.u), count, 1), type(step))
        for axis, along in enumerate(steps):
            along[first + axis] = step
        return vector(steps)
