"""HTML representations of experiments, analyses and identities for notebooks. They contain no
scripts."""

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

MAX_ANALYSED_PARTICLES = 100_000
"""Maximum number of particles of bodies that are analysed automatically."""
STRAIGHT = "computes the equilibrium directly; steps would converge to it"
"""Description of a run of the solver `equilibrium`."""
STYLE = "font-family:system-ui,sans-serif;font-size:13px;color:#222;background:#fff;padding:8px"
"""CSS style of the output."""
TableRows = Iterable[tuple[str, str]]


def experiment_html(experiment: Experiment) -> str:
    """Return a picture of the scene. If the results of `pbdkit check` can be computed quickly, they
    are added."""
    try:
        scene = build_scene(experiment)
    except PbdkitError as error:
        return _page(experiment.name, "", [("invalid", str(error))], [])
    try:
        rows, warnings = _properties(scene)
    except PbdkitError as error:
        rows, warnings = [("unknown", str(error))], []
    return _page(experiment.name, _figure(picture_of(scene)), rows, warnings)


def analysis_html(analysis: Analysis) -> str:
    """Return the verdict on stability and a summary of the eigenvalues."""
    rows = analysis.rows()
    name = f"analysis of {analysis.scene.experiment.name}"
    return _page(name, "", rows, analysis.warnings())


def identity_html(identity: Identity) -> str:
    """Return the output of ``pbdkit identify``: the verdict, the constants and the notes."""
    where = f"{identity.name}: {identity.rule}, {identity.lattice} lattice, {identity.neighbours}"
    return _page(where, "", [*rows_of(identity), *(("note", note) for note in identity.notes)], [])


def _properties(scene: Scene) -> tuple[list[tuple[str, str]], list[str]]:
    experiment, count = scene.experiment, scene.raster.count
    records = experiment.record_count
    rows = [
        ("lattice", f"{experiment.lattice.type}, body {experiment.body.type}"),
        ("rule", f"{experiment.rule.type}, frame {experiment.frame.type}"),
        ("steps", f"{experiment.steps}, recorded {records} times"),
    ]
    if count > MAX_ANALYSED_PARTICLES:
        why = f"not computed for {count} particles; pbdkit.analyse(experiment) computes it"
        return [*rows, ("particles", str(count)), ("stability", why)], list(scene.warnings)
    prediction = forecast(tuned(scene))
    rows += _sizes(prediction)
    if not experiment.solver.makes_steps:
        return [*rows, ("solver", STRAIGHT)], prediction.warnings
    return [*rows, *verdict_of(prediction)], prediction.warnings


def _sizes(prediction: Forecast) -> list[tuple[str, str]]:
    rows = [
        (
            "particles",
            f"{prediction.particles}, of which {prediction.followers} are followers in step 1",
        )
    ]
    rows.append(("bonds", str(prediction.bonds)))
    if prediction.size_mm:
        rows.append(("size", " × ".join(f"{side:.6g}" for side in prediction.size_mm) + " mm"))
    memory, output = f"{prediction.memory_mib:.3g} MiB", f"{prediction.output_mib:.3g} MiB"
    return [*rows, ("memory", f"about {memory}; the result about {output}")]


def _figure(picture: Picture | None) -> str:
    if picture is None:
        return ""
    texts: dict[str, list[str]] = {}
    for colour, text in picture.legend:
        texts.setdefault(colour, []).append(text)
    chips = "".join(
        f'<span style="white-space:nowrap;margin-right:12px"><span style="display:inline-block;'
        f'width:10px;height:10px;background:{colour}"></span> {escape("; ".join(text))}</span> '
        for colour, text in texts.items()
    )
    return f'<div style="max-width:480px">{picture.svg}<div>{chips}</div></div>'


def _page(title: str, figure: str, rows: TableRows, warnings: Iterable[str]) -> str:
    cell = 'style="text-align:left;vertical-align:top;padding:1px 10px 1px 0'
    heading = f"{cell};font-weight:600;white-space:nowrap"
    table = "".join(
        f'<tr><th {heading}">{escape(name)}</th><td {cell}">{escape(text)}</td></tr>'
        for name, text in rows
    )
    notes = "".join(
        f'<p style="margin:4px 0;color:#8a3c00">{escape(each)}</p>' for each in warnings
    )
    return (
        f'<div style="{STYLE}"><div style="font-weight:600;margin-bottom:6px">{escape(title)}</div>'
        f'<div style="display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start">{figure}'
        f'<div style="max-width:460px"><table style="border-collapse:collapse;font-size:inherit">'
        f"{table}</table>{notes}</div></div></div>"
    )
