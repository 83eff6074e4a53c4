"""A posteriori error bound of an equilibrium, and when a run of steps looks for one."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.system import (
    ALL,
    Moves,
    Rows,
    StuckError,
    System,
    one_thread,
    random_displacements,
    solved,
)
from pbdkit.errors import ExperimentError
from pbdkit.model.solver import Settle
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.divergence import way_of
from pbdkit.stepping.leaders import bends_of, is_cut_short, last_event
from pbdkit.stepping.state import State

WAYS = {
    "inverse": "the solution for what is left of the moves, and the inverse for their rounding",
    "solution": "the solution for what is left of the moves",
    "iteration": "some iterations more, and how they fall",
    "damped": "the solution for what is left of the moves, but for motions that cost next to "
    "nothing, as of what hangs by one bond",
    "energy": "some iterations more, and the energy of what they leave",
    "nothing to solve": "nobody follows",
}
CORRECTION = "correction, "
"""Before the name of a way: it bounds only what a correction that was solved for leaves."""


@dataclass(frozen=True)
class Certificate:
    """`residual` is the largest move of the rule at the state; `distance` bounds how far any
    follower is from equilibrium, both lengths; `share` is the distance as a share of the largest
    prescribed displacement; `iterations` counts linearisations and `inner_iterations` those of the
    linear solvers; `bound` says how the distance was obtained; `linearised` whether the rule is not
    linear, so that it holds to first order, with a factor of 2."""

    method: str
    iterations: int
    inner_iterations: int
    residual: float
    distance: float
    share: float
    bound: str
    linearised: bool

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        way = WAYS[self.bound.removeprefix(CORRECTION)]
        if self.bound.startswith(CORRECTION):
            way = f"the correction to there; what it leaves is bounded by {way}"
        return (
            f"within {self.distance:.2g} of equilibrium ({self.share:.1g} of the largest "
            f"prescribed displacement), by {way}"
        )


UNKNOWN = Certificate(
    method="nothing to solve",
    iterations=0,
    inner_iterations=0,
    residual=math.inf,
    distance=math.inf,
    share=math.inf,
    bound="nothing to solve",
    linearised=True,
)


class UnconvergedError(Exception):
    """The best state found is no equilibrium; its certificate comes along."""

    def __init__(self, reason: str, certificate: Certificate = UNKNOWN) -> None:
        super().__init__(reason)
        self.certificate = certificate


class RoundingError(UnconvergedError):
    """A state is as near to an equilibrium as rounding allows, and the tolerance is less."""


def scale_of(scene: Scene, start: State, rows: Rows = ALL) -> float:
    """The largest prescribed displacement: of the leaders, or of the start; where nothing is
    prescribed but rest the largest that loads make, and without any the lattice's spacing."""
    ways = [way_of(leading, scene.experiment.steps) for leading in scene.driven]
    prescribed = rows.communicator.largest(max([rows.max_norm(start.u), *ways]))
    return prescribed or _way_under_loads(scene, start, rows) or spacing_of(scene)


def _way_under_loads(scene: Scene, rest: State, rows: Rows) -> float:
    """The largest displacement that loads make when they change, linearised at rest; 0 where
    nothing holds the body against them. Obstacles may stop all of it: then the largest move that
    loads would make without them."""
    steps, moves, ways = scene.experiment.steps, Moves(scene), [0.0]
    rest = replace(rest, u=np.zeros(rest.u.shape))
    moments = {*scene.loads.changes(steps), *bends_of(scene)} if scene.loads else ()
    pushes = [moves.at(rest, moment) for moment in sorted(moments)]
    if scene.barriers:
        ways += [rows.max_norm(moves.free(rest, moment)) for moment in moments]
    if rows.communicator.any(any(push.any() for push in pushes)):
        with suppress(ExperimentError, StuckError), one_thread():
            system = linearised(scene, rest, steps, "auto", Watch(), rows=rows)
            for push in pushes:
                found = solved(system, push, spacing_of(scene), rows)
                ways.append(rows.max_norm(found))
    return max(ways)


def spacing_of(scene: Scene) -> float:
    """The length of the shortest bond."""
    return min(min(lengths) for lengths in scene.neighbourhood.shells())


def broken_bonds(state: State) -> int:
    """How many bonds are broken."""
    return 0 if state.broken_step is None else int(np.count_nonzero(state.broken_step >= 0))


LINEAR = 1e-9
"""A correction that leaves less than this share of the moves came from the right linearisation."""
FIRST_ORDER = 2.0
"""What a bound is multiplied with that holds to first order only."""
ACCURACY = 1e-8
"""How well linear systems are solved; the bound takes in what that leaves."""

CONTRACTION = 0.1
"""The share of the moves that a correction may leave for its linearisation to be trusted: further
ones, each that much smaller, then lie within a ninth of the first."""
BENT = "the rule bends too much between there and equilibrium for a bound"


@dataclass(frozen=True)
class PredictedEquilibrium:
    """`u` is the equilibrium ahead as far as it is known, and the certificate says how far at most
    any follower is from it; `obstacle` why there is no distance, where it is infinite."""

    u: Floats
    certificate: Certificate
    obstacle: str


class ErrorBound:
    """The outlook from states of a scene with the roles of its last step.

    The correction c, A c = move, leads from u to the equilibrium, and what it fails to do is seen
    in the moves where it leads:

        distance ≤ max |c| + (bound on |A⁻¹|) · |move(u + c)|,

    for rules that are not linear with A linearised at u, the second term to first order, doubled,
    and only where the correction leaves a tenth of the moves at most.

    An outlook follows from the state alone, so that a run that is gone on with has those of the
    uninterrupted one. Between two of them only factors are kept: iterative solvers remember what
    they have solved before.
    """

    def __init__(self, scene: Scene, scale: float, watch: Watch) -> None:
        self._scene, self._scale, self._watch = scene, scale, watch
        self._moves = Moves(scene)
        self._at_rest: System | None = None
        self._broken = 0

    def from_(self, state: State) -> PredictedEquilibrium:
        """The outlook from the end of a step, which is left as it is.

        The distance is infinite where no bound is known: for what is pushed on for ever, and for
        parts that nothing holds under rules that are not linear.
        """
        with one_thread():
            return self._from(state)

    def _from(self, state: State) -> PredictedEquilibrium:
        u, previous = (np.array(u, np.float64) for u in (state.u, state.previous))
        here = replace(state, u=u, previous=previous)
        if not self._scene.barriers:
            at_rest = self._system_at_rest(here)
            if self._is_linear(here, at_rest):
                return self._outlook(here, at_rest)
        return self._outlook(here, self._linearised(here, u), anew=True)

    def _system_at_rest(self, here: State) -> System:
        system, broken = self._at_rest, broken_bonds(here)
        if system is None or broken != self._broken or system.iterations:
            system = self._linearised(here, np.zeros_like(here.u))
            self._at_rest, self._broken = system, broken
        return system

    def _linearised(self, state: State, u: Floats) -> System:
        at, steps = replace(state, u=u), self._scene.experiment.steps
        return linearised(self._scene, at, steps, "auto", self._watch)

    def _outlook(self, here: State, known: System, *, anew: bool = False) -> PredictedEquilibrium:
        """By the system of the scene at rest, or by one that was linearised `anew` at the state."""
        moves = self._moves.at(here, self._scene.experiment.steps)
        ahead, distance = here.u.copy(), math.inf
        correction, obstacle = self._correction(here, known, moves, anew)
        if correction is not None:
            ahead += correction
            left = self._moves.at(replace(here, u=ahead), self._scene.experiment.steps)
            bound = known.distance(left, self._moves.rounding(ahead)) * (
                FIRST_ORDER if anew else 1.0
            )
            distance = float(np.sqrt((correction**2).sum(axis=0)).max(initial=0.0)) + bound
            most = CONTRACTION * float(np.abs(moves).max(initial=0.0)) + self._moves.rounding(ahead)
            if anew and not np.abs(left).max(initial=0.0) <= most:
                distance, obstacle = math.inf, BENT
        distance = math.inf if math.isnan(distance) else distance
        certificate = Certificate(
            method=known.methods,
            iterations=1,
            inner_iterations=known.iterations,
            residual=float(np.abs(moves).max(initial=0.0)),
            distance=distance,
            share=distance / self._scale,
            bound=CORRECTION + known.how,
            linearised=anew,
        )
        return PredictedEquilibrium(ahead, certificate, obstacle)

    def _correction(
        self, here: State, known: System, moves: Floats, anew: bool
    ) -> tuple[Floats | None, str]:
        """None, and why, where there is no equilibrium, or none that is known."""
        try:
            if anew:
                known.refuse_moving_floats(moves, self._moves.rounding(here.u))
            rounding = known.amplification * self._moves.rounding(here.u)
            return known.solve(moves, ACCURACY * self._scale, here, rounding), ""
        except ExperimentError as error:
            return None, str(error).partition("; ")[0] + "; let a leader hold it"

    def _is_linear(self, here: State, known: System) -> bool:
        """Whether followers put elsewhere, at random and as far as the body has come, move by what
        the linearisation at rest says."""
        size = float(np.abs(here.u).max()) or spacing_of(self._scene)
        put, steps = random_displacements(self._scene, size), self._scene.experiment.steps
        moves, moved = (self._moves.at(replace(here, u=u), steps) for u in (here.u, here.u + put))
        return known.mismatch(put, moves, moved) <= LINEAR


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


class SteadyStateMonitor:
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
        self._foresight = ErrorBound(scene, self._scale, watch)
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

    def _obstacle(self, state: State, outlook: PredictedEquilibrium, distance: float) -> str:
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
