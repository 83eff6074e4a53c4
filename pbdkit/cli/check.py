"""``pbdkit check`` and ``identify``: what an experiment will do, and what a rule is physically."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import click
import numpy as np

from pbdkit.cli.options import experiment_argument, json_option, set_option, verbose_option
from pbdkit.plugin.units import BODY_FORCE, FORCE, in_lengths

if TYPE_CHECKING:
    from pbdkit.identification.report import Identity
    from pbdkit.model.boundary_conditions import Driven, LeaderGroup, Load
    from pbdkit.model.experiment import Experiment
    from pbdkit.plugin.units import Units
    from pbdkit.scene.scene import Scene
    from pbdkit.stability.forecast import Forecast


Row = tuple[str, str]
SHOWN = 3
"""So many groups are named in a line; --verbose names all."""


@click.command()
@experiment_argument
@set_option
@verbose_option
@json_option
def check(experiment: str, settings: tuple[str, ...], verbose: bool, as_json: bool) -> None:
    """Say what will happen, without running it: who is held and who leads, whether it is stable,
    in how many steps it settles, what it takes in time and memory."""
    from pbdkit.cli.options import waiting
    from pbdkit.errors import PbdkitWarning
    from pbdkit.model.loading import load_experiment

    with warnings.catch_warnings(record=True) as of_loading:
        warnings.simplefilter("always", PbdkitWarning)
        loaded = load_experiment(experiment, settings)
    from pbdkit.scene.scene import build_scene
    from pbdkit.simulation import rehearse
    from pbdkit.stability.forecast import forecast, refuse_unheld_loads
    from pbdkit.stability.relaxation import tuned

    with waiting(f"checking {loaded.name}", silent=as_json):
        scene = tuned(build_scene(loaded))
        rehearse(scene)
        refuse_unheld_loads(scene)
        found = forecast(scene)
    found = replace(found, warnings=[*(str(w.message) for w in of_loading), *found.warnings])
    if as_json:
        click.echo(json.dumps(found.as_dict()))
        return
    click.echo(f"{loaded.name}: valid")
    rows = [*_who(scene, found, SHOWN if not verbose else None), *_what(loaded, scene, found)]
    for title, text in [*rows, *_more(scene, found)] if verbose else rows:
        click.echo(f"  {title:<10} {text}")
    for warning in dict.fromkeys(found.warnings):
        click.echo(f"warning: {warning}")


def _who(scene: Scene, found: Forecast, most: int | None) -> Iterator[Row]:
    """The body, and who is held, led and loaded; of groups the first `most`."""
    if found.size_mm:
        yield "size", f"{' × '.join(f'{side:.6g}' for side in found.size_mm)} mm"
    raster = scene.raster
    sides = np.ptp(raster.reference(raster.body_rows), axis=0)
    count, extent = len(raster.body_rows), " × ".join(f"{side:.6g}" for side in sides)
    frame = f", and {found.particles - count} of the frame" * (found.particles > count)
    yield "body", f"{count} particles over {extent} lattice units{frame}"
    groups = [(f"leaders.{n}", len(one.rows), one.group) for n, one in enumerate(scene.leading)]
    held = [one for one in groups if one[2].motion.type == "hold"]
    yield from _listed("supports", (f"{_words(*one)}{_when(one[2])}" for one in held), most)
    moving = (f"{_words(*one)} {_motion(one[2])}" for one in groups if one not in held)
    yield from _listed("leaders", moving, most)
    each = scene.loads.each if scene.loads else ()
    units = scene.experiment.units
    loads = ((f"loads.{n}", len(one.rows), one.load) for n, one in enumerate(each))
    yield from _listed("loads", (f"{_words(*one)} {_force(one[2], units)}" for one in loads), most)
    obstacles = enumerate(barrier.group for barrier in scene.barriers)
    yield from _listed("obstacles", (f"obstacles.{n} {_motion(one)}" for n, one in obstacles), most)
    yield from _listed("regions", _in_regions(scene), most)


def _what(loaded: Experiment, scene: Scene, found: Forecast) -> Iterator[Row]:
    """What will happen, and what it takes."""
    if loaded.stepping.is_open:
        why = "the rule is not linear or bonds can break"
        near = "" if found.exact else f", of the step linearised at rest: {why}"
        yield "chosen", f"relaxation {found.relaxation:.6g}, memory {found.memory:.6g}{near}"
    if loaded.solver.makes_steps:
        yield from _stability(found)
        yield from _settling(scene, found)
        if found.period is not None:
            shrinks = f"shrinking by a factor of {found.decay:.4g} a step"
            yield "oscillates", f"slowest period {found.period:.4g} steps, {shrinks}"
    else:
        count = loaded.record_count - 1
        each = f" of each of {count} recorded steps" if count > 1 else ""
        yield "solver", f"goes straight to the equilibrium{each}, to where steps would lead"
        from pbdkit.equilibrium.solve import changes

        if settled := changes(scene, loaded.steps):
            listed = ", ".join(map(str, settled[:SHOWN]))
            more = f" and {len(settled) - SHOWN} more" if len(settled) > SHOWN else ""
            steps = "step" if len(settled) == 1 else "steps"
            yield "settles", f"before roles or loads change, after {steps} {listed}{more}"
    time = "" if found.seconds is None else f"{_seconds(found.seconds)} of stepping, "
    memory = f"{found.memory_mib:.3g} MiB of memory, {found.output_mib:.3g} MiB of output"
    yield "takes", f"{time}{memory} (estimates)"


def _listed(title: str, each: Iterable[str], most: int | None) -> Iterator[Row]:
    """A line of groups."""
    listed = [*each]
    more = len(listed) - (most or len(listed))
    if listed:
        yield title, "; ".join([*listed[:most], *([f"and {more} more"] if more > 0 else [])])


def _words(name: str, count: int, group: LeaderGroup | Load) -> str:
    ((how, which),) = group.select.model_dump().items()
    where = f" ({how} {which})" if isinstance(which, str) else ""
    return f"{name}, {_particles(count)}{where}"


def _particles(count: int) -> str:
    return f"{count} particle{'s' * (count != 1)}"


def _motion(group: Driven) -> str:
    return f"by {group.motion.type}{_when(group)}"


def _when(group: Driven) -> str:
    """Along which axes, and in which steps, if not along all and always."""
    axes, until = "".join(getattr(group, "axes", None) or ()), group.until
    begins = f" from step {group.from_}" * (group.from_ > 1)
    return f" along {axes}" * bool(axes) + begins + f" until step {until}" * (until is not None)


def _force(load: Load, units: Units | None) -> str:
    """As an experiment writes it: in N or kN, and N/mm², where it has the units for that."""
    force, counted = load.force_at(max(load.from_, 1)), ""
    quantity = FORCE if load.force else BODY_FORCE
    if units and not units.lacks(quantity):
        force, counted = force * units.scale(quantity), f" {quantity.unit}".replace("^2", "²")
        if load.force and np.abs(force).max() >= 1e3:
            force, counted = force / 1e3, f" k{FORCE.unit}"
    listed = ", ".join(f"{one:.6g}" for one in force.tolist())
    return f"{'force' if load.force else 'body force'} [{listed}]{counted}"


def _in_regions(scene: Scene) -> Iterator[str]:
    """How many particles of the body lie in each region."""
    from pbdkit.scene.constants import signed_distance

    raster = scene.raster
    x = raster.reference(raster.body_rows)
    for name, region in scene.experiment.regions.items():
        inside = signed_distance(region, raster.lattice.cell(), *x.T) <= 0.0
        yield f"{name}, {_particles(int(inside.sum()))}"


def _stability(found: Forecast) -> Iterator[Row]:
    if found.spectral_radius is None:
        yield "stable", "not known beforehand"
        return
    verdict = "yes" if found.stable else "NO, some modes grow"
    near = ", linearised at the start" * (not found.exact) + ", estimated" * found.estimated
    bound = found.largest_stable_relaxation
    below = f"; stable with relaxations below {bound:.6g}" if bound else ""
    yield "stable", f"{verdict} (spectral radius {found.spectral_radius:.6g}{near}){below}"


def _settling(scene: Scene, found: Forecast) -> Iterator[Row]:
    steps = {t: n for t in ("1e-3", "1e-6") if (n := found.steps_to.get(t)) is not None}
    if not (steps and found.stable):
        return
    told, asked = ", ".join(f"to {t} in {n}" for t, n in steps.items()), scene.experiment.steps
    reached = [t for t, n in steps.items() if n <= asked]
    verdict = f"the {asked} asked for reach {reached[-1] if reached else 'neither'}"
    if scene.experiment.stepping.settle is not None:
        verdict = f"the run ends when it has settled, after {asked} at the latest"
    whole = "" if scene.experiment.fracture.type == "none" else ", as long as no bond breaks"
    yield "settles", f"{told} steps{whole}; {verdict}"


def _seconds(seconds: float) -> str:
    if seconds < 1.0:
        return "less than a second"
    if seconds < 100.0:
        return f"about {seconds:.1g} s" if seconds < 10.0 else f"about {seconds:.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 6000.0 else f"about {seconds / 3600:.3g} h"


def _more(scene: Scene, found: Forecast) -> Iterator[Row]:
    """The rest of what is known."""
    from pbdkit.plugin import RenewsParticles

    experiment = scene.experiment
    records = experiment.record_count
    yield "records", f"{records} states in {experiment.steps} steps, that of time 0 included"
    yield "particles", f"{found.particles}, of which {found.followers} follow in step 1"
    yield "bonds", f"{found.bonds}"
    yield "weights", f"relaxation {found.relaxation:.6g}, memory {found.memory:.6g}"
    if found.spectral_radius is not None:
        near = "exact" if found.exact else "linearised at the start"
        if isinstance(experiment.rule, RenewsParticles):
            near += ", what particles remember held as it is there"
        near += ", estimated: the steps to 1 %" if found.estimated else ""
        least = found.smallest_eigenvalue
        ends = "" if least is None else f"; smallest eigenvalue of the rule's own step {least:.9g}"
        yield "spectrum", f"radius {found.spectral_radius:.9g}, {near}{ends}"
        told = ", ".join(f"{t} in {n}" for t, n in found.steps_to.items() if n is not None)
        yield from [("steps", f"settle to {told}")] if told else []
    if found.lag is not None:
        size, counted = in_lengths(experiment.units)
        end = found.lag_reached
        reached = "" if end is None else f", {size * end:.4g} when they end"
        told = f"{size * found.lag:.4g} {counted} behind equilibrium if the leaders' fastest steps"
        yield "lag", f"{told} went on{reached}"


@click.command()
@experiment_argument
@set_option
@verbose_option
@json_option
def identify(experiment: str, settings: tuple[str, ...], verbose: bool, as_json: bool) -> None:
    """Say what the experiment's rule is physically, on its lattice and neighbours: diffusion or an
    elastic body, and with which constants."""
    from pbdkit.api import identify, load
    from pbdkit.cli.options import waiting

    materials = load(experiment, settings=settings).materials()
    with waiting("identifying", silent=as_json):
        every = {name: identify(one) for name, one in materials.items()}
    if as_json:
        alone = every.get("")
        told = alone.as_dict() if alone else {name: f.as_dict() for name, f in every.items()}
        click.echo(json.dumps(told))
        return
    alike: dict[str, list[str]] = {}
    for name, found in every.items():
        alike.setdefault(json.dumps(found.as_dict()), []).append(name)
    for names in alike.values():
        _show(every[names[0]], ", ".join(filter(None, names)), verbose)
    for note in dict.fromkeys(note for found in every.values() for note in found.notes):
        names = [name for name, found in every.items() if note in found.notes]
        of = f" ({', '.join(names)})" if len(names) < len(every) else ""
        click.echo(f"note{of}: {note}")


def _show(found: Identity, materials: str, verbose: bool) -> None:
    """The table of one material, or of several that are the same."""
    from pbdkit.cli.options import show_table
    from pbdkit.identification.report import table

    where = f" ({materials})" if materials else ""
    click.echo(f"{found.name}: {found.rule}{where}, {found.lattice} lattice, {found.neighbours}")
    show_table(table(found, whole=verbose))
