"""When to look whether a run has settled: often at the length of a step, rarely at the distance."""

from __future__ import annotations

import math

FINEST, COARSEST = 256, 4
"""Looks lie apart by between these parts of the steps since the first: what comes late comes late
by a 256th, or by a step."""
OVERDUE = 4
"""Where steps are short but shrink no more (rounding, or a body that swings), a bound is made each
time the steps since the first look are this many times more."""
NEVER = 2**62


class Pace:
    """When to look, from what the looks before have found.

    Where the modes of a symmetric step shrink by ρ and less, the sizes of its steps fall at a rate
    of at least -ln ρ, and fall ever more slowly. What is extrapolated from two looks,

        distance ≈ ρ / (1 - ρ) · |last step|,  ρ from the ratio of two steps,

    comes out too small, so that one looks too early rather than too late, and it is sharp in the
    end, when one mode is left. It only says when a bound is worth its cost.
    """

    def __init__(self, first: int, tolerance: float) -> None:
        self.next_look = first
        self._begin, self._tolerance = first - 1, tolerance
        self._rate = 0.0
        self._seen: tuple[int, float] | None = None
        self._bounded: tuple[int, float] | None = None
        self._overdue: int | None = None

    def is_near(self, step: int, longest: float, size: float) -> bool:
        """Whether the distance is worth a bound. `longest` is the longest way that a particle made
        in this step, `size` a norm of all ways."""
        if self._seen:
            self._rate = _rate(self._seen, (step, size))
        self._seen = (step, size)
        elapsed = step - self._begin
        # Of two states within the tolerance none is farther from the other than twice that.
        short = longest <= 2.0 * self._tolerance
        if short and self._overdue is None:
            self._overdue = OVERDUE * elapsed
        distance = _distance(longest, self._rate)
        stalls = self._rate == 0.0 and elapsed >= (self._overdue or 0)
        if short and (distance <= self._tolerance or stalls):
            return True
        self._wait(step, _steps_until(distance, self._tolerance, self._rate))
        return False

    def note_distance(self, step: int, distance: float) -> None:
        """What the bound came to, where the run goes on."""
        here = (step, distance)
        rate = (_rate(self._bounded, here) if self._bounded else 0.0) or self._rate
        wanted = self._tolerance if distance > self._tolerance else distance / 2
        self._bounded, self._overdue = here, OVERDUE * (step - self._begin)
        self._wait(step, _steps_until(distance, wanted, rate))

    def _wait(self, step: int, steps: float) -> None:
        elapsed = step - self._begin
        least, most = max(1, elapsed // FINEST), max(1, elapsed // COARSEST)
        self.next_look = step + math.ceil(min(max(steps, least), most))


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
