"""``pbdkit plot`` and ``explain``: a result looked at."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import json_option

if TYPE_CHECKING:
    from pbdkit.results.explanation import Explained, Standing

SHOWN = 20
"""So many broken bonds are listed in words; --json has all."""


@click.command()
@click.argument("file", metavar="OUT.nc", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
@click.option("--time", "times", type=int, multiple=True, help="A recorded step; several panels.")
@click.option("--color", metavar="VARIABLE", help="Colour by a variable, e.g. pe1.")
@click.option("--contours", is_flag=True, help="Fill contours of the variable.")
@click.option("--numbers", is_flag=True, help="Write the particles' numbers.")
@click.option("--force", is_flag=True, help="Replace an existing picture.")
def plot(
    file: Path,
    output: Path | None,
    times: tuple[int, ...],
    color: str | None,
    contours: bool,
    numbers: bool,
    force: bool,
) -> None:
    """Draw configurations of a result: kinds, numbers, any diagnostic in colour."""
    from pbdkit.cli.output import refuse_output, refuse_unwritable, save
    from pbdkit.results.accessor import reading
    from pbdkit.results.picture import draw

    path = output or file.with_suffix(".png")
    refuse_output(path, force=force)
    refuse_unwritable(path)
    with reading(file) as dataset:
        axes = draw(dataset, times or [None], color=color, contours=contours, numbers=numbers)
        whole = axes[0].get_figure(root=True)
        assert whole is not None
        save(path, whole)


@click.command()
@click.argument("file", metavar="OUT.nc", type=click.Path(path_type=Path))
@click.option("--bond", nargs=2, type=int, metavar="A B", help="The bond between two numbers.")
@json_option
def explain(file: Path, bond: tuple[int, int] | None, as_json: bool) -> None:
    """Say which bonds broke, when, how far strained and in which order; or, of one bond, how far it
    is, or was, from breaking, and what happened around it."""
    from pbdkit.api import experiment_of
    from pbdkit.results.accessor import reading
    from pbdkit.results.explanation import Explained
    from pbdkit.scene.scene import build_scene

    with reading(file) as dataset:
        explained = Explained(dataset, build_scene(experiment_of(dataset)))
        found = _of_one(explained, *bond) if bond else _of_all(explained)
        if as_json:
            said = json.dumps(found, default=asdict)
        else:
            said = "\n".join(_bond_in_words(found) if bond else _run_in_words(found))
    click.echo(said)


def _of_all(explained: Explained) -> dict[str, Any]:
    steps = explained.steps
    return {
        "fracture": explained.model.type,
        "bonds": len(steps),
        "broken": int((steps > 0).sum()),
        "broken_from_the_start": int((steps == 0).sum()),
        "in_order": explained.standings(explained.order),
        "nearest": explained.nearest(),
    }


def _of_one(explained: Explained, a: int, b: int) -> dict[str, Any]:
    import numpy as np

    row = explained.row(a, b)
    most = explained.most_strained(row)
    (standing,) = explained.standings(np.array([row]))
    return {
        "fracture": explained.model.type,
        "bond": standing,
        "most_strained": {"step": most[0], "strain": most[1]},
        "remembered": explained.remembered(row),
        "broken_in_all": len(explained.order),
        "around": explained.standings(explained.around(row), standing.step),
    }


def _run_in_words(found: dict[str, Any]) -> Iterator[str]:
    broken, cut = found["broken"], found["broken_from_the_start"]
    start = f", {cut} broken from the start" if cut else ""
    yield f"fracture {found['fracture']}: {broken} of {found['bonds']} bonds broke{start}"
    rows = [s for s in found["in_order"] if s.step]
    if rows:
        yield f"first in step {rows[0].step}, last in step {rows[-1].step}"
        yield "order  step  bond           strain       breaks above"
    for s in rows[:SHOWN]:
        bond = "-".join(map(str, s.bond))
        strain, limit = _number(s.strain_at_break), _number(s.breaks_above)
        yield f"{s.order:>5}  {s.step:>4}  {bond:<13}  {strain:<11}  {limit}"
    if rows and all(s.breaks_above is None for s in rows):
        yield (
            f"{found['fracture']} does not say above which strain a bond breaks: a model does by "
            "`breaking_strain`"
        )
    if len(rows) > SHOWN:
        yield f"and {len(rows) - SHOWN} more: --json lists all"
    if found["nearest"]:
        yield f"nearest to breaking: {_standing(found['nearest'])}"


def _bond_in_words(found: dict[str, Any]) -> Iterator[str]:
    s: Standing = found["bond"]
    yield f"bond {s.bond[0]}-{s.bond[1]}: shell {s.shell}, rest length {s.rest_length:.6g}"
    if s.state == "broken":
        strain = "an unknown strain" if s.strain_at_break is None else f"{s.strain_at_break:.6g}"
        yield (
            f"broke in step {s.step} at strain {strain}, number {s.order} of the "
            f"{found['broken_in_all']} broken"
        )
        if s.breaks_above is not None:
            yield f"fracture {found['fracture']} breaks it above {s.breaks_above:.6g}"
    else:
        yield _standing(s).split(": ", 1)[1]
    if s.state == "intact":
        most = found["most_strained"]
        yield f"longest of the recorded steps in step {most['step']}: strain {most['strain']:.6g}"
    for name, value in found["remembered"].items():
        yield f"{name} {value:.6g}"
    yield from _around_in_words(found["around"], s)


def _around_in_words(around: list[Standing], s: Standing) -> Iterator[str]:
    """The other bonds at its ends: what broke before it, with it and after it."""
    broken = [(other.step, other) for other in around if other.step is not None]
    groups = {"broken around it": broken}
    if (step := s.step) is not None:
        groups = {
            "broken around it before": [each for each in broken if each[0] < step],
            "in the same step": [each for each in broken if each[0] == step],
            "after": [each for each in broken if each[0] > step],
        }
    for title, group in groups.items():
        listed = ", ".join(f"{o.bond[0]}-{o.bond[1]} (step {at})" for at, o in group)
        yield f"{title}: {listed or 'none'}"
    whole = [o for o in around if o.step is None]
    yield f"not broken around it: {len(whole)}" + (
        f", the most strained {_standing(max(whole, key=lambda o: o.strain))}" if whole else ""
    )


def _standing(s: Standing) -> str:
    """An unbroken bond in a few words; what stands before the colon is its name."""
    words = f"{s.bond[0]}-{s.bond[1]}: {s.state}, strain {s.strain:.6g} in step {s.at_step}"
    if s.breaks_above is not None and s.share is not None:
        words += f", breaks above {s.breaks_above:.6g} ({s.share:.3g} of the way)"
    return words


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.6g}"
