"""What a run would refuse at its start, found without one."""

from __future__ import annotations

from contextlib import suppress

from pbdkit.errors import ExperimentError
from pbdkit.results.layout import Column, Values
from pbdkit.results.recorder import Recorder, Sink
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import initial_state

LARGEST = 50_000
"""Of larger bodies nothing is measured ahead of the run."""


class Nowhere(Sink):
    """Keeps nothing."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Nothing is made ready."""

    def put(self, values: Values) -> None:
        """Nothing is kept."""

    def finish(self, attributes: dict[str, str]) -> None:
        """Nothing is written."""

    def abandon(self) -> None:
        """There is nothing to leave behind."""


def rehearse(scene: Scene) -> None:
    """Measures at the start what the run will record; raises what the run would."""
    if not scene.experiment.diagnostics or scene.raster.count > LARGEST:
        return
    recorder = Recorder(scene, Nowhere())
    try:
        recorder.begin()
        with suppress(FloatingPointError):  # such a run diverges at once, and says so
            recorder.observe(initial_state(scene))
    except ExperimentError as error:
        raise scene.experiment.located(error) from None
