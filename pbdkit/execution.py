"""The execution of a run, by one process or by all ranks of a communicator.

Its imports are made when a scene is built, so that a command that ends before starts quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pbdkit.communicator import SERIAL, Communicator

if TYPE_CHECKING:
    from pbdkit.model.experiment import Experiment
    from pbdkit.progress import Watch
    from pbdkit.scene.scene import Scene
    from pbdkit.simulation import Simulation


class Execution:
    """Where runs are carried out: by one process, or, in `pbdkit.mpi.distributed_run`, by all
    processes of a communicator, which make each call together."""

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

    def run(self, scene: Scene, watch: Watch) -> Simulation:
        """Return the run of a scene."""
        from pbdkit.simulation import Simulation

        return Simulation.of_scene(scene, watch=watch)
