"""Runs that are gone on with: what was left unfinished, and what ended and is to go further."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_setting
from pbdkit.experiment.shipped import read_experiment
from pbdkit.experiment.source import Source
from pbdkit.results.layout import SCHEMA_VERSION, Column, Values, When
from pbdkit.results.netcdf_sink import FINAL_STATE, NetcdfSink
from pbdkit.results.other_files import refuse_other_file, refuse_store
from pbdkit.results.overlapping_sink import OverlappingSink
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Recorder, columns_of
from pbdkit.results.result_file import reading
from pbdkit.runs.course import Report, Run, record
from pbdkit.runs.standing import take_up
from pbdkit.scene.scene import build_scene
from pbdkit.storage.run_files import is_unfinished
from pbdkit.storage.seal import opened
from pbdkit.storage.standing import Standing
from pbdkit.storage.unfinished import UnfinishedRun

ENDED = ("complete", "settled", "interrupted")
"""The status of results that can be continued."""


@dataclass(frozen=True)
class Resumption:
    """A run that is ready to be gone on with: ``record()`` does it."""

    run: Run
    sink: NetcdfSink
    recorder: Recorder

    def record(self) -> Report:
        """To its end. Raises what any run does."""
        return record(self.run, self.recorder.sink, recorder=self.recorder)


def resumption(
    output: Path, watch: Watch, *, steps: int | None = None, anyway: bool = False
) -> Resumption | None:
    """The unfinished run of an output, or its result to be continued to so many steps; None where
    all was done but to give the result its name, which it has now.

    Raises ExperimentError where there is nothing to go on with, and, unless told to go on `anyway`,
    where the experiment, pbdkit or a plugin changed since; StorageError for what is damaged.
    """
    refuse_store(output)
    if is_unfinished(output):
        return _unfinished(output, watch, steps, anyway)
    refuse_other_file(output)
    if not output.exists():
        raise ExperimentError(f"{output}: there is no unfinished run of it, and no result")
    if steps is None:
        raise ExperimentError(f"{output}: is finished; --steps N continues it to step N")
    return _continued(output, watch, steps, anyway)


@contextmanager
def _damage_named(output: Path) -> Iterator[None]:
    """What was kept in other forms than a run keeps is damage, not a bug."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise StorageError(f"{output}: what was kept of it is damaged: {error}") from error


def _unfinished(output: Path, watch: Watch, steps: int | None, anyway: bool) -> Resumption | None:
    left = UnfinishedRun.open(output, writing=True)
    try:
        about, origin = left.about, left.about.get("origin")
        if not isinstance(origin, dict):
            raise StorageError("what is noted under 'origin' is damaged")
        sink = NetcdfSink(output, replace=origin.get("replace") is True, origin=origin)
        if "finished" in left.facts:
            with _damage_named(output):
                sink.conclude(left)
            return None
        experiment = _experiment(about, f"{output}, unfinished", steps, left.facts.get("step"))
        if not anyway:
            _refuse_versions(output, about, experiment)
            _refuse_changed_file(output, about, origin)
        scene = build_scene(experiment)
        run, recorder = Run(scene, watch=watch), Recorder(scene, OverlappingSink(sink))
        with _damage_named(output):
            standing = left.standing()
            take_up(run.driver, recorder, standing)
            sink.go_on(left, standing, columns_of(scene), experiment.record.compression)
    except BaseException:
        left.close()
        raise
    return Resumption(run, sink, recorder)


def _continued(output: Path, watch: Watch, steps: int, anyway: bool) -> Resumption:
    """The result stays as it is until the longer one takes its place."""
    with reading(output) as dataset:
        about = dataset.attrs
        if about.get("status") not in ENDED:
            raise ExperimentError(f"is {about.get('status')}: there is nothing to continue")
        if (made_as := about.get("schema_version")) != SCHEMA_VERSION:
            raise ExperimentError(
                f"is of schema_version {made_as}, and what is recorded now is laid out as "
                f"{SCHEMA_VERSION}; run it anew with --set steps={steps}"
            )
        standing = _final_state(output)
        experiment = _experiment(about, str(output), steps, standing.facts.get("step"))
        if not experiment.solver.makes_steps:
            raise ExperimentError(
                "is an equilibrium, which is found and not continued; run it anew with "
                f"--set steps={steps}"
            )
        if not anyway:
            made = {"pbdkit": about.get("pbdkit_version"), "plugins": _map(about, "plugins")}
            _refuse_versions(output, made, experiment)
        scene = build_scene(experiment)
        compression = experiment.record.compression
        run, sink = Run(scene, watch=watch), NetcdfSink(output, True, compression)
        recorder = Recorder(scene, OverlappingSink(sink))
        try:
            recorder.begin(_history(dataset, columns_of(scene), experiment))
            recorded = [t for t in dataset["time"].values.tolist() if experiment.records(t)]
            take_up(run.driver, recorder, standing, recorded[-1])
        except BaseException:
            recorder.sink.abandon()
            raise
    return Resumption(run, sink, recorder)


def _history(dataset: Any, columns: list[Column], experiment: Experiment) -> Iterator[Values]:
    """What was recorded and would be by the longer run, entry by entry."""
    for column in columns:
        if column.when is When.START:
            yield {column.name: dataset[column.name].values}
    for dim in ("time", "step"):
        along = [column.name for column in columns if column.grows and column.dims[0] == dim]
        steps = dataset[dim].values.tolist() if along else []
        for n, step in enumerate(steps):
            if dim == "step" or experiment.records(step):
                yield {name: dataset[name][n].values for name in along}


def _final_state(output: Path) -> Standing:
    content = opened(output)
    try:
        group = content.groups[FINAL_STATE]
        arrays = {name: variable[...] for name, variable in group.variables.items()}
        return Standing({}, json.loads(group.attrs["facts"]), arrays)
    except KeyError:
        raise StorageError("holds no final state: an older pbdkit made it") from None
    finally:
        content.close()


def _experiment(about: Mapping[str, Any], name: str, steps: int | None, done: Any) -> Experiment:
    parts = _map(about, "experiment")
    if steps is not None:
        if isinstance(done, int) and steps <= done:
            raise ExperimentError(f"{name}: {done} steps are done; --steps takes a larger number")
        parts["steps"] = steps
    return Experiment.build(Source(name, parts))


def _map(about: Mapping[str, Any], key: str) -> dict[str, Any]:
    """What is noted there as JSON."""
    try:
        found = json.loads(about.get(key, ""))
    except (ValueError, TypeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise StorageError(f"what is noted under '{key}' is damaged")
    return found


def _refuse_versions(output: Path, made: Mapping[str, Any], experiment: Experiment) -> None:
    here = experiment.distributions() | {"pbdkit": version("pbdkit")}
    before = {**made.get("plugins", {}), "pbdkit": made.get("pbdkit")}
    for name, now in here.items():
        if before.get(name) != now:
            raise ExperimentError(
                f"{output}: was begun with {name} {before.get(name)}, and {now} is installed: the "
                "steps to come may differ; --anyway goes on with it"
            )


def _refuse_changed_file(output: Path, about: Mapping[str, Any], origin: Any) -> None:
    """Where the run came from a file that says something else now."""
    file, settings = origin.get("experiment"), origin.get("settings", [])
    if not isinstance(file, str) or not Path(file).is_file():
        return
    try:
        source = read_experiment(file)
        for setting in settings:
            source = with_setting(source, setting, Experiment.defaults())
        now = json.loads(Experiment.build(source).model_dump_json(by_alias=True))
    except PbdkitError:
        now = None
    begun = _map(about, "experiment")
    if now is not None:  # what the run has chosen itself is no change
        chosen = begun.get("solver", {})
        now["solver"] = {k: chosen.get(k) if v == "auto" else v for k, v in now["solver"].items()}
    if now != begun:
        raise ExperimentError(
            f"{output}: {file} has changed since the run began, which goes on as it was then; "
            "--anyway does so"
        )
