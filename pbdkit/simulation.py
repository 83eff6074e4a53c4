"""One run of a scene: the drivers of the solvers `stepping` and `equilibrium`, and recording."""

from __future__ import annotations

import re
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import DivergedError, ExperimentError, warn_caller
from pbdkit.hooks import worded
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.recorder import Recorder, RunOutcome, Snapshots
from pbdkit.io.sinks import KeepingSink, MemorySink, OverlappingSink, Sink
from pbdkit.linear.stencil import Bound, wave_bound
from pbdkit.model.loading import as_experiment
from pbdkit.model.solver import Control, Equilibrium, Solver, Stepping
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stability.forecast import further_warnings, prediction, quick_warnings
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.divergence import EVERY, Guard
from pbdkit.stepping.engine_choice import Choice, choose, make_engine
from pbdkit.stepping.function_checks import check_functions
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state, unmoved_state

if TYPE_CHECKING:
    import xarray

    from pbdkit.equilibrium.error_bound import ErrorBound, Pace, SteadyStateMonitor
    from pbdkit.equilibrium.load_stepping import EquilibriumPath
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.loading import ComponentClasses, ExperimentLike
    from pbdkit.model.reading import Settings


__all__ = ["Recording", "Simulation"]

States = Generator[State, None, RunOutcome]


class Driver(ABC):
    """Advances one scene from a state to the end of its run.

    Attributes
    ----------
    scene, state, watch
        Scene, current state, and the object that displays progress and cancels the run.
    choice : Choice
        Engine of the run, number of its threads, and the reason for the choice.
    ends_early : bool
        True at the last state of a run that ends before its last step. That state is recorded even
        if no record is due.
    is_complete : bool
        True if nothing remains to be computed after the current state.
    interruption : RunOutcome or None
        Outcome of a run that was interrupted on request.
    automatic : tuple of str
        Solver parameters that are `auto` in the experiment; in the scene they are replaced by
        values.
    load_time : float or None
        Time of the current state, in steps, if it is an equilibrium within a step that is to be
        recorded; otherwise None.
    requested_step : int
        Step at which the state is yielded even if no record is due; -1 for none.
    error_bound : ErrorBound or None
        Error bound of the equilibrium; None before it is reached.
    rejection : FloatingPointError or None
        Error of the recorder, if the current state cannot be recorded. The driver then either ends
        the run or raises the error.
    """

    choice: Choice

    def __init__(self, scene: Scene, state: State, watch: Watch) -> None:
        self.scene, self.state, self.watch = scene, state, watch
        self.ends_early = self.is_complete = False
        self.interruption: RunOutcome | None = None
        self.automatic: tuple[str, ...] = ()
        self.load_time: float | None = None
        self.requested_step = -1
        self.error_bound: ErrorBound | None = None
        self.rejection: FloatingPointError | None = None
        check_functions(scene, state)

    @abstractmethod
    def states(self) -> States:
        """Generate the states of the run, including the first, and return the outcome of the run.

        Each state is valid only until the next one is generated.

        Raises
        ------
        ExperimentError
            If the run is impossible.
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return all data that determine how the run continues from the current state."""

    def restart(self, state: State) -> None:
        """Continue from another state of the same step."""
        self.state = state

    @abstractmethod
    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`, before the first state is generated."""


MAX_CALL_S = 0.2
"""Maximum duration of one call of an engine in seconds.

Progress is shown and interruptions are handled between calls.
"""
SECONDS_A_VALUE = 2e-9
"""First estimate of the time for one step of one particle in seconds."""
MAX_STEPS_A_CALL = 100_000
"""Maximum number of steps in one call of an engine."""


class SteppingDriver(Driver):
    """Driver of the solver `stepping`.

    States are yielded at every recorded step, and at some steps between these.
    """

    def __init__(self, scene: Scene, state: State, watch: Watch) -> None:
        super().__init__(scene, state, watch)
        self._engine, self.choice = make_engine(scene, choose(scene))
        self._steps_per_call = self._steps_in(SECONDS_A_VALUE * scene.raster.count)
        self.guard = Guard.of(scene, state)
        self.monitor: SteadyStateMonitor | None = None
        if tolerance := scene.experiment.stepping.settle:
            from pbdkit.equilibrium.error_bound import SteadyStateMonitor

            self.monitor = SteadyStateMonitor(scene, tolerance, state, watch)
        self.recorded_step = -1
        """Last step that was yielded for recording and not rejected."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the scene, of the divergence test and of the convergence test."""
        monitor = self.monitor
        pace = {"pace": monitor.pace, "obstacle": monitor.obstacle} if monitor else {}
        guard = {"good_step": self.guard.good_step, "next_look": self.guard.next_look}
        return {"state": self.state, "guard": guard, "kept": self.recorded_step, **pace}

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`.

        Two values are not restored, because they are computed from the scene. These are the size of
        the body and, if convergence has not been tested yet, the first step at which it is tested.
        """
        self.state, self.recorded_step = parts["state"], parts["kept"]
        is_good = parts["guard"]["good_step"] == self.state.step
        good_state = self.state.copy() if is_good else self.guard.good_copy
        self.guard = replace(self.guard, good_copy=good_state, **parts["guard"])
        if self.monitor and "pace" in parts:
            self._restore_monitor(self.monitor, parts["pace"], parts["obstacle"])

    def _restore_monitor(self, monitor: SteadyStateMonitor, pace: Pace, obstacle: str) -> None:
        step, new_pace = self.state.step, monitor.pace
        if new_pace.next_look > step:  # The earlier run may have had no such tests.
            return
        if pace.begin != new_pace.begin:
            experiment = self.scene.experiment
            text = (
                f"a run of {experiment.steps} steps tests convergence from step "
                f"{new_pace.next_look} on, and step {step} was reached without a test; start the "
                "run again, or resume it with more steps"
            )
            raise experiment.located(ExperimentError(text, ("solver", "settle")))
        monitor.pace, monitor.obstacle = pace, obstacle

    def restart(self, state: State) -> None:
        """Continue from another state, which becomes the last good state of the divergence test."""
        super().restart(state)
        self.guard = replace(self.guard, good_step=state.step, good_copy=state.copy())

    def states(self) -> States:
        """Generate the states of the run.

        If the run diverges, the last good state is yielded as the last one, unless a later state
        has already been recorded.
        """
        try:
            return (yield from self._stepped())
        except FloatingPointError as error:
            return (yield from self._diverged(error))

    def _stepped(self) -> States:
        steps = self.scene.experiment.steps
        outcome: RunOutcome | None = None
        try:
            yield from self._current_state()
            while not (outcome := self._convergence()) and (step := self.state.step) < steps:
                self.watch.look(step / steps, f"step {step} of {steps}")
                self._advance()
                yield from self._current_state()
        except StoppedError:  # It is also raised while the last state is recorded.
            step = self.state.step
            outcome = RunOutcome("interrupted", f"stopped after step {step}", step)
            self.interruption = outcome
        if self.interruption or self.recorded_step < self.state.step:
            self.ends_early = True
            yield from self._current_state()
        if outcome:
            return outcome
        obstacle = f", not converged: {self.monitor.obstacle}" if self.monitor else ""
        return RunOutcome("complete", f"completed all steps{obstacle}", steps)

    def _advance(self) -> None:
        """Make steps to the next state that is recorded or tested. Raises FloatingPointError."""
        experiment, state = self.scene.experiment, self.state
        stops = [experiment.next_recorded(state.step), self.guard.next_look]
        stops += [self.monitor.pace.next_look] if self.monitor else []
        stops += [self.requested_step] if self.requested_step > state.step else []
        target = min(*stops, state.step + self._steps_per_call)
        is_recorded = experiment.record.keeps(target, target + 1)  # Recorded in longer runs, too.
        notes = target == self.guard.next_look or is_recorded
        start_time, steps = perf_counter(), target - state.step
        self.state = self._engine.advance(state, steps)
        self._steps_per_call = self._steps_in((perf_counter() - start_time) / steps)
        if notes or target == experiment.steps:
            self.guard.look(self.scene, self.state, note=notes)

    def _steps_in(self, seconds_a_step: float) -> int:
        """Return the number of steps in one call of the engine."""
        return max(1, min(MAX_STEPS_A_CALL, int(MAX_CALL_S / max(seconds_a_step, 1e-9))))

    def _current_state(self) -> Iterator[State]:
        """Yield the current state, and raise the error of the recorder if there is one."""
        yield self.state
        if self.rejection:
            raise self.rejection
        if self.scene.experiment.records(self.state.step):
            self.recorded_step = self.state.step

    def _convergence(self) -> RunOutcome | None:
        """Return the outcome of a converged run if a test is due and passes."""
        state = self.state
        if self.monitor is None or state.step != self.monitor.pace.next_look:
            return None
        bound = self.monitor.look(state)
        return RunOutcome("settled", str(bound), state.step, bound.as_dict()) if bound else None

    def _diverged(self, error: FloatingPointError) -> States:
        step, rule = self.state.step, self.scene.experiment.rule.type
        largest, good = self.guard.largest_displacement(self.state), None
        if self.recorded_step < step - 1:
            good = self.guard.last_good(
                self.scene, self._engine, step, self._steps_per_call, self.watch.stopping
            )
        if self.rejection and np.isfinite(largest):
            cause = "displacements are finite, but a recorded variable is not"
        elif np.isnan(largest) and self._was_bounded(good):
            cause = self._cause_of_nan(good)
        else:
            cause = UNSTABLE
        reason = f"{error} diverged under rule '{rule}': {cause}"
        self.rejection = None
        if good is not None and good.step > self.recorded_step:
            self.ends_early = True
            yield good
            if not self.rejection:  # Otherwise a diagnostic is not finite.
                reason += (
                    f"; the last recorded state is step {good.step}, the last in which no "
                    "displacement exceeds the size of the body and the paths of its leaders"
                )
        return RunOutcome("diverged", reason, step)

    def _was_bounded(self, good: State | None) -> bool:
        """Return whether the state before the first NaN was good, so that NaN is not the result of
        growing displacements. `good` is the last good state, or None if the state before the last
        step was recorded."""
        if good is None:
            return self.guard.good_step >= self.state.step - 1
        following = self._engine.advance(good.copy(), 1)
        return bool(np.isnan(self.guard.largest_displacement(following)))

    def _cause_of_nan(self, good: State | None) -> str:
        """Return the place in the rule at which NaN appears, and the remedy.

        It is located by repeating the last steps with numpy.
        """
        rule, copy = type(self.scene.experiment.rule), self.guard.good_copy
        start = (good or copy or initial_state(self.scene)).copy()
        steps, place = self.state.step - start.step, ""
        try:
            if good is not None or steps <= EVERY:
                Stepper(self.scene, strict=True).advance(start, 1 if good is not None else steps)
        except FloatingPointError as error:
            place = f", from {worded(error, rule.__module__.split('.')[0])}"
        return f"a displacement is NaN{place}; guard divisions and roots with `pbdkit.plugin.where`"


UNSTABLE = (
    "the steps became unstable; lower solver.relaxation, or use solver: {type: equilibrium}, which "
    "computes the equilibria that the steps approach"
)
"""Cause and remedy of a divergence by growing displacements."""


class EquilibriumDriver(Driver):
    """Driver of the solver `equilibrium`.

    It yields the initial state, the states after increments of the load, and the equilibrium.
    """

    choice = Choice("equilibrium", 1, "requested")
    moment = 0.0
    """Time up to which the load has been applied, in steps."""
    part = 1.0
    """With a control, part of a step by which the next increment advances."""
    order: Sequence[int] = ()
    """With a control, places in the order in which their responses were computed."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state and the time from which the next increment starts."""
        parts: dict[str, Any] = {"state": self.state, "moment": self.moment}
        if self._control:
            parts |= {"part": self.part, "order": list(self.order)}
            parts |= {name: getattr(self.state, name) for name in ("load_factor", "dissipated")}
        return parts

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.state, self.moment = parts["state"], float(parts["moment"])
        if self._control:
            self.part, self.order = float(parts["part"]), parts["order"]
            for name in ("load_factor", "dissipated"):
                setattr(self.state, name, float(parts[name]))

    @property
    def _control(self) -> Control | None:
        return self.scene.experiment.solver.equilibrium.control

    def states(self) -> States:
        """Generate the states of the run.

        If the run is interrupted or an equilibrium is not found, the last state is the last
        equilibrium that was found.
        """
        from pbdkit.equilibrium.error_bound import UnconvergedError
        from pbdkit.equilibrium.load_stepping import SeparatedError

        state = self.state
        yield state
        try:
            self.error_bound = error_bound = yield from self._increments(state)
            outcome = RunOutcome("complete", str(error_bound), state.step, error_bound.as_dict())
        except UnconvergedError as error:
            bound = error.error_bound
            outcome = RunOutcome(
                "unconverged", (f"{error}; the state is {bound}"), state.step, bound.as_dict()
            )
        except SeparatedError as error:
            outcome = RunOutcome("separated", str(error), state.step)
        except FloatingPointError as error:
            return RunOutcome("unconverged", f"{error} diverged", state.step)
        except StoppedError:
            reason = f"stopped before equilibrium was reached, after step {state.step}"
            outcome = self.interruption = RunOutcome("interrupted", reason, state.step)
        self.ends_early = outcome.status != "complete"
        yield state
        if self.rejection:
            return RunOutcome("unconverged", f"{self.rejection} diverged", state.step)
        return outcome

    def _path(self, state: State) -> EquilibriumPath:
        """Follow the load from a state to equilibrium, or the branch of a control."""
        if self._control:
            from pbdkit.equilibrium.branch import follow

            return follow(self.scene, state, self.watch, self.moment, self.part, self.order)
        from pbdkit.equilibrium.load_stepping import increments

        return increments(self.scene, state, self.watch, self.moment, stops=self._stops)

    @property
    def _stops(self) -> list[int]:
        """Recorded steps between the first and the last one."""
        experiment = self.scene.experiment
        return list(experiment.record.steps_before(experiment.steps))

    def _increments(self, state: State) -> Generator[State, None, ErrorBound]:
        """Yield the states after increments of the load and return the error bound.

        Raises FloatingPointError if a state cannot be recorded.
        """
        path, records_all = self._path(state), self.scene.experiment.record.increments
        while True:
            try:
                reached = next(path)
            except StopIteration as end:
                error_bound: ErrorBound = end.value
                return error_bound
            self.moment, self.is_complete = reached.moment, reached.is_last
            self.part, self.order = reached.part, reached.order
            is_within = records_all and reached.at_rest and reached.moment != reached.state.step
            self.load_time = reached.moment if is_within else None
            yield reached.state
            self.load_time = None
            if self.rejection:
                raise self.rejection


def checkpoint_of(driver: Driver, recorder: Recorder, rate: float = 0.0) -> Checkpoint:
    """Return the checkpoint of a run without copying arrays; `rate` is in steps per second."""
    experiment, step = driver.scene.experiment, driver.state.step
    run = driver.state_dict()
    return Checkpoint.of(experiment, run, recorder.last_steps, step, driver.automatic, rate)


DRIVERS: dict[type[Solver], Callable[[Scene, State, Watch], Driver]] = {
    Stepping: SteppingDriver,
    Equilibrium: EquilibriumDriver,
}
"""Driver of each solver."""
FAILED = ("diverged", "unconverged", "separated")
"""Statuses of runs that reach neither their last step nor equilibrium."""
MAX_DIAGNOSED_PARTICLES = 50_000
"""Maximum number of particles for which the diagnostics are evaluated once before the run."""


class Simulation:
    """Simulation of an experiment, step by step or to its end.

    The results are equal to those of `pbdkit.run` to the last bit, for any number of steps in each
    call. The same warnings are issued.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        Experiment, as for `run`.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    settings : mapping, or iterable of str
        Values that replace those of the experiment, as for `load`.
    start : Simulation, optional
        Simulation that provides the state and the step from which this one starts. Its body must
        have the same particles and bonds. By default the simulation starts from the initial state
        of the experiment.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, a plugin is missing or broken, or the state of `start`
        belongs to another body.

    Examples
    --------
    >>> simulation = pbdkit.Simulation("paper/a")
    >>> with simulation.record("first-steps.nc"):
    ...     simulation.step(50)
    >>> simulation.time
    50
    >>> x, y = simulation.state.position.sel(particle=67)
    >>> error_bound = simulation.equilibrate()
    """

    processes: int = 1
    """Number of processes that share the lattice."""

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
                    "start: its state belongs to another body; particles, bonds, leader groups and "
                    "precision must be the same"
                )
            if state.step > scene.experiment.steps:
                raise ExperimentError(
                    f"start: its state is that of step {state.step}, but the experiment has "
                    f"{scene.experiment.steps} steps; increase `steps`"
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
            Experiment on its lattice.
        start : State, optional
            Initial state; the simulation modifies it.
        watch : Watch, optional
            Display of progress, and requests to stop.
        """
        simulation = cls.__new__(cls)
        simulation._begin(scene, start, watch or Watch())
        return simulation

    def _begin(self, scene: Scene, start: State | None, watch: Watch) -> None:
        automatic = scene.experiment.stepping.open_parameters
        self.scene = scene = tuned(scene)
        with _located(scene):
            make = DRIVERS[type(scene.experiment.solver)]
            self.driver = make(scene, start or initial_state(scene), watch)
        self.driver.automatic = automatic

    outcome: RunOutcome | None = None
    """Outcome of the simulation; None before its end."""

    def __iter__(self) -> Iterator[State]:
        """Yield the states to the end of the run. This is possible only once.

        The states are those of every recorded step, including the first and the last, and of some
        steps between these. A state is valid until the next one is generated, and may be modified.
        ``state.copy()`` returns a state that remains valid.
        """
        with _located(self.scene):
            self.outcome = yield from self.driver.states()

    def step(self, n: int = 1) -> None:
        """Advance by n steps.

        Parameters
        ----------
        n : int
            Number of steps. A run that converges makes fewer steps and sets `outcome`.

        Raises
        ------
        ExperimentError
            If the experiment has fewer steps left, or its solver makes no steps.
        DivergedError
            If a displacement is not finite.
        """
        steps, time = self.experiment.steps, self.time
        if not self.experiment.solver.makes_steps:
            raise ExperimentError(
                "solver: the solver `equilibrium` makes no steps; call run() or equilibrate(), or "
                "set solver: {type: stepping}"
            )
        if type(n) is not int or n < 0:
            raise ExperimentError(f"step: expected a number of steps from 0, got {n!r}")
        if self.outcome:
            raise ExperimentError(f"step: the simulation has ended: {self.outcome.stop_reason}")
        if time + n > steps:
            raise ExperimentError(
                f"step: {n} more steps exceed the {steps} of the experiment, of which {time} are "
                f"made; extend it with settings={{'steps': {time + n}}}"
            )
        self.driver.requested_step = time + n
        self._go(lambda: self.time >= time + n)

    def run(self) -> None:
        """Continue to the end of the experiment, like `pbdkit.run`.

        Raises
        ------
        DivergedError
            If a displacement is not finite, no equilibrium is found, or the body separates into
            parts under the load.
        """
        self._go(lambda: False)

    def equilibrate(self) -> ErrorBound:
        """Compute the equilibrium for the current leaders, loads and parameters.

        Bonds that exceed their limit in equilibrium break. The number of the current step does not
        change, and further steps start from the equilibrium. With ``solver: equilibrium``
        equilibria are computed for increasing load up to the last step, as in `run`.

        Returns
        -------
        ErrorBound
            A posteriori bound on the distance from equilibrium; ``print`` displays it.

        Raises
        ------
        DivergedError
            If the iteration does not converge.
        ExperimentError
            If no equilibrium exists.
        """
        from pbdkit.equilibrium.error_bound import UnconvergedError
        from pbdkit.equilibrium.load_stepping import equilibrate_at_step

        if not self.experiment.solver.makes_steps:
            self.run()
            assert self.driver.error_bound is not None
            return self.driver.error_bound
        state = self.driver.state.copy()
        try:
            with _located(self.scene):
                error_bound = equilibrate_at_step(self.scene, state)
        except UnconvergedError as error:
            raise DivergedError(f"{error}: {error.error_bound}") from None
        self.driver.restart(state)
        return error_bound

    def record(self, path: str | Path | None = None, *, force: bool = False) -> Recording:
        """Begin to record at the current state, as the field `record` of the experiment specifies.

        The current and the last state are always recorded. A state is recorded when the next step
        begins or recording ends; an equilibrium that `equilibrate` has computed until then is
        recorded in its place. Recording ends with the ``with`` block, by `Recording.close`, or with
        the simulation.

        Parameters
        ----------
        path : str or path, optional
            File to write; by default the dataset is kept in memory.
        force : bool
            Replace an existing file.

        Returns
        -------
        Recording
            Context manager; its attribute `dataset` is available after recording has ended.

        Raises
        ------
        ExperimentError
            If the file exists, or the simulation has ended.
        StorageError
            If the file cannot be written.
        """
        if self.outcome:
            raise ExperimentError(f"record: the simulation has ended: {self.outcome.stop_reason}")
        if path is None:
            memory = MemorySink()
            recording = Recording(self, memory, dataset_of=memory.dataset)
        else:
            from pbdkit.io.netcdf import NetcdfSink
            from pbdkit.io.open import open
            from pbdkit.io.save import refuse_existing

            refuse_existing(Path(path), force=force)
            file = NetcdfSink(Path(path), force, self.experiment.record.compression)
            recording = Recording(self, self.sink(file), dataset_of=lambda: open(file.written))
        self._start()
        self._recordings.append(recording)
        return recording

    _recordings: list[Recording]
    _states: Iterator[State] | None = None

    def _start(self) -> None:
        """Start the driver. Its first state is the current one, which is recorded."""
        if self._states is None:
            self._states, self._recordings = iter(self), []
            next(self._states)

    def _go(self, is_reached: Callable[[], bool]) -> None:
        """Advance until a condition holds or the run ends, and record each state."""
        self._start()
        assert self._states is not None
        while not self.outcome and not is_reached():
            try:
                for recording in self._recordings:
                    recording.take(self.driver.state)
                next(self._states, None)
            except BaseException:
                time, recordings, self._recordings = self.time, self._recordings, []
                self.outcome = RunOutcome(
                    "interrupted", f"an error occurred after step {time}", time
                )
                for recording in recordings:
                    recording.abandon()
                raise
        if self.outcome:
            recordings, self._recordings = self._recordings, []
            for recording in recordings:
                recording.finish(self.outcome)
            if self.outcome.status in FAILED:
                raise DivergedError(self.outcome.stop_reason)

    @property
    def experiment(self) -> Experiment:
        """Experiment, in which `auto` is replaced by values."""
        return self.scene.experiment

    @property
    def time(self) -> int:
        """Number of the current step."""
        return self.driver.state.step

    @property
    def state(self) -> xarray.Dataset:
        """Current state as a dataset.

        It contains `position`, `u` and `kind` of every particle, the state variables of rule and
        fracture model, and `broken_step` of every bond if bonds can break. Names, coordinates and
        units are the same as in the dataset of a run. The values are read-only, and later steps do
        not change them.
        """
        return self._snapshots.dataset(self.driver.state)

    @cached_property
    def _snapshots(self) -> Snapshots:
        return Snapshots(self.scene)

    @property
    def choice(self) -> Choice:
        """Engine, number of threads, and the reason for the choice."""
        return self.driver.choice

    @property
    def particles(self) -> int:
        """Number of particles, including those of the frame."""
        return self.scene.raster.count

    def recorder(self, sink: Sink) -> Recorder:
        """Return a recorder that writes the variables of the dataset to a sink."""
        return Recorder(self.scene, sink)

    def sink(self, file: KeepingSink) -> KeepingSink:
        """Return a sink that writes to a file concurrently with the simulation."""
        return OverlappingSink(file)

    @cached_property
    def prediction(self) -> dict[str, Any]:
        """Prediction of stability before the first step, in the form of the attribute of the
        dataset."""
        return prediction(self.scene, self.waves)

    @cached_property
    def waves(self) -> Bound | None:
        """Bound on stability from plane waves, or None if there is none."""
        return wave_bound(self.scene)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings before the first step, about the scene and its stability."""
        return quick_warnings(self.scene, self.waves)

    def further_warnings(self) -> list[str]:
        """Return the warnings of `check` that are not in `warnings` and can be computed within a
        second."""
        repeats = bool(self.waves) and "solver.relaxation" in " ".join(self.warnings)
        warnings = further_warnings(self.scene)
        return [w for w in warnings if not (repeats and w.startswith("solver.relaxation"))]


class Execution:
    """Executes runs in one process.

    The subclass in `pbdkit.mpi.distributed_run` executes them on all ranks of a communicator. There
    all ranks call each method together.
    """

    def __init__(self, communicator: Communicator = SERIAL) -> None:
        self.communicator = communicator

    def scene(self, experiment: Experiment) -> Scene:
        """Return the part of an experiment's scene that this process needs."""
        return build_scene(experiment)

    def tuned(self, scene: Scene) -> Scene:
        """Return the scene with numbers in place of `auto`."""
        return tuned(scene)

    def by_root(self, work: Callable[[], int]) -> int:
        """Return the result of a function that only the root evaluates."""
        return work()

    def run(self, scene: Scene, watch: Watch) -> Simulation:
        """Return the run of a scene."""
        return Simulation.of_scene(scene, watch=watch)


@dataclass(frozen=True)
class RunReport:
    """Outcome and cost of a recorded run.

    Parameters
    ----------
    outcome
        Outcome of the run.
    particles
        Number of particles, including those of the frame.
    wall_s
        Wall time of stepping and recording in seconds.
    choice
        Engine of the run.
    warnings
        Warnings that were issued at the end of the run.
    first
        Step at which this run started; larger than 0 if it was resumed.
    processes
        Number of processes that shared the lattice.
    """

    outcome: RunOutcome
    particles: int
    wall_s: float
    choice: Choice
    warnings: tuple[str, ...] = ()
    first: int = 0
    processes: int = 1

    @property
    def ns_per_particle_step(self) -> float:
        """Wall time of stepping and recording in nanoseconds per particle and step."""
        steps = max(1, self.outcome.steps - self.first)
        return self.wall_s * 1e9 / (self.particles * steps)


def peak_memory() -> int:
    """Return the largest resident memory of this process in bytes; 0 if it is not available.

    Where /proc/self/status exists, its value VmHWM is used, because `ru_maxrss` includes memory of
    the parent process on Linux.
    """
    status = Path("/proc/self/status")
    if status.exists() and (match := re.search(r"VmHWM:\s*(\d+)", status.read_text())):
        return int(match[1]) * 1024
    try:
        from resource import RUSAGE_SELF, getrusage
    except ImportError:
        return 0
    return getrusage(RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class Recording:
    """Recording of a simulation, as the field `record` of its experiment specifies.

    `Simulation.record` returns it. If it is used as a context manager, recording ends with the
    block.
    """

    def __init__(
        self,
        simulation: Simulation,
        sink: Sink,
        recorder: Recorder | None = None,
        dataset_of: Callable[[], xarray.Dataset] | None = None,
    ) -> None:
        self._simulation, self._sink, self._dataset_of = simulation, sink, dataset_of
        self._checkpoints = sink if isinstance(sink, KeepingSink) else None
        self._start_time, self._first = time.perf_counter(), simulation.time
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
        """End recording with the current state.

        If the run has not reached its last step, its status in the dataset is "interrupted".

        Raises
        ------
        StorageError
            If the file cannot be written.
        """
        simulation, time = self._simulation, self._simulation.time
        if self._has_ended:
            return
        if time >= simulation.experiment.steps:
            with suppress(DivergedError):  # recorded as the status of the dataset
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
        """Recorded dataset.

        Raises
        ------
        ExperimentError
            If recording has not ended.
        """
        if not self._has_ended or self._dataset_of is None:
            raise ExperimentError(
                "record: recording has not ended; leave the `with` block, or call close()"
            )
        return self._dataset_of()

    def take(self, state: State) -> None:
        """Record a state, and write a checkpoint if one is due.

        If the state cannot be recorded, the driver receives the error as `rejection`.
        """
        simulation, driver = self._simulation, self._simulation.driver
        try:
            with _located(simulation.scene):
                self._recorder.observe(state, last=driver.ends_early, time=driver.load_time)
        except FloatingPointError as error:
            driver.rejection = error
            return
        # No run is resumed from its last state.
        steps = simulation.experiment.steps
        ends = driver.ends_early or driver.is_complete or state.step >= steps
        if self._checkpoints and not ends and self._checkpoints.due():
            rate = (state.step - self._first) / (time.perf_counter() - self._start_time)
            self._checkpoints.keep(checkpoint_of(driver, self._recorder, rate))

    def suspend(self, outcome: RunOutcome) -> RunReport:
        """Write a checkpoint from which the run can be resumed."""
        assert self._checkpoints
        self._checkpoints.suspend(checkpoint_of(self._simulation.driver, self._recorder))
        return self._report(outcome)

    def finish(self, outcome: RunOutcome) -> RunReport:
        """Record the variables and attributes that exist only at the end of the run."""
        simulation, driver = self._simulation, self._simulation.driver
        if self._checkpoints:
            self._checkpoints.keep_final(checkpoint_of(driver, self._recorder))
        with _located(simulation.scene):
            self._recorder.finish(driver.state, outcome, simulation.prediction)
        self._has_ended = True
        return self._report(outcome, self._recorder.warnings)

    def abandon(self) -> None:
        """Discard the recording; checkpoints remain."""
        self._has_ended, self._dataset_of = True, None
        self._sink.abandon()

    def _report(self, outcome: RunOutcome, warnings: tuple[str, ...] = ()) -> RunReport:
        simulation, wall_s = self._simulation, time.perf_counter() - self._start_time
        cost = simulation.particles, wall_s, simulation.choice
        return RunReport(outcome, *cost, warnings, self._first, simulation.processes)


def record(simulation: Simulation, sink: Sink, *, recorder: Recorder | None = None) -> RunReport:
    """Run a simulation to its end and record it into a sink.

    If `recorder` is given and has begun, it continues an earlier recording. If the simulation is
    interrupted on request and the sink supports checkpoints, a checkpoint is written.
    """
    recording = Recording(simulation, sink, recorder)
    try:
        for state in simulation:
            if isinstance(sink, KeepingSink) and simulation.driver.interruption:
                return recording.suspend(simulation.driver.interruption)
            recording.take(state)
        assert simulation.outcome is not None
        return recording.finish(simulation.outcome)
    except BaseException:
        sink.abandon()
        raise


def rehearse(scene: Scene) -> None:
    """Evaluate the diagnostics for the initial state, so that their errors are raised before the
    run."""
    if not scene.experiment.diagnostics or scene.raster.count > MAX_DIAGNOSED_PARTICLES:
        return
    recorder = Recorder(scene, MemorySink())
    with _located(scene), suppress(FloatingPointError):  # Such a run diverges in its first step.
        recorder.begin()
        recorder.observe(initial_state(scene))


@contextmanager
def _located(scene: Scene) -> Iterator[None]:
    """Add the place in the experiment file to an ExperimentError."""
    try:
        yield
    except ExperimentError as error:
        raise scene.experiment.located(error) from None
