"""Lag of a body behind its equilibrium while leaders move at a steady speed, computed from the
influence of leaders and frame points on followers.

A step places the leaders first, then followers look; frame points still stand as at the end of the
step before, and those that follow leaders show where these stood (with the frame's lag, one step
earlier still). With S the share of L that frame points show,

    u(t+1) = P u(t) + Q u(t-1) + (L - S) u_L(t+1) + S u_L(t - lag) + s,

and leaders that move by v a step, the equilibrium u* moves by δ, A δ = L v, A = 1 - P - Q. The
distance e = u* - u obeys

    e(t+1) = P e(t) + Q e(t-1) + δ + Q δ - (L - S) v + lag · S v,

and becomes steady: A e = P δ where S = 0 and Q = 0. For the barycentre on a sheet of the square
lattice, l long between its ends and with spacing h, that is at most 4 v l² / (9 √3 h²).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.system import ACCURACY, StuckError, System, solved
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER, slot_step
from pbdkit.linear.operator import Guiding, moves_and_couplings, step_operator
from pbdkit.linear.spectrum import Couplings, excess
from pbdkit.model.motions import Oscillation
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.units import Units, in_lengths
from pbdkit.scene.leaders import Leading, kinds_of_places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Edge:
    """The followers at flat places `place`, with ∂move/∂u of their moves, columns by flat
    place."""

    scene: Scene
    place: Indices
    couplings: Couplings

    def moves(self, u: Floats) -> Floats:
        """Planes: what these followers do, relaxed, where others stand at u, planes too."""
        found = np.zeros(u.shape)
        table = self.couplings.times(u.reshape(len(u), -1).T)
        relaxation = self.scene.experiment.stepping.relaxation
        found.reshape(len(u), -1)[:, self.place] = relaxation * table.T
        return found

    def shown(self, u: Floats) -> Floats:
        """Planes: what frame points show of u, nothing elsewhere."""
        found = np.zeros(u.shape)
        if frame := self.scene.frame:
            frame.follow(u.reshape(len(u), -1), found.reshape(len(u), -1))
        return found


def edge_of(scene: Scene, state: State, step: int) -> Edge:
    """At a state, with the roles of a step; of all followers where a rule works on the moves of
    another."""
    raster, guiding = scene.raster, Guiding(scene, step)
    kind = kinds_of_places(raster, scene.leading, step)
    place = np.flatnonzero(kind == FOLLOWER)
    if not scene.inner:
        seen = np.flatnonzero((kind == LEADER) | (kind == FRAME))
        seen = np.concatenate([seen, guiding.guided.place])
        beside = [seen - slot_step(raster.shape, slot) for slot in scene.neighbourhood.every]
        some = np.unique(np.concatenate([*beside, seen])).clip(0, kind.size - 1)
        place = some[kind[some] == FOLLOWER]
    _, couplings = moves_and_couplings(scene, state, place)
    couplings.parts = [
        (rows, there, guiding.turned(place[rows], blocks))
        for rows, there, blocks in couplings.parts
    ]
    return Edge(scene, place, couplings)


DEAREST = 2e8
"""Products of numbers that are made at most to know the lag at the end of an interval."""
EARLY = 0.01
"""Up to this share of 1 / (1 - λ) hardly anything fades that was pushed."""
FINEST = 1e-12
"""The finest accuracy asked for."""


@dataclass(frozen=True)
class Lag:
    """In steps `first` to `last` the fastest leader moves by `speed` a step. The follower that
    trails its equilibrium most does so by `steady` once that has become steady, and by `reached`
    at the end of these steps, where they found the body in equilibrium: within 10 % where following
    it would take too long, None where that is so and the step has a memory. Lengths in lattice
    units; they hold for linear rules as long as no bond breaks."""

    first: int
    last: int
    speed: float
    steady: float
    reached: float | None

    @property
    def size(self) -> float:
        """What is reached, as far as that is known."""
        return self.steady if self.reached is None else self.reached

    def late(self, bond: float, units: Units | None = None) -> list[str]:
        """A warning where the body is left behind its equilibrium by more than a bond; in mm where
        there are units."""
        if self.size <= bond:
            return []
        mm, word = in_lengths(units) if units else (1.0, "")
        speed, behind, length, slower = (
            f"{mm * number:.{digits}g} {word}".rstrip()
            for number, digits in (
                *((self.speed, 4), (self.size, 3), (bond, 3)),
                (self.speed * bond / self.steady, 2),
            )
        )
        return [
            f"leaders: in steps {self.first} to {self.last} the fastest moves by {speed} a step "
            f"and leaves the body {behind} behind its equilibrium, more than a bond ({length}): "
            f"its speed decides how far bonds stretch; move by less than {slower} a step, or take "
            "solver: {type: equilibrium}"
        ]


@dataclass(frozen=True)
class Trail:
    """What drives the distance e = u* - u, planes: e gains `first` in the first step and `push` in
    each of the others; `steady` is A⁻¹ push."""

    first: Floats
    push: Floats
    steady: Floats

    @classmethod
    def of(
        cls, scene: Scene, system: System, state: State, step: int, slowness: float
    ) -> Trail | None:
        """At the velocities of a step; None where nobody feels the leaders. Raises ExperimentError
        where there is no equilibrium, and StuckError."""
        edge, v = edge_of(scene, state, step), np.zeros((scene.axes, *scene.raster.shape))
        for leading in scene.leading:
            if leading.group.leads(step):
                for axis in leading.axes:
                    v.reshape(scene.axes, -1)[axis, leading.place] = _velocity(leading, step)[
                        :, axis
                    ]
        direct, shown = edge.moves(v), edge.moves(edge.shown(v))
        if not (direct + shown).any():
            return None
        size, accuracy = float(np.abs(v).max()), 0.1
        while True:
            # What is wrong with δ may grow by the slowness in A⁻¹ δ.
            accuracy *= ACCURACY
            delta = system.solve(direct + shown, accuracy * size)
            first = delta - direct
            push = first + scene.lag * shown - scene.experiment.stepping.memory * delta
            if scene.lag:
                push += edge.moves(edge.shown(delta))
            steady = solved(system, push, slowness * float(np.abs(push).max()))
            wrong = slowness * accuracy * size
            if wrong <= ACCURACY * float(np.abs(steady).max()) or accuracy <= FINEST:
                return cls(first, push, steady)


def lag_of(
    scene: Scene, state: State, system_at: Callable[[int], System | None], slowness: float
) -> Lag | None:
    """The lag in the fastest interval of two steps or more: a jump of one step has no speed, nor
    has a leader that swings. None where no leader moves so, or the body has no equilibrium.

    `system_at` gives the system of the scene's equilibrium with the roles of a step.
    """
    first, last, speed = fastest(scene)
    system = system_at(first) if speed else None
    if system is None:
        return None
    try:
        trail = Trail.of(scene, system, state, first, slowness)
    except (ExperimentError, StuckError):
        return None
    if trail is None:
        return None
    steps = last - first + 1
    reached = _reached_exactly(scene, trail, first, steps)
    if reached is None:
        reached = _reached_about(scene, trail, system, slowness, steps)
    return Lag(first, last, speed, _largest(trail.steady), reached)


def _reached_exactly(scene: Scene, trail: Trail, first: int, steps: int) -> float | None:
    """max |e| at the end of so many steps, step by step; None where that would take too long."""
    if excess(scene) or steps * scene.raster.count > DEAREST:
        return None
    operator = step_operator(scene, step=first)
    parts = operator.couplings_now, operator.couplings_before
    now, before = (couplings.entries().matrix() for couplings in parts)
    if steps * (now.size if isinstance(now, np.ndarray) else now.nnz) > DEAREST:
        return None
    place = scene.raster.place_of(operator.followers)
    push, error = (e.reshape(len(e), -1)[:, place].T.ravel() for e in (trail.push, trail.first))
    earlier = np.zeros_like(push)
    for _ in range(steps - 1):
        earlier, error = error, now @ error + before @ earlier + push
    return _largest(error.reshape(-1, scene.axes).T)


def _reached_about(
    scene: Scene, trail: Trail, system: System, slowness: float, steps: int
) -> float | None:
    """The same where the step has no memory, e = (1 - Pⁿ) A⁻¹ push, within 10 %: at first all
    pushes together, later with P on the span of A⁻¹ push and A⁻² push."""
    if scene.lag or scene.experiment.stepping.memory:
        return None
    e = trail.steady
    most = min(_largest(e), steps * _largest(trail.push))
    if steps <= EARLY * slowness:
        return most
    try:
        further = solved(system, e, slowness * float(np.abs(e).max()))
    except StuckError:
        return None
    basis, images = (np.stack([a.ravel(), b.ravel()]) for a, b in ((e, further), (trail.push, e)))
    A = np.linalg.solve(basis @ basis.T, basis @ images.T)
    left = np.linalg.matrix_power(np.eye(2) - A, steps)[:, 0]
    return min(most, _largest((1.0 - left[0]) * e - left[1] * further))


def _largest(planes: Floats) -> float:
    return float(np.sqrt((planes * planes).sum(axis=0).max()))


class Interval(NamedTuple):
    """Steps from `first` to `last` in which the fastest leader moves by `speed` a step."""

    first: int
    last: int
    speed: float


def fastest(scene: Scene) -> Interval:
    """The steps, two at least, in which all leaders keep their velocities and one moves
    fastest."""
    steps, moments = scene.experiment.steps, [_moments(each, scene) for each in scene.leading]
    every = np.array(sorted({1, steps + 1, *chain(*moments)}))
    speeds = np.zeros(len(every) - 1)
    for leading, own in zip(scene.leading, moments, strict=True):
        for first, after in pairwise(own):
            speed = np.hypot(*_velocity(leading, first).T).max()
            some = speeds[np.searchsorted(every, first) : np.searchsorted(every, after)]
            np.maximum(some, speed, out=some)
    speeds[np.diff(every) < 2] = 0.0
    n = int(np.argmax(speeds))
    return Interval(int(every[n]), int(every[n + 1]) - 1, float(speeds[n]))


def _moments(leading: Leading, scene: Scene) -> list[int]:
    """When the group begins, ends or changes its velocity."""
    group = leading.group
    last = group.last(scene.experiment.steps)
    some = {group.from_, last + 1, *(group.from_ + n for n in group.motion.knots())}
    return sorted(m for m in some if group.from_ <= m <= last + 1)


def _velocity(leading: Leading, step: int) -> Floats:
    """Of a group's particles in a step, (particle, axis); a rotation turns it on the way."""
    n, motion, at = step - leading.group.from_ + 1, leading.group.motion, leading.reference
    v = np.zeros_like(at)
    if not isinstance(motion, Oscillation):
        before = motion.offset(n - 1, at) if n > 1 else 0.0
        v[:, list(leading.axes)] += (motion.offset(n, at) - before)[..., list(leading.axes)]
    return v
