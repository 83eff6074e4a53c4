"""The dataset of an unfinished run, at its last checkpoint; nothing is written."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from pbdkit.errors import StorageError
from pbdkit.io.layout import Column, Values
from pbdkit.io.netcdf import NetcdfFile, reopened
from pbdkit.io.recorder import Recorder, RunOutcome, columns_of
from pbdkit.io.run_store import UnfinishedRun
from pbdkit.io.seal import opened_in
from pbdkit.io.sinks import Sink
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.plugin.discovery import refuse_retired
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import State, initial_state


class Overlay(Sink):
    """Puts the end of a dataset over a file that stays as it is."""

    def __init__(self, file: NetcdfFile) -> None:
        self._file = file

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """It has begun."""

    def put(self, values: Values) -> None:
        """Over the file."""
        self._file.put(values)

    def finish(self, attributes: dict[str, str]) -> None:
        """Over the file."""
        self._file.finish(attributes)

    def abandon(self) -> None:
        """Nothing was written."""


def unfinished_dataset(output: Path) -> Any:
    """The content as an h5netcdf.File, with status "interrupted", at the last commit: what was
    recorded until then, its state and what is known at the end of a run.

    Raises StorageError, and what building the experiment's scene raises.
    """
    left = UnfinishedRun.open(output, writing=False)
    facts, file = left.facts, left.file(read_only=True)
    if "finished" in facts:
        left.release()
        return opened_in(file)
    checkpoint = left.checkpoint()
    left.release()
    try:
        parts = json.loads(checkpoint.about["experiment"])
        state, seen = checkpoint.state(State)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise StorageError(f"{output}: its store is damaged: {error}") from None
    refuse_retired(parts, f"{output}, which is unfinished,")
    scene = build_scene(Experiment.build(Source(f"{output}, unfinished", parts)))
    if not isinstance(state, State) or not state.fits(initial_state(scene)):
        raise StorageError(f"{output}: its store holds a state of another experiment")
    compress = scene.experiment.record.compression == "zlib"
    making = reopened(file, columns_of(scene), checkpoint, compress=compress)
    recorder = Recorder(scene, Overlay(making))
    recorder.seen = seen
    reason = f"unfinished: step {state.step} of {scene.experiment.steps} when it was kept last"
    with suppress(FloatingPointError):  # a state that is not finite is not shown
        recorder.observe(state, last=True)
    recorder.finish(state, RunOutcome("interrupted", reason, state.step), {})
    return opened_in(file)
