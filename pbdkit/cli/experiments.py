"""What there is to start from, and what is known of an experiment besides its result:
``pbdkit experiments``, ``init``, ``schema``, ``check``, ``identify`` and ``bench``."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option

if TYPE_CHECKING:
    from pbdkit.experiment.model import Experiment
    from pbdkit.prediction.forecast import Forecast


@click.command()
def experiments() -> None:
    """List the shipped experiments."""
    from pbdkit.experiment.shipped import shipped_names, shipped_text

    width = max(map(len, names := shipped_names()))
    for name in names:
        title = shipped_text(name).splitlines()[0].removeprefix("# ")
        click.echo(f"{name:<{width}}  {title}")


@click.command()
@click.argument("file", default="experiment.yaml", type=click.Path(path_type=Path))
def init(file: Path) -> None:
    """Write a commented experiment to start from."""
    from pbdkit.cli.output import refusals_as
    from pbdkit.errors import ExperimentError
    from pbdkit.experiment.shipped import shipped_text

    if os.path.lexists(file):
        raise ExperimentError(f"{file}: exists and is left as it is; name another file")
    with refusals_as(f"{file}: cannot be written"), file.open("x", encoding="utf-8") as written:
        written.write(shipped_text("start"))
    click.echo(f"{file} written; next: pbdkit check {file}, then pbdkit run {file}")


@click.command()
@click.argument("what", type=click.Choice(["experiment", "dataset", "sweep"]), default="experiment")
@click.option("--builtin", is_flag=True, help="Leave third-party components out.")
def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments, datasets or sweeps, closed over what is installed."""
    from pbdkit.experiment.schema import experiment_schema
    from pbdkit.registry.registry import Registry
    from pbdkit.results.layout import dataset_schema
    from pbdkit.sweeps.specification import sweep_schema

    if what == "sweep":
        made = sweep_schema()
    else:
        make = {"experiment": experiment_schema, "dataset": dataset_schema}[what]
        made = make(Registry(), installed=not builtin)
    click.echo(json.dumps(made, indent=2))


@click.command()
@experiment_argument
@set_option
@json_option
def check(experiment: str, settings: tuple[str, ...], as_json: bool) -> None:
    """Validate an experiment and say what will happen, without running it."""
    from pbdkit.api import load
    from pbdkit.prediction.forecast import forecast
    from pbdkit.runs.course import rehearse
    from pbdkit.runs.tuning import tuned
    from pbdkit.scene.scene import build_scene

    loaded = load(experiment, settings=settings)
    scene = tuned(build_scene(loaded))
    rehearse(scene)
    found = forecast(scene)
    if as_json:
        click.echo(json.dumps(found.as_dict()))
        return
    click.echo(f"{loaded.name}: valid")
    records = loaded.recording.count(loaded.steps)
    click.echo(f"  steps      {loaded.steps}, of which {records} are recorded (time 0 included)")
    click.echo(f"  particles  {found.particles}, of which {found.followers} follow in step 1")
    click.echo(f"  bonds      {found.bonds}")
    if found.size_mm:
        click.echo(f"  size       {' × '.join(f'{side:.6g}' for side in found.size_mm)} mm")
    click.echo(f"  memory     about {found.memory_mib:.3g} MiB")
    click.echo(f"  output     about {found.output_mib:.3g} MiB")
    _tell_of_steps(loaded, found)
    for warning in found.warnings:
        click.echo(f"warning: {warning}")


def _tell_of_steps(loaded: Experiment, found: Forecast) -> None:
    """What is known of steps before the first one."""
    from pbdkit.interfaces import RenewsParticles

    if loaded.stepping.is_open:
        why = "the rule is not linear or bonds can break"
        near = "" if found.exact else f", of the step linearised at rest: {why}"
        chosen = f"relaxation {found.relaxation:.6g}, memory {found.memory:.6g}"
        click.echo(f"  chosen     {chosen}{near}")
    if found.spectral_radius is not None:
        verdict = "stable" if found.stable else "not stable"
        near = "" if found.exact else ", linearised at the start"
        if isinstance(loaded.rule, RenewsParticles):
            near += ", what particles remember held as it is there"
        near += ", estimated: the steps to 1 %" if found.estimated else ""
        click.echo(f"  spectrum   radius {found.spectral_radius:.9g}: {verdict}{near}")
        steps = ", ".join(f"{t} in {n}" for t, n in found.steps_to.items() if n is not None)
        if steps:
            whole = "" if loaded.fracture.type == "none" else ", as long as no bond breaks"
            click.echo(f"  settles    to {steps} steps{whole}")
    if found.largest_stable_relaxation is not None:
        click.echo(f"  relaxation stable below {found.largest_stable_relaxation:.6g}")
    if found.period is not None:
        click.echo(
            f"  oscillates: slowest period {found.period:.4g} steps, "
            f"shrinking by a factor of {found.decay:.4g} a step"
        )
    if found.lag is not None:
        reached = "" if found.lag_reached is None else f", {found.lag_reached:.4g} when they end"
        click.echo(
            f"  lag        {found.lag:.4g} lattice units behind equilibrium if the leaders' "
            f"fastest steps went on{reached}"
        )


@click.command()
@experiment_argument
@set_option
@json_option
def identify(experiment: str, settings: tuple[str, ...], as_json: bool) -> None:
    """Say what the experiment's rule is physically, on its lattice and neighbours."""
    from pbdkit.api import identify, load
    from pbdkit.cli.output import show_table

    materials = load(experiment, settings=settings).materials()
    every = {name: identify(one) for name, one in materials.items()}
    if as_json:
        alone = every.get("")
        told = alone.as_dict() if alone else {name: f.as_dict() for name, f in every.items()}
        click.echo(json.dumps(told))
        return
    from pbdkit.identity.verdict import table

    for name, found in every.items():
        where = f" ({name})" if name else ""
        click.echo(
            f"{found.name}: {found.rule}{where}, {found.lattice} lattice, {found.neighbours}"
        )
        show_table(table(found))
        for note in found.notes:
            click.echo(f"note: {note}")


def _sizes(context: click.Context, option: click.Parameter, given: str | None) -> tuple[int, ...]:
    """Numbers of sites, separated by commas, each from 2."""
    words = [word.strip() for word in given.split(",")] if given is not None else []
    for word in words:
        if not (word.isascii() and word.isdecimal()) or not 2 <= int(word) < 2**31:
            what = f"'{word}' is no number of sites from 2; write for instance 50,100,200"
            raise click.BadParameter(what)
    return tuple(dict.fromkeys(map(int, words)))


@click.command()
@experiment_argument
@click.option("--sizes", callback=_sizes, help="Sites along the longer side, e.g. 50,100,200.")
@click.option("--steps", type=click.IntRange(min=1), help="Steps of each run; else its own.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures.")
@click.option("--plot", "picture", type=click.Path(path_type=Path), help="PNG, SVG or PDF.")
@set_option
def bench(
    experiment: str,
    sizes: tuple[int, ...],
    steps: int | None,
    json_file: Path | None,
    picture: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Measure speed against error, at one or several sizes: engines, precisions and threads; where
    the solver is `equilibrium`, its methods and the steps, over tolerances."""
    from pbdkit.api import load
    from pbdkit.bench import work_precision
    from pbdkit.bench.measurement import measure
    from pbdkit.cli.output import refusals_as, refuse_unwritable, save, show_table

    refuse_unwritable(picture, json_file)
    changed = (*settings, *([f"steps={steps}"] if steps else ()))
    loaded = load(experiment, settings=changed)
    rows = [row for n in sizes or (None,) for row in measure(experiment, changed, n, _tell)]
    title = f"{loaded.name}, {loaded.solver.type}, {loaded.steps} steps"
    click.echo(title)
    show_table(work_precision.table(rows))
    click.echo("\n".join(work_precision.lines(rows)))
    if json_file:
        figures = work_precision.as_dict(experiment, settings, loaded.steps, rows)
        with refusals_as(f"{json_file}: cannot be written"):
            json_file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        click.echo(f"{json_file} written")
    if picture:
        save(picture, work_precision.picture(rows, title))


def _tell(what: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"measured {what}", err=True)
