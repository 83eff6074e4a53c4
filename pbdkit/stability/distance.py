"""Distance of a body from its equilibrium while leaders move at a steady speed.

In a step the leaders move first, then the followers. During a step, frame points have the
displacements from the end of the previous step. Frame points that follow leaders therefore have the
displacements that the leaders had at that time or, with frame delay, one step earlier. Let L be the
influence of leaders on followers, and S the part of L that acts by means of frame points. Then

    u(t+1) = P u(t) + Q u(t-1) + (L - S) u_L(t+1) + S u_L(t - d) + s,

If leaders move by v in a step, the equilibrium u* moves by δ, where A δ = L v and A = 1 - P - Q.
The distance e = u* - u from equilibrium satisfies

    e(t+1) = P e(t) + Q e(t-1) + δ + Q δ - (L - S) v + d S v,

and converges to a constant value. If S = 0 and Q = 0, the constant value satisfies A e = P δ. For
the barycentre rule on a sheet of length l, on a square lattice with spacing h, it is at most 4 v l²
/ (9 √3 h²).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.equilibrium.system import ACCURACY, StagnationError, System, solved
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER, distinct, slot_step
from pbdkit.linear.block_matrix import BlockMatrix
from pbdkit.linear.operator import Guiding, moves_and_couplings, step_operator
from pbdkit.linear.spectrum import excess
from pbdkit.model.motions import Oscillation
from pbdkit.plugin.units import Units, in_lengths
from pbdkit.scene.leader_groups import Leading, kinds_of_places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State


@dataclass(frozen=True)
class BoundaryCoupling:
    """Influence of leaders and frame points on the followers near them.

    Parameters
    ----------
    scene
        The scene.
    place
        Flat places of the followers that are influenced.
    couplings
        Derivatives ∂move/∂u of the moves of these followers. Columns are flat places.
    """

    scene: Scene
    place: Indices
    couplings: BlockMatrix

    def moves(self, u: Floats) -> Floats:
        """Return the moves of these followers, including relaxation, for displacements u. Both are
        arrays (axis, sublattice, cell, cell)."""
        result = np.zeros(u.shape)
        table = self.couplings.times(u.reshape(len(u), -1).T)
        relaxation = self.scene.experiment.stepping.relaxation
        result.reshape(len(u), -1)[:, self.place] = relaxation * table.T
        return result

    def frame_displacements(self, u: Floats) -> Floats:
        """Return the displacements that frame points have if the body has the displacements u. The
        result has the shape of u and is zero except at frame points."""
        result = np.zeros(u.shape)
        if frame := self.scene.frame:
            frame.follow(u.reshape(len(u), -1), result.reshape(len(u), -1))
        return result


def boundary_coupling(scene: Scene, state: State, step: int) -> BoundaryCoupling:
    """Linearise the moves of followers beside leaders and frame points, with the roles of a step.

    If the rule is applied to the moves of an inner rule, all followers are included.
    """
    raster, guiding = scene.raster, Guiding(scene, step)
    kind = kinds_of_places(raster, scene.leading, step)
    place = np.flatnonzero(kind == FOLLOWER)
    if not scene.inner:
        boundary = np.flatnonzero((kind == LEADER) | (kind == FRAME))
        boundary = np.concatenate([boundary, guiding.guided.place])
        neighbours = [
            boundary - slot_step(raster.shape, slot) for slot in scene.neighbourhood.every
        ]
        candidates = distinct(np.concatenate([*neighbours, boundary]).clip(0, kind.size - 1))
        place = candidates[kind[candidates] == FOLLOWER]
    _, couplings = moves_and_couplings(scene, state, place)
    couplings.parts = [
        (rows, places, guiding.turned(place[rows], blocks))
        for rows, places, blocks in couplings.parts
    ]
    return BoundaryCoupling(scene, place, couplings)


MAX_PRODUCTS = 2e8
"""Largest number of matrix products that are computed for the distance from equilibrium at the end
of an interval."""
EARLY_FRACTION = 0.01
"""Number of steps, divided by 1 / (1 - λ), up to which the decay of the distance is negligible."""
MIN_ACCURACY = 1e-12
"""Smallest tolerance of the linear solver."""


@dataclass(frozen=True)
class LeaderDistance:
    """Distance of the body from its equilibrium in the steps in which a leader moves fastest.

    Lengths are in lattice units. The results are valid for linear rules as long as no bond breaks.

    Parameters
    ----------
    first, last
        The first and the last of the steps in which a leader moves fastest.
    speed
        Displacement of the fastest leader in a step.
    steady
        Largest distance of a follower from its equilibrium after the distance has become constant.
    reached
        The distance at the end of these steps if the body starts in equilibrium. If computing all
        steps would take too long, the value is an estimate with an accuracy of 10 %. In this case
        it is None if the solver has momentum or the frame has a delay.
    """

    first: int
    last: int
    speed: float
    steady: float
    reached: float | None

    @property
    def size(self) -> float:
        """Return `reached` or, if it is None, `steady`."""
        return self.steady if self.reached is None else self.reached

    def late(self, bond: float, units: Units | None = None) -> list[str]:
        """Warn of a distance that is larger than the length `bond`. The message is in mm if the
        scene has units."""
        if self.size <= bond:
            return []
        mm, unit = in_lengths(units) if units else (1.0, "")
        speed, distance, length, bound = (
            f"{mm * number:.{digits}g} {unit}".rstrip()
            for number, digits in (
                *((self.speed, 4), (self.size, 3), (bond, 3)),
                (self.speed * bond / self.steady, 2),
            )
        )
        return [
            f"leaders: in steps {self.first} to {self.last} the fastest moves by {speed} per step, "
            f"which brings the body {distance} from equilibrium, more than a bond ({length}): the "
            f"strain of bonds depends on this speed; move by less than {bound} per step, or use "
            "solver: {type: equilibrium}"
        ]


@dataclass(frozen=True)
class DistanceIncrements:
    """Increments of the distance e = u* - u, as arrays (axis, sublattice, cell, cell).

    Parameters
    ----------
    first
        Increment in the first step.
    push
        Increment in each further step.
    steady
        A⁻¹ push.
    """

    first: Floats
    push: Floats
    steady: Floats

    @classmethod
    def of(
        cls, scene: Scene, system: System, state: State, step: int, slowness: float
    ) -> DistanceIncrements | None:
        """Compute the increments for the velocities that the leaders have in a step. Return None if
        the leaders influence no follower.

        Raises
        ------
        ExperimentError
            If there is no equilibrium.
        StagnationError
            If the linear solver does not converge.
        """
        coupling, v = (
            boundary_coupling(scene, state, step),
            np.zeros((scene.axes, *scene.raster.shape)),
        )
        for leading in scene.leading:
            if leading.group.leads(step):
                for axis in leading.axes:
                    v.reshape(scene.axes, -1)[axis, leading.place] = _velocity(leading, step)[
                        :, axis
                    ]
        direct, through_frame = coupling.moves(v), coupling.moves(coupling.frame_displacements(v))
        if not (direct + through_frame).any():
            return None
        size, accuracy = float(np.abs(v).max()), 0.1
        while True:
            # In A⁻¹ δ, the error of δ may be multiplied by the slowness.
            accuracy *= ACCURACY
            delta = system.solve(direct + through_frame, accuracy * size)
            first = delta - direct
            push = (
                first + scene.frame_delay * through_frame - scene.experiment.stepping.memory * delta
            )
            if scene.frame_delay:
                push += coupling.moves(coupling.frame_displacements(delta))
            steady = solved(system, push, slowness * float(np.abs(push).max()))
            error = slowness * accuracy * size
            if error <= ACCURACY * float(np.abs(steady).max()) or accuracy <= MIN_ACCURACY:
                return cls(first, push, steady)


def distance_from_equilibrium(
    scene: Scene, state: State, system_at: Callable[[int], System | None], slowness: float
) -> LeaderDistance | None:
    """Compute the distance from equilibrium in the interval of at least two steps in which a leader
    moves fastest.

    A displacement in a single step, or an oscillation, has no constant speed.

    Parameters
    ----------
    system_at
        Function that returns the equilibrium system with the roles of a step.
    slowness
        1 / (1 - λ) of the slowest mode.

    Returns
    -------
    LeaderDistance or None
        It is None if no leader moves at constant speed, or if the body has no equilibrium.
    """
    first, last, speed = fastest(scene)
    system = system_at(first) if speed else None
    if system is None:
        return None
    try:
        increments = DistanceIncrements.of(scene, system, state, first, slowness)
    except (ExperimentError, StagnationError):
        return None
    if increments is None:
        return None
    steps = last - first + 1
    reached = _reached_exactly(scene, increments, first, steps)
    if reached is None:
        reached = _reached_about(scene, increments, system, slowness, steps)
    return LeaderDistance(first, last, speed, _largest(increments.steady), reached)


def _reached_exactly(
    scene: Scene, increments: DistanceIncrements, first: int, steps: int
) -> float | None:
    """Compute max |e| after some steps, by computing each step. Return None if this would take too
    long."""
    if excess(scene) or steps * scene.raster.count > MAX_PRODUCTS:
        return None
    operator = step_operator(scene, step=first)
    parts = operator.couplings_current, operator.couplings_previous
    current, previous = (couplings.entries().matrix() for couplings in parts)
    if steps * (current.size if isinstance(current, np.ndarray) else current.nnz) > MAX_PRODUCTS:
        return None
    place = scene.raster.place_of(operator.followers)
    push, error = (
        e.reshape(len(e), -1)[:, place].T.ravel() for e in (increments.push, increments.first)
    )
    last_error = np.zeros_like(push)
    for _ in range(steps - 1):
        last_error, error = error, current @ error + previous @ last_error + push
    return _largest(error.reshape(-1, scene.axes).T)


def _reached_about(
    scene: Scene, increments: DistanceIncrements, system: System, slowness: float, steps: int
) -> float | None:
    """Compute max |e| after some steps without momentum, with an accuracy of 10 %. The formula is e
    = (1 - Pⁿ) A⁻¹ push.

    For few steps, the increments are added without decay. For more steps, P is projected onto the
    span of A⁻¹ push and A⁻² push.
    """
    if scene.frame_delay or scene.experiment.stepping.memory:
        return None
    e = increments.steady
    bound = min(_largest(e), steps * _largest(increments.push))
    if steps <= EARLY_FRACTION * slowness:
        return bound
    try:
        second = solved(system, e, slowness * float(np.abs(e).max()))
    except StagnationError:
        return None
    basis, images = (
        np.stack([a.ravel(), b.ravel()]) for a, b in ((e, second), (increments.push, e))
    )
    A = np.linalg.solve(basis @ basis.T, basis @ images.T)
    remainder = np.linalg.matrix_power(np.eye(2) - A, steps)[:, 0]
    return min(bound, _largest((1.0 - remainder[0]) * e - remainder[1] * second))


def _largest(planes: Floats) -> float:
    return float(np.sqrt((planes * planes).sum(axis=0).max()))


class Interval(NamedTuple):
    """Steps from `first` to `last`, in which the fastest leader moves by `speed` in each step."""

    first: int
    last: int
    speed: float


def fastest(scene: Scene) -> Interval:
    """Return the interval in which a leader moves fastest. It has at least two steps, and all
    velocities are constant in it."""
    steps, changes = scene.experiment.steps, [_changes(leading, scene) for leading in scene.leading]
    bounds = np.array(sorted({1, steps + 1, *chain(*changes)}))
    speeds = np.zeros(len(bounds) - 1)
    for leading, group_changes in zip(scene.leading, changes, strict=True):
        for first, end in pairwise(group_changes):
            speed = np.hypot(*_velocity(leading, first).T).max()
            section = speeds[np.searchsorted(bounds, first) : np.searchsorted(bounds, end)]
            np.maximum(section, speed, out=section)
    speeds[np.diff(bounds) < 2] = 0.0
    n = int(np.argmax(speeds))
    return Interval(int(bounds[n]), int(bounds[n + 1]) - 1, float(speeds[n]))


def _changes(leading: Leading, scene: Scene) -> list[int]:
    """Return the steps in which a group starts, ends or changes its velocity."""
    group = leading.group
    last = group.last(scene.experiment.steps)
    steps = {group.from_, last + 1, *(group.from_ + n for n in group.motion.knots())}
    return sorted(step for step in steps if group.from_ <= step <= last + 1)


def _velocity(leading: Leading, step: int) -> Floats:
    """Return the velocities of a group's particles in a step, (particle, axis). Rotations are
    included."""
    n, motion, at = step - leading.group.from_ + 1, leading.group.motion, leading.reference
    v = np.zeros_like(at)
    if not isinstance(motion, Oscillation):
        previous = motion.offset(n - 1, at) if n > 1 else 0.0
        v[:, list(leading.axes)] += (motion.offset(n, at) - previous)[..., list(leading.axes)]
    return v
