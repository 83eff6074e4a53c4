"""``pbdkit run``, which Ctrl-C and SIGTERM end between two steps: what is kept is whole."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option

if TYPE_CHECKING:
    from pbdkit.runs.course import Report


@click.command()
@experiment_argument
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The file to write.")
@set_option
@click.option("--force", is_flag=True, help="Replace an existing output by a whole result.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
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
    from pbdkit.api import load
    from pbdkit.cli.output import disk_warnings, folder_kept, refuse_output
    from pbdkit.results.netcdf import NetcdfSink, OverlappingSink
    from pbdkit.results.progress import Watch, progress_bar
    from pbdkit.runs.course import Run, record
    from pbdkit.scene.scene import build_scene

    with folder_kept():
        loaded = load(experiment, settings=settings)
        path = output or Path(loaded.name.replace("/", "-") + ".nc")
    refuse_output(path, force=force, experiment=Path(experiment))
    file = NetcdfSink(path, replace=force, compression=loaded.record.compression)
    scene = build_scene(loaded)
    _warn(disk_warnings(path, scene), quiet)
    drawn = not (quiet or as_json) and sys.stderr.isatty()
    with asked_to_stop() as stopping, progress_bar(drawn) as show:
        one = Run(scene, watch=Watch(stopping, show))
        _warn(one.warnings, quiet)
        report = record(one, OverlappingSink(file))
    _warn(report.warnings, quiet)
    if as_json:
        click.echo(json.dumps(_figures(report, file.written)))
    elif not quiet and report.outcome.status in ("complete", "settled"):
        _say(report, path, settling=loaded.stepping.settle is not None)
    return _exit_code(report, path, file.written)


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether the process has been asked to stop.

    A second Ctrl-C stops at once. Outside the main thread signals are not ours to handle.
    """
    asked: list[int] = []

    def note(number: int, frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    ours = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if ours else ()
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _warn(texts: Iterable[str], quiet: bool) -> None:
    for text in () if quiet else texts:
        click.echo(f"warning: {text}", err=True)


def _say(report: Report, path: Path, *, settling: bool) -> None:
    outcome = report.outcome
    size = f"{report.particles} particles, {outcome.steps} steps in {report.wall_s:.2g} s"
    click.echo(f"{outcome.status}: {size}, written to {path}")
    if outcome.certificate:
        click.echo(f"{outcome.certificate['method']}: {outcome.stop_reason}")
    elif settling:
        click.echo(outcome.stop_reason)
    if report.choice.engine != "equilibrium":
        threads = f" on {report.choice.threads} threads" if report.choice.threads > 1 else ""
        click.echo(f"engine: {report.choice.engine}{threads} ({report.choice.reason})")


def _figures(report: Report, path: Path) -> dict[str, Any]:
    from pbdkit.runs.course import peak_memory

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
        "output": str(path),
    }


def _exit_code(report: Report, path: Path, written: Path) -> int:
    if report.outcome.status in ("complete", "settled"):
        return 0
    left = "" if written == path else f"; {path} is left as it was"
    what = f"{report.outcome.status}: {report.outcome.stop_reason}"
    click.echo(f"pbdkit: {what}; what was recorded until then is in {written}{left}", err=True)
    return 130 if report.outcome.status == "interrupted" else 4
