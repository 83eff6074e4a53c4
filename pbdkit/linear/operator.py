"""The step operator: the paper's "transformation operator between matrices" as a sparse matrix.

u(t+1) = now · u(t) + before · u(t-1) + led · u_L + source for the displacements of the followers,
one unknown a particle and axis. `before` is empty except for frames with lag and for memory; loads
are in `source`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import EMPTY, FOLLOWER, FRAME, LEADER, slot_step
from pbdkit.linear.response import by_sublattice, has_neighbours, respond
from pbdkit.linear.spectrum import Couplings, Entries, frame_matrices
from pbdkit.model.solver import Stepping
from pbdkit.plugin.frame import Indices
from pbdkit.scene.leaders import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.leaders import Guidance
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    import scipy.sparse


Floats = NDArray[np.floating[Any]]


class Guiding:
    """The guided particles of a step, looked up by their flat place. `turns` takes the moves of
    each to those that it makes, (particle, axis, axis): T = 1 along free axes, and shares there of
    the move along others (stepping/guidance.py)."""

    def __init__(self, scene: Scene, step: int) -> None:
        guidance = Guidance(scene)
        self.guided = guided = guidance.at(step)
        self.free = np.eye(scene.axes) * ~guided.led.T[:, None]
        """(particle, axis, axis): 1 along free axes."""
        self.turns = self.free + guidance.shares(guided)

    def __bool__(self) -> bool:
        return len(self.guided.place) > 0

    def numbers(self, place: Indices) -> Indices:
        """Of those at flat places, -1 where nobody is guided."""
        if not self:
            return np.full(len(place), -1)
        order = np.argsort(self.guided.place)
        at = np.searchsorted(self.guided.place, place, sorter=order).clip(max=len(order) - 1)
        return np.where(self.guided.place[order[at]] == place, order[at], -1)

    def turned(self, place: Indices, values: Floats) -> Floats:
        """The moves, or blocks, (particle, axis, ...), of particles at flat places."""
        own = self.numbers(place)
        if not (some := np.flatnonzero(own >= 0)).size:
            return values
        turned = values.copy()
        turned[some] = np.einsum("eab,eb...->ea...", self.turns[own[some]], values[some])
        return turned

    def put(
        self, free: Couplings, led: Couplings, rows: Indices, there: Indices,
        numbers: tuple[Indices, Indices], blocks: Floats,
    ) -> None:  # fmt: skip
        """Add what particles at flat places do as followers, and what guided ones do as leaders;
        `numbers` are those of each as a follower and as a leader."""
        own = self.numbers(there)
        if (some := np.flatnonzero(own >= 0)).size:
            led_blocks, blocks = blocks[some], blocks.copy()
            blocks[some] = np.einsum("eab,ebc->eac", led_blocks, self.free[own[some]])
            led.add(rows[some], numbers[1][some], led_blocks - blocks[some])
        free.add(rows, numbers[0], blocks)


Integers = NDArray[np.signedinteger[Any]]


@dataclass(frozen=True)
class StepOperator:
    """One step, linearised at a state, for fixed roles and leaders that stand still.

    `followers` and `leaders` are rows of the particle table; in the plane unknown 2n is x of the
    n-th follower, 2n + 1 its y, and the same for leaders. The couplings hold the same by
    particle; of those with leaders, `couplings_shown` is the share that frame points show. Guided
    particles are of both: `held` are their unknowns that lead, with empty rows and columns.
    """

    followers: Indices
    leaders: Indices
    couplings_now: Couplings
    couplings_before: Couplings
    couplings_led: Couplings
    couplings_shown: Couplings
    source: Floats
    held: Indices

    @property
    def couplings_both(self) -> Couplings:
        """`now` + `before`: the step where displacements stay as they are."""
        now = self.couplings_now
        return Couplings(now.shape, now.axes, now.parts + self.couplings_before.parts)

    @cached_property
    def now(self) -> scipy.sparse.csr_array:
        """What u(t) is multiplied with."""
        return self.couplings_now.entries().sparse()

    @cached_property
    def before(self) -> scipy.sparse.csr_array:
        """What u(t-1) is multiplied with."""
        return self.couplings_before.entries().sparse()

    @cached_property
    def led(self) -> scipy.sparse.csr_array:
        """What the leaders' displacements are multiplied with."""
        return self.couplings_led.entries().sparse()

    def augmented(self) -> Entries:
        """The operator on (u(t), u(t-1)); that on u(t) where the step does not look back. Without
        what is held."""
        parts = self.couplings_now, self.couplings_before
        now, before = (couplings.entries().without(self.held) for couplings in parts)
        if not len(before.values):
            return now
        size = now.shape[0]
        every, shape = np.arange(size), (2 * size, 2 * size)
        earlier = Entries(before.rows, before.columns + size, before.values, shape)
        return now.plus(earlier).plus(Entries(every + size, every, np.ones(size), shape))


def step_operator(
    scene: Scene, state: State | None = None, step: int | None = None
) -> StepOperator:
    """The operator of a scene at a state (default: the start), with the roles of a step (default:
    the last), relaxation, memory and frame included.

    Raises ExperimentError where neighbours are found anew at every step.
    """
    if scene.experiment.neighbours.nearness():
        text = "neighbours that are found anew have no step operator"
        raise ExperimentError(text, ("neighbours",))
    state, step = state or initial_state(scene), step or scene.experiment.steps
    return _Assembly(scene, state, step).operator()


def moves_and_couplings(scene: Scene, state: State, place: Indices) -> tuple[Floats, Couplings]:
    """The moves (particle, axis) of the particles at some flat places, and ∂move/∂u: rows in the
    order of the places, columns by flat place."""
    if scene.inner is None:
        return _directly(scene, state, place)
    body = scene.raster.place_of(scene.raster.body_rows)
    z, inner = moves_and_couplings(scene.inner, state, body)
    field = np.zeros(state.u.shape)
    flat = field.reshape(len(field), -1)
    flat[:, body] = z.T
    if scene.frame:
        scene.frame.follow(flat, flat)
    moves, outer = _directly(scene, replace(state, u=field), place)
    seen = _followed(scene).entries().sparse() @ inner.entries().sparse()
    product = (outer.entries().sparse() @ seen).tobsr((scene.axes, scene.axes))
    product.sum_duplicates()
    rows = np.repeat(np.arange(len(place)), np.diff(product.indptr))
    couplings = Couplings(outer.shape, scene.axes)
    couplings.add(rows, product.indices, product.data)
    return moves, couplings


def _followed(scene: Scene) -> Couplings:
    """What body and frame show of the body: rows by flat place, columns in the order of the body's
    particles."""
    raster = scene.raster
    body, place = raster.body_rows, raster.place_of(np.arange(raster.count))
    followed = Couplings((raster.kind.size, len(body)), scene.axes)
    identity = np.broadcast_to(np.eye(scene.axes), (len(body), scene.axes, scene.axes))
    followed.add(place[body], np.arange(len(body)), identity)
    if scene.frame:
        point = np.setdiff1d(np.arange(raster.count), body)[scene.frame.map.point]
        column = np.searchsorted(body, scene.frame.map.body)
        followed.add(place[point], column, frame_matrices(scene.frame.map.weight, scene.axes))
    return followed


def _directly(scene: Scene, state: State, place: Indices) -> tuple[Floats, Couplings]:
    """By the scene's own rule; who has no neighbours stays, whatever it makes of nothing."""
    kind, moves = scene.raster.kind.ravel(), np.zeros((len(place), scene.axes))
    couplings = Couplings((len(place), kind.size), scene.axes)
    moving = np.flatnonzero(has_neighbours(scene, place)).astype(np.int32)
    for s, own in by_sublattice(scene, place[moving]):
        some = moving[own]
        (response,) = respond(scene, state, s, place[some])
        moves[some] = response.of_each(response.answer)
        steps = [0, *(slot_step(scene.raster.shape, slot) for slot in response.neighbours)]
        there = place[some] + np.array(steps)[:, None]
        blocks = np.stack([response.own, *response.neighbours.values()])
        slot, row = np.nonzero(kind[there] != EMPTY)
        couplings.add(some[row], there[slot, row], blocks[slot, response.kind[row]])
    return moves, couplings


class _Assembly:
    """Collects the couplings, looking particles up by their flat place on the raster."""

    def __init__(self, scene: Scene, state: State, step: int) -> None:
        self._scene, self._state, self._step = scene, state, step
        raster, kinds = scene.raster, kinds_at(scene.raster, scene.leading, step)
        self._kind = np.full(raster.kind.size, EMPTY, np.int8)
        self._unknown = np.full(raster.kind.size, -1, np.int32)
        self._guiding = guiding = Guiding(scene, step)
        rows = {kind: np.flatnonzero(kinds == kind) for kind in (FRAME, LEADER, FOLLOWER)}
        rows[FOLLOWER] = np.sort(np.concatenate([rows[FOLLOWER], guiding.guided.rows]))
        self._as_leader = self._unknown
        for kind, some in rows.items():
            place = raster.place_of(some)
            self._kind[place] = kind
            self._unknown[place] = np.arange(len(some))
            if kind == LEADER and guiding:
                self._as_leader = self._unknown.copy()
        self._followers, self._leaders = rows[FOLLOWER], rows[LEADER]
        free, led = len(self._followers), len(self._leaders)
        self._now, self._before = (Couplings((free, free), scene.axes) for _ in range(2))
        self._led, self._shown = (Couplings((free, led), scene.axes) for _ in range(2))

    def operator(self) -> StepOperator:
        scene, solver, u = self._scene, self._scene.experiment.stepping, self._state.u
        place = scene.raster.place_of(self._followers)
        moves, couplings = moves_and_couplings(scene, self._state, place)
        self._stay(self._now, place, np.arange(len(place), dtype=np.int32), 1.0)
        moves = self._guiding.turned(place, moves)
        couplings.parts = [
            (rows, there, self._guiding.turned(place[rows], blocks))
            for rows, there, blocks in couplings.parts
        ]
        for rows, there, blocks in couplings.parts:
            self._see(rows, there, solver.relaxation * blocks)
        if solver.memory:
            moving = np.flatnonzero(has_neighbours(scene, place))
            self._stay(self._now, place, moving, solver.memory)
            self._stay(self._before, place, moving, -solver.memory)
        if u.any():
            moves = moves - couplings.times(u.reshape(scene.axes, -1).T.astype(float, copy=False))
        if scene.loads:
            moves = moves + self._pushed(place)
        source, who = (solver.relaxation * moves).ravel(), (self._followers, self._leaders)
        axis, some = np.nonzero(self._guiding.guided.led)
        guided = self._unknown[self._guiding.guided.place[some]]
        couplings_of = self._now, self._before, self._led, self._shown
        return StepOperator(*who, *couplings_of, source, np.sort(scene.axes * guided + axis))

    def _stay(self, couplings: Couplings, place: Indices, rows: Indices, factor: float) -> None:
        """Adds factor · 1 where followers are free."""
        own = self._guiding.numbers(place[rows])
        couplings.add_scaled_identity(rows[own < 0], factor)
        some = np.flatnonzero(own >= 0)
        couplings.add(rows[some], rows[some], factor * self._guiding.free[own[some]])

    def _pushed(self, place: Indices) -> Floats:
        """(follower, axis): what the loads of the step add to the moves."""
        moved = []
        for scene in (replace(self._scene, loads=None), self._scene):
            state = replace(self._state.copy(), step=self._step - 1)
            SlotFollowers(scene, Stepping()).move(self._state.u, state.previous, state)
            moved.append(state.previous.reshape(scene.axes, -1)[:, place].T)
        return moved[1] - moved[0]

    def _see(self, rows: Integers, there: Indices, weight: Floats) -> None:
        """Add what particles at flat places do to followers: frame points through those that they
        follow, each in the place of the frame point."""
        by_frame, frame = self._kind[there] == FRAME, self._scene.frame
        if frame is not None and by_frame.any():
            first, last = (
                np.searchsorted(frame.map.point, self._unknown[there[by_frame]], side)
                for side in ("left", "right")
            )
            count = np.ones(len(there), np.intp)
            count[by_frame] = last - first
            offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            start = np.zeros(len(there), np.intp)
            start[by_frame] = first
            rows, there, weight, by_frame, entry = (
                np.repeat(values, count, axis=0)
                for values in (rows, there, weight, by_frame, start)
            )
            entry = (entry + offset)[by_frame]
            follows = frame_matrices(frame.map.weight[entry], self._scene.axes)
            there[by_frame] = frame.body_place[entry]
            weight[by_frame] = np.einsum("eab,ebc->eac", weight[by_frame], follows)
        led, free = (self._kind[there] == kind for kind in (LEADER, FOLLOWER))
        self._led.add(rows[led], self._as_leader[there[led]], weight[led])
        shown = led & by_frame
        self._shown.add(rows[shown], self._as_leader[there[shown]], weight[shown])
        lags = by_frame if frame is not None and frame.map.lag else np.zeros_like(by_frame)
        nowhere = Couplings((0, 0), 0)
        for couplings, leads, some in (
            (self._now, self._led, free & ~lags),
            (self._before, self._led, free & lags),
            (nowhere, self._shown, free & by_frame),
        ):
            numbers = self._unknown[there[some]], self._as_leader[there[some]]
            self._guiding.put(couplings, leads, rows[some], there[some], numbers, weight[some])
