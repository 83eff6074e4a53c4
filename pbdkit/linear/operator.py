"""The step operator: the paper's "transformation operator between matrices" as a sparse matrix.

A step maps the displacements of the followers, with one unknown for each particle and axis, as

    u(t+1) = A u(t) + B u(t-1) + C u_L + f

with A = `current`, B = `previous`, C = `leader` and f = `source`. B is empty unless the frame has a
delay or the solver has momentum. Loads are part of f.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pbdkit.array_types import Floats, Indices, Integers
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import EMPTY, FOLLOWER, FRAME, LEADER, slot_step
from pbdkit.linear.block_matrix import BlockMatrix, CoordinateMatrix, frame_matrices
from pbdkit.linear.response import by_sublattice, has_neighbours, respond
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.leaders import Guidance
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    import scipy.sparse


class Guiding:
    """Guided particles of a step. Their motion is prescribed along some axes and free along the
    others.

    Attributes
    ----------
    free : (particle, axis, axis)
        Identity along the free axes, zero elsewhere.
    turns : (particle, axis, axis)
        Matrix T of each particle, which maps its unconstrained move to its constrained move. Along
        free axes the result is the move, plus fractions of the move along prescribed axes
        (`pbdkit.stepping.leaders`).
    """

    def __init__(self, scene: Scene, step: int) -> None:
        guidance = Guidance(scene)
        self.guided = guided = guidance.at(step)
        self.free = np.eye(scene.axes) * ~guided.lead_axes.T[:, None]
        self.turns = self.free + guidance.shares(step)

    def __bool__(self) -> bool:
        return len(self.guided.place) > 0

    def numbers(self, place: Indices) -> Indices:
        """Return the index of the guided particle at each flat place, -1 where there is none."""
        if not self:
            return np.full(len(place), -1)
        order = np.argsort(self.guided.place)
        at = np.searchsorted(self.guided.place, place, sorter=order).clip(max=len(order) - 1)
        return np.where(self.guided.place[order[at]] == place, order[at], -1)

    def turned(self, place: Indices, values: Floats) -> Floats:
        """Return the constrained moves of particles at flat places, given the unconstrained moves.
        The shape is (particle, axis, ...), so that blocks of a matrix can be given in place of
        moves."""
        numbers = self.numbers(place)
        if not (rows := np.flatnonzero(numbers >= 0)).size:
            return values
        turned = values.copy()
        turned[rows] = np.einsum("eab,eb...->ea...", self.turns[numbers[rows]], values[rows])
        return turned

    def put(
        self, free: BlockMatrix, leader: BlockMatrix, rows: Indices, places: Indices,
        numbers: tuple[Indices, Indices], blocks: Floats,
    ) -> None:  # fmt: skip
        """Add the blocks of followers to `free`. The blocks of guided particles are split between
        `free` and `leader`.

        Parameters
        ----------
        free, leader
            Matrices for free unknowns (`free`) and for prescribed displacements (`leader`). Blocks
            are added to both.
        rows, places
            Row and flat place of each block.
        numbers
            Two indices for each block: the number of its unknown, and the number of its prescribed
            displacement.
        blocks : (entry, axis, axis)
            ∂move/∂u.
        """
        guided_numbers = self.numbers(places)
        if (guided := np.flatnonzero(guided_numbers >= 0)).size:
            all_blocks, blocks = blocks[guided], blocks.copy()
            free_axes = self.free[guided_numbers[guided]]
            blocks[guided] = np.einsum("eab,ebc->eac", all_blocks, free_axes)
            leader.add(rows[guided], numbers[1][guided], all_blocks - blocks[guided])
        free.add(rows, numbers[0], blocks)


@dataclass(frozen=True)
class StepOperator:
    """One step, linearised at a state. Roles are constant and leaders are at rest.

    In the plane, unknown 2n is the x displacement of the n-th follower, and unknown 2n + 1 its y
    displacement; leaders are numbered in the same way. The attributes `couplings_...` contain the
    same matrices as the methods, as blocks between particles.

    Parameters
    ----------
    followers, leaders
        Rows of followers and of leaders in the particle table. Guided particles are contained in
        both.
    couplings_current, couplings_previous, couplings_leader
        ∂u(t+1)/∂u(t), ∂u(t+1)/∂u(t-1) and ∂u(t+1)/∂u_L.
    couplings_frame
        The part of `couplings_leader` that acts through frame points.
    source : (unknown,)
        Displacement that a step adds at u = 0. It consists of the effect of loads and of the
        remainder of the linearisation.
    prescribed_unknowns
        Unknowns of guided particles along prescribed axes. Their rows and columns are empty.
    """

    followers: Indices
    leaders: Indices
    couplings_current: BlockMatrix
    couplings_previous: BlockMatrix
    couplings_leader: BlockMatrix
    couplings_frame: BlockMatrix
    source: Floats
    prescribed_unknowns: Indices

    @property
    def couplings_steady(self) -> BlockMatrix:
        """Return `couplings_current` + `couplings_previous`, the matrix of a step if u(t-1) =
        u(t)."""
        current = self.couplings_current
        return BlockMatrix(
            current.shape, current.axes, current.parts + self.couplings_previous.parts
        )

    @cached_property
    def current(self) -> scipy.sparse.csr_array:
        """Assemble the matrix ∂u(t+1)/∂u(t)."""
        return self.couplings_current.entries().sparse()

    @cached_property
    def previous(self) -> scipy.sparse.csr_array:
        """Assemble the matrix ∂u(t+1)/∂u(t-1)."""
        return self.couplings_previous.entries().sparse()

    @cached_property
    def leader(self) -> scipy.sparse.csr_array:
        """Assemble the matrix ∂u(t+1)/∂u_L of derivatives with respect to prescribed
        displacements."""
        return self.couplings_leader.entries().sparse()

    def augmented(self) -> CoordinateMatrix:
        """Return the operator on the pair (u(t), u(t-1)), or on u(t) only if the step does not
        depend on u(t-1).

        Prescribed unknowns are omitted.
        """
        parts = self.couplings_current, self.couplings_previous
        current, previous = (
            couplings.entries().without(self.prescribed_unknowns) for couplings in parts
        )
        if not len(previous.values):
            return current
        size = current.shape[0]
        unknowns, shape = np.arange(size), (2 * size, 2 * size)
        upper = CoordinateMatrix(previous.rows, previous.columns + size, previous.values, shape)
        return current.plus(upper).plus(
            CoordinateMatrix(unknowns + size, unknowns, np.ones(size), shape)
        )


def step_operator(
    scene: Scene, state: State | None = None, step: int | None = None
) -> StepOperator:
    """Assemble the step operator of a scene, including relaxation, momentum and frame.

    Parameters
    ----------
    scene
        Scene with the rule that is linearised.
    state
        State at which the rule is linearised; by default the initial state.
    step
        Step that determines roles and loads; by default the last step.

    Raises
    ------
    ExperimentError
        If neighbours are searched at every step.
    """
    if scene.experiment.neighbours.nearness():
        text = (
            "there is no step operator if neighbours are re-evaluated; set "
            "neighbours.reevaluate: false"
        )
        raise ExperimentError(text, ("neighbours",))
    state, step = state or initial_state(scene), step or scene.experiment.steps
    return _Assembly(scene, state, step).operator()


def moves_and_couplings(scene: Scene, state: State, place: Indices) -> tuple[Floats, BlockMatrix]:
    """Compute the moves of particles and their derivatives ∂move/∂u.

    Parameters
    ----------
    place
        Flat places of the particles.

    Returns
    -------
    moves : (particle, axis)
        Moves at `state`.
    couplings
        ∂move/∂u, rows in the order of `place`, columns by flat place.
    """
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
    chain = _followed(scene).entries().sparse() @ inner.entries().sparse()
    product = (outer.entries().sparse() @ chain).tobsr((scene.axes, scene.axes))
    product.sum_duplicates()
    rows = np.repeat(np.arange(len(place)), np.diff(product.indptr))
    couplings = BlockMatrix(outer.shape, scene.axes)
    couplings.add(rows, product.indices, product.data)
    return moves, couplings


def _followed(scene: Scene) -> BlockMatrix:
    """Return the matrix that maps the displacements of the body to the displacements of body and
    frame. Rows are flat places, and columns are the particles of the body in their order."""
    raster = scene.raster
    body, place = raster.body_rows, raster.place_of(np.arange(raster.count))
    followed = BlockMatrix((raster.kind.size, len(body)), scene.axes)
    identity = np.broadcast_to(np.eye(scene.axes), (len(body), scene.axes, scene.axes))
    followed.add(place[body], np.arange(len(body)), identity)
    if scene.frame:
        point = np.setdiff1d(np.arange(raster.count), body)[scene.frame.map.point]
        column = np.searchsorted(body, scene.frame.map.body)
        followed.add(place[point], column, frame_matrices(scene.frame.map.weight, scene.axes))
    return followed


def _directly(scene: Scene, state: State, place: Indices) -> tuple[Floats, BlockMatrix]:
    """Compute moves and couplings with the scene's own rule, without an inner rule. Particles
    without neighbours do not move."""
    kind, moves = scene.raster.kind.ravel(), np.zeros((len(place), scene.axes))
    couplings = BlockMatrix((len(place), kind.size), scene.axes)
    moving = np.flatnonzero(has_neighbours(scene, place)).astype(np.int32)
    for s, numbers in by_sublattice(scene, place[moving]):
        rows = moving[numbers]
        (response,) = respond(scene, state, s, place[rows])
        moves[rows] = response.of_each(response.answer)
        steps = [0, *(slot_step(scene.raster.shape, slot) for slot in response.neighbours)]
        ends = place[rows] + np.array(steps)[:, None]
        blocks = np.stack([response.centre, *response.neighbours.values()])
        slot, row = np.nonzero(kind[ends] != EMPTY)
        couplings.add(rows[row], ends[slot, row], blocks[slot, response.kind[row]])
    return moves, couplings


class _Assembly:
    """Assemble the couplings. Particles are looked up by their flat place on the raster."""

    def __init__(self, scene: Scene, state: State, step: int) -> None:
        self._scene, self._state, self._step = scene, state, step
        raster, kinds = scene.raster, kinds_at(scene.raster, scene.leading, step)
        self._kind = np.full(raster.kind.size, EMPTY, np.int8)
        self._unknown = np.full(raster.kind.size, -1, np.int32)
        self._guiding = guiding = Guiding(scene, step)
        rows = {kind: np.flatnonzero(kinds == kind) for kind in (FRAME, LEADER, FOLLOWER)}
        rows[FOLLOWER] = np.sort(np.concatenate([rows[FOLLOWER], guiding.guided.rows]))
        self._as_leader = self._unknown
        for kind, members in rows.items():
            place = raster.place_of(members)
            self._kind[place] = kind
            self._unknown[place] = np.arange(len(members))
            if kind == LEADER and guiding:
                self._as_leader = self._unknown.copy()
        self._followers, self._leaders = rows[FOLLOWER], rows[LEADER]
        free, leaders = len(self._followers), len(self._leaders)
        self._current, self._previous = (BlockMatrix((free, free), scene.axes) for _ in range(2))
        self._leader, self._frame_leader = (
            BlockMatrix((free, leaders), scene.axes) for _ in range(2)
        )

    def operator(self) -> StepOperator:
        scene, solver, u = self._scene, self._scene.experiment.stepping, self._state.u
        place = scene.raster.place_of(self._followers)
        moves, couplings = moves_and_couplings(scene, self._state, place)
        self._add_identity(self._current, place, np.arange(len(place), dtype=np.int32), 1.0)
        moves = self._guiding.turned(place, moves)
        couplings.parts = [
            (rows, places, self._guiding.turned(place[rows], blocks))
            for rows, places, blocks in couplings.parts
        ]
        for rows, places, blocks in couplings.parts:
            self._add(rows, places, solver.relaxation * blocks)
        if solver.memory:
            moving = np.flatnonzero(has_neighbours(scene, place))
            self._add_identity(self._current, place, moving, solver.memory)
            self._add_identity(self._previous, place, moving, -solver.memory)
        if u.any():
            moves = moves - couplings.times(u.reshape(scene.axes, -1).T.astype(float, copy=False))
        if scene.loads:
            moves = moves + self._load_moves(place)
        source, members = (solver.relaxation * moves).ravel(), (self._followers, self._leaders)
        axis, guided_number = np.nonzero(self._guiding.guided.lead_axes)
        unknown = self._unknown[self._guiding.guided.place[guided_number]]
        couplings_by_source = self._current, self._previous, self._leader, self._frame_leader
        return StepOperator(
            *members, *couplings_by_source, source, np.sort(scene.axes * unknown + axis)
        )

    def _add_identity(
        self, couplings: BlockMatrix, place: Indices, rows: Indices, factor: float
    ) -> None:
        """Add factor · 1 along the free axes of followers."""
        numbers = self._guiding.numbers(place[rows])
        couplings.add_scaled_identity(rows[numbers < 0], factor)
        guided = np.flatnonzero(numbers >= 0)
        couplings.add(rows[guided], rows[guided], factor * self._guiding.free[numbers[guided]])

    def _load_moves(self, place: Indices) -> Floats:
        """Compute what the loads of the step add to the moves, (follower, axis)."""
        added = SlotFollowers(self._scene).load_moves(self._state.u, self._state, self._step)
        return added.reshape(self._scene.axes, -1)[:, place].T

    def _add(self, rows: Integers, places: Indices, blocks: Floats) -> None:
        """Add blocks. Blocks of followers and leaders are added directly. Blocks of frame points
        are distributed over the body particles that the points follow."""
        by_frame, frame = self._kind[places] == FRAME, self._scene.frame
        if frame is not None and by_frame.any():
            first, last = (
                np.searchsorted(frame.map.point, self._unknown[places[by_frame]], side)
                for side in ("left", "right")
            )
            count = np.ones(len(places), np.intp)
            count[by_frame] = last - first
            offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            start = np.zeros(len(places), np.intp)
            start[by_frame] = first
            rows, places, blocks, by_frame, entry = (
                np.repeat(values, count, axis=0)
                for values in (rows, places, blocks, by_frame, start)
            )
            entry = (entry + offset)[by_frame]
            frame_weights = frame_matrices(frame.map.weight[entry], self._scene.axes)
            places[by_frame] = frame.body_place[entry]
            blocks[by_frame] = np.einsum("eab,ebc->eac", blocks[by_frame], frame_weights)
        is_leader, is_follower = (self._kind[places] == kind for kind in (LEADER, FOLLOWER))
        self._leader.add(rows[is_leader], self._as_leader[places[is_leader]], blocks[is_leader])
        through_frame = is_leader & by_frame
        leaders = self._as_leader[places[through_frame]]
        self._frame_leader.add(rows[through_frame], leaders, blocks[through_frame])
        delayed = by_frame if frame is not None and frame.map.delay else np.zeros_like(by_frame)
        discarded = BlockMatrix((0, 0), 0)
        for couplings, leads, selected in (
            (self._current, self._leader, is_follower & ~delayed),
            (self._previous, self._leader, is_follower & delayed),
            (discarded, self._frame_leader, is_follower & by_frame),
        ):
            numbers = self._unknown[places[selected]], self._as_leader[places[selected]]
            self._guiding.put(
                couplings, leads, rows[selected], places[selected], numbers, blocks[selected]
            )
