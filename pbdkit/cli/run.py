"""``pbdkit run``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option

if TYPE_CHECKING:
    from pbdkit.running import Report


@click.command()
@experiment_argument
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The file to write.")
@set_option
@click.option("--force", is_flag=True, help="Replace an existing output.")
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
    from pbdkit.analysis.forecast import quick_warnings
    from pbdkit.api import load
    from pbdkit.cli.stopping import asked_to_stop
    from pbdkit.running import run_into
    from pbdkit.scene.scene import build_scene

    loaded = load(experiment, settings=settings)
    path = output or Path(loaded.name.replace("/", "-") + ".nc")
    _refuse_existing(path, force)
    scene = build_scene(loaded)
    if not quiet:
        for warning in quick_warnings(scene):
            click.echo(f"warning: {warning}", err=True)

    from pbdkit.results.netcdf import NetcdfSink
    from pbdkit.results.overlapping import OverlappingSink

    silent = quiet or as_json or not sys.stderr.isatty()
    sink = OverlappingSink(NetcdfSink(path, replace=force, compression=loaded.record.compression))
    with asked_to_stop() as stopping:
        report = run_into(sink, scene, progress=not silent, stopping=stopping)
    for warning in () if quiet else report.warnings:
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        click.echo(json.dumps(_figures(report, path)))
    elif not quiet and report.outcome.status in ("complete", "settled"):
        _say(report, path, settling=loaded.solver.settle is not None)
    return _exit_code(report, path)


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


def _refuse_existing(path: Path, force: bool) -> None:
    from pbdkit.errors import ExperimentError, StorageError

    try:
        is_folder, exists = path.is_dir(), path.exists()
    except OSError as error:
        raise StorageError(f"{str(path)[:80]}...: {error.strerror}") from None
    if is_folder:
        raise ExperimentError(f"{path}: is a folder; name a file with -o")
    if exists and not force:
        raise ExperimentError(f"{path}: exists; --force replaces it, -o names another file")


def _figures(report: Report, path: Path) -> dict[str, Any]:
    return {
        "status": report.outcome.status,
        "steps": report.outcome.steps,
        "particles": report.particles,
        "wall_s": round(report.wall_s, 6),
        "ns_per_particle_step": round(report.ns_per_particle_step, 3),
        "peak_memory_mib": _peak_memory_mib(),
        "engine": report.choice.engine,
        "threads": report.choice.threads,
        "output": str(path),
    }


def _peak_memory_mib() -> float | None:
    """Of this process; None where the system does not tell."""
    try:
        from resource import RUSAGE_SELF, getrusage
    except ImportError:
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(getrusage(RUSAGE_SELF).ru_maxrss / unit, 1)


def _exit_code(report: Report, path: Path) -> int:
    codes = {"diverged": 4, "unconverged": 4, "interrupted": 130}
    code = codes.get(report.outcome.status, 0)
    if code:
        click.echo(
            f"pbdkit: {report.outcome.status}: {report.outcome.stop_reason}; "
            f"what was recorded until then is in {path}",
            err=True,
        )
    return code
