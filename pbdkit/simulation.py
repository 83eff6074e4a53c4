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
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pbdkit.errors import DivergedError, ExperimentError, warn_caller
from pbdkit.hooks import worded
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.recorder import Recorder, RunOutcome, Snapshots
from pbdkit.io.sinks import KeepingSink, MemorySink, OverlappingSink, Sink
from pbdkit.linear.stencil import Bound, wave_bound
from pbdkit.model.loading import as_experiment
from pbdkit.model.solver import Equilibrium, Solver, Stepping
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stability.forecast import outlook, prediction, quick_warnings
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.divergence import EVERY, Guard
from pbdkit.stepping.engine_choice import Choice, choose, make_engine
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state, unmoved_state

if TYPE_CHECKING:
    import xarray

    from pbdkit.equilibrium.certificate import Certificate, Pace, SteadyStateMonitor
    from pbdkit.equilibrium.solve import Way
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.loading import ComponentClasses, ExperimentLike
    from pbdkit.model.reading import Settings


__all__ = ["Recording", "Simulation"]

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
        self.pause = -1
        """A step at which to give out the state whatever is recorded."""
        self.certificate: Certificate | None = None
        """The bound on the distance of the last state from equilibrium, of an equilibrium that was
        found."""
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

    def restart(self, state: State) -> None:
        """Go on from another state of the same step in place of that just given out."""
        self.state = state

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
        self.settling: SteadyStateMonitor | None = None
        if asked := scene.experiment.stepping.settle:
            from pbdkit.equilibrium.certificate import (
                SteadyStateMonitor,  # only where it is asked for
            )

            self.settling = SteadyStateMonitor(scene, asked, state, watch)
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

    def _take_up_settling(self, settling: SteadyStateMonitor, pace: Pace, obstacle: str) -> None:
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

    def restart(self, state: State) -> None:
        """Go on from another state; the guard looks back to it."""
        super().restart(state)
        self.guard = replace(self.guard, good_step=state.step, kept=state.copy())

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
        stops = [experiment.next_recorded(state.step), self.guard.next_look]
        stops += [self.settling.pace.next_look] if self.settling else []
        stops += [self.pause] if self.pause > state.step else []
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
            self.certificate = certificate = yield from self._on_the_way(state)
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


class Simulation:
    """One simulation of an experiment, stepped by hand or to its end.

    The numbers are those of `pbdkit.run`, bit for bit, however many steps are made in a call. A
    warning is issued for what is doubtful in the scene, as `pbdkit.run` does.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        As `pbdkit.run` takes it.
    components, settings
        As in `pbdkit.load`.
    start : Simulation, optional
        The simulation from whose state this one starts, at the step that it has reached: the body
        must have the same particles and bonds. By default the initial state of the experiment.

    Raises
    ------
    ExperimentError, PluginError
        Where the experiment is wrong, a plugin is missing or broken, or the start is the state of
        another body.

    Examples
    --------
    >>> simulation = pbdkit.Simulation("paper/a")
    >>> with simulation.record("first-steps.nc"):
    ...     simulation.step(50)
    >>> simulation.state.position.sel(particle=67)
    >>> simulation.equilibrate()
    """

    processes: int = 1
    """The number of processes that share it."""

    def __init__(
        self,
        experiment: ExperimentLike,
        *,
        components: ComponentClasses = (),
        settings: Settings = (),
        start: Simulation | None = None,
    ) -> None:
        scene = build_scene(as_experiment(experiment, components, settings))
        state = None
        if start is not None:
            state = start.driver.state.copy()
            if not state.fits(unmoved_state(scene, scene.raster.shape[1:])):
                raise ExperimentError(
                    "start: its state is that of another body: the particles, bonds, leader "
                    "groups and precision must be the same"
                )
            if state.step > scene.experiment.steps:
                raise ExperimentError(
                    f"start: step {state.step} is reached, and the experiment has "
                    f"{scene.experiment.steps} steps"
                )
        self._begin(scene, state, Watch())
        for text in self.warnings:
            warn_caller(text)

    @classmethod
    def of_scene(
        cls, scene: Scene, *, start: State | None = None, watch: Watch | None = None
    ) -> Simulation:
        """Return the simulation of a scene, without warnings.

        Parameters
        ----------
        scene : Scene
            The experiment on its lattice.
        start : State, optional
            The state to go on from, which the simulation takes over.
        watch : Watch, optional
            Shows progress and says whether to stop.
        """
        simulation = cls.__new__(cls)
        simulation._begin(scene, start, watch or Watch())
        return simulation

    def _begin(self, scene: Scene, start: State | None, watch: Watch) -> None:
        chosen = scene.experiment.stepping.open_parameters
        self.scene = scene = tuned(scene)
        with _located(scene):
            make = DRIVERS[type(scene.experiment.solver)]
            self.driver = make(scene, start or initial_state(scene), watch)
        self.driver.chosen = chosen

    outcome: RunOutcome | None = None
    """How the simulation ended; None until it has."""

    def __iter__(self) -> Iterator[State]:
        """Yield the states to the end, once: of every step of which something is recorded, the
        first and the last included, and of some between. Each is valid, and may be changed, until
        the next: ``state.copy()`` keeps it."""
        with _located(self.scene):
            self.outcome = yield from self.driver.states()

    def step(self, n: int = 1) -> None:
        """Make steps.

        Parameters
        ----------
        n : int
            The number of steps. A run that has settled ends earlier, as `outcome` then says.

        Raises
        ------
        ExperimentError
            Where the experiment has fewer steps left, or its solver makes none.
        DivergedError
            Where a displacement leaves the finite numbers.
        """
        steps, time = self.experiment.steps, self.time
        if not self.experiment.solver.makes_steps:
            raise ExperimentError(
                "solver: an equilibrium is found without steps: call run() or equilibrate(), or "
                "take solver: {type: stepping}"
            )
        if type(n) is not int or n < 0:
            raise ExperimentError(f"step: expected a number of steps from 0, got {n!r}")
        if self.outcome:
            raise ExperimentError(f"step: the simulation has ended: {self.outcome.stop_reason}")
        if time + n > steps:
            raise ExperimentError(
                f"step: step {time} of {steps} is reached, and {n} more are asked for; "
                f"settings={{'steps': {time + n}}} makes the experiment longer"
            )
        self.driver.pause = time + n
        self._go(lambda: self.time >= time + n)

    def run(self) -> None:
        """Go on to the end of the experiment, as `pbdkit.run` does.

        Raises
        ------
        DivergedError
            Where a displacement leaves the finite numbers, there is no equilibrium, or the body
            comes apart on the way to one.
        """
        self._go(lambda: False)

    def equilibrate(self) -> Certificate:
        """Move the body to equilibrium, with leaders, loads and numbers as they are now.

        Bonds that are too long in equilibrium break. The time stays as it is, and steps go on from
        there. With ``solver: equilibrium`` the load is followed to the last step, as in `run`.

        Returns
        -------
        Certificate
            The bound on the distance from equilibrium; ``print`` shows it.

        Raises
        ------
        DivergedError
            Where no equilibrium is found.
        ExperimentError
            Where there is none.
        """
        from pbdkit.equilibrium.certificate import UnconvergedError
        from pbdkit.equilibrium.solve import settle_at_step

        if not self.experiment.solver.makes_steps:
            self.run()
            assert self.driver.certificate is not None
            return self.driver.certificate
        state = self.driver.state.copy()
        try:
            with _located(self.scene):
                certificate = settle_at_step(self.scene, state)
        except UnconvergedError as error:
            raise DivergedError(f"{error}: {error.certificate}") from None
        self.driver.restart(state)
        return certificate

    def record(self, path: str | Path | None = None, *, force: bool = False) -> Recording:
        """Record from the present state on what the experiment asks for under `record`.

        The present state is recorded in any case, and so is the last one. Recording ends with the
        block, or by `Recording.close`, and where the simulation ends.

        Parameters
        ----------
        path : str or path, optional
            The file to write, as `pbdkit.run` does; by default the dataset is kept in memory.
        force : bool
            Replace an existing file.

        Returns
        -------
        Recording
            A context manager, whose `dataset` is there when it has ended.

        Raises
        ------
        ExperimentError
            Where the file exists, or the simulation has ended.
        StorageError
            Where the file cannot be written.
        """
        if self.outcome:
            raise ExperimentError(f"record: the simulation has ended: {self.outcome.stop_reason}")
        if path is None:
            memory = MemorySink()
            recording = Recording(self, memory, dataset_of=memory.dataset)
        else:
            from pbdkit.io.netcdf import NetcdfSink
            from pbdkit.io.open import open
            from pbdkit.io.save import refuse_taken

            refuse_taken(Path(path), force=force)
            file = NetcdfSink(Path(path), force, self.experiment.record.compression)
            recording = Recording(self, self.sink(file), dataset_of=lambda: open(file.written))
        self._start()
        self._recordings.append(recording)
        return recording

    _recordings: list[Recording]
    _states: Iterator[State] | None = None

    def _start(self) -> None:
        """Let the driver give out the present state, which recordings then take."""
        if self._states is None:
            self._states, self._recordings = iter(self), []
            next(self._states)

    def _go(self, is_reached: Callable[[], bool]) -> None:
        """Go on until a time is reached, or the end; recordings take each state as it is left."""
        self._start()
        assert self._states is not None
        while not self.outcome and not is_reached():
            try:
                for recording in self._recordings:
                    recording.take(self.driver.state)
                next(self._states, None)
            except BaseException:
                time, ending, self._recordings = self.time, self._recordings, []
                self.outcome = RunOutcome("interrupted", f"by an error after step {time}", time)
                for recording in ending:
                    recording.abandon()
                raise
        if self.outcome:
            ending, self._recordings = self._recordings, []
            for recording in ending:
                recording.finish(self.outcome)
            if self.outcome.status in FAILED:
                raise DivergedError(self.outcome.stop_reason)

    @property
    def experiment(self) -> Experiment:
        """The experiment, with numbers in place of `auto`."""
        return self.scene.experiment

    @property
    def time(self) -> int:
        """The number of steps that are made."""
        return self.driver.state.step

    @property
    def state(self) -> xarray.Dataset:
        """The present state: `position`, `u` and `kind` of every particle, what rule and fracture
        model remember, and `broken_step` of every bond where bonds can break.

        The names, coordinates and units are those of a run's dataset at one time. The values are
        read-only, and later steps do not change them.
        """
        return self._snapshots.dataset(self.driver.state)

    @cached_property
    def _snapshots(self) -> Snapshots:
        return Snapshots(self.scene)

    @property
    def choice(self) -> Choice:
        """The engine, its threads, and why."""
        return self.driver.choice

    @property
    def particles(self) -> int:
        """How many there are, frame included."""
        return self.scene.raster.count

    def recorder(self, sink: Sink) -> Recorder:
        """Return what takes from its states what the dataset holds."""
        return Recorder(self.scene, sink)

    def sink(self, file: KeepingSink) -> KeepingSink:
        """Return a sink that writes into a file beside the simulation."""
        return OverlappingSink(file)

    @cached_property
    def prediction(self) -> dict[str, Any]:
        """What was known of it before the first step."""
        return prediction(self.scene, self.waves)

    @cached_property
    def waves(self) -> Bound | None:
        """The bound on its stability from plane waves."""
        return wave_bound(self.scene)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """The warnings before the first step: of the scene, and of stability."""
        return quick_warnings(self.scene, self.waves)

    def outlook(self) -> list[str]:
        """Return what else `check` warns of, where the body is so small that it is known at
        once."""
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


class Recording:
    """What a simulation records of its states, as its experiment asks for under `record`.

    Made by `Simulation.record`, and a context manager: recording ends with the block.
    """

    def __init__(
        self,
        simulation: Simulation,
        sink: Sink,
        recorder: Recorder | None = None,
        dataset_of: Callable[[], xarray.Dataset] | None = None,
    ) -> None:
        self._simulation, self._sink, self._dataset_of = simulation, sink, dataset_of
        self._keeping = sink if isinstance(sink, KeepingSink) else None
        self._begun, self._first = time.perf_counter(), simulation.time
        self._has_ended = False
        try:
            if recorder is None:
                recorder = simulation.recorder(sink)
                with _located(simulation.scene):
                    recorder.begin()
        except BaseException:
            self.abandon()
            raise
        self._recorder = recorder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End recording with the present state. A run that has not come to its end is then recorded
        with the status "interrupted".

        Raises
        ------
        StorageError
            Where the file cannot be written.
        """
        simulation, time = self._simulation, self._simulation.time
        if self._has_ended:
            return
        if time >= simulation.experiment.steps:
            with suppress(DivergedError):  # the dataset says it
                simulation.run()
            return
        simulation._recordings.remove(self)
        try:
            self._recorder.observe(simulation.driver.state, last=True)
            self.finish(RunOutcome("interrupted", f"stopped after step {time}", time))
        except BaseException:
            self.abandon()
            raise

    @property
    def dataset(self) -> xarray.Dataset:
        """The dataset that was recorded.

        Raises
        ------
        ExperimentError
            Where recording has not ended.
        """
        if not self._has_ended or self._dataset_of is None:
            raise ExperimentError("record: has not ended: leave the block, or call close()")
        return self._dataset_of()

    def take(self, state: State) -> None:
        """Record what is wanted of a state, and keep where the simulation stands, if it is due. A
        state that cannot be recorded is for the driver to deal with."""
        simulation, driver = self._simulation, self._simulation.driver
        try:
            with _located(simulation.scene):
                self._recorder.observe(state, last=driver.ending, within=driver.within)
        except FloatingPointError as error:
            driver.rejection = error
            return
        # At its end there is nothing to go on to: what follows from the last state is its end.
        ends = driver.ending or driver.is_over or state.step >= simulation.experiment.steps
        if self._keeping and not ends and self._keeping.due():
            rate = (state.step - self._first) / (time.perf_counter() - self._begun)
            self._keeping.keep(checkpoint_of(driver, self._recorder, rate))

    def suspend(self, outcome: RunOutcome) -> RunReport:
        """Leave the run where it stands, to be gone on with."""
        assert self._keeping
        self._keeping.suspend(checkpoint_of(self._simulation.driver, self._recorder))
        return self._report(outcome)

    def finish(self, outcome: RunOutcome) -> RunReport:
        """Record what is known at the end."""
        simulation, driver = self._simulation, self._simulation.driver
        if self._keeping:
            self._keeping.note_end(checkpoint_of(driver, self._recorder))
        with _located(simulation.scene):
            self._recorder.finish(driver.state, outcome, simulation.prediction)
        self._has_ended = True
        return self._report(outcome, self._recorder.warnings)

    def abandon(self) -> None:
        """Give up what was recorded; what was kept stays."""
        self._has_ended, self._dataset_of = True, None
        self._sink.abandon()

    def _report(self, outcome: RunOutcome, warnings: tuple[str, ...] = ()) -> RunReport:
        simulation, wall_s = self._simulation, time.perf_counter() - self._begun
        cost = simulation.particles, wall_s, simulation.choice
        return RunReport(outcome, *cost, warnings, self._first, simulation.processes)


def record(simulation: Simulation, sink: Sink, *, recorder: Recorder | None = None) -> RunReport:
    """Take a simulation to its end, and what the experiment records of it into the sink.

    A `recorder` of the sink that has begun goes on with what it took before. A simulation that is
    asked to stop is left where it stands, where the sink can keep that.
    """
    recording = Recording(simulation, sink, recorder)
    try:
        for state in simulation:
            if isinstance(sink, KeepingSink) and simulation.driver.stopped:
                return recording.suspend(simulation.driver.stopped)
            recording.take(state)
        assert simulation.outcome is not None
        return recording.finish(simulation.outcome)
    except BaseException:
        sink.abandon()
        raise


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
