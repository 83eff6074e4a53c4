"""Command ``pbdkit status``: progress of an unfinished run."""

from __future__ import annotations

import json
from pathlib import Path

import click

from pbdkit.errors import ExperimentError
from pbdkit.io.other_files import refuse_other_file, refuse_store
from pbdkit.io.run_store import status_of


def status(output: Path, as_json: bool) -> None:
    """Report the progress of an unfinished run: step, rate and remaining time."""
    refuse_store(output)
    facts = status_of(output)
    if facts is None:
        refuse_other_file(output)
        state = "the run is finished" if output.exists() else "there is no such run"
        raise ExperimentError(f"{output}: {state}; runs of less than a second have no status")
    if as_json:
        click.echo(json.dumps(facts))
        return
    click.echo(f"{output}: step {facts['step']} of {facts['steps']}, {facts['state']}")
    if facts["rate"]:
        click.echo(f"rate: {facts['rate']:.3g} steps per second")
    if facts["state"] == "running" and facts["left_s"] is not None:
        click.echo(f"time left: about {_duration(facts['left_s'])}")
    elif facts["state"] != "running":
        click.echo(f"`pbdkit resume {output}` continues it")


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"
