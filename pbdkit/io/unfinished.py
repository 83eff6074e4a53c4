"""The dataset of an unfinished run at its last checkpoint. Nothing is written to the disk."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from pbdkit.errors import StorageError
from pbdkit.io.layout import Column, Values
from pbdkit.io.netcdf import NetcdfFile, reopen_dataset
from pbdkit.io.recorder import Recorder, RunOutcome, columns_of
from pbdkit.io.run_store import UnfinishedRun
from pbdkit.io.seal import open_content
from pbdkit.io.sinks import Sink
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.plugin.discovery import refuse_retired
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import State, initial_state


class Overlay(Sink):
    """Sink that writes the end of a dataset into an open file. The changes are only in memory."""

    def __init__(self, file: NetcdfFile) -> None:
        self._file = file

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Do nothing, because the file already has all columns."""

    def put(self, values: Values) -> None:
        """Overwrite values in the file."""
        self._file.put(values)

    def finish(self, attributes: dict[str, str]) -> None:
        """Overwrite the attributes in the file."""
        self._file.finish(attributes)

    def abandon(self) -> None:
        """Do nothing, because nothing was written to the disk."""


def unfinished_dataset(output: Path) -> Any:
    """Return the dataset of an unfinished run as of its last commit, as an h5netcdf.File.

    It contains the data that were recorded until then, the state of the checkpoint and the final
    values. Its status is "interrupted". Raises StorageError, and the errors of `build_scene`.
    """
    run = UnfinishedRun.open(output, writing=False)
    facts, file = run.facts, run.file(read_only=True)
    if "finished" in facts:
        run.release()
        return open_content(file)
    checkpoint = run.checkpoint()
    run.release()
    try:
        parts = json.loads(checkpoint.about["experiment"])
        state, recorded = checkpoint.state(State)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise StorageError(f"{output}: its store is damaged: {error}") from None
    refuse_retired(parts, f"{output}, which is unfinished,")
    scene = build_scene(Experiment.build(Source(f"{output}, unfinished", parts)))
    if not isinstance(state, State) or not state.fits(initial_state(scene)):
        raise StorageError(f"{output}: the state in its store belongs to another experiment")
    compress = scene.experiment.record.compression == "zlib"
    target = reopen_dataset(file, columns_of(scene), checkpoint, compress=compress)
    recorder = Recorder(scene, Overlay(target))
    recorder.last_steps = recorded
    reason = f"unfinished: step {state.step} of {scene.experiment.steps} at the last checkpoint"
    with suppress(FloatingPointError):  # A state that is not finite is not part of the dataset.
        recorder.observe(state, last=True)
    recorder.finish(state, RunOutcome("interrupted", reason, state.step), {})
    return open_content(file)
