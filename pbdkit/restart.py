"""Resume a run: from the checkpoint of an unfinished run, or from the end of a finished one that is
to be continued.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pbdkit.communicator import Communicator
from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.layout import SCHEMA_VERSION, Column, Values, When
from pbdkit.io.netcdf import FINAL_STATE, NetcdfSink
from pbdkit.io.open import reading, refuse_other_file, refuse_store
from pbdkit.io.paged_file import PiecedArray
from pbdkit.io.recorder import Recorder, columns_of
from pbdkit.io.run_store import UnfinishedRun, is_unfinished, make_room
from pbdkit.io.seal import opened
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source, with_settings
from pbdkit.model.shipped import read_experiment
from pbdkit.plugin.discovery import refuse_retired
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.simulation import Driver, Execution, RunReport, Simulation, record
from pbdkit.stability.relaxation import with_solver


def restore(
    driver: Driver,
    recorder: Recorder,
    checkpoint: Checkpoint | None,
    communicator: Communicator,
    recorded: int | None = None,
) -> None:
    """Let a run that has not begun continue from the checkpoint that the root has; `recorded` is
    the last step recorded, where that is another one than was kept. Raises StorageError for a
    checkpoint that is damaged or of another scene."""
    own, parts = driver.state_dict(), dict[str, Any]()
    with communicator.raise_together():
        if checkpoint:
            experiment, classes = driver.scene.experiment, dict[str, type]()
            if experiment.stepping.settle:
                from pbdkit.equilibrium.certificate import Pace

                classes["Pace"] = Pace
            parts = checkpoint.parts(own, experiment.steps, classes)
            if recorded is not None:
                parts["kept"] = parts["seen"].recorded = recorded
    recorder.seen = communicator.bcast(parts.get("seen"))
    driver.load_state_dict(parts)


ENDED = ("complete", "settled", "interrupted")
"""The status of results that can be continued."""
BLOCK_BYTES = 2**22
"""Of a result that is continued so much is read at once, or one row if that is more."""


def asked(
    left: UnfinishedRun, output: Path, steps: int | None, anyway: bool
) -> tuple[Source | None, dict[str, Any]]:
    """The experiment of an unfinished run, None where all of it is done, and where it came from."""
    about, origin = left.about, left.about.get("origin")
    if not isinstance(origin, dict):
        raise StorageError("what is noted under 'origin' is damaged")
    if "finished" in left.facts:
        return None, origin
    source = _source(about, f"{output}, unfinished", steps, left.facts.get("step"))
    experiment = Experiment.build(source)
    if steps not in (None, about.get("steps")) and not experiment.solver.makes_steps:
        raise ExperimentError(
            f"{output}: an equilibrium is looked for, and the way there depends on `steps`: resume "
            f"it without --steps, or run it anew with --set steps={steps}"
        )
    if not anyway:
        _refuse_versions(output, about, experiment)
        _refuse_changed_file(output, about, origin)
    return source, origin


def chosen_parameters(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """The parameters of the solver that the run has chosen itself."""
    found = facts.get("chosen", [])
    if not isinstance(found, list) or not {*found} <= {"relaxation", "memory"}:
        raise StorageError("what is noted under 'chosen' is damaged")
    return tuple(found)


def longer(
    dataset: Any, output: Path, steps: int, anyway: bool, kept: ExitStack | None = None
) -> tuple[Source, Checkpoint]:
    """The experiment of a result, of more steps, and where it stands; its arrays stay in the file
    until `kept` is closed, where that is given. Raises ExperimentError where it is to be run anew.
    """
    about = dataset.attrs
    if about.get("status") not in ENDED:
        raise ExperimentError(f"is {about.get('status')}: there is nothing to continue")
    if (made_as := about.get("schema_version")) != SCHEMA_VERSION:
        raise ExperimentError(
            f"is of schema_version {made_as}, and what is recorded now is laid out as "
            f"{SCHEMA_VERSION}; run it anew with --set steps={steps}"
        )
    checkpoint = _final_state(output, kept)
    source = _source(about, str(output), steps, checkpoint.facts.get("step"))
    experiment = Experiment.build(source)
    if not experiment.solver.makes_steps:
        raise ExperimentError(
            "is an equilibrium, which is found and not continued; run it anew with "
            f"--set steps={steps}"
        )
    if not anyway:
        made = {"pbdkit": about.get("pbdkit_version"), "plugins": _map(about, "plugins")}
        _refuse_versions(output, made, experiment)
    return source, checkpoint


def history(
    dataset: Any, columns: list[Column], experiment: Experiment, *, pieced: bool = False
) -> Iterator[Values]:
    """What was recorded and would be by the longer run, entry by entry; large ones `pieced` on
    request."""
    for column in columns:
        if column.when is When.START:
            yield {column.name: _entry(dataset[column.name], pieced)}
    for dim in ("time", "step"):
        along = [column.name for column in columns if column.grows and column.dims[0] == dim]
        steps = dataset[dim].values.tolist() if along else []
        for step, values in zip(steps, _rows(dataset, along, dim, pieced), strict=False):
            if dim == "step" or experiment.records(step):
                yield values


def _rows(dataset: Any, names: list[str], dim: str, pieced: bool) -> Iterator[Values]:
    """Row by row along a dimension. They are read in blocks: to read anything takes far longer than
    to read one row of a small body."""
    count = dataset.sizes.get(dim, 0)
    size = sum(dataset[name].nbytes for name in names)
    block = max(1, BLOCK_BYTES * count // max(1, size))
    for start in range(0, count, block):
        if pieced and block == 1:
            yield {name: _entry(dataset[name][start], pieced) for name in names}
            continue
        read = {name: dataset[name][start : start + block].values for name in names}
        for n in range(min(block, count - start)):
            yield {name: values[n] for name, values in read.items()}


def _entry(variable: Any, pieced: bool) -> Any:
    """All that a variable holds."""
    if not pieced or variable.dtype.kind not in "fiub" or variable.nbytes <= BLOCK_BYTES:
        return variable.values
    count, some = len(variable), max(1, BLOCK_BYTES * len(variable) // variable.nbytes)
    pieces = (variable[at : at + some].values for at in range(0, count, some))
    return PiecedArray(variable.shape, variable.dtype, pieces)


def _final_state(output: Path, kept: ExitStack | None) -> Checkpoint:
    content = opened(output)
    with ExitStack() as closing:
        closing.callback(content.close)
        try:
            group = content.groups[FINAL_STATE]
            facts, arrays = json.loads(group.attrs["facts"]), dict(group.variables)
        except KeyError:
            raise StorageError("holds no final state: an older pbdkit made it") from None
        if kept is None:
            arrays = {name: variable[...] for name, variable in arrays.items()}
        else:
            kept.push(closing.pop_all())
        return Checkpoint({}, facts, arrays)


def _source(about: Mapping[str, Any], name: str, steps: int | None, done: Any) -> Source:
    parts = _map(about, "experiment")
    refuse_retired(parts, f"{name}: going on")
    if steps is not None:
        if isinstance(done, int) and steps <= done:
            raise ExperimentError(f"{name}: {done} steps are done; --steps takes a larger number")
        parts["steps"] = steps
    return Source(name, parts)


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
        source = read_experiment(file, allow_outside=True)  # only compared
        source = with_settings(source, settings, Experiment.defaults())
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


SAME_WEIGHT = 1e-6
"""Relaxation and memory chosen on other machines differ by less."""


@dataclass(frozen=True)
class Resumption:
    """A run that is ready to be gone on with: ``record()`` does it."""

    run: Simulation
    sink: NetcdfSink
    recorder: Recorder

    def record(self) -> RunReport:
        """To its end. Raises what any run does."""
        return record(self.run, self.recorder.sink, recorder=self.recorder)


def resumption(
    output: Path,
    watch: Watch,
    *,
    steps: int | None = None,
    anyway: bool = False,
    execution: Execution | None = None,
) -> Resumption | None:
    """The unfinished run of an output, or its result to be continued to so many steps; None where
    all was done but to give the result its name, which it has now. With the `execution`
    of several processes they share what is left, however many have begun it.

    Raises ExperimentError where there is nothing to go on with, and, unless told to go on `anyway`,
    where the experiment, pbdkit or a plugin changed since; StorageError for what is damaged.
    """
    execution = execution or Execution()
    with execution.communicator.raise_together():
        unfinished = execution.communicator.is_root and _is_unfinished(output, steps)
    if execution.communicator.bcast(unfinished):
        return _unfinished(output, watch, steps, anyway, execution)
    return _continued(output, watch, steps or 0, anyway, execution)


def _is_unfinished(output: Path, steps: int | None) -> bool:
    """Whether a run of it is; else there is a result that can be continued to more steps."""
    refuse_store(output)
    if is_unfinished(output):
        return True
    refuse_other_file(output)
    if not output.exists():
        raise ExperimentError(f"{output}: there is no unfinished run of it, and no result")
    if steps is None:
        raise ExperimentError(f"{output}: is finished; --steps N continues it to step N")
    make_room(output)
    return False


@contextmanager
def _damage_named(output: Path) -> Iterator[None]:
    """What was kept in other forms than a run keeps is damage, not a bug."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise StorageError(f"{output}: what was kept of it is damaged: {error}") from error


def _unfinished(
    output: Path, watch: Watch, steps: int | None, anyway: bool, execution: Execution
) -> Resumption | None:
    communicator = execution.communicator
    left: UnfinishedRun | None = None
    checkpoint, source, origin = None, None, dict[str, Any]()
    chosen, is_same = tuple[str, ...](), True
    try:
        with communicator.raise_together():
            if communicator.is_root:
                left = UnfinishedRun.open(output, writing=True, anyway=anyway)
                source, origin = asked(left, output, steps, anyway)
                chosen = chosen_parameters(left.facts)
                is_same = steps in (None, left.about.get("steps"))
        source, origin, chosen, is_same = communicator.bcast((source, origin, chosen, is_same))
        sink = NetcdfSink(output, replace=origin.get("replace") is True, origin=origin)
        with communicator.raise_together(), _damage_named(output):
            if left and source is None:
                sink.conclude(left)
            elif left:
                checkpoint = left.checkpoint(on_disk=communicator.size > 1)
        if source is None:
            return None
        experiment = Experiment.build(source)
        scene = execution.scene(experiment)
        if not (is_same or anyway):
            _refuse_other_weights(f"{output}: ", scene, chosen, execution)
        run = execution.run(scene, watch)
        run.driver.chosen = chosen
        recorder = run.recorder(run.sink(sink))
        with _damage_named(output):
            restore(run.driver, recorder, checkpoint, communicator)
        with communicator.raise_together(), _damage_named(output):
            if left and checkpoint:
                columns = columns_of(run.scene)
                sink.go_on(left, checkpoint, columns, experiment.record.compression)
    except BaseException:
        if left:
            left.close()
        raise
    return Resumption(run, sink, recorder)


def _continued(
    output: Path, watch: Watch, steps: int, anyway: bool, execution: Execution
) -> Resumption:
    """The result stays as it is until the longer one takes its place."""
    communicator = execution.communicator
    with ExitStack() as open_until_read:
        source, checkpoint, dataset, chosen = None, None, None, tuple[str, ...]()
        with communicator.raise_together():
            if communicator.is_root:
                dataset = open_until_read.enter_context(reading(output))
                kept = open_until_read if communicator.size > 1 else None
                source, checkpoint = longer(dataset, output, steps, anyway, kept)
                chosen = chosen_parameters(checkpoint.facts)
        source, chosen = communicator.bcast((source, chosen))
        experiment = Experiment.build(source)
        scene = execution.scene(experiment)
        if not anyway:
            _refuse_other_weights("", scene, chosen, execution)
        run = execution.run(scene, watch)
        run.driver.chosen = chosen
        sink = NetcdfSink(output, True, experiment.record.compression)
        recorder, recorded = run.recorder(run.sink(sink)), None
        try:
            before: Iterable[Values] = ()
            if dataset is not None:
                columns, pieced = columns_of(run.scene), communicator.size > 1
                before = history(dataset, columns, experiment, pieced=pieced)
                recorded = [t for t in dataset["time"].values.tolist() if experiment.records(t)][-1]
            recorder.begin(before)
            restore(run.driver, recorder, checkpoint, communicator, recorded)
        except BaseException:
            recorder.sink.abandon()
            raise
    return Resumption(run, sink, recorder)


def _refuse_other_weights(
    place: str, scene: Scene, chosen: tuple[str, ...], execution: Execution
) -> None:
    """Raises ExperimentError where a run of the scene, which has another number of steps, would
    choose other numbers in place of `auto`; they follow from the roles of the last step."""
    before = scene.experiment.stepping
    auto = before.model_copy(update={f"asked_{name}": "auto" for name in chosen})
    now = execution.tuned(with_solver(scene, auto)).experiment.stepping if chosen else before
    for name in chosen:
        old, new = getattr(before, name), getattr(now, name)
        if not math.isclose(old, new, rel_tol=SAME_WEIGHT, abs_tol=SAME_WEIGHT):
            raise ExperimentError(
                f"{place}the steps were made with {name} {old:.6g}, chosen for the roles of the "
                f"shorter run's last step, and a run of {scene.experiment.steps} steps takes "
                f"{new:.6g}; run it anew with --set steps={scene.experiment.steps}, or --anyway "
                "goes on with the former"
            )
