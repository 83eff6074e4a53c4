"""The run of a scene into a sink: step by step, or straight to equilibrium."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pbdkit.equilibrium.finding import UnconvergedError
from pbdkit.equilibrium.loading import settle
from pbdkit.errors import ExperimentError
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.results.progress import progress_bar
from pbdkit.results.recorder import Outcome, Recorder, Sink
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import Choice, choose, make_engine
from pbdkit.stepping.engine import Engine
from pbdkit.stepping.guard import Guard
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from pbdkit.equilibrium.settling import Settling

LONGEST_CALL_S, SECONDS_A_VALUE = 0.2, 2e-9
"""An engine is called for so long at most, so that progress shows and interruptions are heard."""
_STRAIGHT = Choice("equilibrium", 1, "asked for")


@dataclass(frozen=True)
class Report:
    """How a run went, for those who look at its cost, and what is to be said of its end."""

    outcome: Outcome
    particles: int
    wall_s: float
    choice: Choice
    warnings: tuple[str, ...] = ()

    @property
    def ns_per_particle_step(self) -> float:
        """Wall time of stepping and recording together."""
        return self.wall_s * 1e9 / (self.particles * max(1, self.outcome.steps))


def run_into(
    sink: Sink, scene: Scene, *, progress: bool, stopping: Callable[[], bool] = lambda: False
) -> Report:
    """Steps the scene to its end, or until `stopping` says so, and records it into the sink."""
    recorder = Recorder(scene, sink)
    straight = isinstance(scene.experiment.solver, Equilibrium)
    engine, choice = (None, _STRAIGHT) if straight else make_engine(scene, choose(scene))
    begun = time.perf_counter()
    try:
        recorder.begin()
        with progress_bar(scene.experiment.steps, progress and not straight) as show:
            if engine is None:
                outcome = _go_straight(scene, recorder)
            else:
                outcome = _step_through(scene, engine, recorder, show, stopping)
    except ExperimentError as error:
        sink.abandon()
        raise scene.experiment.located(error) from None
    except BaseException:
        sink.abandon()
        raise
    wall_s = time.perf_counter() - begun
    return Report(outcome, scene.raster.count, wall_s, choice, recorder.warnings)


def _go_straight(scene: Scene, recorder: Recorder) -> Outcome:
    state, steps = initial_state(scene), scene.experiment.steps
    recorder.observe(state)
    try:
        certificate = settle(scene, state)
        outcome = Outcome("complete", str(certificate), steps, certificate.as_dict())
    except UnconvergedError as error:
        found = error.certificate
        outcome = Outcome("unconverged", f"{error}: {found}", steps, found.as_dict())
    state.step = steps
    try:
        recorder.observe(state)
    except FloatingPointError as error:
        outcome = Outcome("unconverged", f"{error} left all bounds", steps)
    recorder.finish(state, outcome)
    return outcome


def _step_through(
    scene: Scene,
    engine: Engine,
    recorder: Recorder,
    show: Callable[[int], None],
    stopping: Callable[[], bool],
) -> Outcome:
    steps, state = scene.experiment.steps, initial_state(scene)
    patience = max(1, int(LONGEST_CALL_S / (SECONDS_A_VALUE * scene.raster.count)))
    outcome, guard = None, Guard(scene, state)
    settling = _settling(scene, state)
    try:
        recorder.observe(state)
        while state.step < steps and not outcome and not stopping():
            wanted = recorder.next_after(state.step)
            reached = min(wanted, guard.next_look, state.step + patience)
            if settling:
                reached = min(reached, settling.next_look)
            state = engine.advance(state, reached - state.step)
            if reached == guard.next_look or recorder.records(reached):
                guard.look(state)
            recorder.observe(state)
            show(state.step)
            if settling and reached == settling.next_look:
                outcome = _settled(settling, state)
        if state.step < steps:
            recorder.observe_last(state)
            stopped = f"stopped after step {state.step}"
            outcome = outcome or Outcome("interrupted", stopped, state.step)
    except FloatingPointError as error:
        reason = f"{error} left all bounds under rule '{scene.experiment.rule.type}'"
        if recorder.last_recorded < state.step - 1:
            reason += _keep(recorder, guard.last_good(engine, state.step, patience, stopping))
        outcome = Outcome("diverged", reason, state.step)
    unsettled = f", not settled: {settling.obstacle}" if settling else ""
    outcome = outcome or Outcome("complete", f"all steps done{unsettled}", steps)
    recorder.finish(state, outcome)
    return outcome


def _keep(recorder: Recorder, good: State | None) -> str:
    """Records the last good state of a run that diverged, and says so."""
    if good is None or good.step <= recorder.last_recorded:
        return ""
    try:
        recorder.observe_last(good)
    except FloatingPointError:  # of a diagnostic; nothing of that step is kept
        return ""
    return f"; kept is step {good.step}, the last no larger than the body and its leaders' ways"


def _settling(scene: Scene, start: State) -> Settling | None:
    asked = scene.experiment.solver.settle
    if asked is None:
        return None
    from pbdkit.equilibrium.settling import Settling  # only where it is asked for

    return Settling(scene, asked, start)


def _settled(settling: Settling, state: State) -> Outcome | None:
    found = settling.look(state)
    return Outcome("settled", str(found), state.step, found.as_dict()) if found else None
