"""``pbdkit report``: a result as one page of HTML."""

from __future__ import annotations

from pathlib import Path

import click

from pbdkit.cli.options import PATH, at_option, result_argument


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="The page; OUT.html if left out.")
@click.option("--bench", type=PATH, help="What `pbdkit bench --json` wrote, shown in the page.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing page.")
def report(
    file: Path, output: Path | None, bench: Path | None, at: dict[str, str], force: bool
) -> None:
    """Write one page to share: the moving lattice, histories, curves, what was predicted, what
    broke, how to run it again; of a sweep its map and its members. It needs no network."""
    from pbdkit.cli.options import refuse_output, refuse_unwritable
    from pbdkit.io.open import reading, refuse_other_file
    from pbdkit.web.report import BUDGET
    from pbdkit.web.report import report as write

    refuse_other_file(file)
    path = output or file.with_suffix(".html")
    refuse_output(path, force=force)
    refuse_unwritable(None, path)
    with reading(file, sweeps=True, at=at) as dataset:
        write(dataset, path, bench=bench, replace=force)
    size = path.stat().st_size
    click.echo(f"{path} written, {size / 1e6:.2g} MB; open it in a browser")
    if size > BUDGET:
        click.echo(f"it is larger than {BUDGET / 1e6:.2g} MB: what it holds cannot be thinned more")
