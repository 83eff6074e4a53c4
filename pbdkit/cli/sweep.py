"""Command ``pbdkit sweep``, which runs the members of a sweep."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from pbdkit.cli.output import refusals_as
from pbdkit.errors import ExperimentError
from pbdkit.progress import Stop, progress_bar, stop_on_signals
from pbdkit.sweeps.execute import Summary, carry_out, executor_of
from pbdkit.sweeps.specification import Member, SweepPlan, read_sweep

CONNECT_S = 10.0
"""Timeout for the connection to a cluster in seconds."""
MAX_LISTED = 20
"""Maximum number of failures that are listed. The variable `message` of the dataset contains all of
them."""
MAX_NAMED = 3
"""Maximum number of separated members of which the parameters are printed."""


def sweep(
    file: Path, folder: Path | None, workers: int | None, address: str | None, quiet: bool
) -> int:
    """Run an experiment for many parameter values; a second call runs the remaining members."""
    specified, base, source = read_sweep(file)
    plan, path = SweepPlan(specified, base, source), folder or Path(file.stem)
    _refuse_folder(path)
    with (
        _client(address) as client,
        stop_on_signals() as stopping,
        progress_bar(not quiet and sys.stderr.isatty()) as show,
    ):
        summary = carry_out(plan, path, executor_of(workers, client), stopping, show)
    for fault in summary.faults:
        click.echo(f"warning: {fault}", err=True)
    return report_end(summary, path, stopping, quiet)


def _refuse_folder(folder: Path) -> None:
    """Raise ExperimentError if the path exists and is no folder."""
    with refusals_as(str(folder)[:80]):
        if folder.exists() and not folder.is_dir():
            raise ExperimentError(f"{folder}: is not a folder; name one with -o")


@contextmanager
def _client(address: str | None) -> Iterator[Any]:
    """Yield the client of the cluster at an address. If no address is given, yield None. Raises
    ExperimentError."""
    if address is None:
        yield None
        return
    try:
        import distributed
    except ImportError:
        what = "--dask requires dask.distributed: pip install 'pbdkit[sweep]'"
        raise ExperimentError(what) from None
    # Log messages about lost connections, with tracebacks, would hide the messages of the program.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client: Any = distributed.Client(  # type: ignore[no-untyped-call]  # untyped package
            address, timeout=CONNECT_S
        )
    except (OSError, ValueError, ImportError) as error:
        raise ExperimentError(f"--dask {address}: no scheduler responds: {error}") from None
    with client:
        yield client


def report_end(summary: Summary, folder: Path, stop: Stop, quiet: bool) -> int:
    """Print the outcome of the sweep, and return the exit status."""
    count, missing = len(summary.members), len(summary.members) - len(summary.ends)
    failures = summary.failures
    if summary.path is None:
        text = (
            f"interrupted: {count - missing} of {count} members are finished and stored in {folder}"
        )
        text = text if count else "interrupted while members were validated; none was run"
        click.echo(f"pbdkit: {text}; the same command runs the remaining ones", err=True)
        return stop.exit_status
    if not quiet:
        stored = count - summary.run
        remark = f" ({summary.run} run now, {stored} stored before)" if stored else ""
        separated = summary.separated
        complete = count - len(failures) - len(separated)
        outcome = f"{complete} of {count} members complete{_separated(separated)}"
        click.echo(f"{outcome}{remark}: {summary.path}")
    if failures:
        _show(summary)
    return 5 if failures else 0


def _separated(members: list[Member]) -> str:
    """Return the number of separated members and the parameters of the first ones."""
    if not members:
        return ""
    words = [member.words for member in members[:MAX_NAMED]]
    rest = [f"and {len(members) - MAX_NAMED} more"] if len(members) > MAX_NAMED else []
    return f", {len(members)} separated ({'; '.join(words + rest)})"


def _show(summary: Summary) -> None:
    """Print a table of the members that have no values."""
    from pbdkit.cli.tables import Table, add_rows, show_table

    failures = summary.failures
    table = Table("member", "status", "message", title=f"{len(failures)} members have no values")
    rows = ((member.words, status, text) for member, status, text in failures[:MAX_LISTED])
    add_rows(table, ((words, status, text.splitlines()[0]) for words, status, text in rows))
    show_table(table, stderr=True)
    if len(failures) > MAX_LISTED:
        rest = (
            f"and {len(failures) - MAX_LISTED} more; see `status` and `message` in {summary.path}"
        )
        click.echo(rest, err=True)
