"""Resume an unfinished run from its checkpoint, or extend a finished run from its last state."""

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
from pbdkit.io.open import reading
from pbdkit.io.other_files import refuse_other_file, refuse_store
from pbdkit.io.paged_file import PiecedArray
from pbdkit.io.recorder import Recorder, columns_of
from pbdkit.io.run_store import UnfinishedRun, is_unfinished, make_room
from pbdkit.io.seal import open_sealed
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
    """Restore a checkpoint in a run that has not begun, so that the run continues from it.

    The checkpoint is that of the root, the process that reads and writes files. `recorded` is the
    last recorded step, if it differs from that of the checkpoint. StorageError is raised if the
    checkpoint is damaged or belongs to another scene.
    """
    initial, parts = driver.state_dict(), dict[str, Any]()
    with communicator.raise_together():
        if checkpoint:
            experiment, classes = driver.scene.experiment, dict[str, type]()
            if experiment.stepping.settle:
                from pbdkit.equilibrium.error_bound import Pace

                classes["Pace"] = Pace
            parts = checkpoint.parts(initial, experiment.steps, classes)
            if recorded is not None:
                parts["kept"] = parts["seen"].recorded = recorded
    recorder.last_steps = communicator.bcast(parts.get("seen"))
    driver.load_state_dict(parts)


CONTINUABLE = ("complete", "settled", "interrupted")
"""Status of results that can be continued."""
BLOCK_BYTES = 2**22
"""Number of bytes of a result that are read together. At least one row is read."""


def unfinished_source(
    unfinished: UnfinishedRun, output: Path, steps: int | None, anyway: bool
) -> tuple[Source | None, dict[str, Any]]:
    """Return the experiment of an unfinished run, and the description of its origin.

    The experiment is None if all steps are done.

    Raises
    ------
    ExperimentError
        If the experiment or a version has changed, unless `anyway` is true.
    """
    about, origin = unfinished.about, unfinished.about.get("origin")
    if not isinstance(origin, dict):
        raise StorageError("the checkpoint is damaged: 'origin' is not a mapping")
    if "finished" in unfinished.facts:
        return None, origin
    source = _source(about, f"{output}, unfinished", steps, unfinished.facts.get("step"))
    experiment = Experiment.build(source)
    if steps not in (None, about.get("steps")) and not experiment.solver.makes_steps:
        raise ExperimentError(
            f"{output}: the load path to an equilibrium depends on `steps`; resume it without "
            f"--steps, or run it again with --set steps={steps}"
        )
    if not anyway:
        _refuse_versions(output, about, experiment)
        _refuse_changed_file(output, about, origin)
    return source, origin


def chosen_parameters(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parameters of the solver that the run has selected for `auto`."""
    names = facts.get("chosen", [])
    if not isinstance(names, list) or not {*names} <= {"relaxation", "memory"}:
        raise StorageError("the checkpoint is damaged: 'chosen' is not a list of solver parameters")
    return tuple(names)


def longer(
    dataset: Any, output: Path, steps: int, anyway: bool, stack: ExitStack | None = None
) -> tuple[Source, Checkpoint]:
    """Return the experiment of a result with a larger number of steps, and the final state.

    Parameters
    ----------
    stack
        Stack that keeps the file open while the arrays are used. If it is None, the arrays are read
        completely and the file is closed.

    Raises
    ------
    ExperimentError
        If the result cannot be continued.
    """
    about = dataset.attrs
    if about.get("status") not in CONTINUABLE:
        raise ExperimentError(f"has the status {about.get('status')} and cannot be continued")
    if (result_version := about.get("schema_version")) != SCHEMA_VERSION:
        raise ExperimentError(
            f"has schema_version {result_version}, and this pbdkit writes {SCHEMA_VERSION}; run it "
            f"again with --set steps={steps}"
        )
    checkpoint = _final_state(output, stack)
    source = _source(about, str(output), steps, checkpoint.facts.get("step"))
    experiment = Experiment.build(source)
    if not experiment.solver.makes_steps:
        raise ExperimentError(
            f"is an equilibrium, which cannot be continued; run it again with --set steps={steps}"
        )
    if not anyway:
        versions = {"pbdkit": about.get("pbdkit_version"), "plugins": _map(about, "plugins")}
        _refuse_versions(output, versions, experiment)
    return source, checkpoint


def history(
    dataset: Any, columns: list[Column], experiment: Experiment, *, pieced: bool = False
) -> Iterator[Values]:
    """Yield those records of a result that the extended run contains too.

    Parameters
    ----------
    pieced
        Whether large arrays are read in pieces.
    """
    for column in columns:
        if column.when is When.START:
            yield {column.name: _entry(dataset[column.name], pieced)}
    for dim in ("time", "step"):
        names = [column.name for column in columns if column.grows and column.dims[0] == dim]
        steps = dataset[dim].values.tolist() if names else []
        for step, values in zip(steps, _rows(dataset, names, dim, pieced), strict=False):
            if dim == "step" or experiment.records(step):
                yield values


def _rows(dataset: Any, names: list[str], dim: str, pieced: bool) -> Iterator[Values]:
    """Yield row by row along a dimension.

    Rows are read in blocks, which is much faster for small bodies than reading them separately.
    """
    count = dataset.sizes.get(dim, 0)
    size = sum(dataset[name].nbytes for name in names)
    block = max(1, BLOCK_BYTES * count // max(1, size))
    for start in range(0, count, block):
        if pieced and block == 1:
            yield {name: _entry(dataset[name][start], pieced) for name in names}
            continue
        content = {name: dataset[name][start : start + block].values for name in names}
        for n in range(min(block, count - start)):
            yield {name: values[n] for name, values in content.items()}


def _entry(variable: Any, pieced: bool) -> Any:
    """Return all values of a variable, in pieces if it is large."""
    if not pieced or variable.dtype.kind not in "fiub" or variable.nbytes <= BLOCK_BYTES:
        return variable.values
    count, rows = len(variable), max(1, BLOCK_BYTES * len(variable) // variable.nbytes)
    pieces = (variable[start : start + rows].values for start in range(0, count, rows))
    return PiecedArray(variable.shape, variable.dtype, pieces)


def _final_state(output: Path, stack: ExitStack | None) -> Checkpoint:
    content = open_sealed(output)
    with ExitStack() as closing:
        closing.callback(content.close)
        try:
            group = content.groups[FINAL_STATE]
            facts, arrays = json.loads(group.attrs["facts"]), dict(group.variables)
        except KeyError:
            raise StorageError(
                "contains no final state: it was written by an older pbdkit"
            ) from None
        if stack is None:
            arrays = {name: variable[...] for name, variable in arrays.items()}
        else:
            stack.push(closing.pop_all())
        return Checkpoint({}, facts, arrays)


def _source(about: Mapping[str, Any], name: str, steps: int | None, completed: Any) -> Source:
    parts = _map(about, "experiment")
    refuse_retired(parts, f"{name}: resuming")
    if steps is not None:
        if isinstance(completed, int) and steps <= completed:
            raise ExperimentError(
                f"{name}: {completed} steps are completed; --steps must be larger"
            )
        parts["steps"] = steps
    return Source(name, parts)


def _map(about: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Parse the JSON mapping under a key."""
    try:
        mapping = json.loads(about.get(key, ""))
    except (ValueError, TypeError, RecursionError):
        mapping = None
    if not isinstance(mapping, dict):
        raise StorageError(f"'{key}' is damaged: it is not a JSON mapping")
    return mapping


def _refuse_versions(output: Path, versions: Mapping[str, Any], experiment: Experiment) -> None:
    installed = experiment.distributions() | {"pbdkit": version("pbdkit")}
    previous = {**versions.get("plugins", {}), "pbdkit": versions.get("pbdkit")}
    for name, current in installed.items():
        if previous.get(name) != current:
            raise ExperimentError(
                f"{output}: was started with {name} {previous.get(name)}, and {current} is "
                "installed: further steps may differ; --anyway resumes it"
            )


def _refuse_changed_file(output: Path, about: Mapping[str, Any], origin: Any) -> None:
    """Raise ExperimentError if the experiment file of the run has changed."""
    file, settings = origin.get("experiment"), origin.get("settings", [])
    if not isinstance(file, str) or not Path(file).is_file():
        return
    try:
        source = read_experiment(file, allow_outside=True)  # only to compare it
        source = with_settings(source, settings, Experiment.defaults())
        current = json.loads(Experiment.build(source).model_dump_json(by_alias=True))
    except PbdkitError:
        current = None
    original = _map(about, "experiment")
    if current is not None:  # Values that the run selected for `auto` are not changes.
        chosen = original.get("solver", {})
        current["solver"] = {
            key: chosen.get(key) if value == "auto" else value
            for key, value in current["solver"].items()
        }
    if current != original:
        raise ExperimentError(
            f"{output}: {file} has changed since the run started; --anyway resumes the run with "
            "the original experiment"
        )


WEIGHT_TOLERANCE = 1e-6
"""Relative difference up to which values of relaxation and momentum are considered equal.

The values were computed on different machines.
"""


@dataclass(frozen=True)
class Resumption:
    """A run that is ready to be resumed.

    Parameters
    ----------
    run
        The run, with its state restored.
    sink
        File of the result.
    recorder
        Recorder of the remaining steps.
    """

    run: Simulation
    sink: NetcdfSink
    recorder: Recorder

    def record(self) -> RunReport:
        """Run the remaining steps, and return a report of the run.

        Raises
        ------
        PbdkitError
            For the same reasons as any other run.
        """
        return record(self.run, self.recorder.sink, recorder=self.recorder)


def resumption(
    output: Path,
    watch: Watch,
    *,
    steps: int | None = None,
    anyway: bool = False,
    execution: Execution | None = None,
) -> Resumption | None:
    """Prepare to resume the unfinished run of an output, or to continue its result.

    Parameters
    ----------
    output
        Path of the result.
    watch
        Progress and cancellation.
    steps
        Total number of steps to which a finished run is extended.
    anyway
        Whether changes of the experiment or of versions are ignored.
    execution
        Execution of the run, by default in one process. Any number of processes can resume a run.

    Returns
    -------
    Resumption or None
        The result is None if all steps were already done. The result then has its final name.

    Raises
    ------
    ExperimentError
        If there is nothing to resume. Also if the experiment, pbdkit or a plugin has changed,
        unless `anyway` is true.
    StorageError
        If the checkpoint is damaged.
    """
    execution = execution or Execution()
    with execution.communicator.raise_together():
        unfinished = execution.communicator.is_root and _is_unfinished(output, steps)
    if execution.communicator.bcast(unfinished):
        return _unfinished(output, watch, steps, anyway, execution)
    return _continued(output, watch, steps or 0, anyway, execution)


def _is_unfinished(output: Path, steps: int | None) -> bool:
    """Return whether the run of an output is unfinished. If not, its result can be extended."""
    refuse_store(output)
    if is_unfinished(output):
        return True
    refuse_other_file(output)
    if not output.exists():
        raise ExperimentError(
            f"{output}: there is neither an unfinished run nor a result; `pbdkit run` computes one"
        )
    if steps is None:
        raise ExperimentError(f"{output}: is finished; --steps N continues it to step N")
    make_room(output)
    return False


@contextmanager
def _report_damage(output: Path) -> Iterator[None]:
    """Report a malformed checkpoint as StorageError."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise StorageError(f"{output}: the checkpoint is damaged: {error}") from error


def _unfinished(
    output: Path, watch: Watch, steps: int | None, anyway: bool, execution: Execution
) -> Resumption | None:
    communicator = execution.communicator
    unfinished: UnfinishedRun | None = None
    checkpoint, source, origin = None, None, dict[str, Any]()
    chosen, is_same = tuple[str, ...](), True
    try:
        with communicator.raise_together():
            if communicator.is_root:
                unfinished = UnfinishedRun.open(output, writing=True, anyway=anyway)
                source, origin = unfinished_source(unfinished, output, steps, anyway)
                chosen = chosen_parameters(unfinished.facts)
                is_same = steps in (None, unfinished.about.get("steps"))
        source, origin, chosen, is_same = communicator.bcast((source, origin, chosen, is_same))
        sink = NetcdfSink(output, replace=origin.get("replace") is True, origin=origin)
        with communicator.raise_together(), _report_damage(output):
            if unfinished and source is None:
                sink.conclude(unfinished)
            elif unfinished:
                checkpoint = unfinished.checkpoint(on_disk=communicator.size > 1)
        if source is None:
            return None
        experiment = Experiment.build(source)
        scene = execution.scene(experiment)
        if not (is_same or anyway):
            _refuse_other_weights(f"{output}: ", scene, chosen, execution)
        run = execution.run(scene, watch)
        run.driver.automatic = chosen
        recorder = run.recorder(run.sink(sink))
        with _report_damage(output):
            restore(run.driver, recorder, checkpoint, communicator)
        with communicator.raise_together(), _report_damage(output):
            if unfinished and checkpoint:
                columns = columns_of(run.scene)
                sink.go_on(unfinished, checkpoint, columns, experiment.record.compression)
    except BaseException:
        if unfinished:
            unfinished.close()
        raise
    return Resumption(run, sink, recorder)


def _continued(
    output: Path, watch: Watch, steps: int, anyway: bool, execution: Execution
) -> Resumption:
    """Extend the run of a result. The result is replaced only when the extended run is complete."""
    communicator = execution.communicator
    with ExitStack() as stack:
        source, checkpoint, dataset, chosen = None, None, None, tuple[str, ...]()
        with communicator.raise_together():
            if communicator.is_root:
                dataset = stack.enter_context(reading(output))
                stack_of_arrays = stack if communicator.size > 1 else None
                source, checkpoint = longer(dataset, output, steps, anyway, stack_of_arrays)
                chosen = chosen_parameters(checkpoint.facts)
        source, chosen = communicator.bcast((source, chosen))
        experiment = Experiment.build(source)
        scene = execution.scene(experiment)
        if not anyway:
            _refuse_other_weights("", scene, chosen, execution)
        run = execution.run(scene, watch)
        run.driver.automatic = chosen
        sink = NetcdfSink(output, True, experiment.record.compression)
        recorder, recorded = run.recorder(run.sink(sink)), None
        try:
            records: Iterable[Values] = ()
            if dataset is not None:
                columns, pieced = columns_of(run.scene), communicator.size > 1
                records = history(dataset, columns, experiment, pieced=pieced)
                recorded = [
                    time for time in dataset["time"].values.tolist() if experiment.records(time)
                ][-1]
            recorder.begin(records)
            restore(run.driver, recorder, checkpoint, communicator, recorded)
            _ = run.warnings  # cached; an error in them must not leave the file of the sink
        except BaseException:
            recorder.sink.abandon()
            raise
    return Resumption(run, sink, recorder)


def _refuse_other_weights(
    place: str, scene: Scene, chosen: tuple[str, ...], execution: Execution
) -> None:
    """Raise ExperimentError if the extended run would select other values for `auto`.

    The values of `auto` depend on the roles of the particles in the last step.
    """
    stepping = scene.experiment.stepping
    auto = stepping.model_copy(update={f"{name}_setting": "auto" for name in chosen})
    new_stepping = (
        execution.tuned(with_solver(scene, auto)).experiment.stepping if chosen else stepping
    )
    for name in chosen:
        old, new = getattr(stepping, name), getattr(new_stepping, name)
        if not math.isclose(old, new, rel_tol=WEIGHT_TOLERANCE, abs_tol=WEIGHT_TOLERANCE):
            raise ExperimentError(
                f"{place}the completed steps used {name} {old:.6g}, which was chosen for the "
                "leaders and loads at the end of the shorter run; a run of "
                f"{scene.experiment.steps} steps uses {new:.6g}; run it again with --set "
                f"steps={scene.experiment.steps}, or use --anyway to continue with {old:.6g}"
            )
