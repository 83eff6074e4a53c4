"""Runs that are gone on with: what was left unfinished, and what ended and is to go further."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.experiment.model import Experiment
from pbdkit.results.layout import Values
from pbdkit.results.netcdf_sink import NetcdfSink
from pbdkit.results.other_files import refuse_other_file, refuse_store
from pbdkit.results.progress import Watch
from pbdkit.results.recorder import Recorder, columns_of
from pbdkit.results.result_file import reading
from pbdkit.runs.continuation import take_up
from pbdkit.runs.course import Report, Run, record
from pbdkit.runs.earlier_run import asked, chosen_parameters, history, longer
from pbdkit.runs.processes import Processes
from pbdkit.runs.tuning import with_solver
from pbdkit.scene.scene import Scene
from pbdkit.storage.run_files import is_unfinished, make_room
from pbdkit.storage.unfinished import UnfinishedRun

SAME_WEIGHT = 1e-6
"""Relaxation and memory chosen on other machines differ by less."""


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
    output: Path,
    watch: Watch,
    *,
    steps: int | None = None,
    anyway: bool = False,
    processes: Processes | None = None,
) -> Resumption | None:
    """The unfinished run of an output, or its result to be continued to so many steps; None where
    all was done but to give the result its name, which it has now. Several `processes` share what
    is left, however many have begun it.

    Raises ExperimentError where there is nothing to go on with, and, unless told to go on `anyway`,
    where the experiment, pbdkit or a plugin changed since; StorageError for what is damaged.
    """
    together = processes or Processes()
    with together.agreeing():
        unfinished = together.first and _is_unfinished(output, steps)
    if together.told(unfinished):
        return _unfinished(output, watch, steps, anyway, together)
    return _continued(output, watch, steps or 0, anyway, together)


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
    output: Path, watch: Watch, steps: int | None, anyway: bool, together: Processes
) -> Resumption | None:
    left: UnfinishedRun | None = None
    standing, source, origin = None, None, dict[str, Any]()
    chosen, is_same = tuple[str, ...](), True
    try:
        with together.agreeing():
            if together.first:
                left = UnfinishedRun.open(output, writing=True, anyway=anyway)
                source, origin = asked(left, output, steps, anyway)
                chosen = chosen_parameters(left.facts)
                is_same = steps in (None, left.about.get("steps"))
        source, origin, chosen, is_same = together.told((source, origin, chosen, is_same))
        sink = NetcdfSink(output, replace=origin.get("replace") is True, origin=origin)
        with together.agreeing(), _damage_named(output):
            if left and source is None:
                sink.conclude(left)
            elif left:
                standing = left.standing(on_disk=together.size > 1)
        if source is None:
            return None
        experiment = Experiment.build(source)
        scene = together.scene(experiment)
        if not (is_same or anyway):
            _refuse_other_weights(f"{output}: ", scene, chosen, together)
        run = together.run(scene, watch)
        run.driver.chosen = chosen
        recorder = run.recorder(run.sink(sink))
        with _damage_named(output):
            take_up(run.driver, recorder, standing, together)
        with together.agreeing(), _damage_named(output):
            if left and standing:
                columns = columns_of(run.scene)
                sink.go_on(left, standing, columns, experiment.record.compression)
    except BaseException:
        if left:
            left.close()
        raise
    return Resumption(run, sink, recorder)


def _continued(
    output: Path, watch: Watch, steps: int, anyway: bool, together: Processes
) -> Resumption:
    """The result stays as it is until the longer one takes its place."""
    with ExitStack() as open_until_read:
        source, standing, dataset, chosen = None, None, None, tuple[str, ...]()
        with together.agreeing():
            if together.first:
                dataset = open_until_read.enter_context(reading(output))
                kept = open_until_read if together.size > 1 else None
                source, standing = longer(dataset, output, steps, anyway, kept)
                chosen = chosen_parameters(standing.facts)
        source, chosen = together.told((source, chosen))
        experiment = Experiment.build(source)
        scene = together.scene(experiment)
        if not anyway:
            _refuse_other_weights("", scene, chosen, together)
        run = together.run(scene, watch)
        run.driver.chosen = chosen
        sink = NetcdfSink(output, True, experiment.record.compression)
        recorder, recorded = run.recorder(run.sink(sink)), None
        try:
            before: Iterable[Values] = ()
            if dataset is not None:
                columns, pieced = columns_of(run.scene), together.size > 1
                before = history(dataset, columns, experiment, pieced=pieced)
                recorded = [t for t in dataset["time"].values.tolist() if experiment.records(t)][-1]
            recorder.begin(before)
            take_up(run.driver, recorder, standing, together, recorded)
        except BaseException:
            recorder.sink.abandon()
            raise
    return Resumption(run, sink, recorder)


def _refuse_other_weights(
    place: str, scene: Scene, chosen: tuple[str, ...], together: Processes
) -> None:
    """Raises ExperimentError where a run of the scene, which has another number of steps, would
    choose other numbers in place of `auto`; they follow from the roles of the last step."""
    before = scene.experiment.stepping
    auto = before.model_copy(update={f"asked_{name}": "auto" for name in chosen})
    now = together.tuned(with_solver(scene, auto)).experiment.stepping if chosen else before
    for name in chosen:
        old, new = getattr(before, name), getattr(now, name)
        if not math.isclose(old, new, rel_tol=SAME_WEIGHT, abs_tol=SAME_WEIGHT):
            raise ExperimentError(
                f"{place}the steps were made with {name} {old:.6g}, chosen for the roles of the "
                f"shorter run's last step, and a run of {scene.experiment.steps} steps takes "
                f"{new:.6g}; run it anew with --set steps={scene.experiment.steps}, or --anyway "
                "goes on with the former"
            )
