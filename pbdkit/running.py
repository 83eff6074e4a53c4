"""Runs experiments: from a file, a dict or an object to a dataset in memory or in a file."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.analysis.analysis import Analysis
from pbdkit.analysis.forecast import refuse_too_much_output
from pbdkit.equilibrium.finding import UnconvergedError
from pbdkit.equilibrium.loading import settle
from pbdkit.errors import DivergedError, ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_setting
from pbdkit.experiment.shipped import read_experiment
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.experiment.source import Source
from pbdkit.interfaces import Component
from pbdkit.registry.registry import GIVEN, Registry
from pbdkit.results.memory import MemorySink
from pbdkit.results.progress import progress_bar
from pbdkit.results.recorder import Outcome, Recorder, Sink
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.choice import Choice, choose, make_engine
from pbdkit.stepping.engine import Engine
from pbdkit.stepping.guard import Guard
from pbdkit.stepping.state import initial_state

if TYPE_CHECKING:
    import xarray

LONGEST_CALL_S, SECONDS_A_VALUE = 0.2, 2e-9
"""An engine is called for so long at most, so that progress shows and interruptions are heard."""
Components = Iterable[type[Component]]
_STRAIGHT = Choice("equilibrium", 1, "asked for")


@dataclass(frozen=True)
class Report:
    """How a run went, for those who look at its cost."""

    outcome: Outcome
    particles: int
    wall_s: float
    choice: Choice

    @property
    def ns_per_particle_step(self) -> float:
        """Wall time of stepping and recording together."""
        return self.wall_s * 1e9 / (self.particles * max(1, self.outcome.steps))


def load(
    name: str | Path, *, components: Components = (), settings: Iterable[str] = ()
) -> Experiment:
    """The experiment in a YAML file, or the shipped one of that name, e.g. "paper/a".

    `settings` are changes such as "rule.K=-0.002"; `components` are classes from Python that the
    experiment may name besides the installed ones. Raises ExperimentError and PluginError.
    """
    source = read_experiment(str(name))
    for setting in settings:
        source = with_setting(source, setting, Experiment.defaults())
    return Experiment.build(source, components)


def run(
    experiment: Experiment | Mapping[str, Any] | str | Path,
    *,
    components: Components = (),
    progress: bool = True,
) -> xarray.Dataset:
    """Runs an experiment and returns its dataset; nothing is written.

    `experiment` may also be a dict, a file or the name of a shipped experiment. Raises
    ExperimentError for a wrong experiment, PluginError for a missing or broken plugin, and
    DivergedError, with what was recorded before, when the run leaves the finite numbers.
    """
    sink, scene = MemorySink(), build_scene(_experiment(experiment, components))
    refuse_too_much_output(scene)
    report = run_into(sink, scene, progress=progress)
    dataset = sink.dataset()
    if report.outcome.status in ("diverged", "unconverged"):
        raise DivergedError(report.outcome.stop_reason, dataset)
    return dataset


def analyse(
    experiment: Experiment | Mapping[str, Any] | str | Path, *, components: Components = ()
) -> Analysis:
    """What is known of a run before its first step: stability, eigenvalues, steps to a tolerance,
    and the step operator as a sparse matrix (``.operator``)."""
    return Analysis(build_scene(_experiment(experiment, components)))


def rerun(
    dataset: xarray.Dataset, *, components: Components = (), progress: bool = True
) -> xarray.Dataset:
    """The same run again, bit for bit, from the experiment that the dataset carries."""
    return run(experiment_of(dataset, components), progress=progress)


def experiment_of(dataset: xarray.Dataset, components: Components = ()) -> Experiment:
    """The experiment that a dataset carries. Raises ExperimentError where there is none, or where
    it wants components that are not there."""
    if "experiment" not in dataset.attrs:
        raise ExperimentError("the dataset carries no experiment: pbdkit did not make it")
    source = Source("dataset", json.loads(dataset.attrs["experiment"]))
    try:
        return Experiment.build(source, components)
    except ExperimentError as error:
        given = json.loads(dataset.attrs.get("plugins", "{}")).get(GIVEN)
        if given is None or components:
            raise
        raise ExperimentError(f"{error}; it was run with components=[...]: {given}") from None


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
    return Report(outcome, scene.raster.count, time.perf_counter() - begun, choice)


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
    outcome, guard = Outcome("complete", "all steps done", steps), Guard(scene, state)
    try:
        recorder.observe(state)
        while state.step < steps and not stopping():
            wanted = recorder.next_after(state.step)
            reached = min(wanted, guard.next_look, state.step + patience)
            state = engine.advance(state, reached - state.step)
            if reached == guard.next_look or recorder.records(reached):
                guard.look(state)
            recorder.observe(state)
            show(state.step)
        if state.step < steps:
            recorder.observe_last(state)
            outcome = Outcome("interrupted", f"stopped after step {state.step}", state.step)
    except FloatingPointError as error:
        reason = f"{error} left all bounds under rule '{scene.experiment.rule.type}'"
        outcome = Outcome("diverged", reason, state.step)
    recorder.finish(state, outcome)
    return outcome


def _experiment(
    given: Experiment | Mapping[str, Any] | str | Path, components: Components
) -> Experiment:
    if isinstance(given, Experiment):
        Registry(components)  # what is handed over is checked, needed or not
        return given
    if isinstance(given, Mapping):
        return Experiment.build(Source(data=dict(given)), components)
    return load(given, components=components)
