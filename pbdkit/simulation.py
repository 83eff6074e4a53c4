"""One run of a scene: its drivers (stepping and equilibrium), checkpoints and recording."""

from __future__ import annotations

import re
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.recorder import Recorder, RunOutcome
from pbdkit.io.sinks import KeepingSink, MemorySink, OverlappingSink, Sink
from pbdkit.linear.stencil import Bound, wave_bound
from pbdkit.model.solver import Equilibrium, Solver, Stepping
from pbdkit.plugin.discovery import worded
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stability.forecast import outlook, prediction, quick_warnings
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.divergence import EVERY, Guard
from pbdkit.stepping.engine_choice import Choice, choose, make_engine
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from pbdkit.equilibrium.certificate import Certificate, Pace, Settling
    from pbdkit.equilibrium.solve import Way
    from pbdkit.model.experiment import Experiment


States = Generator[State, None, RunOutcome]


class Driver(ABC):
    """Takes one scene from a state to its end, once.

    `state` is where it stands, `choice` what steps it. `ending` says of a state just given out that
    it is the last of a run that ends before its last step, to be kept whatever the plan, `is_over`
    that nothing remains to be computed; `stopped` is how such a run ends that was asked to stop.
    """

    choice: Choice

    def __init__(self, scene: Scene, state: State, watch: Watch) -> None:
        self.scene, self.state, self.watch = scene, state, watch
        self.ending = self.is_over = False
        self.stopped: RunOutcome | None = None
        self.chosen: tuple[str, ...] = ()
        """The parameters of the solver that were `auto`, and are numbers now."""
        self.within: float | None = None
        """The moment within a step of which the state just given out is an equilibrium to be
        recorded; None elsewhere."""
        self.rejection: FloatingPointError | None = None
        """Why whoever looked at the last state could not use it; its next move is up to the
        driver."""

    @abstractmethod
    def states(self) -> States:
        """The states on the way, the first included, each valid until the next is asked for; then
        how it ended. Raises ExperimentError where there is no way."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """All that decides how it goes on from a state just given out."""

    @abstractmethod
    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Goes on from there, before the first state was asked for."""


LONGEST_CALL_S, SECONDS_A_VALUE = 0.2, 2e-9
"""An engine is called for so long at most, so that progress shows and interruptions are heard."""
MOST_STEPS = 100_000
"""A call."""


class SteppingDriver(Driver):
    """The driver of the solver `stepping`: gives out a state at every step of which something is
    wanted, and some between."""

    def __init__(self, scene: Scene, state: State, watch: Watch) -> None:
        super().__init__(scene, state, watch)
        self._engine, self.choice = make_engine(scene, choose(scene))
        self._patience = self._steps_in(SECONDS_A_VALUE * scene.raster.count)
        self.guard = Guard.of(scene, state)
        self.settling: Settling | None = None
        if asked := scene.experiment.stepping.settle:
            from pbdkit.equilibrium.certificate import Settling  # only where it is asked for

            self.settling = Settling(scene, asked, state, watch)
        self.kept = -1
        """The last step that was given out to be recorded, and was not rejected."""

    def state_dict(self) -> dict[str, Any]:
        """The state, and what the guard and whoever looks whether it has settled remember."""
        settling = self.settling
        pace = {"pace": settling.pace, "obstacle": settling.obstacle} if settling else {}
        guard = {"good_step": self.guard.good_step, "next_look": self.guard.next_look}
        return {"state": self.state, "guard": guard, "kept": self.kept, **pace}

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """What follows from the scene is its own: the size of the body, and when to look whether
        it has settled, where a run of so many steps has not looked by then."""
        self.state, self.kept = parts["state"], parts["kept"]
        is_good = parts["guard"]["good_step"] == self.state.step
        kept = self.state.copy() if is_good else self.guard.kept
        self.guard = replace(self.guard, kept=kept, **parts["guard"])
        if self.settling and "pace" in parts:
            self._take_up_settling(self.settling, parts["pace"], parts["obstacle"])

    def _take_up_settling(self, settling: Settling, pace: Pace, obstacle: str) -> None:
        step, own = self.state.step, settling.pace
        if own.next_look > step:  # what is to happen by then, the other run may not have known
            return
        if pace.begin != own.begin:
            experiment = self.scene.experiment
            text = (
                f"a run of {experiment.steps} steps looks from step {own.next_look} on whether it "
                f"has settled, and step {step} was reached without; run it anew, or go on to more "
                "steps"
            )
            raise experiment.located(ExperimentError(text, ("solver", "settle")))
        settling.pace, settling.obstacle = pace, obstacle

    def states(self) -> States:
        """A run that diverges gives out the last good state at its end, where that is later than
        what was recorded."""
        try:
            return (yield from self._stepped())
        except FloatingPointError as error:
            return (yield from self._diverged(error))

    def _stepped(self) -> States:
        steps = self.scene.experiment.steps
        outcome: RunOutcome | None = None
        try:
            yield from self._given_out()
            while not (outcome := self._settled()) and (step := self.state.step) < steps:
                self.watch.look(step / steps, f"step {step} of {steps}")
                self._advance()
                yield from self._given_out()
        except StoppedError:  # after the last step, too, while it is looked at
            step = self.state.step
            self.stopped = outcome = RunOutcome("interrupted", f"stopped after step {step}", step)
        if self.stopped or self.kept < self.state.step:
            self.ending = True
            yield from self._given_out()
        if outcome:
            return outcome
        unsettled = f", not settled: {self.settling.obstacle}" if self.settling else ""
        return RunOutcome("complete", f"all steps done{unsettled}", steps)

    def _advance(self) -> None:
        """To the next step at which to look. Raises FloatingPointError."""
        experiment, state = self.scene.experiment, self.state
        stops = [experiment.next_wanted(state.step), self.guard.next_look]
        stops += [self.settling.pace.next_look] if self.settling else []
        reached = min(*stops, state.step + self._patience)
        planned = experiment.record.keeps(reached, reached + 1)  # by longer runs, too
        notes = reached == self.guard.next_look or planned
        begun, steps = perf_counter(), reached - state.step
        self.state = self._engine.advance(state, steps)
        self._patience = self._steps_in((perf_counter() - begun) / steps)
        if notes or reached == experiment.steps:
            self.guard.look(self.scene, self.state, note=notes)

    def _steps_in(self, seconds_a_step: float) -> int:
        """How many steps a call takes, where a step takes so long."""
        return max(1, min(MOST_STEPS, int(LONGEST_CALL_S / max(seconds_a_step, 1e-9))))

    def _given_out(self) -> Iterator[State]:
        """The state. Raises what whoever looked at it has against it."""
        yield self.state
        if self.rejection:
            raise self.rejection
        if self.scene.experiment.records(self.state.step):
            self.kept = self.state.step

    def _settled(self) -> RunOutcome | None:
        state = self.state
        if self.settling is None or state.step != self.settling.pace.next_look:
            return None
        found = self.settling.look(state)
        return RunOutcome("settled", str(found), state.step, found.as_dict()) if found else None

    def _diverged(self, error: FloatingPointError) -> States:
        step, rule = self.state.step, self.scene.experiment.rule.type
        cause = self._cause_of_nan()
        if self.rejection and not cause and np.isfinite(self.state.u).all():
            cause = ": displacements are finite, but not what is measured of them"
        reason = f"{error} left all bounds under rule '{rule}'{cause}"
        self.rejection = None
        if self.kept < step - 1:
            good = self.guard.last_good(
                self.scene, self._engine, step, self._patience, self.watch.stopping
            )
            if good is not None and good.step > self.kept:
                self.ending = True
                yield good
                if not self.rejection:  # else a diagnostic of it is not finite
                    reason += (
                        f"; kept is step {good.step}, the last no larger than the body and its "
                        "leaders' ways"
                    )
        return RunOutcome("diverged", reason, step)

    def _cause_of_nan(self) -> str:
        """Where the rule made NaN of numbers, found by stepping once more with numpy; empty where
        there is no NaN."""
        if not np.isnan(self.state.u).any():
            return ""
        rule, start = type(self.scene.experiment.rule), self.guard.kept
        start = start.copy() if start else initial_state(self.scene)
        steps, found = self.state.step - start.step, ""
        try:
            if steps <= EVERY:
                Stepper(self.scene, strict=True).advance(start, steps)
        except FloatingPointError as error:
            found = f", from {worded(error, rule.__module__.split('.')[0])}"
        return (
            f": a displacement is NaN{found}; guard divisions and roots with `pbdkit.plugin.where`"
        )


class EquilibriumDriver(Driver):
    """The driver of the solver `equilibrium`: gives out the start, what it reaches on the way, and
    the equilibrium."""

    choice = Choice("equilibrium", 1, "asked for")
    moment = 0.0
    """What of the load's way has been reached, in steps."""

    def state_dict(self) -> dict[str, Any]:
        """The state and the moment: each increment begins anew from them."""
        return {"state": self.state, "moment": self.moment}

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """From the last that was reached."""
        self.state, self.moment = parts["state"], float(parts["moment"])

    def states(self) -> States:
        """Interrupted, or without an equilibrium, it gives out how far it had come."""
        # Loaded by those who look for an equilibrium, and by nobody else.
        from pbdkit.equilibrium.certificate import UnconvergedError
        from pbdkit.equilibrium.solve import SeparatedError

        state = self.state
        yield state
        try:
            certificate = yield from self._on_the_way(state)
            outcome = RunOutcome("complete", str(certificate), state.step, certificate.as_dict())
        except UnconvergedError as error:
            found = error.certificate
            outcome = RunOutcome("unconverged", f"{error}: {found}", state.step, found.as_dict())
        except SeparatedError as error:
            outcome = RunOutcome("separated", str(error), state.step)
        except FloatingPointError as error:
            return RunOutcome("unconverged", f"{error} left all bounds", state.step)
        except StoppedError:
            reason = f"stopped on the way to equilibrium, after step {state.step}"
            outcome = self.stopped = RunOutcome("interrupted", reason, state.step)
        self.ending = outcome.status != "complete"
        yield state
        if self.rejection:
            return RunOutcome("unconverged", f"{self.rejection} left all bounds", state.step)
        return outcome

    def _way(self, state: State) -> Way:
        """What is reached on the way of a state to equilibrium."""
        from pbdkit.equilibrium.solve import increments

        return increments(self.scene, state, self.watch, self.moment, stops=self._stops)

    @property
    def _stops(self) -> list[int]:
        """The recorded steps between the first and the last one."""
        experiment = self.scene.experiment
        return list(experiment.record.steps_before(experiment.steps))

    def _on_the_way(self, state: State) -> Generator[State, None, Certificate]:
        """Raises FloatingPointError where a state cannot be recorded."""
        way, increments = self._way(state), self.scene.experiment.record.increments
        while True:
            try:
                reached = next(way)
            except StopIteration as end:
                certificate: Certificate = end.value
                return certificate
            self.moment, self.is_over = reached.moment, reached.is_last
            within = increments and reached.at_rest and reached.moment != reached.state.step
            self.within = reached.moment if within else None
            yield reached.state
            self.within = None
            if self.rejection:
                raise self.rejection


def checkpoint_of(driver: Driver, recorder: Recorder, rate: float = 0.0) -> Checkpoint:
    """Return the checkpoint of a run, its arrays not copied; `rate` is in steps a second."""
    experiment, step = driver.scene.experiment, driver.state.step
    run = driver.state_dict()
    return Checkpoint.of(experiment, run, recorder.seen, step, driver.chosen, rate)


DRIVERS: dict[type[Solver], Callable[[Scene, State, Watch], Driver]] = {
    Stepping: SteppingDriver,
    Equilibrium: EquilibriumDriver,
}
"""What carries out what an experiment asks for under `solver`."""
FAILED = ("diverged", "unconverged", "separated")
"""How runs end that do not come to their last step or to rest."""
LARGEST = 50_000
"""Of larger bodies nothing is measured ahead of the run."""


class Run:
    """One run of a scene, gone through once: ``for state in Run(scene): ...``.

    A state comes at every step of which the experiment records something, the first and the last
    included, and at some between. It is valid, and may be changed, until the next is asked for:
    ``state.copy()`` keeps it. `watch` is told how far the run is and says whether to stop; `start`
    is the state to go on from, which the run takes over. Raises ExperimentError, with its place in
    the file, and PluginError.
    """

    processes = 1
    """That share it."""

    def __init__(
        self, scene: Scene, *, start: State | None = None, watch: Watch | None = None
    ) -> None:
        chosen = scene.experiment.stepping.open_parameters
        self.scene = scene = tuned(scene)
        self.outcome: RunOutcome | None = None
        """How the run ended; None until it has."""
        with _located(scene):
            make = DRIVERS[type(scene.experiment.solver)]
            self.driver = make(scene, start or initial_state(scene), watch or Watch())
        self.driver.chosen = chosen

    def __iter__(self) -> Iterator[State]:
        with _located(self.scene):
            self.outcome = yield from self.driver.states()

    @property
    def state(self) -> State:
        """Where the run stands; of one that diverged, what it came to."""
        return self.driver.state

    @property
    def choice(self) -> Choice:
        """The engine, its threads, and why."""
        return self.driver.choice

    @property
    def particles(self) -> int:
        """How many there are, frame included."""
        return self.scene.raster.count

    def recorder(self, sink: Sink) -> Recorder:
        """What takes from its states what the dataset holds."""
        return Recorder(self.scene, sink)

    def sink(self, file: KeepingSink) -> KeepingSink:
        """What writes into a file beside the run."""
        return OverlappingSink(file)

    @cached_property
    def prediction(self) -> dict[str, Any]:
        """What was known of it before the first step."""
        return prediction(self.scene, self.waves)

    @cached_property
    def waves(self) -> Bound | None:
        """What plane waves say of its stability."""
        return wave_bound(self.scene)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What is to be said before the first step: of the scene, and of stability."""
        return quick_warnings(self.scene, self.waves)

    def outlook(self) -> list[str]:
        """What else `check` warns of, where the body is so small that it is known at once."""
        wave_warns = bool(self.waves) and "solver.relaxation" in " ".join(self.warnings)
        found = outlook(self.scene)
        return [w for w in found if not (wave_warns and w.startswith("solver.relaxation"))]


@dataclass(frozen=True)
class RunReport:
    """How a recorded run went, for those who look at its cost, and what is to be said of its
    end."""

    outcome: RunOutcome
    particles: int
    wall_s: float
    choice: Choice
    warnings: tuple[str, ...] = ()
    first: int = 0
    """The step from which on it was run."""
    processes: int = 1
    """That shared it."""

    @property
    def ns_per_particle_step(self) -> float:
        """Wall time of stepping and recording together."""
        made = max(1, self.outcome.steps - self.first)
        return self.wall_s * 1e9 / (self.particles * made)


def peak_memory() -> int:
    """Bytes at most resident in this process; 0 where the system does not tell.

    Linux counts what the process that started this one had resident into ru_maxrss, so the
    figure of this program's own memory is taken where there is one.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+)", status.read_text())):
        return int(found[1]) * 1024
    try:
        from resource import RUSAGE_SELF, getrusage
    except ImportError:
        return 0
    return getrusage(RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def record(run: Run, sink: Sink, *, recorder: Recorder | None = None) -> RunReport:
    """Takes a run to its end, and what the experiment records of it into the sink. A `recorder` of
    the sink that has begun goes on with what it took before. A run that is asked to stop is left
    where it stands, where the sink can keep that."""
    begun, scene, first = time.perf_counter(), run.scene, run.state.step
    keeping = sink if isinstance(sink, KeepingSink) else None

    def report(outcome: RunOutcome, warnings: tuple[str, ...] = ()) -> RunReport:
        wall_s = time.perf_counter() - begun
        return RunReport(outcome, run.particles, wall_s, run.choice, warnings, first, run.processes)

    try:
        if recorder is None:
            recorder = run.recorder(sink)
            with _located(scene):
                recorder.begin()
        for state in run:
            if keeping and run.driver.stopped:
                keeping.suspend(checkpoint_of(run.driver, recorder))
                return report(run.driver.stopped)
            try:
                with _located(scene):
                    within = run.driver.within
                    recorder.observe(state, last=run.driver.ending, within=within)
            except FloatingPointError as error:
                run.driver.rejection = error
                continue
            # At its end there is nothing to go on to: what follows from the last state is its end.
            ends = run.driver.ending or run.driver.is_over
            ends = ends or state.step >= scene.experiment.steps
            if keeping and not ends and keeping.due():
                rate = (state.step - first) / (time.perf_counter() - begun)
                keeping.keep(checkpoint_of(run.driver, recorder, rate))
        assert run.outcome is not None
        if keeping:
            keeping.note_end(checkpoint_of(run.driver, recorder))
        with _located(scene):
            recorder.finish(run.state, run.outcome, run.prediction)
    except BaseException:
        sink.abandon()
        raise
    return report(run.outcome, recorder.warnings)


def rehearse(scene: Scene) -> None:
    """Measures at the start what the run will record; raises what the run would."""
    if not scene.experiment.diagnostics or scene.raster.count > LARGEST:
        return
    recorder = Recorder(scene, MemorySink())
    with _located(scene), suppress(FloatingPointError):  # such a run diverges at once, and says so
        recorder.begin()
        recorder.observe(initial_state(scene))


@contextmanager
def _located(scene: Scene) -> Iterator[None]:
    """An ExperimentError gets the place of its field in the file."""
    try:
        yield
    except ExperimentError as error:
        raise scene.experiment.located(error) from None


class Execution:
    """Where runs are carried out: by one process, or, in `pbdkit.mpi.run`, by all processes of a
    communicator, which make each call together."""

    def __init__(self, communicator: Communicator = SERIAL) -> None:
        self.communicator = communicator

    def scene(self, experiment: Experiment) -> Scene:
        """Return what this process needs of an experiment's scene."""
        from pbdkit.scene.scene import build_scene

        return build_scene(experiment)

    def tuned(self, scene: Scene) -> Scene:
        """Return the scene with numbers in place of `auto`."""
        from pbdkit.stability.relaxation import tuned

        return tuned(scene)

    def by_root(self, work: Callable[[], int]) -> int:
        """Return what the root alone comes to."""
        return work()

    def run(self, scene: Scene, watch: Watch) -> Run:
        """Return the run of a scene."""
        return Run(scene, watch=watch)
