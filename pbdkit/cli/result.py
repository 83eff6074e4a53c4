"""``pbdkit explain``, ``status``, ``verify`` and ``export``: inspect a result or an unfinished run,
and write it in another format.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from operator import eq, gt, lt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pbdkit.cli.options import PATH, at_option, json_option, result_argument

if TYPE_CHECKING:
    import xarray

    from pbdkit.io.explain import BondStatus, Explained
    from pbdkit.scene.scene import Scene


SHOWN = 20
"""So many broken bonds are listed in words; --json has all."""


@click.command()
@result_argument("files", "FILE...", nargs=-1, required=True)
def verify(files: tuple[Path, ...]) -> int:
    """Recompute the digests of results and say, a line a file, which are as they were written."""
    from pbdkit.cli.options import waiting

    faults = []
    for file in files:
        with waiting(f"reading {file}"):
            fault = _verified(file)
        click.echo(fault or f"{file}: is as it was written")
        faults += [fault] if fault else []
    return 6 if faults else 0


def _verified(file: Path) -> str:
    """What a file's line says against it, if anything."""
    from pbdkit.cli.options import refusals_as
    from pbdkit.errors import StorageError
    from pbdkit.io.open import UNSEALED, other_file, refuse_no_file
    from pbdkit.io.seal import SealedFile
    from pbdkit.untrusted_files import refuse_no_result

    fault = ""
    try:
        if told := other_file(file):
            raise StorageError(f"{file}: {told}")
        refuse_no_file(file)
        with refusals_as(str(file)), SealedFile(file) as content:
            content.check()
            if content.seal is None:
                refuse_no_result(file)
                fault = f"{file}: {UNSEALED}"
            else:
                _refuse_elsewhere(file)
    except StorageError as error:
        fault = str(error)
    return fault


def _refuse_elsewhere(file: Path) -> None:
    """Raises StorageError where the bytes are what was sealed, and refer to others elsewhere."""
    from pbdkit.errors import StorageError, one_line
    from pbdkit.io.seal import opened

    try:
        opened(file).close()
    except StorageError:
        raise
    except Exception as error:  # whatever the libraries make of it
        raise StorageError(f"{file}: cannot be read as netCDF-4: {one_line(str(error))}") from None


@click.command()
@result_argument("output")
@json_option
def status(output: Path, as_json: bool) -> None:
    """Say of an unfinished run how far it is, at which rate, and when it will end."""
    from pbdkit.errors import ExperimentError
    from pbdkit.io.open import refuse_other_file, refuse_store
    from pbdkit.io.run_store import status_of

    refuse_store(output)
    found = status_of(output)
    if found is None:
        refuse_other_file(output)
        what = "is finished" if output.exists() else "there is no such run"
        raise ExperimentError(f"{output}: {what}; runs of less than a second leave no trace")
    if as_json:
        click.echo(json.dumps(found))
        return
    click.echo(f"{output}: step {found['step']} of {found['steps']}, {found['state']}")
    if found["rate"]:
        click.echo(f"rate: {found['rate']:.3g} steps a second")
    if found["state"] == "running" and found["left_s"] is not None:
        click.echo(f"time left: about {_duration(found['left_s'])}")
    elif found["state"] != "running":
        click.echo(f"`pbdkit resume {output}` goes on with it")


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"


@click.command()
@result_argument("file")
@click.option("--bond", nargs=2, type=int, metavar="A B", help="The bond between two numbers.")
@at_option
@json_option
def explain(file: Path, bond: tuple[int, int] | None, at: dict[str, str], as_json: bool) -> None:
    """Say which bonds broke, when, how far strained and in which order; or, of one bond, how far it
    is, or was, from breaking, and what happened around it."""
    from pbdkit.cli.options import waiting
    from pbdkit.io.explain import Explained
    from pbdkit.io.layout import scene_of
    from pbdkit.io.open import reading

    with waiting(f"reading {file}", silent=as_json), reading(file, at=at) as dataset:
        explained = Explained(dataset, scene_of(dataset, "explain"))
        found = _of_one(explained, *bond) if bond else _of_all(explained)
        words = _bond_in_words(found) if bond else _run_in_words(found)
        said = json.dumps(found, default=asdict) if as_json else "\n".join(words)
    click.echo(said)


def _of_all(explained: Explained) -> dict[str, Any]:
    steps = explained.steps
    return {
        "fracture": explained.model.type,
        "bonds": len(steps),
        "broken": int((steps > 0).sum() - explained.cut.sum()),
        "cut": int(explained.cut.sum()),
        "broken_from_the_start": int((steps == 0).sum()),
        "in_order": explained.standings(explained.order),
        "nearest": explained.nearest(),
    }


def _of_one(explained: Explained, a: int, b: int) -> dict[str, Any]:
    import numpy as np

    row = explained.row(a, b)
    step, strain = explained.most_strained(row)
    (standing,) = explained.standings(np.array([row]))
    return {
        "fracture": explained.model.type,
        "bond": standing,
        "most_strained": {"step": step, "strain": strain},
        "remembered": explained.remembered(row),
        "broken_in_all": len(explained.order),
        "around": explained.standings(explained.around(row), standing.step),
    }


def _run_in_words(found: dict[str, Any]) -> Iterator[str]:
    broken, model = found["broken"], found["fracture"]
    also = {"cut": found["cut"], "broken from the start": found["broken_from_the_start"]}
    more = "".join(f", {count} {how}" for how, count in also.items() if count)
    yield f"fracture {model}: {broken} of {found['bonds']} bonds broke{more}"
    rows = [s for s in found["in_order"] if s.state == "broken"]
    if rows:
        yield f"first in step {rows[0].step}, last in step {rows[-1].step}"
        yield "order  step  bond           strain       breaks above"
    for s in rows[:SHOWN]:
        strain, limit = _number(s.strain_at_break), _number(s.breaks_above)
        yield f"{s.order:>5}  {s.step:>4}  {_name(s):<13}  {strain:<11}  {limit}"
    if rows and all(s.breaks_above is None for s in rows):
        does = "a model does by `breaking_strain`"
        yield f"{model} does not say above which strain a bond breaks: {does}"
    if len(rows) > SHOWN:
        yield f"and {len(rows) - SHOWN} more: --json lists all"
    if found["nearest"]:
        yield f"nearest to breaking: {_name(found['nearest'])}: {_standing(found['nearest'])}"


def _bond_in_words(found: dict[str, Any]) -> Iterator[str]:
    s: BondStatus = found["bond"]
    yield f"bond {_name(s)}: shell {s.shell}, rest length {s.rest_length:.6g}"
    if s.state == "broken":
        strain = _number(s.strain_at_break, "an unknown strain")
        order = f"number {s.order} of the {found['broken_in_all']} broken"
        yield f"broke in step {s.step} at strain {strain}, {order}"
        if s.breaks_above is not None:
            yield f"fracture {found['fracture']} breaks it above {s.breaks_above:.6g}"
    elif s.state == "cut":
        yield f"cut at the beginning of step {s.step}"
    else:
        yield _standing(s)
    if s.state == "intact":
        most = found["most_strained"]
        yield f"longest of the recorded steps in step {most['step']}: strain {most['strain']:.6g}"
    yield from (f"{name} {value:.6g}" for name, value in found["remembered"].items())
    yield from _around_in_words(found["around"], s.step)


def _around_in_words(around: list[BondStatus], step: int | None) -> Iterator[str]:
    """The other bonds at its ends: what broke before it, with it and after it."""
    broken = [s for s in around if s.step is not None]
    groups = {"broken around it": broken}
    if step is not None:
        when: dict[str, Any] = {"broken around it before": lt, "in the same step": eq, "after": gt}
        groups = {
            title: [s for s in broken if is_so(s.step, step)] for title, is_so in when.items()
        }
    for title, group in groups.items():
        yield f"{title}: {', '.join(f'{_name(s)} (step {s.step})' for s in group) or 'none'}"
    whole = [s for s in around if s.step is None]
    most = max(whole, key=lambda s: s.strain, default=None)
    strained = f", the most strained {_name(most)}: {_standing(most)}" if most else ""
    yield f"not broken around it: {len(whole)}{strained}"


def _name(s: BondStatus) -> str:
    return f"{s.bond[0]}-{s.bond[1]}"


def _standing(s: BondStatus) -> str:
    """An unbroken bond in a few words."""
    words = f"{s.state}, strain {s.strain:.6g} in step {s.at_step}"
    if s.breaks_above is not None and s.share is not None:
        words += f", breaks above {s.breaks_above:.6g} ({s.share:.3g} of the way)"
    return words


def _number(value: float | None, unknown: str = "not known") -> str:
    return unknown if value is None else f"{value:.6g}"


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
    from pbdkit.cli.options import refuse_output
    from pbdkit.errors import ExperimentError, StorageError
    from pbdkit.io.open import reading, refuse_other_file
    from pbdkit.io.vtkhdf import export as write

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
    from pbdkit.io.layout import scene_of

    try:
        return scene_of(dataset, "a grid of cells")
    except PbdkitError as error:
        click.echo(f"warning: without cells, as its experiment is not there: {error}", err=True)
        return None
