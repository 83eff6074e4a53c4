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

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import connected, one_minus
from pbdkit.analysis.operator import step_operator
from pbdkit.experiment.leaders import Oscillation
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
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

    def late(self, bond: float) -> list[str]:
        """A warning where the body is left behind its equilibrium by more than a bond."""
        if self.size <= bond:
            return []
        return [
            f"leaders: in steps {self.first} to {self.last} the fastest moves by "
            f"{self.speed:.4g} a step and leaves the body {self.size:.3g} behind its "
            f"equilibrium, more than a bond ({bond:.3g}): its speed decides how far bonds stretch; "
            f"move by less than {self.speed * bond / self.steady:.2g} a step, or take "
            "solver: {type: equilibrium}"
        ]


def lag_of(scene: Scene) -> Lag | None:
    """The lag in the fastest interval of two steps or more: a jump of one step has no speed, nor
    has a leader that swings. None where no leader moves so, or the body has no equilibrium.

    Raises ExperimentError where neighbours are found anew.
    """
    first, last, speed = _fastest(scene)
    if speed == 0.0:
        return None
    operator = step_operator(scene, step=first)
    v = np.zeros((len(operator.leaders), 2))
    for leading in scene.leading:
        if leading.group.leads(first):
            v[np.searchsorted(operator.leaders, leading.rows)] = _velocity(leading, first)
    pull, shown = (c.times(v).ravel() for c in (operator.couplings_led, operator.couplings_shown))
    both = operator.couplings_both.entries().matrix()
    _, label = connected(both, strongly=False)
    who = np.flatnonzero(np.isin(label, label[pull != 0.0]))
    solve = _solver(both[who][:, who]) if len(who) else None
    if solve is None:
        return None
    parts = operator.couplings_now, operator.couplings_before
    now, before = (couplings.entries().matrix()[who][:, who] for couplings in parts)
    delta = solve(pull[who])
    first_push = delta - (pull - shown)[who]
    push = first_push + before @ delta + scene.lag * shown[who]

    def largest(error: Floats) -> float:
        return float(np.sqrt(np.bincount(who // 2, error * error).max()))

    steady, steps = largest(solve(push)), last - first + 1
    if steps * (now.size if isinstance(now, np.ndarray) else now.nnz) > DEAREST:
        return Lag(first, last, speed, steady, None)
    earlier, error = np.zeros_like(push), first_push
    for _ in range(steps - 1):
        earlier, error = error, now @ error + before @ earlier + push
    return Lag(first, last, speed, steady, largest(error))


def _fastest(scene: Scene) -> tuple[int, int, float]:
    """(first, last, speed): the steps, two at least, in which all leaders keep their velocities and
    one moves fastest."""
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
    return int(every[n]), int(every[n + 1]) - 1, float(speeds[n])


def _moments(leading: Leading, scene: Scene) -> list[int]:
    """When the group begins, ends or changes its velocity."""
    group = leading.group
    last = group.last(scene.experiment.steps)
    some = {group.from_, last + 1, *(group.from_ + n for n in group.motion.knots())}
    return sorted(m for m in some if group.from_ <= m <= last + 1)


def _velocity(leading: Leading, step: int) -> Floats:
    """Of a group's particles in a step, (particle, axis); a rotation turns it on the way."""
    n, motion, at = step - leading.group.from_ + 1, leading.group.motion, leading.reference
    if isinstance(motion, Oscillation):
        return np.zeros_like(at)
    before = motion.offset(n - 1, at) if n > 1 else 0.0
    return np.zeros_like(at) + (motion.offset(n, at) - before)


def _solver(step: Any) -> Callable[[Floats], Floats] | None:
    """What solves (1 - step) x = b; None for a singular matrix."""
    matrix = one_minus(step)
    if isinstance(matrix, np.ndarray):
        regular = np.linalg.cond(matrix) < WORST
        return (lambda b: np.asarray(np.linalg.solve(matrix, b))) if regular else None
    from scipy.sparse.linalg import splu

    try:
        factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A")
    except RuntimeError:  # "Factor is exactly singular"
        return None
    pivots = np.abs(factors.U.diagonal())
    return factors.solve if pivots.max() < WORST * pivots.min() else None
