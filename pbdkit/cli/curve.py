"""``pbdkit curve``: what changes in the course of a result, as lines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import PATH, at_option, result_argument
from pbdkit.errors import ExperimentError

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

CURVES = ("stress-strain", "load-displacement", "energies")
CRACKS: dict[str, Any] = {"crack": "map", "crack-length": "length", "broken-bonds": "bonds"}
HISTORY = "history"


@click.command()
@result_argument("file")
@click.argument("kind", required=False, type=click.Choice([*CURVES, HISTORY, *CRACKS]))
@click.option("-o", "--output", type=PATH, help="PNG, SVG or PDF.")
@click.option("--y", metavar="VARIABLE", help="Draw this, e.g. reaction_x or pe1.")
@click.option("--x", metavar="VARIABLE", help="Over this; the time if it is not said.")
@click.option(
    "--particle",
    "particles",
    type=int,
    multiple=True,
    help="Its history; again for one more.",
)
@click.option("--bond", nargs=2, type=int, metavar="A B", help="The history of a bond.")
@click.option("--group", type=int, help="Forces of this leader group.")
@click.option("--load", type=int, help="Forces of this load.")
@click.option("--obstacle", type=int, help="Forces of this obstacle.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def curve(
    file: Path, kind: str | None, output: Path | None, at: dict[str, str], force: bool, **asked: Any
) -> None:
    """Draw what changes in the course of a result: a curve, histories, the crack.

    \b
    stress-strain      nominal stress over nominal strain
    load-displacement  force over displacement of a leader group, load or obstacle
    energies           the energies over the steps
    history            a variable (--y, else u) of particles or a bond over the steps
    crack              the broken bonds, by the step in which they broke
    crack-length       the length of the longest crack over the steps
    broken-bonds       their number over the steps

    Without KIND the first that the result has. --y alone draws that variable over the steps, and
    with --particle or --bond its history there. Results of sweeps have a line a member.
    """
    from pbdkit.cli.output import refuse_output, refuse_unwritable, save
    from pbdkit.results.other_files import refuse_other_file
    from pbdkit.results.result_file import reading

    refuse_other_file(file)
    path = output or file.with_name(f"{file.stem}-{_named(kind, asked)}.png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file, sweeps=True, at=at) as dataset:
        from pbdkit.drawing.figures import figure_of  # needs matplotlib, which is there by now

        save(path, figure_of(_drawn(dataset, kind, **asked)), replace=force)


def _named(kind: str | None, asked: dict[str, Any]) -> str:
    """What the picture is called where nobody says."""
    if kind in (None, HISTORY) and (asked["particles"] or asked["bond"]):
        return f"{HISTORY}-{asked['y']}" if asked["y"] else HISTORY
    return kind or asked["y"] or "curve"


def _drawn(
    dataset: xarray.Dataset,
    kind: Any,
    x: str | None,
    y: str | None,
    particles: tuple[int, ...],
    bond: tuple[int, int] | None,
    **chosen: Any,
) -> Axes:
    from pbdkit.drawing.crack import crack
    from pbdkit.drawing.curve import curve
    from pbdkit.drawing.history import history

    if x is not None and y is None:
        raise ExperimentError(
            f"--x {x}: no variable is given to be drawn over it; add --y VARIABLE"
        )
    if kind in CRACKS:
        return crack(dataset, kind=CRACKS[kind])
    if kind == HISTORY or (kind is None and (particles or bond)):
        return history(dataset, y, particle=particles or None, bond=bond)
    return curve(dataset, x, y, kind=kind, **chosen)
