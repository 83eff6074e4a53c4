"""A run on several processes, and its recording."""

from __future__ import annotations

from collections.abc import Callable

from pbdkit.analysis.stencil import Bound, wave_bound
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.solvers import Equilibrium, Solver, Stepping
from pbdkit.prediction.forecast import prediction, quick_warnings
from pbdkit.ranks.building import CUTS, built
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.divided_driver import DividedStepwise, Division, whole_of
from pbdkit.ranks.divided_equilibrium import DividedStraight
from pbdkit.ranks.divided_recording import DividedRecorder, PartSink
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Recorder
from pbdkit.results.sink import KeepingSink, Sink
from pbdkit.runs.course import Run
from pbdkit.runs.drivers import Driver
from pbdkit.runs.tuning import tuned, with_solver
from pbdkit.scene.scene import Scene

DRIVERS: dict[type[Solver], Callable[[Division, Scene, Watch], Driver]] = {
    Stepping: DividedStepwise,
    Equilibrium: DividedStraight,
}
"""What carries it out on one of them."""


class DividedRun(Run):
    """One run that several processes share: each has its part of the scene. What it gives out are
    states of the part. Raises what any run does, in all processes."""

    def __init__(self, ranks: Ranks, scene: Scene, watch: Watch) -> None:
        chosen = scene.experiment.stepping.open_parameters
        scene, kind = _tuned(ranks, scene), type(scene.experiment.solver)
        with ranks.agreeing():
            parts = CUTS[kind].subdomains(scene, ranks.size)
        self.division = Division(ranks, scene, parts)
        self.scene, self.outcome, self.processes = self.division.scene, None, ranks.size
        self.driver = DRIVERS[kind](self.division, scene, watch)
        self.driver.chosen = chosen
        bound = wave_bound(scene)
        self.warnings, self.prediction = self._warnings(scene, bound), prediction(scene, bound)

    def _warnings(self, scene: Scene, bound: Bound | None) -> tuple[str, ...]:
        """Whether masses are too light the first process finds, of the whole."""
        if not any(leading.share is not None for leading in scene.leading):
            return quick_warnings(scene, bound)
        with self.division.ranks.agreeing():
            whole = self.division.whole_of(scene)
            return quick_warnings(whole, bound) if whole else ()

    def outlook(self) -> list[str]:
        """Nothing: `check` looks at the whole."""
        return []

    @property
    def particles(self) -> int:
        """Of the whole."""
        return self.division.count

    def recorder(self, sink: Sink) -> Recorder:
        """Of the part, into what `sink` gives."""
        assert isinstance(sink, PartSink)
        return DividedRecorder(self.division, sink)

    def sink(self, inner: KeepingSink) -> KeepingSink:
        """Joins the parts for the sink of the first process."""
        return PartSink(self.division, inner)


def _tuned(ranks: Ranks, scene: Scene) -> Scene:
    """With numbers in place of `auto`, which the first process finds, of the whole."""
    if not scene.experiment.stepping.is_open:
        return scene
    found = None
    with ranks.agreeing():
        if whole := whole_of(ranks, scene):
            found = tuned(whole).experiment.stepping
    return with_solver(scene, ranks.told(found))


class SharingRanks(Ranks):
    """Processes that share every run."""

    def scene(self, experiment: Experiment) -> Scene:
        """Each what it needs for its part."""
        return built(self, experiment)

    def tuned(self, scene: Scene) -> Scene:
        """Each its part of the scene, with the numbers that are found for the whole."""
        return _tuned(self, scene)

    def run(self, scene: Scene, watch: Watch) -> Run:
        """Each its part."""
        return DividedRun(self, scene, watch)
