"""A run on several processes, and its recording."""

from __future__ import annotations

from pbdkit.analysis.stencil import wave_bound
from pbdkit.errors import ExperimentError
from pbdkit.prediction.forecast import prediction, quick_warnings
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.divided_driver import DividedStepwise, Division
from pbdkit.ranks.divided_recording import DividedRecorder, PartSink
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Recorder
from pbdkit.results.sink import KeepingSink, Sink
from pbdkit.runs.course import Run
from pbdkit.runs.tuning import tuned
from pbdkit.scene.scene import Scene


class DividedRun(Run):
    """One run that several processes share: each steps its part of the scene. What it gives out are
    states of the part. Raises what any run does, in all processes."""

    def __init__(self, ranks: Ranks, scene: Scene, watch: Watch) -> None:
        if not scene.experiment.solver.makes_steps:
            refusal = "an equilibrium is found by one process; run it without mpiexec"
            raise scene.experiment.located(ExperimentError(refusal, ("solver", "type")))
        whole, self.processes = tuned(scene), ranks.size
        with ranks.agreeing():
            self.division = Division(ranks, whole)
        self.scene, self.outcome = self.division.scene, None
        self.driver = DividedStepwise(self.division, whole, watch)
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
