"""Commands ``pbdkit sweep`` and ``fit``, and those to start from: ``experiments``, ``init`` and
``schema``."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import completed_by, outside_option

if TYPE_CHECKING:
    from pbdkit.cli.run import Stop
    from pbdkit.sweeps.execute import Summary


PATH = click.Path(path_type=Path)
CONNECT_S = 10.0
"""Timeout for the connection to a cluster in seconds."""
MAX_LISTED = 20
"""Number of failures that are listed; `message` in the dataset has all."""


@click.command()
@click.argument("file", metavar="SWEEP", type=PATH)
@click.option("-o", "--output", "folder", type=PATH, help="Folder of the results of members.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Number of processes; default one for each processor.",
)
@click.option(
    "--dask", "address", metavar="ADDRESS", help="Run on the dask cluster at this address."
)
@outside_option
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def sweep(
    file: Path, folder: Path | None, workers: int | None, address: str | None, quiet: bool
) -> int:
    """Run an experiment for many parameter values; a second call runs the remaining members."""
    from pbdkit.cli.run import stop_on_signals
    from pbdkit.progress import progress_bar
    from pbdkit.sweeps.execute import carry_out, crew_of
    from pbdkit.sweeps.specification import SweepPlan, read_sweep

    specified, base, source = read_sweep(file)
    plan, path = SweepPlan(specified, base, source), folder or Path(file.stem)
    _refuse_folder(path)
    with (
        _client(address) as client,
        stop_on_signals() as stopping,
        progress_bar(not quiet and sys.stderr.isatty()) as show,
    ):
        summary = carry_out(plan, path, crew_of(workers, client), stopping, show)
    for fault in summary.faults:
        click.echo(f"warning: {fault}", err=True)
    return _report_end(summary, path, stopping, quiet)


def _refuse_folder(folder: Path) -> None:
    """Raise ExperimentError if the path exists and is no folder."""
    from pbdkit.cli.options import refusals_as
    from pbdkit.errors import ExperimentError

    with refusals_as(str(folder)[:80]):
        if folder.exists() and not folder.is_dir():
            raise ExperimentError(f"{folder}: is not a folder; name one with -o")


@contextmanager
def _client(address: str | None) -> Iterator[Any]:
    """Yield the client of the cluster at an address, or None without one; raise ExperimentError."""
    from pbdkit.errors import ExperimentError

    if address is None:
        yield None
        return
    try:
        from distributed import Client

        connect: Any = Client
    except ImportError:
        what = "--dask needs dask.distributed: pip install 'pbdkit[sweep]'"
        raise ExperimentError(what) from None
    # Its log messages about lost connections, with tracebacks, would hide those of the program.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = connect(address, timeout=CONNECT_S)
    except (OSError, ValueError, ImportError) as error:
        raise ExperimentError(f"--dask {address}: no scheduler responds: {error}") from None
    with client:
        yield client


def _report_end(summary: Summary, folder: Path, stop: Stop, quiet: bool) -> int:
    """Print the outcome of the sweep, and return the exit status."""
    count, missing = len(summary.members), len(summary.members) - len(summary.ends)
    failures = summary.failures
    if summary.path is None:
        text = f"interrupted: {count - missing} of {count} members are finished, in {folder}"
        text = text if count else "interrupted while members were validated; none was run"
        click.echo(f"pbdkit: {text}; the same command runs the others", err=True)
        return stop.exit_status
    if not quiet:
        stored = count - summary.run
        remark = f" ({summary.run} run now, {stored} before)" if stored else ""
        click.echo(f"{count - len(failures)} of {count} members complete{remark}: {summary.path}")
    if failures:
        _show(summary)
    return 5 if failures else 0


def _show(summary: Summary) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from pbdkit.cli.options import UNLIMITED

    failures = summary.failures
    table = Table("member", "status", "message", title=f"{len(failures)} members have no values")
    for member, status, message in failures[:MAX_LISTED]:
        table.add_row(*map(Text, (member.words, status, message.splitlines()[0])))
    width = None if sys.stderr.isatty() else UNLIMITED
    Console(stderr=True, width=width, highlight=False).print(table)
    if len(failures) > MAX_LISTED:
        rest = f"and {len(failures) - MAX_LISTED} more: `status` and `message` in {summary.path}"
        click.echo(rest, err=True)


@click.command()
@click.argument("file", metavar="FIT")
@click.option("-o", "--output", type=PATH, help="JSON file; default the name of FIT with .json.")
@click.option(
    "--plot",
    "picture",
    type=PATH,
    help="Picture (PNG, SVG or PDF): measurement, fit and residuals.",
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
@outside_option
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def fit(file: str, output: Path | None, picture: Path | None, force: bool, quiet: bool) -> None:
    """Fit parameters to measured fields, or strengths to repeated tests, with their errors."""
    import pbdkit
    from pbdkit.cli.options import refuse_output, refuse_unwritable, save, waiting
    from pbdkit.fitting.strength import is_strength_fit
    from pbdkit.io.atomic_file import write

    path = output or Path(Path(file).name or "fit").with_suffix(".json")
    refuse_output(path, force=force, experiment=Path(file))
    if picture:
        refuse_output(picture, force=force)
    refuse_unwritable(picture, path)
    repeats = is_strength_fit(file)
    if picture and repeats:
        raise pbdkit.ExperimentError("a strength fit has no picture; leave --plot out")
    with waiting(f"fitting {file}", silent=quiet):
        result = pbdkit.fit_strength(file) if repeats else pbdkit.fit(file)
    write(path, json.dumps(result.as_dict(), indent=2) + "\n", replace=force)
    if not quiet:
        click.echo(str(result))
        click.echo(f"{path} written")
    if picture:
        from pbdkit.fitting.fit_result import Fitted
        from pbdkit.plotting.fit_figures import draw_fit

        assert isinstance(result, Fitted)
        save(picture, draw_fit(result), replace=force, quiet=quiet)


START = "start"
"""The shipped experiment that `init` writes by default."""


@click.command()
@click.argument("name", required=False, shell_complete=completed_by("shipped"))
def experiments(name: str | None) -> None:
    """List the shipped experiments, or print the file of one, e.g. paper/f1."""
    from pbdkit.model.shipped import shipped_names, shipped_text, shipped_title

    if name is not None:
        click.echo(shipped_text(name), nl=False)
        return
    width = max(map(len, names := shipped_names()))
    for shipped in names:
        click.echo(f"{shipped:<{width}}  {shipped_title(shipped)}")


@click.command()
@click.argument("file", required=False, type=PATH)
@click.option(
    "--from",
    "origin",
    metavar="NAME",
    shell_complete=completed_by("shipped"),
    help="Shipped experiment to copy with its data files, e.g. paper/f1.",
)
def init(file: Path | None, origin: str | None) -> None:
    """Write an experiment to start from: a commented one, or a copy of a shipped one.

    FILE is experiment.yaml by default, or with --from the last part of NAME with .yaml.
    """
    from pbdkit.errors import ExperimentError
    from pbdkit.io.atomic_file import write_together
    from pbdkit.model.shipped import SUFFIX, shipped_data, shipped_names, shipped_text

    path, text = (
        file or Path(Path(origin or "experiment").name + SUFFIX),
        shipped_text(origin or START),
    )
    if origin is None and str(path) in shipped_names():
        copy = f"`pbdkit init {path.name}{SUFFIX} --from {path}` copies it"
        raise ExperimentError(f"{path}: is the name of a shipped experiment, not a file; {copy}")
    data = shipped_data(origin) if origin else []
    files = {path.with_name(d.name): d.read_bytes() for d in data} | {path: text.encode()}
    for target in files:
        if os.path.lexists(target):
            raise ExperimentError(f"{target}: exists and is not changed; name another file")
    write_together(files)
    remark = f" with {', '.join(d.name for d in data)}" if data else ""
    click.echo(f"{path} written{remark}; next: pbdkit check {path}, then pbdkit run {path}")


@click.command()
@click.argument(
    "what", type=click.Choice(["experiment", "dataset", "sweep", "fit"]), default="experiment"
)
@click.option("--builtin", is_flag=True, help="Leave out third-party components.")
def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments, datasets, sweeps or fits, with all installed
    components."""
    from pbdkit.fitting.fit_schema import fit_schema
    from pbdkit.io.layout import dataset_schema
    from pbdkit.model.schema import experiment_schema
    from pbdkit.plugin.registry import Registry
    from pbdkit.sweeps.specification import sweep_schema

    if what in (schemas := {"sweep": sweep_schema, "fit": fit_schema}):
        result = schemas[what]()
    else:
        schema_of = {"experiment": experiment_schema, "dataset": dataset_schema}[what]
        result = schema_of(Registry(), installed=not builtin)
    click.echo(json.dumps(result, indent=2))
