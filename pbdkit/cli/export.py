"""``pbdkit export``: a result in the format of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import PATH, at_option, result_argument

if TYPE_CHECKING:
    import xarray

    from pbdkit.scene.scene import Scene

SUFFIX = ".vtkhdf"


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="A .vtkhdf file; beside OUT.nc if not said.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing file.")
def export(file: Path, output: Path | None, at: dict[str, str], force: bool) -> None:
    """Write a result as VTKHDF, which ParaView opens: every recorded step with all variables.

    Particles are vertices, bonds lines, and the cells of the lattice triangles and quads; the cell
    array `part` tells them apart (0, 1, 2), and `broken` those that are torn.
    """
    from pbdkit.cli.output import refuse_output
    from pbdkit.errors import ExperimentError, StorageError
    from pbdkit.results.other_files import refuse_other_file
    from pbdkit.results.result_file import reading
    from pbdkit.results.vtkhdf import export as write

    refuse_other_file(file)
    path = output or file.with_suffix(SUFFIX)
    if path.suffix != SUFFIX:
        raise ExperimentError(f"{path}: ends in {SUFFIX}, so that ParaView knows what it is")
    refuse_output(path, force=force)
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    with reading(file, at=at) as dataset:
        write(dataset, path, _scene_of(dataset), replace=force)
    click.echo(f"{path} written")


def _scene_of(dataset: xarray.Dataset) -> Scene | None:
    """The scene that the cells are those of; without it, which is told, there are no cells."""
    from pbdkit.errors import PbdkitError
    from pbdkit.results.carried import scene_of

    try:
        return scene_of(dataset, "a grid of cells")
    except PbdkitError as error:
        click.echo(f"warning: without cells, as its experiment is not there: {error}", err=True)
        return None
