"""The execution of a run, by one process or by all ranks of a communicator."""

from __future__ import annotations

from collections.abc import Callable

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.model.experiment import Experiment
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Simulation
from pbdkit.stability.relaxation import tuned


class Execution:
    """Executes runs: in one process, or, in `pbdkit.mpi.distributed_run`, on all ranks of a
    communicator, which call each method together."""

    def __init__(self, communicator: Communicator = SERIAL) -> None:
        self.communicator = communicator

    def scene(self, experiment: Experiment) -> Scene:
        """Return the part of an experiment's scene that this process needs."""
        return build_scene(experiment)

    def tuned(self, scene: Scene) -> Scene:
        """Return the scene with numbers in place of `auto`."""
        return tuned(scene)

    def by_root(self, work: Callable[[], int]) -> int:
        """Return the result of work that the root does alone."""
        return work()

    def run(self, scene: Scene, watch: Watch) -> Simulation:
        """Return the run of a scene."""
        return Simulation.of_scene(scene, watch=watch)
