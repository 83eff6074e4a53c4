"""Commands ``pbdkit explain``, ``status``, ``verify`` and ``export``: inspect and convert
results."""

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

    from pbdkit.io.explain import BondStatus, BondTable
    from pbdkit.scene.scene import Scene


MAX_LISTED = 20
"""Number of broken bonds that are listed as text; --json lists all."""


@click.command()
@result_argument("files", "FILE...", nargs=-1, required=True)
def verify(files: tuple[Path, ...]) -> int:
    """Recompute the checksums of results, and report for each file whether it is unchanged."""
    from pbdkit.cli.options import waiting

    faults = []
    for file in files:
        with waiting(f"reading {file}"):
            fault = _fault_of(file)
        click.echo(fault or f"{file}: unchanged since it was written")
        faults += [fault] if fault else []
    return 6 if faults else 0


def _fault_of(file: Path) -> str:
    """Return the fault of a result, or an empty string."""
    from pbdkit.cli.options import refusals_as
    from pbdkit.errors import StorageError
    from pbdkit.io.open import UNSEALED, refuse_no_file
    from pbdkit.io.other_files import other_file
    from pbdkit.io.seal import SealedFile
    from pbdkit.untrusted_files import refuse_no_result

    fault = ""
    try:
        if description := other_file(file):
            raise StorageError(f"{file}: {description}")
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
    """Raise StorageError if the bytes are those that were sealed, but refer to other files."""
    from pbdkit.errors import StorageError, one_line
    from pbdkit.io.seal import open_sealed

    try:
        open_sealed(file).close()
    except StorageError:
        raise
    except Exception as error:  # h5py raises errors of many types
        raise StorageError(f"{file}: cannot be read as netCDF-4: {one_line(str(error))}") from None


@click.command()
@result_argument("output")
@json_option
def status(output: Path, as_json: bool) -> None:
    """Report the progress of an unfinished run: step, rate and remaining time."""
    from pbdkit.errors import ExperimentError
    from pbdkit.io.other_files import refuse_other_file, refuse_store
    from pbdkit.io.run_store import status_of

    refuse_store(output)
    facts = status_of(output)
    if facts is None:
        refuse_other_file(output)
        state = "is finished" if output.exists() else "there is no such run"
        raise ExperimentError(f"{output}: {state}; runs of less than a second have no status")
    if as_json:
        click.echo(json.dumps(facts))
        return
    click.echo(f"{output}: step {facts['step']} of {facts['steps']}, {facts['state']}")
    if facts["rate"]:
        click.echo(f"rate: {facts['rate']:.3g} steps a second")
    if facts["state"] == "running" and facts["left_s"] is not None:
        click.echo(f"time left: about {_duration(facts['left_s'])}")
    elif facts["state"] != "running":
        click.echo(f"`pbdkit resume {output}` continues it")


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"


@click.command()
@result_argument("file")
@click.option(
    "--bond", nargs=2, type=int, metavar="A B", help="Numbers of the two particles of a bond."
)
@at_option
@json_option
def explain(file: Path, bond: tuple[int, int] | None, at: dict[str, str], as_json: bool) -> None:
    """Explain fracture: which bonds broke, when, at which strain and in which order.

    For one bond, report its distance from breaking, or its break, and what happened around it.
    """
    from pbdkit.cli.options import waiting
    from pbdkit.io.explain import BondTable
    from pbdkit.io.layout import scene_of
    from pbdkit.io.open import reading

    with waiting(f"reading {file}", silent=as_json), reading(file, at=at) as dataset:
        explained = BondTable(dataset, scene_of(dataset, "explain"))
        facts = _bond_facts(explained, *bond) if bond else _run_facts(explained)
        lines = _bond_in_words(facts) if bond else _run_in_words(facts)
        text = json.dumps(facts, default=asdict) if as_json else "\n".join(lines)
    click.echo(text)


def _run_facts(explained: BondTable) -> dict[str, Any]:
    steps = explained.steps
    return {
        "fracture": explained.model.type,
        "bonds": len(steps),
        "broken": int((steps > 0).sum() - explained.cut.sum()),
        "cut": int(explained.cut.sum()),
        "broken_from_the_start": int((steps == 0).sum()),
        "in_order": explained.statuses(explained.order),
        "nearest": explained.nearest(),
    }


def _bond_facts(explained: BondTable, a: int, b: int) -> dict[str, Any]:
    import numpy as np

    row = explained.row(a, b)
    step, strain = explained.most_strained(row)
    (standing,) = explained.statuses(np.array([row]))
    return {
        "fracture": explained.model.type,
        "bond": standing,
        "most_strained": {"step": step, "strain": strain},
        "remembered": explained.remembered(row),
        "broken_in_all": len(explained.order),
        "around": explained.statuses(explained.around(row), standing.step),
    }


def _run_in_words(facts: dict[str, Any]) -> Iterator[str]:
    broken, model = facts["broken"], facts["fracture"]
    further = {"cut": facts["cut"], "broken from the start": facts["broken_from_the_start"]}
    rest = "".join(f", {count} {kind}" for kind, count in further.items() if count)
    yield f"fracture {model}: {broken} of {facts['bonds']} bonds broke{rest}"
    rows = [standing for standing in facts["in_order"] if standing.state == "broken"]
    if rows:
        yield f"first in step {rows[0].step}, last in step {rows[-1].step}"
        yield "order  step  bond           strain       breaks above"
    for standing in rows[:MAX_LISTED]:
        strain, limit = _number(standing.strain_at_break), _number(standing.breaks_above)
        position = f"{standing.order:>5}  {standing.step:>4}  {_name(standing):<13}"
        yield f"{position}  {strain:<11}  {limit}"
    if rows and all(standing.breaks_above is None for standing in rows):
        remedy = "models declare it by `breaking_strain`"
        yield f"{model} has no strain above which a bond breaks: {remedy}"
    if len(rows) > MAX_LISTED:
        yield f"and {len(rows) - MAX_LISTED} more: --json lists all"
    if facts["nearest"]:
        yield f"nearest to breaking: {_name(facts['nearest'])}: {_standing(facts['nearest'])}"


def _bond_in_words(facts: dict[str, Any]) -> Iterator[str]:
    s: BondStatus = facts["bond"]
    yield f"bond {_name(s)}: shell {s.shell}, rest length {s.rest_length:.6g}"
    if s.state == "broken":
        strain = _number(s.strain_at_break, "an unknown strain")
        order = f"number {s.order} of the {facts['broken_in_all']} broken"
        yield f"broke in step {s.step} at strain {strain}, {order}"
        if s.breaks_above is not None:
            yield f"fracture {facts['fracture']} breaks it above {s.breaks_above:.6g}"
    elif s.state == "cut":
        yield f"cut at the beginning of step {s.step}"
    else:
        yield _standing(s)
    if s.state == "intact":
        step, strain = facts["most_strained"]["step"], facts["most_strained"]["strain"]
        yield f"largest strain of the recorded steps in step {step}: {strain:.6g}"
    yield from (f"{name} {value:.6g}" for name, value in facts["remembered"].items())
    yield from _around_in_words(facts["around"], s.step)


def _around_in_words(around: list[BondStatus], step: int | None) -> Iterator[str]:
    """Describe the other bonds at its ends: those that broke before it, with it and after it."""
    broken = [standing for standing in around if standing.step is not None]
    groups = {"broken around it": broken}
    if step is not None:
        relations: dict[str, Any] = {
            "broken around it before": lt,
            "in the same step": eq,
            "after": gt,
        }
        groups = {
            title: [standing for standing in broken if relation(standing.step, step)]
            for title, relation in relations.items()
        }
    for title, group in groups.items():
        bonds = ", ".join(f"{_name(standing)} (step {standing.step})" for standing in group)
        yield f"{title}: {bonds or 'none'}"
    unbroken = [standing for standing in around if standing.step is None]
    maximum = max(unbroken, key=lambda standing: standing.strain, default=None)
    remark = f", the most strained {_name(maximum)}: {_standing(maximum)}" if maximum else ""
    yield f"not broken around it: {len(unbroken)}{remark}"


def _name(s: BondStatus) -> str:
    return f"{s.bond[0]}-{s.bond[1]}"


def _standing(s: BondStatus) -> str:
    """Describe an unbroken bond in a few words."""
    words = f"{s.state}, strain {s.strain:.6g} in step {s.at_step}"
    if s.breaks_above is not None and s.share is not None:
        words += f", breaks above {s.breaks_above:.6g} ({s.share:.3g} of the way)"
    return words


def _number(value: float | None, unknown: str = "not known") -> str:
    return unknown if value is None else f"{value:.6g}"


SUFFIX = ".vtkhdf"
"""File name extension of VTKHDF files."""


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="A .vtkhdf file; default OUT.vtkhdf.")
@at_option
@click.option("--force", is_flag=True, help="Replace an existing file.")
def export(file: Path, output: Path | None, at: dict[str, str], force: bool) -> None:
    """Write a result as VTKHDF for ParaView: every recorded step with all variables.

    Particles are vertices, bonds lines, and the cells of the lattice triangles and quads. The cell
    array `part` distinguishes them (0, 1, 2), and `broken` marks torn cells.
    """
    from pbdkit.cli.options import refuse_output
    from pbdkit.errors import ExperimentError, StorageError
    from pbdkit.io.open import reading
    from pbdkit.io.other_files import refuse_other_file
    from pbdkit.io.vtkhdf import export as write

    refuse_other_file(file)
    path = output or file.with_suffix(SUFFIX)
    if path.suffix != SUFFIX:
        raise ExperimentError(
            f"{path}: must end in {SUFFIX}, by which ParaView recognises the format"
        )
    refuse_output(path, force=force)
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    with reading(file, at=at) as dataset:
        write(dataset, path, _scene_of(dataset), replace=force)
    click.echo(f"{path} written")


def _scene_of(dataset: xarray.Dataset) -> Scene | None:
    """Return the scene of the cells; without it, warn that there are no cells."""
    from pbdkit.errors import PbdkitError
    from pbdkit.io.layout import scene_of

    try:
        return scene_of(dataset, "a grid of cells")
    except PbdkitError as error:
        click.echo(
            f"warning: written without cells, since the experiment is not available: {error}",
            err=True,
        )
        return None
