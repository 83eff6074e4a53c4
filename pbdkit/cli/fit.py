"""Command ``pbdkit fit``, which writes the fitted values and their errors."""

from __future__ import annotations

import json
from pathlib import Path

import click

import pbdkit
from pbdkit.cli.output import refuse_output, refuse_unwritable, save
from pbdkit.errors import ExperimentError
from pbdkit.fitting.fit_file import is_strength_fit
from pbdkit.fitting.fit_result import Fitted
from pbdkit.fitting.specimens import FittedSpecimens
from pbdkit.io.atomic_file import write
from pbdkit.plotting.fit_figures import draw_fit
from pbdkit.progress import waiting


def fit(file: str, output: Path | None, picture: Path | None, force: bool, quiet: bool) -> None:
    """Fit parameters to measured fields, or strengths to repeated tests, and estimate their
    errors."""
    path = output or Path(Path(file).name or "fit").with_suffix(".json")
    refuse_output(path, force=force, experiment=Path(file))
    if picture:
        refuse_output(picture, force=force)
    refuse_unwritable(picture, path)
    if picture and is_strength_fit(file):
        raise ExperimentError("a strength fit has no picture; omit --plot")
    with waiting(f"fitting {file}", silent=quiet):
        result = pbdkit.fit(file)
    write(path, json.dumps(result.as_dict(), indent=2) + "\n", replace=force)
    if not quiet:
        click.echo(str(result))
        click.echo(f"{path} written")
    if picture:
        assert isinstance(result, Fitted | FittedSpecimens)
        save(picture, draw_fit(result), replace=force, quiet=quiet)
