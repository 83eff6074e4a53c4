"""``pbdkit sweep``: many runs, of which those that are finished need not run again."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import outside_option

if TYPE_CHECKING:
    from pbdkit.cli.stopping import Stop
    from pbdkit.sweeps.course import Summary

PATH = click.Path(path_type=Path)
CONNECT_S = 10.0
SHOWN = 20
"""So many failures are shown; `message` in the dataset has all."""


@click.command()
@click.argument("file", metavar="SWEEP", type=PATH)
@click.option("-o", "--output", "folder", type=PATH, help="The folder to keep the members in.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes; else one a processor.")
@click.option("--dask", "address", metavar="ADDRESS", help="Run on a dask cluster instead.")
@outside_option
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def sweep(
    file: Path, folder: Path | None, workers: int | None, address: str | None, quiet: bool
) -> int:
    """Run an experiment over many parameters; a second call runs what is left."""
    from pbdkit.cli.stopping import asked_to_stop
    from pbdkit.results.progress import progress_bar
    from pbdkit.sweeps.calling import crew_of
    from pbdkit.sweeps.course import carry_out
    from pbdkit.sweeps.member import Asked
    from pbdkit.sweeps.specification import read_sweep

    specified, base, source = read_sweep(file)
    asked, kept = Asked(specified, base, source), folder or Path(file.stem)
    _refuse_folder(kept)
    with (
        _client(address) as client,
        asked_to_stop() as stopping,
        progress_bar(not quiet and sys.stderr.isatty()) as show,
    ):
        summary = carry_out(asked, kept, crew_of(workers, client), stopping, show)
    for fault in summary.faults:
        click.echo(f"warning: {fault}", err=True)
    return _told(summary, kept, stopping, quiet)


def _refuse_folder(folder: Path) -> None:
    """Raises ExperimentError where something else than a folder has the name."""
    from pbdkit.cli.output import refusals_as
    from pbdkit.errors import ExperimentError

    with refusals_as(str(folder)[:80]):
        if folder.exists() and not folder.is_dir():
            raise ExperimentError(f"{folder}: is no folder; name one with -o")


@contextmanager
def _client(address: str | None) -> Iterator[Any]:
    """The cluster at that address, if there is to be one. Raises ExperimentError."""
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
    # Its notes on lost connections, with tracebacks, would stand between those of the program.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = connect(address, timeout=CONNECT_S)
    except (OSError, ValueError, ImportError) as error:
        raise ExperimentError(f"--dask {address}: no scheduler answers: {error}") from None
    with client:
        yield client


def _told(summary: Summary, folder: Path, stop: Stop, quiet: bool) -> int:
    """Says how it went; the exit status."""
    count, missing = len(summary.members), len(summary.members) - len(summary.ends)
    failures = summary.failures
    if summary.path is None:
        what = f"interrupted: {count - missing} of {count} members are finished, in {folder}"
        what = what if count else "interrupted while members were validated; none was run"
        click.echo(f"pbdkit: {what}; the same command goes on with the others", err=True)
        return stop.exit_status
    if not quiet:
        held = count - summary.run
        before = f" ({summary.run} run now, {held} held before)" if held else ""
        click.echo(f"{count - len(failures)} of {count} members complete{before}: {summary.path}")
    if failures:
        _show(summary)
    return 5 if failures else 0


def _show(summary: Summary) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from pbdkit.cli.output import UNLIMITED

    failures = summary.failures
    table = Table("member", "status", "message", title=f"{len(failures)} members have no values")
    for member, status, message in failures[:SHOWN]:
        table.add_row(*map(Text, (member.words, status, message.splitlines()[0])))
    width = None if sys.stderr.isatty() else UNLIMITED
    Console(stderr=True, width=width, highlight=False).print(table)
    if len(failures) > SHOWN:
        more = f"and {len(failures) - SHOWN} more: `status` and `message` in {summary.path}"
        click.echo(more, err=True)
