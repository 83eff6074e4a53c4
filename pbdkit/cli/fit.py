"""``pbdkit fit``: parameters from measurements."""

from __future__ import annotations

import json
from pathlib import Path

import click

from pbdkit.cli.options import outside_option

PATH = click.Path(path_type=Path)


@click.command()
@click.argument("file", metavar="FIT")
@click.option("-o", "--output", type=PATH, help="JSON; else the name of FIT with .json.")
@click.option("--plot", "picture", type=PATH, help="PNG, SVG or PDF: measured, fitted, left.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@outside_option
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def fit(file: str, output: Path | None, picture: Path | None, force: bool, quiet: bool) -> None:
    """Find the parameters that fit a measured field best, or the strengths of repeated tests, with
    their errors."""
    import pbdkit
    from pbdkit.cli.output import refuse_output, refuse_unwritable, save
    from pbdkit.cli.waiting import waiting
    from pbdkit.fitting.strength_specification import is_strength_fit
    from pbdkit.storage.destination import write

    path = output or Path(Path(file).name or "fit").with_suffix(".json")
    refuse_output(path, force=force, experiment=Path(file))
    if picture:
        refuse_output(picture, force=force)
    refuse_unwritable(picture, path)
    repeats = is_strength_fit(file)
    if picture and repeats:
        raise pbdkit.ExperimentError("a strength fit has no picture; leave --plot out")
    with waiting(f"fitting {file}", silent=quiet):
        found = pbdkit.fit_strength(file) if repeats else pbdkit.fit(file)
    write(path, json.dumps(found.as_dict(), indent=2) + "\n", replace=force)
    if not quiet:
        for line in found.lines():
            click.echo(line)
        click.echo(f"{path} written")
    if picture:
        from pbdkit.drawing.fit import draw_fit
        from pbdkit.fitting.fitted import Fitted

        assert isinstance(found, Fitted)
        save(picture, draw_fit(found), replace=force, quiet=quiet)
