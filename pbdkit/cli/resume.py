"""Command ``pbdkit resume``: continue a run."""

from __future__ import annotations

from pathlib import Path

import click

from pbdkit.cli.run import (
    advice_on_failure,
    exit_status,
    progress_of_run,
    report_end,
    run_together,
    warn,
)
from pbdkit.communicator import Communicator
from pbdkit.mpi.launch import execution_of
from pbdkit.restart import resumption
from pbdkit.simulation import Execution


def resume(
    communicator: Communicator,
    output: Path,
    steps: int | None,
    anyway: bool,
    quiet: bool,
    as_json: bool,
) -> int:
    """Continue the interrupted run of an output file, and return the exit status."""
    quiet = quiet or not communicator.is_root

    def resume_by(execution: Execution, is_repeated: bool) -> int:
        with progress_of_run(output, quiet or as_json) as (stop, watch):
            resumed = resumption(output, watch, steps=steps, anyway=anyway, execution=execution)
            if resumed is None:
                if not quiet:
                    click.echo(f"{output}: is finished and complete")
                return 0
            warn(resumed.run.warnings, quiet)
            with advice_on_failure(output, resumed.sink):
                report = resumed.record()
        if execution.communicator.is_root:
            report_end(resumed.run, report, resumed.sink, output, quiet, as_json)
        return exit_status(report.outcome, stop)

    return run_together(execution_of(communicator), quiet, resume_by)
