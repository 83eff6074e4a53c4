"""A run on several processes, and its recording."""

from __future__ import annotations

from collections.abc import Callable

from pbdkit.analysis.stencil import wave_bound
from pbdkit.experiment.solvers import Equilibrium, Solver, Stepping
from pbdkit.prediction.forecast import prediction, quick_warnings
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.divided_driver import DividedStepwise, Division
from pbdkit.ranks.divided_equilibrium import DividedStraight
from pbdkit.ranks.divided_recording import DividedRecorder, PartSink
from pbdkit.ranks.divided_rows import deep_subdomains
from pbdkit.ranks.subdomain import Subdomain, subdomains
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Recorder
from pbdkit.results.sink import KeepingSink, Sink
from pbdkit.runs.course import Run
from pbdkit.runs.drivers import Driver
from pbdkit.runs.tuning import tuned
from pbdkit.scene.scene import Scene

CUTS: dict[type[Solver], Callable[[Scene, int], list[Subdomain]]] = {
    Stepping: subdomains,
    Equilibrium: deep_subdomains,
}
"""What cuts a scene into parts for a solver."""
DRIVERS: dict[type[Solver], Callable[[Division, Scene, Watch], Driver]] = {
    Stepping: DividedStepwise,
    Equilibrium: DividedStraight,
}
"""What carries it out on one of them."""


class DividedRun(Run):
    """One run that several processes share: each has its part of the scene. What it gives out are
    states of the part. Raises what any run does, in all processes."""

    def __init__(self, ranks: Ranks, scene: Scene, watch: Watch) -> None:
        whole, kind = tuned(scene), type(scene.experiment.solver)
        cut, driver = CUTS[kind], DRIVERS[kind]
        with ranks.agreeing():
            self.division = Division(ranks, whole, cut(whole, ranks.size))
        self.scene, self.outcome, self.processes = self.division.scene, None, ranks.size
        self.driver = driver(self.division, whole, watch)
        self.warnings, self.prediction = (), {}
        if ranks.first:
            bound = wave_bound(whole)
            self.warnings = quick_warnings(whole, bound)
            self.prediction = prediction(whole, bound)

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


class SharingRanks(Ranks):
    """Processes that share every run."""

    def run(self, scene: Scene, watch: Watch) -> Run:
        """Each its part."""
        return DividedRun(self, scene, watch)
