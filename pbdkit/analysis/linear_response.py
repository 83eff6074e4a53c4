"""A rule's answer to small displacements, from the rule's own functions and nothing else.

Linear rules come out exactly, whatever the configuration; others linearised at a state. At rest,
particles with the same neighbours present answer alike, and one of each kind is asked.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.stencil import array_of, derivative
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
        if same and at_rest:
            kinds, place = _alike(scene, state, sublattice, place)
        return [
            _Followers(scene, state, sublattice, place, answer).response(kinds, at_rest)
            for answer in answers
        ]


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
    of_bonds = list(state.bond_values) if isinstance(scene.experiment.fracture, Softens) else []
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
    if scene.cells:
        kinds = [to.w.left for to in neighbours] + [w.left for to in neighbours for w in to.more]
        left = np.array([np.broadcast_to(shares, some.shape) for shares in kinds])
        cut = (left[: len(neighbours)] != 1.0).any(axis=0)
        code[cut] = 1 + np.unique(left[:, cut], axis=1, return_inverse=True)[1].ravel()
    differing = [mask for to in neighbours for mask in (to.present, to.broken) if mask is not None]
    for mask in differing:
        code = 2 * code + mask
    # More than fits a number, leaving 20 bits for the cut cells around a particle.
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
        if state.broken_step is not None:
            plane, at_this_end = around.home[slot]
            home = block if at_this_end else block.seen_through(slot)
            here &= home.within(state.broken_step[plane]) < 0
        for side in around.tiling.beside[slot] if scene.cells else ():
            first = block.seen_through(side.first) if side.first else block
            here &= first.of(whole[side.kind])
    return plain


class _Followers:
    """The rule on some places, with differences that can be nudged."""

    def __init__(
        self, scene: Scene, state: State, sublattice: int, place: Indices, answer: str
    ) -> None:
        around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
        self._evaluator, self._name = Evaluator(scene).given(around.parameters), answer
        self._answer = {"move": self._evaluator.move, "force": self._evaluator.force}[answer]
        u = state.u.astype(float, copy=False)
        self._here, self._slots = around.here(u, state), around.slots
        self._d = dict(zip(around.slots, around.differences(u), strict=True))
        self._neighbours = dict(zip(around.slots, around.neighbours(state), strict=True))
        self._still = self._contributions(self._d, self._here.u)

    def response(self, kinds: Indices, finite: bool) -> Response:
        """Of followers of these kinds, `finite` or refused."""
        answer = self._standing.T
        own, neighbours = self._derivative(None), {s: self._derivative(s) for s in self._slots}
        if finite and not all(np.isfinite(v).all() for v in (answer, own, *neighbours.values())):
            raise ValueError(f"its {self._name} at rest, or a derivative of it, is not finite")
        return Response(kinds, own, neighbours, answer)

    def _derivative(self, mover: Slot | None) -> Floats:
        """∂answer/∂u_k through a slot or, for None, ∂answer/∂u_j with all neighbours where they
        are; (place, axis of the answer, axis of u)."""
        shape, axes = self._here.u.x.shape, np.eye(len(self._here.u))
        if self._evaluator.rule.linear:
            columns = [array_of(self._moved(mover, e, 1.0), shape) - self._standing for e in axes]
        else:
            columns = [derivative(partial(self._moved, mover, e), shape) for e in axes]
        return np.moveaxis(np.array(columns), (0, 1), (2, 1))

    @cached_property
    def _standing(self) -> Floats:
        """(axis of the answer, place): the answers as they are."""
        return array_of(self._applied(self._still, self._here.u), self._here.u.x.shape)

    def _moved(self, mover: Slot | None, along: Floats, step: complex) -> Any:
        """The answers (place) after a step of the neighbour at a slot, or of one's own."""
        here, nudge = self._here.u, vector(step * component for component in along)
        if mover is not None:
            nudged = {mover: self._d[mover] + nudge}
            return self._applied(self._still | self._contributions(nudged, here), here)
        stepped = {slot: d - nudge for slot, d in self._d.items()}
        return self._applied(self._contributions(stepped, here + nudge), here + nudge)

    def _contributions(
        self, differences: dict[Slot, Components], here: Components
    ) -> dict[Slot, Contributions]:
        with np.errstate(all="ignore"):
            return {
                slot: self._evaluator.contribution(d, here, self._neighbours[slot])
                for slot, d in differences.items()
            }

    def _applied(self, contributions: dict[Slot, Contributions], here: Components) -> Any:
        parts = [(contributions[slot], to.present) for slot, to in self._neighbours.items()]
        with np.errstate(all="ignore"):
            return self._answer(summed(parts), self._here._replace(u=here))
