"""Pages of experiments, analyses and identities in notebooks: HTML without scripts."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from pbdkit.errors import PbdkitError
from pbdkit.identification.identity import Identity, rows_of
from pbdkit.model.experiment import Experiment
from pbdkit.plotting.scene_figure import Picture, picture_of
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stability.analysis import Analysis, verdict_of
from pbdkit.stability.forecast import Forecast, forecast
from pbdkit.stability.relaxation import tuned

LARGEST = 100_000
"""Bodies of more particles are not analysed before they are asked for."""
STRAIGHT = "goes straight to the equilibrium, to where steps would lead"
STYLE = "font-family:system-ui,sans-serif;font-size:13px;color:#222;background:#fff;padding:8px"
TableRows = Iterable[tuple[str, str]]


def experiment_html(experiment: Experiment) -> str:
    """A picture of the scene before it runs, and beside it what `pbdkit check` says, where that
    takes no second."""
    try:
        scene = build_scene(experiment)
    except PbdkitError as error:
        return _page(experiment.name, "", [("not possible", str(error))], [])
    try:
        rows, warnings = _known(scene)
    except PbdkitError as error:
        rows, warnings = [("not known", str(error))], []
    return _page(experiment.name, _figure(picture_of(scene)), rows, warnings)


def analysis_html(analysis: Analysis) -> str:
    """The verdict on stability, and the eigenvalues in a few numbers."""
    rows = analysis.rows()
    name = f"analysis of {analysis.scene.experiment.name}"
    return _page(name, "", rows, analysis.warnings())


def identity_html(found: Identity) -> str:
    """What ``pbdkit identify`` says: the verdict, the constants and the notes."""
    where = f"{found.name}: {found.rule}, {found.lattice} lattice, {found.neighbours}"
    return _page(where, "", [*rows_of(found), *(("note", note) for note in found.notes)], [])


def _known(scene: Scene) -> tuple[list[tuple[str, str]], list[str]]:
    experiment, count = scene.experiment, scene.raster.count
    records = experiment.record_count
    rows = [
        ("lattice", f"{experiment.lattice.type}, body {experiment.body.type}"),
        ("rule", f"{experiment.rule.type}, frame {experiment.frame.type}"),
        ("steps", f"{experiment.steps}, recorded {records} times"),
    ]
    if count > LARGEST:
        why = f"not looked at for {count} particles; pbdkit.analyse(experiment) does"
        return [*rows, ("particles", str(count)), ("stability", why)], list(scene.warnings)
    found = forecast(tuned(scene))
    rows += _sizes(found)
    if not experiment.solver.makes_steps:
        return [*rows, ("solver", STRAIGHT)], found.warnings
    return [*rows, *verdict_of(found)], found.warnings


def _sizes(found: Forecast) -> list[tuple[str, str]]:
    rows = [("particles", f"{found.particles}, of which {found.followers} follow in step 1")]
    rows.append(("bonds", str(found.bonds)))
    if found.size_mm:
        rows.append(("size", " × ".join(f"{side:.6g}" for side in found.size_mm) + " mm"))
    memory, output = f"{found.memory_mib:.3g} MiB", f"{found.output_mib:.3g} MiB"
    return [*rows, ("memory", f"about {memory}; the result about {output}")]


def _figure(picture: Picture | None) -> str:
    if picture is None:
        return ""
    named: dict[str, list[str]] = {}
    for colour, said in picture.legend:
        named.setdefault(colour, []).append(said)
    chips = "".join(
        f'<span style="white-space:nowrap;margin-right:12px"><span style="display:inline-block;'
        f'width:10px;height:10px;background:{colour}"></span> {escape("; ".join(said))}</span> '
        for colour, said in named.items()
    )
    return f'<div style="max-width:480px">{picture.svg}<div>{chips}</div></div>'


def _page(title: str, figure: str, rows: TableRows, warnings: Iterable[str]) -> str:
    cell = 'style="text-align:left;vertical-align:top;padding:1px 10px 1px 0'
    heading = f"{cell};font-weight:600;white-space:nowrap"
    table = "".join(
        f'<tr><th {heading}">{escape(name)}</th><td {cell}">{escape(said)}</td></tr>'
        for name, said in rows
    )
    told = "".join(f'<p style="margin:4px 0;color:#8a3c00">{escape(each)}</p>' for each in warnings)
    return (
        f'<div style="{STYLE}"><div style="font-weight:600;margin-bottom:6px">{escape(title)}</div>'
        f'<div style="display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start">{figure}'
        f'<div style="max-width:460px"><table style="border-collapse:collapse;font-size:inherit">'
        f"{table}</table>{told}</div></div></div>"
    )
