"""The step operator: the paper's "transformation operator between matrices" as a sparse matrix.

u(t+1) = now · u(t) + before · u(t-1) + led · u_L + source for the displacements of the followers,
two unknowns a particle (x, y). `before` is empty but for frames with lag and for memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.linearising import Response, respond
from pbdkit.analysis.matrices import Entries
from pbdkit.errors import ExperimentError
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leading import kinds_at
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    import scipy.sparse

Floats = NDArray[np.float64]
Parts = list[tuple[Indices, Indices, Floats]]
"""(row, column, value) of the entries of a matrix, in parts."""


@dataclass(frozen=True)
class StepOperator:
    """One step, linearised at a state, for fixed roles and leaders that stand still.

    `followers` and `leaders` are rows of the particle table; unknown 2n is x of the n-th follower,
    2n + 1 its y, and the same for leaders.
    """

    followers: Indices
    leaders: Indices
    entries_now: Entries
    entries_before: Entries
    entries_led: Entries
    source: Floats

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
    """Collects the entries of the operator. Unknowns are looked up by row of the particle table."""

    def __init__(self, scene: Scene, state: State, step: int) -> None:
        self._scene, self._state = scene, state
        self._kinds = kinds_at(scene.raster, scene.leading, step)
        self._followers = np.flatnonzero(self._kinds == FOLLOWER)
        self._leaders = np.flatnonzero(self._kinds == LEADER)
        self._unknown = np.full(len(self._kinds), -1, np.intp)
        self._unknown[self._followers] = np.arange(len(self._followers))
        self._unknown[self._leaders] = np.arange(len(self._leaders))
        self._now: Parts = []
        self._before: Parts = []
        self._led: Parts = []
        self._source = np.zeros(2 * len(self._followers))
        self._accompanied = np.zeros(len(self._followers), bool)

    def operator(self) -> StepOperator:
        raster, memory = self._scene.raster, self._scene.experiment.solver.memory
        for s in range(raster.shape[0]):
            if block := raster.body_block(s):
                self._add(respond(self._scene, self._state, block))
        size, led = 2 * len(self._followers), 2 * len(self._leaders)
        every = np.arange(size)
        self._now.append((every, every, np.ones(size)))
        if memory:
            moving = every[np.repeat(self._accompanied, 2)]
            self._now.append((moving, moving, np.full(len(moving), memory)))
            self._before.append((moving, moving, np.full(len(moving), -memory)))
        return StepOperator(
            self._followers,
            self._leaders,
            _joined(self._now, (size, size)),
            _joined(self._before, (size, size)),
            _joined(self._led, (size, led)),
            self._source,
        )

    def _add(self, response: Response) -> None:
        """The rows of a block's followers. Particles with no neighbour stay, whatever the rule
        makes of nothing."""
        raster, relaxation = self._scene.raster, self._scene.experiment.solver.relaxation
        block = response.block
        m, n = np.nonzero(raster.kind[block.slices()] == FOLLOWER)
        i, j = m + block.start[0], n + block.start[1]
        rows = raster.rows_at(np.full(len(m), block.sublattice), i, j)
        others = {
            slot: raster.rows_at(np.full(len(m), slot.target), i + slot.cell[0], j + slot.cell[1])
            for slot in response.neighbours
        }
        accompanied = np.any([there >= 0 for there in others.values()], axis=0)
        kept = (self._kinds[rows] == FOLLOWER) & accompanied
        m, n, rows = m[kept], n[kept], rows[kept]
        self._accompanied[self._unknown[rows]] = True
        own = relaxation * response.own[m, n]
        self._put(self._now, rows, rows, own)
        constant = relaxation * response.move[m, n] - _times(own, self._u(rows))
        for slot, derivative in response.neighbours.items():
            weight, there = relaxation * derivative[m, n], others[slot][kept]
            felt = (there >= 0) & (weight != 0.0).any(axis=(1, 2))
            constant[felt] -= _times(weight[felt], self._u(there[felt]))
            self._see(rows[felt], there[felt], weight[felt])
        unknown = self._unknown[rows]
        self._source.reshape(-1, 2)[unknown] += constant

    def _u(self, rows: Indices) -> Floats:
        place = self._scene.raster.place_of(rows)
        return np.stack([plane.ravel()[place] for plane in self._state.u], axis=1)

    def _see(self, rows: Indices, others: Indices, weight: Floats) -> None:
        """Followers and leaders directly, frame points through those that they follow."""
        kinds = self._kinds[others]
        for kind, entries in ((FOLLOWER, self._now), (LEADER, self._led)):
            some = kinds == kind
            self._put(entries, rows[some], others[some], weight[some])
        frame, some = self._scene.frame, kinds == FRAME
        if frame is None or not some.any():
            return
        point = np.searchsorted(np.flatnonzero(self._kinds == FRAME), others[some])
        first = np.searchsorted(frame.map.point, point)
        last = np.searchsorted(frame.map.point, point + 1)
        for e in range(int((last - first).max(initial=0))):
            there = first + e < last
            entry = (first + e)[there]
            product = np.einsum(
                "eab,ebc->eac", weight[some][there], _matrices(frame.map.weight[entry])
            )
            follower, body = rows[some][there], frame.map.body[entry]
            of_leader = self._kinds[body] == LEADER
            free = self._before if frame.map.lag else self._now
            self._put(self._led, follower[of_leader], body[of_leader], product[of_leader])
            self._put(free, follower[~of_leader], body[~of_leader], product[~of_leader])

    def _put(self, entries: Parts, rows: Indices, columns: Indices, blocks: Floats) -> None:
        for a in (0, 1):
            for b in (0, 1):
                value = blocks[:, a, b]
                kept = value != 0.0
                row, column = self._unknown[rows[kept]], self._unknown[columns[kept]]
                entries.append((2 * row + a, 2 * column + b, value[kept]))


def _matrices(weights: Floats) -> Floats:
    return weights[:, None, None] * np.eye(2) if weights.ndim == 1 else weights


def _times(matrices: Floats, vectors: Floats) -> Floats:
    product: Floats = np.einsum("eab,eb->ea", matrices, vectors)
    return product


def _joined(parts: Parts, shape: tuple[int, int]) -> Entries:
    if not parts:
        nothing = np.empty(0, np.intp)
        return Entries(nothing, nothing, np.empty(0), shape)
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Entries(rows, columns, values, shape)
