"""How far a body trails its equilibrium while leaders move at a steady speed.

A step puts leaders in place first, then followers look; frame points still stand as at the end of
the step before, and those that follow leaders show where these stood (with the frame's lag, a step
earlier yet). With S the share of L that frame points show,

    u(t+1) = P u(t) + Q u(t-1) + (L - S) u_L(t+1) + S u_L(t - lag) + s,

and leaders that move by v a step, the equilibrium u* moves by δ, A δ = L v, A = 1 - P - Q. The
distance e = u* - u obeys

    e(t+1) = P e(t) + Q e(t-1) + δ + Q δ - (L - S) v + lag · S v,

and becomes steady: A e = P δ where S = 0 and Q = 0. For the barycentre on a sheet of the square
lattice, l long between its ends and h apart, that is 4 v l² / (9 √3 h²) at most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.matrices import connected
from pbdkit.analysis.operator import StepOperator, step_operator
from pbdkit.experiment.motions import Oscillation
from pbdkit.scene.leading import Leading
from pbdkit.scene.scene import Scene

Floats = NDArray[np.float64]
Solve = Callable[[Floats], Floats]
DEAREST = 2e8
"""Products of numbers that are made at most to know the lag at the end of an interval."""
WORST = 1e12
"""Matrices that stretch some vectors by so much more than others count as singular."""


@dataclass(frozen=True)
class Lag:
    """In steps `first` to `last` the fastest leader moves by `speed` a step. The follower that
    trails its equilibrium most does so by `steady` once that has become steady, and by `reached`
    at the end of these steps, where they found the body in equilibrium; None where that would take
    too long. Lengths in lattice units; exact for linear rules as long as no bond breaks."""

    first: int
    last: int
    speed: float
    steady: float
    reached: float | None

    @property
    def size(self) -> float:
        """What is reached, as far as that is known."""
        return self.steady if self.reached is None else self.reached


@dataclass(frozen=True)
class _Interval:
    """Steps in which all leaders keep their velocities, (particle, axis) for each leading group."""

    first: int
    last: int
    velocities: tuple[tuple[Leading, Floats], ...]

    @property
    def speed(self) -> float:
        """Of the fastest leader."""
        return max((float(np.hypot(*v.T).max()) for _, v in self.velocities), default=0.0)


def lag_of(scene: Scene) -> Lag | None:
    """The lag in the fastest interval of two steps or more: a jump of one step has no speed, nor
    has a leader that swings. None where no leader moves so, or the body has no equilibrium.

    Raises ExperimentError where neighbours are found anew.
    """
    intervals = [i for i in _intervals(scene) if i.last > i.first]
    fastest = max(intervals, key=lambda i: i.speed, default=None)
    if fastest is None or fastest.speed == 0.0:
        return None
    operator = step_operator(scene, step=fastest.first)
    v = np.zeros((len(operator.leaders), 2))
    for leading, velocity in fastest.velocities:
        v[np.searchsorted(operator.leaders, leading.rows)] = velocity
    trailing = _trailing(operator, v, scene.frame.map.lag if scene.frame else 0)
    if trailing is None:
        return None
    steps = fastest.last - fastest.first + 1
    return Lag(fastest.first, fastest.last, fastest.speed, trailing.steady(), trailing.after(steps))


def _intervals(scene: Scene) -> Iterator[_Interval]:
    """Between any two moments at which a leader group begins, ends or changes its velocity."""
    steps = scene.experiment.steps
    moments = {1, steps + 1}
    for leading in scene.leading:
        group = leading.group
        moments |= {group.from_, group.last(steps) + 1}
        moments |= {group.from_ + n for n in group.motion.knots()}
    for first, after in pairwise(sorted(m for m in moments if 1 <= m <= steps + 1)):
        some = [leading for leading in scene.leading if leading.group.leads(first)]
        velocities = tuple((leading, _velocity(leading, first)) for leading in some)
        yield _Interval(first, after - 1, velocities)


def _velocity(leading: Leading, step: int) -> Floats:
    """Of a group's particles in a step, (particle, axis); a rotation turns it on the way."""
    n, motion, at = step - leading.group.from_ + 1, leading.group.motion, leading.reference
    if isinstance(motion, Oscillation):
        return np.zeros_like(at, dtype=float)
    before = motion.offset(n - 1, at) if n > 1 else 0.0
    velocity: Floats = np.zeros_like(at, dtype=float) + (motion.offset(n, at) - before)
    return velocity


@dataclass(frozen=True)
class _Trailing:
    """The recurrence of e for the unknowns `who` that moving leaders reach: P, Q, what solves
    A x = b, and what pushes in the first step, and in all others."""

    who: NDArray[np.intp]
    now: Any
    before: Any
    solve: Solve
    first_push: Floats
    push: Floats

    def steady(self) -> float:
        """The largest distance once it is steady."""
        return self._largest(self.solve(self.push))

    def after(self, steps: int) -> float | None:
        """The largest distance after so many steps; None where that is too dear."""
        dense = isinstance(self.now, np.ndarray)
        if steps * (self.now.size if dense else self.now.nnz) > DEAREST:
            return None
        before, error = np.zeros_like(self.push), self.first_push
        for _ in range(steps - 1):
            before, error = error, self.now @ error + self.before @ before + self.push
        return self._largest(error)

    def _largest(self, error: Floats) -> float:
        return float(np.sqrt(np.bincount(self.who // 2, error * error).max()))


def _trailing(operator: StepOperator, v: Floats, lag: int) -> _Trailing | None:
    """None where no follower feels the leaders, or A has no inverse."""
    pull = operator.couplings_led.times(v).ravel()
    shown = operator.couplings_shown.times(v).ravel()
    both = operator.entries_now.plus(operator.entries_before).matrix()
    _, label = connected(both, strongly=False)
    who = np.flatnonzero(np.isin(label, label[pull != 0.0]))
    solve = _solver(both[who][:, who]) if len(who) else None
    if solve is None:
        return None
    now, before = (
        entries.matrix()[who][:, who] for entries in (operator.entries_now, operator.entries_before)
    )
    pull, shown = pull[who], shown[who]
    delta = solve(pull)
    first_push = delta - (pull - shown)
    push = first_push + before @ delta + lag * shown
    return _Trailing(who, now, before, solve, first_push, push)


def _solver(step: Any) -> Solve | None:
    """What solves (1 - step) x = b; None for a singular matrix."""
    size = step.shape[0]
    if isinstance(step, np.ndarray):
        matrix = np.eye(size) - step
        if not np.linalg.cond(matrix) < WORST:
            return None
        return lambda b: np.asarray(np.linalg.solve(matrix, b))
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    try:
        factors = splu((eye_array(size) - step).tocsc(), permc_spec="MMD_AT_PLUS_A")
    except RuntimeError:  # "Factor is exactly singular"
        return None
    pivots = np.abs(factors.U.diagonal())
    if not pivots.max() < WORST * pivots.min():
        return None
    return lambda b: np.asarray(factors.solve(b))
