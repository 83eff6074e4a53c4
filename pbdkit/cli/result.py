"""Commands ``pbdkit explain`` and ``pbdkit export``: fracture in a result, and its conversion."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from operator import eq, gt, lt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pbdkit.cli.output import refuse_output
from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.io import vtkhdf
from pbdkit.io.explain import PLACES, BondRecords, BondStatus, TipStatus, tip_statuses
from pbdkit.io.layout import scene_of
from pbdkit.io.open import reading
from pbdkit.io.other_files import refuse_other_file
from pbdkit.progress import waiting
from pbdkit.scene.scene import Scene

if TYPE_CHECKING:
    import xarray

MAX_LISTED = 20
"""Maximum number of broken bonds that are listed as text; --json lists all of them."""


def explain(file: Path, bond: tuple[int, int] | None, at: dict[str, str], as_json: bool) -> None:
    """Explain fracture: which bonds broke, when, at which strain and in which order.

    With the diagnostic stress-intensity, also report how close each crack is to growing.

    For one bond, report how close it is to breaking or how it broke, and what happened around
    it.
    """
    with waiting(f"reading {file}", silent=as_json), reading(file, at=at) as dataset:
        scene = scene_of(dataset, "explain")
        explained = BondRecords(dataset, scene)
        facts = _bond_facts(explained, *bond) if bond else _run_facts(explained)
        if not bond:
            facts["crack_tips"] = tip_statuses(dataset, scene.experiment)
        lines = _bond_in_words(facts) if bond else _run_in_words(facts)
        text = json.dumps(facts, default=_as_dict) if as_json else "\n".join(lines)
    click.echo(text)


def _run_facts(explained: BondRecords) -> dict[str, Any]:
    steps = explained.steps
    is_broken = (steps > 0) & ~explained.cut
    by_place = np.bincount(explained.places[is_broken], minlength=len(PLACES))
    return {
        "fracture": explained.model.type,
        "bonds": len(steps),
        "broken": int(is_broken.sum()),
        "cut": int(explained.cut.sum()),
        "broken_from_the_start": int((steps == 0).sum()),
        "broken_by_place": dict(zip(PLACES, by_place.tolist(), strict=True)),
        "in_order": explained.statuses(explained.order),
        "nearest": explained.nearest(),
    }


def _bond_facts(explained: BondRecords, a: int, b: int) -> dict[str, Any]:
    row = explained.row(a, b)
    step, strain = explained.most_strained(row)
    (status,) = explained.statuses(np.array([row]))
    return {
        "fracture": explained.model.type,
        "bond": status,
        "most_strained": {"step": step, "strain": strain},
        "remembered": explained.remembered(row),
        "broken_in_all": len(explained.order),
        "around": explained.statuses(explained.around(row), status.step),
    }


def _run_in_words(facts: dict[str, Any]) -> Iterator[str]:
    broken, model = facts["broken"], facts["fracture"]
    further = {"cut": facts["cut"], "broken from the start": facts["broken_from_the_start"]}
    rest = "".join(f", {count} {kind}" for kind, count in further.items() if count)
    yield f"fracture {model}: {broken} of {facts['bonds']} bonds broke{rest}"
    by_place = facts["broken_by_place"]
    if by_place["body"] < broken:
        yield (
            f"of these {by_place['body']} in the body, {by_place['outside the outline']} with an "
            f"end outside its outline, and {by_place['frame']} with an end in the frame"
        )
    rows = [status for status in facts["in_order"] if status.state == "broken"]
    has_limits = any(status.breaks_above is not None for status in rows)
    if rows:
        yield f"first in step {rows[0].step}, last in step {rows[-1].step}"
        yield "order  step  bond           strain" + ("       breaks above" if has_limits else "")
    for status in rows[:MAX_LISTED]:
        strain, limit = _number(status.strain_at_break), _number(status.breaks_above)
        position = f"{status.order:>5}  {status.step:>4}  {_name(status):<13}"
        place = "" if status.place == "body" else f"  {status.place}"
        yield f"{position}  {strain:<11}" + (f"  {limit}" if has_limits else "") + place
    if rows and not has_limits:
        remedy = "a fracture model declares it by `breaking_strain`"
        yield f"{model} declares no strain above which a bond breaks: {remedy}"
    if len(rows) > MAX_LISTED:
        yield f"and {len(rows) - MAX_LISTED} more; --json lists all"
    if facts["nearest"]:
        nearest = facts["nearest"]
        yield f"nearest to breaking: {_name(nearest)}: {_describe_status(nearest)}"
    yield from map(_tip_in_words, facts["crack_tips"])


def _tip_in_words(tip: TipStatus) -> str:
    """Describe a crack tip, and how far its crack is from growing."""
    x, y = tip.place
    name = f"crack tip {tip.tip} at ({x:.6g}, {y:.6g}) in step {tip.at_step}"
    if tip.release is None:
        return f"{name}: no energy release rate, because there is no crack or no space around it"
    words = f"{name}: energy release rate {tip.release:.6g} {tip.units}"
    if tip.critical is None or tip.share is None:
        return f"{words}; the fracture model has no critical energy release rate"
    words += f", {tip.share:.3g} of the critical one, {tip.critical:.6g}"
    if tip.load_factor is None:
        return words
    return f"{words}; the crack grows at {tip.load_factor:.4g} times the load"


def _as_dict(status: Any) -> dict[str, Any]:
    """Return a status as a dictionary; that of a tip contains its ratios too."""
    ratios = {"share": status.share} if isinstance(status, TipStatus) else {}
    return asdict(status) | ratios | ({"load_factor": status.load_factor} if ratios else {})


def _bond_in_words(facts: dict[str, Any]) -> Iterator[str]:
    s: BondStatus = facts["bond"]
    yield f"bond {_name(s)}: shell {s.shell}, rest length {s.rest_length:.6g}"
    if s.state == "broken":
        strain = _number(s.strain_at_break, "an unknown strain")
        order = f"bond {s.order} of {facts['broken_in_all']} in the order of breaking"
        yield f"broke in step {s.step} at strain {strain}, {order}"
        if s.breaks_above is not None:
            yield f"fracture {facts['fracture']}: it breaks above the strain {s.breaks_above:.6g}"
    elif s.state == "cut":
        yield f"cut at the beginning of step {s.step}"
    else:
        yield _describe_status(s)
    if s.state == "intact":
        step, strain = facts["most_strained"]["step"], facts["most_strained"]["strain"]
        yield f"largest strain in a recorded step: {strain:.6g}, in step {step}"
    yield from (f"{name} {value:.6g}" for name, value in facts["remembered"].items())
    yield from _around_in_words(facts["around"], s.step)


def _around_in_words(around: list[BondStatus], step: int | None) -> Iterator[str]:
    """Describe the other bonds of both ends of a bond. They are grouped into bonds that broke
    before it, in the same step, and after it."""
    broken = [status for status in around if status.step is not None]
    groups = {"adjacent bonds broken": broken}
    if step is not None:
        relations: dict[str, Any] = {
            "adjacent bonds broken before": lt,
            "adjacent bonds broken in the same step": eq,
            "adjacent bonds broken after": gt,
        }
        groups = {
            title: [status for status in broken if relation(status.step, step)]
            for title, relation in relations.items()
        }
    for title, group in groups.items():
        bonds = ", ".join(f"{_name(status)} (step {status.step})" for status in group)
        yield f"{title}: {bonds or 'none'}"
    unbroken = [status for status in around if status.step is None]
    maximum = max(unbroken, key=lambda status: status.strain, default=None)
    remark = (
        f"; the largest strain is that of {_name(maximum)}: {_describe_status(maximum)}"
        if maximum
        else ""
    )
    yield f"adjacent bonds not broken: {len(unbroken)}{remark}"


def _name(s: BondStatus) -> str:
    return f"{s.bond[0]}-{s.bond[1]}"


def _describe_status(s: BondStatus) -> str:
    """Describe an unbroken bond in a few words."""
    words = f"{s.state}, strain {s.strain:.6g} in step {s.at_step}"
    if s.breaks_above is not None and s.share is not None:
        words += f", breaks above {s.breaks_above:.6g} ({s.share:.3g} of this limit)"
    return words


def _number(value: float | None, unknown: str = "not known") -> str:
    return unknown if value is None else f"{value:.6g}"


SUFFIX = ".vtkhdf"
"""File name extension of VTKHDF files."""


def export(file: Path, output: Path | None, at: dict[str, str], force: bool) -> None:
    """Write a result as VTKHDF for ParaView: every recorded step with all variables.

    Particles are vertices, bonds lines, and the cells of the lattice triangles and quads. The cell
    array `part` distinguishes them (0, 1, 2), and `broken` marks torn cells.
    """
    refuse_other_file(file)
    path = output or file.with_suffix(SUFFIX)
    if path.suffix != SUFFIX:
        raise ExperimentError(
            f"{path}: the name must end in {SUFFIX}, by which ParaView recognises the format"
        )
    refuse_output(path, force=force)
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    with reading(file, at=at) as dataset:
        vtkhdf.export(dataset, path, _scene_of(dataset), replace=force)
    click.echo(f"{path} written")


def _scene_of(dataset: xarray.Dataset) -> Scene | None:
    """Return the scene, which is needed for the cells. If it cannot be built, warn that the file
    contains no cells."""
    try:
        return scene_of(dataset, "a grid of cells")
    except PbdkitError as error:
        click.echo(
            f"warning: written without cells, since the experiment is not available: {error}",
            err=True,
        )
        return None
