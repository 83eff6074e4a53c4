"""The step operator: the paper's "transformation operator between matrices" as a sparse matrix.

u(t+1) = now · u(t) + before · u(t-1) + led · u_L + source for the displacements of the followers,
an unknown a particle and axis. `before` is empty but for frames with lag and for memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.composition import moves_and_couplings
from pbdkit.analysis.couplings import Couplings, Entries, frame_matrices, some_of
from pbdkit.analysis.linear_response import Response, has_neighbours, respond
from pbdkit.errors import ExperimentError
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.raster import EMPTY, FOLLOWER, FRAME, LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    import scipy.sparse

Floats = NDArray[np.float64]
Integers = NDArray[np.signedinteger[Any]]


@dataclass(frozen=True)
class StepOperator:
    """One step, linearised at a state, for fixed roles and leaders that stand still.

    `followers` and `leaders` are rows of the particle table; in the plane unknown 2n is x of the
    n-th follower, 2n + 1 its y, and the same for leaders. The couplings hold the same by
    particle; of those with leaders, `couplings_shown` is the share that frame points show.
    """

    followers: Indices
    leaders: Indices
    couplings_now: Couplings
    couplings_before: Couplings
    couplings_led: Couplings
    couplings_shown: Couplings
    source: Floats

    @cached_property
    def entries_now(self) -> Entries:
        """The entries of `now`."""
        return self.couplings_now.entries()

    @cached_property
    def entries_before(self) -> Entries:
        """The entries of `before`."""
        return self.couplings_before.entries()

    @cached_property
    def entries_led(self) -> Entries:
        """The entries of `led`."""
        return self.couplings_led.entries()

    @cached_property
    def now(self) -> scipy.sparse.csr_array:
        """What u(t) is multiplied with."""
        return self.entries_now.sparse()

    @cached_property
    def before(self) -> scipy.sparse.csr_array:
        """What u(t-1) is multiplied with."""
        return self.entries_before.sparse()

    @cached_property
    def led(self) -> scipy.sparse.csr_array:
        """What the leaders' displacements are multiplied with."""
        return self.entries_led.sparse()

    def augmented(self) -> Entries:
        """The operator on (u(t), u(t-1)); that on u(t) where the step does not look back."""
        now, before = self.entries_now, self.entries_before
        if not len(before.values):
            return now
        size = now.shape[0]
        every = np.arange(size)
        return Entries(
            np.concatenate([now.rows, before.rows, every + size]),
            np.concatenate([now.columns, before.columns + size, every]),
            np.concatenate([now.values, before.values, np.ones(size)]),
            (2 * size, 2 * size),
        )


def step_operator(
    scene: Scene, state: State | None = None, step: int | None = None
) -> StepOperator:
    """The operator of a scene at a state (default: the start), with the roles of a step (default:
    the last), relaxation, memory and frame included.

    Raises ExperimentError where neighbours are found anew at every step.
    """
    if scene.experiment.neighbours.nearness():
        raise ExperimentError(
            "neighbours that are found anew have no step operator", ("neighbours",)
        )
    return _Assembly(
        scene, state or initial_state(scene), step or scene.experiment.steps
    ).operator()


class _Assembly:
    """Collects the couplings, looking particles up by their flat place on the raster: the
    neighbour at a slot is a constant step away."""

    def __init__(self, scene: Scene, state: State, step: int) -> None:
        self._scene, self._state = scene, state
        raster, kinds = scene.raster, kinds_at(scene.raster, scene.leading, step)
        self._kind = np.full(raster.kind.size, EMPTY, np.int8)
        self._unknown = np.full(raster.kind.size, -1, np.int32)
        rows = {kind: np.flatnonzero(kinds == kind) for kind in (FOLLOWER, LEADER, FRAME)}
        for kind, some in rows.items():
            place = raster.place_of(some)
            self._kind[place] = kind
            self._unknown[place] = np.arange(len(some))
        self._followers, self._leaders = rows[FOLLOWER], rows[LEADER]
        free, led = len(self._followers), len(self._leaders)
        axes = scene.axes
        self._now, self._before = Couplings((free, free), axes), Couplings((free, free), axes)
        self._led, self._shown = Couplings((free, led), axes), Couplings((free, led), axes)
        self._source = np.zeros((free, axes))

    def operator(self) -> StepOperator:
        memory = self._scene.experiment.stepping.memory
        self._now.add_scaled_identity(np.arange(len(self._followers), dtype=np.int32), 1.0)
        place = self._scene.raster.place_of(self._followers)
        cells = self._kind.size // self._scene.raster.shape[0]
        for s in range(self._scene.raster.shape[0]):
            own = place if self._scene.raster.shape[0] == 1 else place[place // cells == s]
            own = own[has_neighbours(self._scene, s, own)]
            if len(own):
                if self._scene.inner:
                    self._add_nested(own)
                else:
                    self._add(own, respond(self._scene, self._state, s, own))
                if memory:
                    self._now.add_scaled_identity(self._unknown[own], memory)
                    self._before.add_scaled_identity(self._unknown[own], -memory)
        return StepOperator(
            self._followers,
            self._leaders,
            self._now,
            self._before,
            self._led,
            self._shown,
            self._source.ravel(),
        )

    def _add(self, place: Indices, response: Response) -> None:
        """The rows of the followers at some places of one sublattice."""
        relaxation = self._scene.experiment.stepping.relaxation
        u = self._state.u.reshape(self._scene.axes, -1).astype(float, copy=False)
        rows = self._unknown[place]
        own = response.of_each(relaxation * response.own)
        self._now.add(rows, rows, own)
        at_rest = not u.any()
        constant: Floats = relaxation * response.of_each(response.move)
        if not at_rest:
            constant = constant - _times(own, u[:, place].T)
        for slot, derivative in response.neighbours.items():
            there = place + response.steps[slot]
            weight = response.of_each(relaxation * derivative)
            if not at_rest:
                present = (self._kind[there] != EMPTY)[:, None]
                constant = constant - np.where(present, _times(weight, u[:, there].T), 0.0)
            self._see(rows, there, weight)
        self._source[rows] = constant

    def _add_nested(self, place: Indices) -> None:
        """The rows of followers whose rule works on the moves of another."""
        relaxation, rows = self._scene.experiment.stepping.relaxation, self._unknown[place]
        moves, couplings = moves_and_couplings(self._scene, self._state, place)
        everybody = self._scene.raster.place_of(np.arange(self._scene.raster.count))
        u = self._state.u.reshape(self._scene.axes, -1)[:, everybody].T.astype(float, copy=False)
        self._source[rows] = relaxation * (moves - couplings.times(u))
        for own, column, blocks in couplings.parts:
            self._see(rows[own], everybody[column], relaxation * blocks)

    def _see(self, rows: Integers, there: Indices, weight: Floats) -> None:
        """Followers and leaders directly, frame points through those that they follow."""
        kinds = self._kind[there]
        for kind, couplings in ((FOLLOWER, self._now), (LEADER, self._led)):
            some = kinds == kind
            if some.all():
                couplings.add(rows, self._unknown[there], weight)
            elif some.any():
                couplings.add(rows[some], self._unknown[there[some]], some_of(weight, some))
        frame, some = self._scene.frame, kinds == FRAME
        if frame is None or not some.any():
            return
        point, rows, weight = self._unknown[there[some]], rows[some], some_of(weight, some)
        first = np.searchsorted(frame.map.point, point)
        last = np.searchsorted(frame.map.point, point + 1)
        for e in range(int((last - first).max(initial=0))):
            has = first + e < last
            entry = (first + e)[has]
            follows = frame_matrices(frame.map.weight[entry], self._scene.axes)
            product = np.einsum("eab,ebc->eac", weight[has], follows)
            body = frame.body_place[entry]
            of_leader = self._kind[body] == LEADER
            free = self._before if frame.map.lag else self._now
            sums = ((self._led, of_leader), (self._shown, of_leader), (free, ~of_leader))
            for couplings, those in sums:
                couplings.add(rows[has][those], self._unknown[body[those]], product[those])


def _times(matrices: Floats, vectors: Floats) -> Floats:
    product: Floats = np.einsum("eab,eb->ea", matrices, vectors)
    return product
