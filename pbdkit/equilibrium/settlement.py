"""When to look whether a run has settled: often at the length of a step, rarely at the distance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pbdkit.equilibrium.certificate import Certificate, Foresight, Outlook, scale_of
from pbdkit.experiment.solvers import Settle
from pbdkit.results.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaker import Fracturing
from pbdkit.stepping.prescription import is_cut_short, last_event
from pbdkit.stepping.state import State

FINEST, COARSEST = 256, 4
"""Looks lie apart by between these parts of the steps since the first: what comes late comes late
by a 256th, or by a step."""
OVERDUE = 4
"""Where steps are short but shrink no more (rounding, or a body that swings), a bound is made each
time the steps since the first look are this many times more."""
NEVER = 2**62


@dataclass
class Pace:
    """When to look, from what the looks before have found.

    Where the modes of a symmetric step shrink by ρ and less, the sizes of its steps fall at a rate
    of at least -ln ρ, and fall ever more slowly. What is extrapolated from two looks,

        distance ≈ ρ / (1 - ρ) · |last step|,  ρ from the ratio of two steps,

    comes out too small, so that one looks too early rather than too late, and it is sharp in the
    end, when one mode is left. It only says when a bound is worth its cost.
    """

    next_look: int
    """The step at which to look next."""
    tolerance: float
    begin: int
    """The step before the first look."""
    rate: float = 0.0
    """Of the decay, a step; 0 while none is seen."""
    seen: tuple[int, float] | None = None
    """The last look: its step, and the size of the step made there."""
    bounded: tuple[int, float] | None = None
    """The last bound: its step, and the distance."""
    overdue: int | None = None
    """The steps since the first look after which a bound is made all the same."""

    def is_near(self, step: int, longest: float, size: float) -> bool:
        """Whether the distance is worth a bound. `longest` is the longest way that a particle made
        in this step, `size` a norm of all ways."""
        if self.seen:
            self.rate = _rate(self.seen, (step, size))
        self.seen = (step, size)
        elapsed = step - self.begin
        # Of two states within the tolerance none is farther from the other than twice that.
        short = longest <= 2.0 * self.tolerance
        if short and self.overdue is None:
            self.overdue = OVERDUE * elapsed
        distance = _distance(longest, self.rate)
        stalls = self.rate == 0.0 and elapsed >= (self.overdue or 0)
        if short and (distance <= self.tolerance or stalls):
            return True
        self._wait(step, _steps_until(distance, self.tolerance, self.rate))
        return False

    def note_distance(self, step: int, distance: float) -> None:
        """What the bound came to, where the run goes on."""
        here = (step, distance)
        rate = (_rate(self.bounded, here) if self.bounded else 0.0) or self.rate
        wanted = self.tolerance if distance > self.tolerance else distance / 2
        self.bounded, self.overdue = here, OVERDUE * (step - self.begin)
        self._wait(step, _steps_until(distance, wanted, rate))

    def _wait(self, step: int, steps: float) -> None:
        elapsed = step - self.begin
        least, most = max(1, elapsed // FINEST), max(1, elapsed // COARSEST)
        self.next_look = step + math.ceil(min(max(least, steps), most))


def _rate(earlier: tuple[int, float], later: tuple[int, float]) -> float:
    """The rate of decay a step between two values, 0 where they do not fall."""
    (begin, before), (end, after) = earlier, later
    if not after < before or not math.isfinite(before):
        return 0.0
    return math.log(before / after) / (end - begin) if after > 0.0 else math.inf


def _distance(length: float, rate: float) -> float:
    """ρ / (1 - ρ) · length for ρ = exp(-rate)."""
    if length == 0.0:
        return 0.0
    return length / math.expm1(min(rate, 500.0)) if rate > 0.0 else math.inf


def _steps_until(value: float, wanted: float, rate: float) -> float:
    """The steps in which a value that falls at a rate comes to what is wanted."""
    if value <= wanted:
        return 0.0
    return math.log(value / wanted) / rate if rate > 0.0 and math.isfinite(value) else math.inf


class Settling:
    """Looks at the states of a run that is to end once it has settled: roles no longer change,
    leaders rest, no follower can be farther from equilibrium than the tolerance, and no bond is so
    near to breaking that it might on the way there.

    Where the step looks back, a body may swing through its equilibrium: what memory and frames
    with lag can carry it on counts as distance.
    """

    def __init__(self, scene: Scene, settle: Settle, start: State, watch: Watch) -> None:
        self._scale = scale_of(scene, start)
        self._tolerance = settle.tolerance * self._scale
        steps, leading = scene.experiment.steps, scene.driven
        ends = not any(is_cut_short(group, steps) for group in leading)
        first = max(last_event(scene), start.step + 1) if ends else NEVER
        self.pace = Pace(first, self._tolerance, first - 1)
        self._foresight = Foresight(scene, self._scale, watch)
        self._fracturing = Fracturing.of(scene)
        self._carrying = _carrying(scene)
        unended = "leaders do not come to rest before its end"
        self.obstacle = "steps are too few" if ends else unended
        """Why the run has not settled, as found at the last look."""

    def look(self, state: State) -> Certificate | None:
        """At the end of that step: the certificate where the run has settled. Raises StoppedError
        where the watch says so. Neither changes the pace: another look finds the same."""
        before, found = replace(self.pace), None
        try:
            found = self._look(state)
        except StoppedError:
            self.pace = before
            raise
        if found:
            self.pace = before
        return found

    def _look(self, state: State) -> Certificate | None:
        with np.errstate(all="ignore"):
            way = (state.u - state.previous).ravel()
            longest, size = float(np.abs(way).max()), float(np.linalg.norm(way))
        if not self.pace.is_near(state.step, longest, size):
            self.obstacle = f"in step {state.step} particles still moved by up to {longest:.2g}"
            return None
        outlook = self._foresight.from_(state)
        distance = outlook.certificate.distance + self._carrying * longest
        self.obstacle = self._obstacle(state, outlook, distance)
        if not self.obstacle:
            share = distance / self._scale
            return replace(outlook.certificate, distance=distance, share=share)
        self.pace.note_distance(state.step, distance)
        return None

    def _obstacle(self, state: State, outlook: Outlook, distance: float) -> str:
        at = f"at step {state.step}"
        if not math.isfinite(distance):
            return f"{at} {outlook.obstacle or 'nothing bounds the distance from equilibrium'}"
        if distance > self._tolerance:
            return f"{at} within {distance:.2g} of equilibrium, not within {self._tolerance:.2g}"
        ahead = 2.0 * distance  # at both ends of a bond
        if self._fracturing and self._fracturing.may_break(outlook.u, state, ahead):
            return f"{at} a bond may break on the last {distance:.2g} to equilibrium"
        return ""


def _carrying(scene: Scene) -> float:
    """How many times the last step a body may be carried on: |b| / (1 - |b|) by memory b, which
    makes each step b times the last, and once by a frame that lags."""
    memory = abs(scene.experiment.stepping.memory)
    return (memory / (1.0 - memory) if memory < 1.0 else np.inf) + scene.lag
