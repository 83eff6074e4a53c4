"""Runs stopped at random checks and resumed, in this process, by other engines and threads too."""

from __future__ import annotations

import json
import random
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from trials import differences, often

from pbdkit import simulation as drivers
from pbdkit.communicator import SERIAL
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.recorder import Recorder, columns_of
from pbdkit.io.run_store import UnfinishedRun, is_unfinished
from pbdkit.io.sinks import OverlappingSink
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.plugin import Component
from pbdkit.progress import StoppedError, Watch
from pbdkit.restart import restore
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import RunReport, Simulation, record

Components = Iterable[type[Component]]
MOST_STOPS = 4
NUMPY = {"engine": "numpy"}
ENGINES = [NUMPY, {"engine": "compiled", "threads": 1}, {"engine": "compiled", "threads": 2}]


class Looks(Watch):
    """Watch that stops at one of the next checks; not while the last good state of a run that
    diverged is searched: a stop then leaves no such state."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.left = at

    def look(self, share: float, what: str = "") -> None:
        self.left -= 1
        if self.left <= 0:
            raise StoppedError


def with_engine(parts: dict[str, Any], engine: dict[str, Any]) -> dict[str, Any]:
    """Return the same run, carried out by another engine; an equilibrium has none to choose."""
    solver = parts["solver"]
    return parts if solver["type"] == "equilibrium" else parts | {"solver": solver | engine}


def compression_of(experiment: Experiment) -> str:
    """That of its file."""
    return experiment.record.compression


def begun(parts: dict[str, Any], output: Path, own: Components, watch: Watch) -> RunReport:
    """A run from its start."""
    experiment = Experiment.build(Source("trial", parts), own)
    sink = NetcdfSink(output, compression=compression_of(experiment))
    return record(Simulation.of_scene(build_scene(experiment), watch=watch), OverlappingSink(sink))


def resumed(output: Path, own: Components, watch: Watch, engine: dict[str, Any]) -> RunReport:
    """The unfinished run of an output, by an engine of its own, as `pbdkit resume` does it."""
    left = UnfinishedRun.open(output, writing=True)
    try:
        parts = with_engine(json.loads(left.about["experiment"]), engine)
        experiment = Experiment.build(Source("stored", parts), own)
        scene, checkpoint = build_scene(experiment), left.checkpoint()
        sink = NetcdfSink(output)
        run, recorder = (
            Simulation.of_scene(scene, watch=watch),
            Recorder(scene, OverlappingSink(sink)),
        )
        restore(run.driver, recorder, checkpoint, SERIAL)
        sink.go_on(left, checkpoint, columns_of(scene), compression_of(experiment))
    except BaseException:
        left.close()
        raise
    return record(run, recorder.sink, recorder=recorder)


def resumed_otherwise(
    parts: dict[str, Any],
    folder: Path,
    draw: random.Random,
    own: Components = (),
    engines: list[dict[str, Any]] = ENGINES,
) -> tuple[list[str], int]:
    """Return the differences of the run, stopped and resumed several times, from the uninterrupted
    one; and the number of stops."""
    own, often_enough = list(own), drivers.MAX_CALL_S
    whole, output = folder / "whole.nc", folder / "out.nc"
    for path in (whole, output):
        path.unlink(missing_ok=True)
    dumped = json.loads(
        Experiment.build(Source("trial", parts), own).model_dump_json(by_alias=True)
    )
    if dumped["solver"].get("precision") == "float32":  # in which engines round differently
        engines = [draw.choice(engines)]
    parts = with_engine(dumped, draw.choice(engines))
    often(1e9)
    counting = Looks(2**60)
    begun(parts, whole, own, counting)
    most = min(2**60 - counting.left, parts["steps"]) + 1
    often(0.0 if draw.random() < 0.5 else 1e9)
    if draw.random() < 0.5:
        drivers.MAX_CALL_S = 0.0  # a look each step
        most = parts["steps"] + 1
    stops = 0
    try:
        report = begun(parts, output, own, Looks(draw.randint(1, most)))
        while is_unfinished(output):
            stops += 1
            watch = Looks(draw.randint(1, most) if stops < MOST_STOPS else 2**60)
            report = resumed(output, own, watch, draw.choice(engines))
    finally:
        drivers.MAX_CALL_S = often_enough
    del report
    found = [d for d in differences(whole, output) if d != "attributes ['experiment']"]
    left = sorted(p.name for p in folder.iterdir() if p not in (whole, output))
    return found + ([f"left behind: {left}"] if left else []), stops
