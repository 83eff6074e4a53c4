"""``pbdkit run`` and ``resume``, which a signal ends between two steps, so that everything kept is
complete.
"""

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
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.io.recorder import RunOutcome
    from pbdkit.progress import Watch
    from pbdkit.simulation import Execution, RunReport, Simulation


NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
"""Ctrl-C, what ends a process, a terminal that closes, and the warning that batch systems send; a
system may lack some."""


class Stop:
    """Whether, and by which signal, the process was asked to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self) -> bool:
        """Whether it was."""
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """130 for Ctrl-C, else 128 and the number of the signal."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def asked_to_stop() -> Iterator[Stop]:
    """Yields what tells whether the process has been asked to stop.

    A second Ctrl-C stops at once. Outside the main thread signals are not ours to handle.
    """
    stop = Stop()

    def note(number: int, frame: Any) -> None:
        if stop():
            raise KeyboardInterrupt
        stop.signal = signal.Signals(number)

    ours = threading.current_thread() is threading.main_thread()
    found = [getattr(signal, name) for name in NAMES if hasattr(signal, name)] if ours else []
    # Who starts it with `nohup` wants it to survive the terminal.
    hears = {n: n.name != "SIGHUP" or signal.getsignal(n) is not signal.SIG_IGN for n in found}
    numbers = [number for number in found if hears[number]]
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


ENDED = ("complete", "settled")
"""How runs end that came to what was asked for."""

quiet_option = click.option("--quiet", is_flag=True, help="Print nothing but errors.")


@click.command()
@experiment_argument
@click.option("-o", "--output", type=PATH, help="The file to write.")
@set_option
@click.option("--force", is_flag=True, help="Replace an existing output by a whole result.")
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
        given = str(Path(experiment).absolute()) if Path(experiment).is_file() else experiment
        origin = {"experiment": given, "settings": list(settings)}
        quiet = quiet or not execution.communicator.is_root

        def run_by(chosen: Execution, again: bool) -> int:
            from pbdkit.io.netcdf import NetcdfSink
            from pbdkit.simulation import record

            scene = chosen.scene(loaded)
            with chosen.communicator.raise_together():
                if chosen.communicator.is_root:
                    refuse_unfinished(path, force=force or again)
            file = NetcdfSink(path, force, loaded.record.compression, origin=origin)
            _warn(disk_warnings(path, scene), quiet)
            with _watched(path, quiet or as_json, file) as (stop, watch):
                one = chosen.run(scene, watch)
                del scene  # of which each of several processes goes on with its part alone
                _warn([*one.warnings, *([] if quiet else one.outlook())], quiet)
                report = record(one, one.sink(file))
            if chosen.communicator.is_root:
                _tell(one, report, file, path, quiet, as_json)
            return _exit_status(report.outcome, stop)

        return _shared(execution, quiet, run_by)


@click.command()
@result_argument("output")
@click.option("--steps", type=click.IntRange(min=1), help="Continue a finished run to this step.")
@click.option(
    "--anyway",
    is_flag=True,
    help="Also where the experiment or a version changed, or where the last commits are lost.",
)
@quiet_option
@json_option
def resume(output: Path, steps: int | None, anyway: bool, quiet: bool, as_json: bool) -> int:
    """Go on with an interrupted run that was to write OUT.nc, to the same result bit for bit."""
    from pbdkit.mpi.launch import launched
    from pbdkit.restart import resumption

    with launched() as execution:
        quiet = quiet or not execution.communicator.is_root

        def resume_by(chosen: Execution, _: bool) -> int:
            with _watched(output, quiet or as_json) as (stop, watch):
                found = resumption(output, watch, steps=steps, anyway=anyway, execution=chosen)
                if found is None:
                    if not quiet:
                        click.echo(f"{output}: was finished, and is whole")
                    return 0
                _warn(found.run.warnings, quiet)
                with _told_what_is_kept(output, found.sink):
                    report = found.record()
            if chosen.communicator.is_root:
                _tell(found.run, report, found.sink, output, quiet, as_json)
            return _exit_status(report.outcome, stop)

        return _shared(execution, quiet, resume_by)


def _shared(execution: Execution, quiet: bool, work: Callable[[Execution, bool], int]) -> int:
    """Done by all processes together; where they cannot share it, again by the first of them."""
    try:
        return work(execution, False)
    except NotSharedError as error:
        told = str(error).replace("; run it in one process", "; the first of them runs it alone")
        _warn([told], quiet)
    from pbdkit.simulation import Execution

    # A signal that all of them get must not end those who wait.
    with nullcontext() if execution.communicator.is_root else asked_to_stop():
        return execution.by_root(lambda: work(Execution(), True))


@contextmanager
def _watched(
    path: Path, silent: bool, file: NetcdfSink | None = None
) -> Iterator[tuple[Stop, Watch]]:
    """Progress on a terminal, and signals heard."""
    from pbdkit.progress import Watch, progress_bar

    drawn = not silent and sys.stderr.isatty()
    with asked_to_stop() as stop, progress_bar(drawn) as show:
        watch = Watch(stop, show)
        if file is None:
            yield stop, watch
            return
        with _told_what_is_kept(path, file):
            yield stop, watch


@contextmanager
def _told_what_is_kept(path: Path, file: NetcdfSink) -> Iterator[None]:
    """Where a run fails that was kept, how to go on with it."""
    try:
        yield
    except NotSharedError:
        raise
    except ExperimentError:
        if file.kept:
            click.echo(
                f"what was recorded until then is kept, and `pbdkit plot {path}` draws it; to "
                "resume would be refused in the same way: change the experiment, and run it with "
                "--force",
                err=True,
            )
        raise
    except BaseException:
        if file.kept:
            click.echo(_how_to_go_on(path), err=True)
        raise


def _how_to_go_on(path: Path) -> str:
    return f"`pbdkit resume {path}` goes on from what was kept"


def _warn(texts: Iterable[str], quiet: bool) -> None:
    for text in () if quiet else texts:
        click.echo(f"warning: {text}", err=True)


def _tell(
    run: Simulation, report: RunReport, file: NetcdfSink, path: Path, quiet: bool, as_json: bool
) -> None:
    """What there is to say of a run that ended."""
    _warn(report.warnings, quiet)
    outcome = report.outcome
    if as_json:
        click.echo(json.dumps(_figures(report, file.written)))
    elif not quiet and outcome.status in ENDED:
        _say(report, file.written, settling=run.scene.experiment.stepping.settle is not None)
    what = f"pbdkit: {outcome.status}: {outcome.stop_reason}"
    if outcome.status == "interrupted":
        click.echo(f"{what}; {_how_to_go_on(path)}", err=True)
    elif outcome.status not in ENDED:
        left = "" if file.written == path else f"; {path} is left as it was"
        click.echo(f"{what}; what was recorded until then is in {file.written}{left}", err=True)


def _exit_status(outcome: RunOutcome, stop: Stop) -> int:
    """Of the program, in all processes."""
    if outcome.status in ENDED:
        return 0
    return stop.exit_status if outcome.status == "interrupted" else 4


def _say(report: RunReport, path: Path, *, settling: bool) -> None:
    outcome = report.outcome
    made = f"{outcome.steps - report.first} of {outcome.steps}" if report.first else outcome.steps
    steps = "step" if made == 1 else "steps"
    size = f"{report.particles} particles, {made} {steps} in {report.wall_s:.2g} s"
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
