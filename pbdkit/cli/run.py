"""Command ``pbdkit run``. A signal ends a run between two steps, so that all its records are
complete."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import click

from pbdkit.communicator import Communicator
from pbdkit.errors import ExperimentError, NotSharedError
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.recorder import RunOutcome
from pbdkit.io.run_store import make_room
from pbdkit.model.experiment import Experiment
from pbdkit.mpi.launch import execution_of
from pbdkit.progress import Stop, Watch, progress_bar, stop_on_signals
from pbdkit.scene.memory_estimate import MIB, sizes_of
from pbdkit.scene.scene import Scene
from pbdkit.simulation import Execution, RunReport, Simulation, peak_memory, record

SUCCESSFUL = ("complete", "settled")
"""Status of runs that ended as intended."""


def run(
    communicator: Communicator,
    experiment: Experiment,
    path: Path,
    origin: dict[str, Any],
    *,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> int:
    """Run an experiment into a file, and return the exit status.

    Parameters
    ----------
    communicator
        Processes that were started together.
    experiment
        Experiment.
    path
        File to write.
    origin
        Arguments of the command line from which the experiment can be loaded again.
    force
        Whether an existing file is replaced, and an unfinished run discarded.
    quiet, as_json
        Whether nothing is printed (`quiet`), and whether the outcome is printed as a JSON object
        (`as_json`).
    """

    def run_by(execution: Execution, is_repeated: bool) -> int:
        scene = execution.scene(experiment)
        with execution.communicator.raise_together():
            if execution.communicator.is_root:
                refuse_unfinished(path, force=force or is_repeated)
        file = NetcdfSink(path, force, experiment.record.compression, origin=origin)
        warn(disk_warnings(path, scene), quiet)
        with progress_of_run(path, quiet or as_json, file) as (stop, watch):
            simulation = execution.run(scene, watch)
            # If there are several processes, each of them keeps only its part of the scene.
            del scene
            warn([*simulation.warnings, *([] if quiet else simulation.further_warnings())], quiet)
            report = record(simulation, simulation.sink(file))
        if execution.communicator.is_root:
            report_end(simulation, report, file, path, quiet, as_json)
        return exit_status(report.outcome, stop)

    return run_together(execution_of(communicator), quiet, run_by)


def refuse_unfinished(path: Path, *, force: bool) -> None:
    """Raise ExperimentError if there is an unfinished run. With `force` the unfinished run is
    discarded instead.

    A run that another process is writing is never discarded.
    """
    if not make_room(path, discard=force):
        raise ExperimentError(
            f"{path}: this run is unfinished; `pbdkit resume {path}` continues it, "
            "--force discards it, -o names another file"
        )


def disk_warnings(path: Path, scene: Scene) -> Iterator[str]:
    """Warn if the output may be too large for its disk."""
    output = sizes_of(scene.experiment, scene.neighbourhood, scene.raster.total).output
    with suppress(OSError):  # A missing folder is reported when the file is opened.
        if output > (free := shutil.disk_usage(path.parent).free):
            yield (
                f"record: the output of about {output / MIB:.3g} MiB may not fit into the "
                f"{free / MIB:.3g} MiB that are free in {path.parent}; record fewer steps, or "
                "name a file on another disk with -o"
            )


def run_together(execution: Execution, quiet: bool, work: Callable[[Execution, bool], int]) -> int:
    """Let all processes work together. If they cannot share the work, the first process does it
    alone."""
    try:
        return work(execution, False)
    except NotSharedError as error:
        text = str(error).replace("; run it in one process", "; the first process runs it alone")
        warn([text], quiet)
    # A signal may be sent to all processes, and must not end those that are waiting.
    with nullcontext() if execution.communicator.is_root else stop_on_signals():
        return execution.by_root(lambda: work(Execution(), True))


@contextmanager
def progress_of_run(
    path: Path, silent: bool, file: NetcdfSink | None = None
) -> Iterator[tuple[Stop, Watch]]:
    """Show progress on a terminal, and handle signals."""
    is_drawn = not silent and sys.stderr.isatty()
    with stop_on_signals() as stop, progress_bar(is_drawn) as show:
        watch = Watch(stop, show)
        if file is None:
            yield stop, watch
            return
        with advice_on_failure(path, file):
            yield stop, watch


@contextmanager
def advice_on_failure(path: Path, file: NetcdfSink) -> Iterator[None]:
    """If a run fails and its records are on the disk, print how to resume it."""
    try:
        yield
    except NotSharedError:
        raise
    except ExperimentError:
        if file.has_checkpoint:
            click.echo(
                f"the records up to this step are kept, and `pbdkit plot {path}` draws them; "
                "resuming would fail in the same way: change the experiment, and run it with "
                "--force",
                err=True,
            )
        raise
    except BaseException:
        if file.has_checkpoint:
            click.echo(_resume_advice(path), err=True)
        raise


def _resume_advice(path: Path) -> str:
    return f"`pbdkit resume {path}` continues it"


def warn(texts: Iterable[str], quiet: bool) -> None:
    """Print warnings unless `quiet`."""
    for text in () if quiet else texts:
        click.echo(f"warning: {text}", err=True)


def report_end(
    run: Simulation, report: RunReport, file: NetcdfSink, path: Path, quiet: bool, as_json: bool
) -> None:
    """Print the outcome of a run."""
    warn(report.warnings, quiet)
    outcome = report.outcome
    if as_json:
        click.echo(json.dumps(_figures(report, file.written)))
    elif not quiet and outcome.status in SUCCESSFUL:
        _print_summary(
            report,
            file.written,
            ends_at_convergence=run.scene.experiment.stepping.settle is not None,
        )
    outcome_text = f"pbdkit: {outcome.status}: {outcome.stop_reason}"
    if outcome.status == "interrupted":
        click.echo(f"{outcome_text}; {_resume_advice(path)}", err=True)
    elif outcome.status not in SUCCESSFUL:
        remark = "" if file.written == path else f"; {path} is unchanged"
        click.echo(
            f"{outcome_text}; the records up to this step are in {file.written}{remark}", err=True
        )


def exit_status(outcome: RunOutcome, stop: Stop) -> int:
    """Return the exit status of the program. It is the same in all processes."""
    if outcome.status in SUCCESSFUL:
        return 0
    return stop.exit_status if outcome.status == "interrupted" else 4


def _print_summary(report: RunReport, path: Path, *, ends_at_convergence: bool) -> None:
    outcome = report.outcome
    count = f"{outcome.steps - report.first} of {outcome.steps}" if report.first else outcome.steps
    steps = "step" if count == 1 else "steps"
    size = f"{report.particles} particles, {count} {steps} in {report.wall_s:.2g} s"
    size += f" on {report.processes} processes" if report.processes > 1 else ""
    click.echo(f"{outcome.status}: {size}, written to {path}")
    if outcome.error_bound:
        click.echo(f"{outcome.error_bound['method']}: {outcome.stop_reason}")
    elif ends_at_convergence:
        click.echo(outcome.stop_reason)
    if report.choice.engine != "equilibrium":
        threads = f" on {report.choice.threads} threads" if report.choice.threads > 1 else ""
        click.echo(f"engine: {report.choice.engine}{threads} ({report.choice.reason})")


def _figures(report: RunReport, path: Path) -> dict[str, Any]:
    peak = peak_memory()
    return {
        "status": report.outcome.status,
        "steps": report.outcome.steps,
        "particles": report.particles,
        "wall_s": round(report.wall_s, 6),
        "ns_per_particle_step": round(report.ns_per_particle_step, 3),
        "peak_memory_mib": round(peak / 2**20, 1) if peak else None,
        "engine": report.choice.engine,
        "threads": report.choice.threads,
        "processes": report.processes,
        "output": str(path),
    }
