"""Those who carry out a run together: here one process, alone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pbdkit.experiment.model import Experiment
    from pbdkit.results.progress import Watch
    from pbdkit.runs.course import Run
    from pbdkit.scene.scene import Scene


class Processes:
    """One process, which has nobody to talk to. Each call is made by all of several processes."""

    first: bool = True
    """Whether this one speaks for all: it reads, writes and talks to the user."""
    size: int = 1

    def told(self, value: Any) -> Any:
        """The value that the first process has."""
        return value

    def agreeing(self) -> AbstractContextManager[None]:
        """What is raised in the block, in any process, is raised in all of them at its end."""
        return nullcontext()

    def scene(self, experiment: Experiment) -> Scene:
        """What this one needs of an experiment's scene: here all."""
        from pbdkit.scene.scene import build_scene

        return build_scene(experiment)

    def tuned(self, scene: Scene) -> Scene:
        """The scene with numbers in place of `auto`."""
        from pbdkit.runs.tuning import tuned

        return tuned(scene)

    def by_first(self, work: Callable[[], int]) -> int:
        """What the first process alone comes to."""
        return work()

    def run(self, scene: Scene, watch: Watch) -> Run:
        """The run of a scene that they make together."""
        from pbdkit.runs.course import Run

        return Run(scene, watch=watch)
