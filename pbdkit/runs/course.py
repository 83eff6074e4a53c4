"""The run of a scene, its recording, and a rehearsal of that."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pbdkit.analysis.stencil import Bound, wave_bound
from pbdkit.errors import ExperimentError
from pbdkit.experiment.solvers import Equilibrium, Solver, Stepping
from pbdkit.prediction.forecast import outlook, prediction, quick_warnings
from pbdkit.results.overlapping_sink import OverlappingSink
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Outcome, Recorder
from pbdkit.results.sink import KeepingSink, MemorySink, Sink
from pbdkit.runs.drivers import Driver, Stepwise, Straight
from pbdkit.runs.standing import standing_of
from pbdkit.runs.tuning import tuned
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import Choice
from pbdkit.stepping.state import State, initial_state

DRIVERS: dict[type[Solver], Callable[[Scene, State, Watch], Driver]] = {
    Stepping: Stepwise,
    Equilibrium: Straight,
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
        self.outcome: Outcome | None = None
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
class Report:
    """How a recorded run went, for those who look at its cost, and what is to be said of its
    end."""

    outcome: Outcome
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


def record(run: Run, sink: Sink, *, recorder: Recorder | None = None) -> Report:
    """Takes a run to its end, and what the experiment records of it into the sink. A `recorder` of
    the sink that has begun goes on with what it took before. A run that is asked to stop is left
    where it stands, where the sink can keep that."""
    begun, scene, first = time.perf_counter(), run.scene, run.state.step
    keeping = sink if isinstance(sink, KeepingSink) else None

    def report(outcome: Outcome, warnings: tuple[str, ...] = ()) -> Report:
        wall_s = time.perf_counter() - begun
        return Report(outcome, run.particles, wall_s, run.choice, warnings, first, run.processes)

    try:
        if recorder is None:
            recorder = run.recorder(sink)
            with _located(scene):
                recorder.begin()
        for state in run:
            if keeping and run.driver.stopped:
                keeping.suspend(standing_of(run.driver, recorder))
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
                keeping.keep(standing_of(run.driver, recorder, rate))
        assert run.outcome is not None
        if keeping:
            keeping.note_end(standing_of(run.driver, recorder))
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
