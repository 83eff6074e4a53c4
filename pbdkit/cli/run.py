"""Commands ``pbdkit run`` and ``pbdkit resume``. A signal ends a run between two steps, so that all
records are complete."""

from __future__ import annotations

import json
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import PATH, experiment_argument, json_option, result_argument, set_option
from pbdkit.errors import ExperimentError, NotSharedError, PbdkitWarning

if TYPE_CHECKING:
    from pbdkit.execution import Execution
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.io.recorder import RunOutcome
    from pbdkit.progress import Watch
    from pbdkit.simulation import RunReport, Simulation


SIGNAL_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
"""Signals that end a run: Ctrl-C, termination, a closed terminal, and the warning of batch systems.
Some do not exist on every system."""


class Stop:
    """Request to stop the process, by a signal; calling it returns whether there was one."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self) -> bool:
        """Return whether the process was asked to stop."""
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """Return 130 for Ctrl-C, else 128 plus the number of the signal."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Record signals in the block instead of ending the process; a second Ctrl-C ends it at once.

    Outside the main thread signals cannot be handled.
    """
    stop = Stop()

    def note(number: int, frame: Any) -> None:
        if stop():
            raise KeyboardInterrupt
        stop.signal = signal.Signals(number)

    is_main_thread = threading.current_thread() is threading.main_thread()
    signals = (
        [getattr(signal, name) for name in SIGNAL_NAMES if hasattr(signal, name)]
        if is_main_thread
        else []
    )
    # A process started with `nohup` must survive the terminal.
    is_handled = {
        number: number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN
        for number in signals
    }
    numbers = [number for number in signals if is_handled[number]]
    previous = {number: signal.signal(number, note) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


SUCCESSFUL = ("complete", "settled")
"""Status of runs that ended as intended."""

quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")


@click.command()
@experiment_argument
@click.option("-o", "--output", type=PATH, help="The file to write.")
@set_option
@click.option(
    "--force", is_flag=True, help="Replace an existing output once the result is complete."
)
@quiet_option
@json_option
def run(
    experiment: str,
    output: Path | None,
    settings: tuple[str, ...],
    force: bool,
    quiet: bool,
    as_json: bool,
) -> int:
    """Run an experiment: a YAML file or the name of a shipped one, e.g. paper/a."""
    from pbdkit.cli.options import disk_warnings, folder_kept, refuse_output, refuse_unfinished
    from pbdkit.model.loading import load_experiment
    from pbdkit.mpi.launch import launched

    with launched() as execution:
        with execution.communicator.raise_together():
            with folder_kept(), warnings.catch_warnings():
                if quiet or not execution.communicator.is_root:
                    warnings.simplefilter("ignore", PbdkitWarning)
                loaded = load_experiment(experiment, settings)
                path = output or Path(loaded.name.replace("/", "-") + ".nc")
            if execution.communicator.is_root:
                refuse_output(path, force=force, experiment=Path(experiment))
        origin_path = str(Path(experiment).absolute()) if Path(experiment).is_file() else experiment
        origin = {"experiment": origin_path, "settings": list(settings)}
        quiet = quiet or not execution.communicator.is_root

        def run_by(chosen: Execution, is_repeated: bool) -> int:
            from pbdkit.io.netcdf import NetcdfSink
            from pbdkit.simulation import record

            scene = chosen.scene(loaded)
            with chosen.communicator.raise_together():
                if chosen.communicator.is_root:
                    refuse_unfinished(path, force=force or is_repeated)
            file = NetcdfSink(path, force, loaded.record.compression, origin=origin)
            _warn(disk_warnings(path, scene), quiet)
            with _progress(path, quiet or as_json, file) as (stop, watch):
                simulation = chosen.run(scene, watch)
                del scene  # each of several processes keeps its part alone
                _warn([*simulation.warnings, *([] if quiet else simulation.outlook())], quiet)
                report = record(simulation, simulation.sink(file))
            if chosen.communicator.is_root:
                _report_end(simulation, report, file, path, quiet, as_json)
            return _exit_status(report.outcome, stop)

        return _shared(execution, quiet, run_by)


@click.command()
@result_argument("output")
@click.option("--steps", type=click.IntRange(min=1), help="Continue a finished run to this step.")
@click.option(
    "--anyway",
    is_flag=True,
    help="Resume although the experiment or a version changed, or the last commits are lost.",
)
@quiet_option
@json_option
def resume(output: Path, steps: int | None, anyway: bool, quiet: bool, as_json: bool) -> int:
    """Continue an interrupted run that was to write OUT.nc; the result is the same bit for bit."""
    from pbdkit.mpi.launch import launched
    from pbdkit.restart import resumption

    with launched() as execution:
        quiet = quiet or not execution.communicator.is_root

        def resume_by(chosen: Execution, is_repeated: bool) -> int:
            with _progress(output, quiet or as_json) as (stop, watch):
                resumed = resumption(output, watch, steps=steps, anyway=anyway, execution=chosen)
                if resumed is None:
                    if not quiet:
                        click.echo(f"{output}: is finished and complete")
                    return 0
                _warn(resumed.run.warnings, quiet)
                with _advice_on_failure(output, resumed.sink):
                    report = resumed.record()
            if chosen.communicator.is_root:
                _report_end(resumed.run, report, resumed.sink, output, quiet, as_json)
            return _exit_status(report.outcome, stop)

        return _shared(execution, quiet, resume_by)


def _shared(execution: Execution, quiet: bool, work: Callable[[Execution, bool], int]) -> int:
    """Let all processes work together; if they cannot share the work, let the first do it alone."""
    try:
        return work(execution, False)
    except NotSharedError as error:
        text = str(error).replace("; run it in one process", "; the first of them runs it alone")
        _warn([text], quiet)
    from pbdkit.execution import Execution

    # A signal that is sent to all processes must not end those that wait.
    with nullcontext() if execution.communicator.is_root else stop_on_signals():
        return execution.by_root(lambda: work(Execution(), True))


@contextmanager
def _progress(
    path: Path, silent: bool, file: NetcdfSink | None = None
) -> Iterator[tuple[Stop, Watch]]:
    """Show progress on a terminal, and handle signals."""
    from pbdkit.progress import Watch, progress_bar

    is_drawn = not silent and sys.stderr.isatty()
    with stop_on_signals() as stop, progress_bar(is_drawn) as show:
        watch = Watch(stop, show)
        if file is None:
            yield stop, watch
            return
        with _advice_on_failure(path, file):
            yield stop, watch


@contextmanager
def _advice_on_failure(path: Path, file: NetcdfSink) -> Iterator[None]:
    """Print how to resume a run that fails with records on disk."""
    try:
        yield
    except NotSharedError:
        raise
    except ExperimentError:
        if file.kept:
            click.echo(
                f"the records until then are kept, and `pbdkit plot {path}` draws them; resuming "
                "would fail in the same way: change the experiment, and run it with --force",
                err=True,
            )
        raise
    except BaseException:
        if file.kept:
            click.echo(_resume_advice(path), err=True)
        raise


def _resume_advice(path: Path) -> str:
    return f"`pbdkit resume {path}` continues it"


def _warn(texts: Iterable[str], quiet: bool) -> None:
    for text in () if quiet else texts:
        click.echo(f"warning: {text}", err=True)


def _report_end(
    run: Simulation, report: RunReport, file: NetcdfSink, path: Path, quiet: bool, as_json: bool
) -> None:
    """Print the outcome of a run."""
    _warn(report.warnings, quiet)
    outcome = report.outcome
    if as_json:
        click.echo(json.dumps(_figures(report, file.written)))
    elif not quiet and outcome.status in SUCCESSFUL:
        _print_summary(
            report, file.written, settling=run.scene.experiment.stepping.settle is not None
        )
    outcome_text = f"pbdkit: {outcome.status}: {outcome.stop_reason}"
    if outcome.status == "interrupted":
        click.echo(f"{outcome_text}; {_resume_advice(path)}", err=True)
    elif outcome.status not in SUCCESSFUL:
        remark = "" if file.written == path else f"; {path} is unchanged"
        click.echo(
            f"{outcome_text}; the records until then are in {file.written}{remark}", err=True
        )


def _exit_status(outcome: RunOutcome, stop: Stop) -> int:
    """Return the exit status of the program, the same in all processes."""
    if outcome.status in SUCCESSFUL:
        return 0
    return stop.exit_status if outcome.status == "interrupted" else 4


def _print_summary(report: RunReport, path: Path, *, settling: bool) -> None:
    outcome = report.outcome
    count = f"{outcome.steps - report.first} of {outcome.steps}" if report.first else outcome.steps
    steps = "step" if count == 1 else "steps"
    size = f"{report.particles} particles, {count} {steps} in {report.wall_s:.2g} s"
    size += f" on {report.processes} processes" if report.processes > 1 else ""
    click.echo(f"{outcome.status}: {size}, written to {path}")
    if outcome.certificate:
        click.echo(f"{outcome.certificate['method']}: {outcome.stop_reason}")
    elif settling:
        click.echo(outcome.stop_reason)
    if report.choice.engine != "equilibrium":
        threads = f" on {report.choice.threads} threads" if report.choice.threads > 1 else ""
        click.echo(f"engine: {report.choice.engine}{threads} ({report.choice.reason})")


def _figures(report: RunReport, path: Path) -> dict[str, Any]:
    from pbdkit.simulation import peak_memory

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
