"""A posteriori error bound of an equilibrium, and detection of the steady state of a run."""

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
    StagnationError,
    System,
    one_thread,
    random_displacements,
    solved,
)
from pbdkit.errors import ExperimentError
from pbdkit.model.solver import SteadyStateCriterion
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.divergence import largest_offset
from pbdkit.stepping.leaders import is_cut_short
from pbdkit.stepping.program import breakpoints_of, last_event
from pbdkit.stepping.state import State

BOUND_KINDS = {
    "inverse": "the solution for the residual and the inverse for its rounding error",
    "solution": "the solution for the residual",
    "iteration": "further iterations and their rate of convergence",
    "damped": "the solution for the residual, without motions of almost no stiffness, such as "
    "those "
    "of parts attached by one bond",
    "energy": "further iterations and the energy of the remaining error",
    "nothing to solve": "the absence of followers",
}
"""Descriptions of the kinds of bounds."""
CORRECTION = "correction, "
"""Prefix of the kind of a bound on the error that remains after a computed correction."""


PRESCRIBED = "the largest prescribed displacement"
"""Meaning of the scale of errors if leaders or the initial state prescribe displacements."""


@dataclass(frozen=True)
class ErrorBound:
    """A posteriori bound on the error of an equilibrium.

    Parameters
    ----------
    method : str
        Linear solver.
    iterations : int
        Number of linearisations.
    inner_iterations : int
        Number of iterations of the linear solvers.
    residual : float
        Largest move of the rule in the state, in lattice units.
    distance : float
        Bound on the distance of any follower from equilibrium, in lattice units.
    share : float
        The distance divided by the displacement that `scale` names.
    bound : str
        Kind of the bound.
    linearised : bool
        True if the rule is not linear. The bound is then computed from the linearisation and
        multiplied by a safety factor of 2.
    scale : str
        Displacement to which `share` refers, in words; not part of `as_dict`.
    """

    method: str
    iterations: int
    inner_iterations: int
    residual: float
    distance: float
    share: float
    bound: str
    linearised: bool
    scale: str = PRESCRIBED

    def as_dict(self) -> dict[str, Any]:
        """Return the bound as plain values, for JSON.

        Returns
        -------
        dict
            Values by name.
        """
        return {name: value for name, value in asdict(self).items() if name != "scale"}

    def __str__(self) -> str:
        description = BOUND_KINDS[self.bound.removeprefix(CORRECTION)]
        if self.bound.startswith(CORRECTION):
            description = f"the correction to it; the error after it is bounded by {description}"
        return (
            f"within {self.distance:.2g} of equilibrium ({self.share:.1g} of {self.scale}), by "
            f"{description}"
        )


UNKNOWN = ErrorBound(
    method="nothing to solve",
    iterations=0,
    inner_iterations=0,
    residual=math.inf,
    distance=math.inf,
    share=math.inf,
    bound="nothing to solve",
    linearised=True,
)
"""Error bound before anything is computed."""


class UnconvergedError(Exception):
    """The best state found is not an equilibrium. The exception contains the error bound of this
    state."""

    def __init__(self, reason: str, error_bound: ErrorBound = UNKNOWN) -> None:
        super().__init__(reason)
        self.error_bound = error_bound


class RoundingError(UnconvergedError):
    """A state is as near to an equilibrium as rounding permits, but not within the tolerance."""


class DisplacementScale(float):
    """Displacement to which errors of equilibria refer, in lattice units, and its `meaning`."""

    meaning: str

    @classmethod
    def of(cls, value: float, meaning: str) -> DisplacementScale:
        """Return a displacement with a meaning."""
        scale = cls(value)
        scale.meaning = meaning
        return scale


def scale_of(scene: Scene, start: State, rows: Rows = ALL) -> DisplacementScale:
    """Return the largest displacement that leaders or the initial state prescribe. If all are zero,
    return the largest displacement caused by loads; without loads, the length of the shortest
    bond."""
    offsets = [largest_offset(leading, scene.experiment.steps) for leading in scene.driven]
    prescribed = rows.communicator.largest(max([rows.max_norm(start.u), *offsets]))
    if prescribed:
        return DisplacementScale.of(prescribed, PRESCRIBED)
    if under_loads := _displacement_under_loads(scene, start, rows):
        return DisplacementScale.of(under_loads, "the largest displacement under the loads")
    return DisplacementScale.of(spacing_of(scene), "the length of the shortest bond")


def _displacement_under_loads(scene: Scene, rest: State, rows: Rows) -> float:
    """Return the largest displacement that changes of the loads cause, computed by the
    linearisation at rest; 0 if nothing holds the body against the loads. If obstacles prevent every
    displacement, return the largest move that the loads cause without obstacles."""
    steps, moves, displacements = scene.experiment.steps, Moves(scene), [0.0]
    rest = replace(rest, u=np.zeros(rest.u.shape))
    moments = {*scene.loads.changes(steps), *breakpoints_of(scene)} if scene.loads else ()
    pushes = [moves.at(rest, moment) for moment in sorted(moments)]
    if scene.barriers:
        displacements += [rows.max_norm(moves.free(rest, moment)) for moment in moments]
    if rows.communicator.any(any(push.any() for push in pushes)):
        with suppress(ExperimentError, StagnationError), one_thread():
            system = linearised(scene, rest, steps, "auto", Watch(), rows=rows)
            for push in pushes:
                solution = solved(system, push, spacing_of(scene), rows)
                displacements.append(rows.max_norm(solution))
    return max(displacements)


def spacing_of(scene: Scene) -> float:
    """Return the length of the shortest bond."""
    return min(min(lengths) for lengths in scene.neighbourhood.shells())


def broken_bonds(state: State) -> int:
    """Return the number of broken bonds."""
    return 0 if state.broken_step is None else int(np.count_nonzero(state.broken_step >= 0))


LINEAR = 1e-9
"""Ratio of the moves after a correction to those before it, below which the rule counts as
linear."""
FIRST_ORDER = 2.0
"""Safety factor of bounds that are computed from a linearisation."""
ACCURACY = 1e-8
"""Relative accuracy of linear systems; the bound includes the remaining error."""

CONTRACTION = 0.1
"""Largest ratio of the moves after a correction to those before it for which the linearisation is
valid. Further corrections, each of them this ratio times the previous one, then add up to at most a
ninth of the first correction."""
TOO_NONLINEAR = "the rule is too nonlinear between the state and equilibrium for a bound"
"""Reason for an infinite distance under a rule that is too nonlinear."""


@dataclass(frozen=True)
class PredictedEquilibrium:
    """Predicted equilibrium `u` with its error bound. If the distance of the bound is infinite,
    `obstacle` is the reason."""

    u: Floats
    error_bound: ErrorBound
    obstacle: str


class EquilibriumPredictor:
    """Prediction of the equilibrium from states of a scene with the roles of its last step.

    The correction c, with A c = move, leads from u to the equilibrium. Its error follows from the
    moves at u + c: distance ≤ max ‖c‖ + (bound on ‖A⁻¹‖) · ‖move(u + c)‖. If the rule is not
    linear, A is the linearisation at u. The second term then neglects terms of higher order and is
    doubled, and the correction has to reduce the moves to a tenth.

    A prediction depends on the state only, so that a resumed run has the same predictions as an
    uninterrupted one. For this reason, only factors of matrices are stored between two predictions:
    the results of iterative solvers would depend on earlier solutions.
    """

    def __init__(self, scene: Scene, scale: DisplacementScale, watch: Watch) -> None:
        self._scene, self._scale, self._watch = scene, scale, watch
        self._moves = Moves(scene)
        self._at_rest: System | None = None
        self._broken = 0

    def predict(self, state: State) -> PredictedEquilibrium:
        """Predict the equilibrium that the run reaches, given the state at the end of a step; the
        state is not changed.

        The distance is infinite if no bound is known: for bodies under a load that nothing
        balances, and for floating parts under rules that are not linear.
        """
        with one_thread():
            return self._predict(state)

    def _predict(self, state: State) -> PredictedEquilibrium:
        u, previous = (np.array(u, np.float64) for u in (state.u, state.previous))
        start = replace(state, u=u, previous=previous)
        if not self._scene.barriers:
            at_rest = self._system_at_rest(start)
            if self._is_linear(start, at_rest):
                return self._predict_by(start, at_rest)
        return self._predict_by(start, self._linearised(start, u), relinearised=True)

    def _system_at_rest(self, state: State) -> System:
        system, broken = self._at_rest, broken_bonds(state)
        if system is None or broken != self._broken or system.iterations:
            system = self._linearised(state, np.zeros_like(state.u))
            self._at_rest, self._broken = system, broken
        return system

    def _linearised(self, state: State, u: Floats) -> System:
        at, steps = replace(state, u=u), self._scene.experiment.steps
        return linearised(self._scene, at, steps, "auto", self._watch)

    def _predict_by(
        self, state: State, system: System, *, relinearised: bool = False
    ) -> PredictedEquilibrium:
        """Predict by the system at rest or, with `relinearised`, by a system that is linearised at
        the state."""
        moves = self._moves.at(state, self._scene.experiment.steps)
        ahead, distance = state.u.copy(), math.inf
        correction, obstacle = self._correction(state, system, moves, relinearised)
        if correction is not None:
            ahead += correction
            remainder = self._moves.at(replace(state, u=ahead), self._scene.experiment.steps)
            bound = system.distance(remainder, self._moves.rounding(ahead)) * (
                FIRST_ORDER if relinearised else 1.0
            )
            distance = float(np.sqrt((correction**2).sum(axis=0)).max(initial=0.0)) + bound
            limit = CONTRACTION * float(np.abs(moves).max(initial=0.0)) + self._moves.rounding(
                ahead
            )
            if relinearised and not np.abs(remainder).max(initial=0.0) <= limit:
                distance, obstacle = math.inf, TOO_NONLINEAR
        distance = math.inf if math.isnan(distance) else distance
        error_bound = ErrorBound(
            method=system.methods,
            iterations=1,
            inner_iterations=system.iterations,
            residual=float(np.abs(moves).max(initial=0.0)),
            distance=distance,
            share=distance / self._scale,
            bound=CORRECTION + system.bound_kind,
            linearised=relinearised,
            scale=self._scale.meaning,
        )
        return PredictedEquilibrium(ahead, error_bound, obstacle)

    def _correction(
        self, state: State, system: System, moves: Floats, relinearised: bool
    ) -> tuple[Floats | None, str]:
        """Return the correction, or None with the reason why no equilibrium can be predicted."""
        try:
            if relinearised:
                system.refuse_moving_floats(moves, self._moves.rounding(state.u))
            rounding = system.amplification * self._moves.rounding(state.u)
            return system.solve(moves, ACCURACY * self._scale, state, rounding), ""
        except ExperimentError as error:
            return None, str(error).partition("; ")[0] + "; constrain it with a leader group"

    def _is_linear(self, state: State, system: System) -> bool:
        """Return whether moves agree with the linearisation at rest. They are tested at random
        displacements of the same size as the displacements of the body."""
        size = float(np.abs(state.u).max()) or spacing_of(self._scene)
        probe, steps = random_displacements(self._scene, size), self._scene.experiment.steps
        moves, moved = (
            self._moves.at(replace(state, u=u), steps) for u in (state.u, state.u + probe)
        )
        return system.mismatch(probe, moves, moved) <= LINEAR


FINEST = 256
"""The interval to the next check is at least the number of steps since the first check, divided by
this number."""
COARSEST = 4
"""The interval to the next check is at most the number of steps since the first check, divided by
this number."""
OVERDUE = 4
"""A bound is computed, even if steps do not shrink (because of rounding, or vibrations), when the
number of steps since the first check has increased by this factor."""
NEVER = 2**62
"""Step after the end of any run."""


@dataclass
class Pace:
    """Schedule of the checks for a steady state.

    Let the step operator be symmetric, with eigenvalues of at most ρ. Then the displacements of
    successive steps decay at a rate of at least -ln ρ. The rate decreases during the run. The
    distance is extrapolated from two checks: distance ≈ ρ / (1 - ρ) · ‖last step‖, where ρ is
    determined from the ratio of the sizes of two steps. The extrapolated distance is too small as
    long as several modes remain, and exact for a single mode. Checks are therefore made too early
    rather than too late. The estimate determines when a bound is computed, and not the value of the
    bound.
    """

    next_look: int
    """Step of the next check."""
    tolerance: float
    begin: int
    """Step before the first check."""
    rate: float = 0.0
    """Rate of decay in each step; 0 if there is none."""
    seen: tuple[int, float] | None = None
    """Step of the last check, and the norm of its displacements."""
    bounded: tuple[int, float] | None = None
    """Step of the last bound, and its distance."""
    overdue: int | None = None
    """Number of steps since the first check after which a bound is computed in any case."""

    def is_near(self, step: int, longest: float, size: float) -> bool:
        """Return whether a bound is to be computed, for a step with a longest displacement
        `longest` and a norm `size` of all displacements."""
        if self.seen:
            self.rate = _rate(self.seen, (step, size))
        self.seen = (step, size)
        elapsed = step - self.begin
        # Two states with a distance of at most the tolerance from equilibrium differ by at most
        # twice the tolerance.
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
        """Schedule the next check after a bound that is not small enough."""
        entry = (step, distance)
        rate = (_rate(self.bounded, entry) if self.bounded else 0.0) or self.rate
        wanted = self.tolerance if distance > self.tolerance else distance / 2
        self.bounded, self.overdue = entry, OVERDUE * (step - self.begin)
        self._wait(step, _steps_until(distance, wanted, rate))

    def _wait(self, step: int, steps: float) -> None:
        elapsed = step - self.begin
        shortest, longest = max(1, elapsed // FINEST), max(1, elapsed // COARSEST)
        self.next_look = step + math.ceil(min(max(shortest, steps), longest))


def _rate(earlier: tuple[int, float], later: tuple[int, float]) -> float:
    """Return the rate of decay in each step between two values, 0 if they do not decrease."""
    (begin, earlier_value), (end, later_value) = earlier, later
    if not later_value < earlier_value or not math.isfinite(earlier_value):
        return 0.0
    return math.log(earlier_value / later_value) / (end - begin) if later_value > 0.0 else math.inf


def _distance(length: float, rate: float) -> float:
    """Return ρ / (1 - ρ) · length for ρ = exp(-rate)."""
    if length == 0.0:
        return 0.0
    return length / math.expm1(min(rate, 500.0)) if rate > 0.0 else math.inf


def _steps_until(value: float, wanted: float, rate: float) -> float:
    """Return the number of steps in which a value that decays at this rate decreases to the wanted
    value."""
    if value <= wanted:
        return 0.0
    return math.log(value / wanted) / rate if rate > 0.0 and math.isfinite(value) else math.inf


class SteadyStateMonitor:
    """Detection of the steady state of a run.

    In a steady state, roles are constant, leaders rest, the distance of all followers from
    equilibrium is within the tolerance, and no bond can break before equilibrium is reached. With
    momentum or a frame delay, a step also depends on the previous state, and a body near its
    equilibrium may still vibrate about it. The displacement that they may still cause is therefore
    added to the distance.
    """

    def __init__(
        self, scene: Scene, criterion: SteadyStateCriterion, start: State, watch: Watch
    ) -> None:
        self._scale = scale_of(scene, start)
        self._tolerance = criterion.tolerance * self._scale
        steps, leading = scene.experiment.steps, scene.driven
        ends = not any(is_cut_short(group, steps) for group in leading)
        first = max(last_event(scene), start.step + 1) if ends else NEVER
        self.pace = Pace(first, self._tolerance, first - 1)
        self._predictor = EquilibriumPredictor(scene, self._scale, watch)
        self._fracturing = Fracturing.of(scene)
        self._remaining_motion = _remaining_motion(scene)
        unended = "leaders do not come to rest before its end"
        self.obstacle = "there are too few steps" if ends else unended
        """Reason why the state at the last check was not a steady state."""

    def look(self, state: State) -> ErrorBound | None:
        """Return the error bound if the end of a step is a steady state.

        Raises StoppedError if the user interrupts. If there is no bound or the user interrupts, the
        schedule is not changed, so that repeating the check has the same result.
        """
        pace, error_bound = replace(self.pace), None
        try:
            error_bound = self._look(state)
        except StoppedError:
            self.pace = pace
            raise
        if error_bound:
            self.pace = pace
        return error_bound

    def _look(self, state: State) -> ErrorBound | None:
        with np.errstate(all="ignore"):
            move = (state.u - state.previous).ravel()
            longest, size = float(np.abs(move).max()), float(np.linalg.norm(move))
        if not self.pace.is_near(state.step, longest, size):
            self.obstacle = f"in step {state.step} particles still moved by up to {longest:.2g}"
            return None
        prediction = self._predictor.predict(state)
        distance = prediction.error_bound.distance + self._remaining_motion * longest
        self.obstacle = self._obstacle(state, prediction, distance)
        if not self.obstacle:
            share = distance / self._scale
            return replace(prediction.error_bound, distance=distance, share=share)
        self.pace.note_distance(state.step, distance)
        return None

    def _obstacle(self, state: State, prediction: PredictedEquilibrium, distance: float) -> str:
        at = f"at step {state.step}"
        if not math.isfinite(distance):
            return f"{at} {prediction.obstacle or 'the distance from equilibrium has no bound'}"
        if distance > self._tolerance:
            return (
                f"{at} the distance from equilibrium, {distance:.2g}, exceeds {self._tolerance:.2g}"
            )
        ahead = 2.0 * distance  # Each end of a bond can move by the distance.
        if self._fracturing and self._fracturing.may_break(prediction.u, state, ahead):
            return f"{at} a bond may break within the remaining distance of {distance:.2g}"
        return ""


def _remaining_motion(scene: Scene) -> float:
    """Return a bound on the displacement after the last step, divided by the displacement in that
    step. For the momentum b, it is |b| / (1 - |b|), because each further displacement is b times
    the previous one. The frame delay is added."""
    memory = abs(scene.experiment.stepping.memory)
    return (memory / (1.0 - memory) if memory < 1.0 else np.inf) + scene.frame_delay
