"""Command ``pbdkit check``: forecast of an experiment."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace

import click
import numpy as np

from pbdkit.model.boundary_conditions import Driven, LeaderGroup, Load
from pbdkit.model.experiment import Experiment
from pbdkit.model.solver import OpeningControl
from pbdkit.plugin import Calibrated, RenewsParticles, UsesStiffness, length
from pbdkit.plugin.units import BODY_FORCE, FORCE, Units, in_lengths
from pbdkit.progress import waiting
from pbdkit.scene.constants import signed_distance
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import rehearse
from pbdkit.stability.forecast import Forecast, forecast, refuse_unheld_loads
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.function_checks import check_functions
from pbdkit.stepping.state import initial_state

Row = tuple[str, str]
MAX_LISTED = 3
"""Maximum number of groups that are listed in a line without --verbose."""


def check(
    experiment: Experiment, loading_warnings: list[str], *, verbose: bool, as_json: bool
) -> None:
    """Print the forecast of an experiment.

    Parameters
    ----------
    experiment
        Experiment.
    loading_warnings
        Warnings that were issued when it was loaded.
    verbose, as_json
        Whether all details are printed (`verbose`), and whether the forecast is printed as a JSON
        object (`as_json`).
    """
    with waiting(f"checking {experiment.name}", silent=as_json):
        built = build_scene(experiment)
        check_functions(built, initial_state(built))
        scene = tuned(built)
        rehearse(scene)
        refuse_unheld_loads(scene)
        predicted = forecast(scene)
    predicted = replace(predicted, warnings=[*loading_warnings, *predicted.warnings])
    if as_json:
        click.echo(json.dumps(predicted.as_dict()))
        return
    click.echo(f"{experiment.name}: valid")
    rows = [
        *_boundary_rows(scene, predicted, MAX_LISTED if not verbose else None),
        *_run_rows(experiment, scene, predicted),
    ]
    for title, text in [*rows, *_detail_rows(scene, predicted)] if verbose else rows:
        click.echo(f"  {title:<10} {text}")
    for warning in dict.fromkeys(predicted.warnings):
        click.echo(f"warning: {warning}")


def _boundary_rows(scene: Scene, predicted: Forecast, limit: int | None) -> Iterator[Row]:
    """Yield rows about the body, supports, leaders and loads. At most `limit` groups are listed in
    a row."""
    if predicted.size_mm:
        yield "size", f"{' × '.join(f'{side:.6g}' for side in predicted.size_mm)} mm"
    raster = scene.raster
    sides = np.ptp(raster.reference(raster.body_rows), axis=0)
    count, extent = len(raster.body_rows), " × ".join(f"{side:.6g}" for side in sides)
    frame = f", and {predicted.particles - count} of the frame" * (predicted.particles > count)
    yield "body", f"{count} particles over {extent} lattice units{frame}"
    groups = [(f"leaders.{n}", len(item.rows), item.group) for n, item in enumerate(scene.leading)]
    supports = [item for item in groups if item[2].motion.type == "hold"]
    yield from _row_of(
        "supports", (f"{_describe(*item)}{_duration(item[2])}" for item in supports), limit
    )
    moving = (f"{_describe(*item)} {_motion(item[2])}" for item in groups if item not in supports)
    yield from _row_of("leaders", moving, limit)
    resolved_loads = scene.loads.each if scene.loads else ()
    units = scene.experiment.units
    loads = ((f"loads.{n}", len(item.rows), item.load) for n, item in enumerate(resolved_loads))
    yield from _row_of(
        "loads", (f"{_describe(*item)} {_force(item[2], units)}" for item in loads), limit
    )
    obstacles = enumerate(barrier.group for barrier in scene.barriers)
    yield from _row_of(
        "obstacles", (f"obstacles.{n} {_motion(item)}" for n, item in obstacles), limit
    )
    yield from _row_of("regions", _in_regions(scene), limit)


def _run_rows(loaded: Experiment, scene: Scene, predicted: Forecast) -> Iterator[Row]:
    """Yield rows about the time dependence of the run and its cost."""
    if loaded.stepping.is_open:
        reason = "the rule is not linear or bonds can break"
        remark = "" if predicted.exact else f", for the step linearised at rest: {reason}"
        yield (
            "chosen",
            f"relaxation {predicted.relaxation:.6g}, memory {predicted.memory:.6g}{remark}",
        )
    if loaded.solver.makes_steps:
        yield from _stability(predicted)
        yield from _convergence(scene, predicted)
        if predicted.period is not None:
            decay = f"decaying by a factor of {predicted.decay:.4g} per step"
            yield "oscillates", f"slowest period {predicted.period:.4g} steps, {decay}"
    else:
        count = loaded.record_count - 1
        equilibria = f", one for each of {count} recorded steps" if count > 1 else ""
        yield "solver", _described(loaded, equilibria)
        from pbdkit.equilibrium.load_stepping import changes

        if steps_of_changes := changes(scene, loaded.steps):
            listed = ", ".join(map(str, steps_of_changes[:MAX_LISTED]))
            rest = (
                f" and {len(steps_of_changes) - MAX_LISTED} more"
                if len(steps_of_changes) > MAX_LISTED
                else ""
            )
            steps = "step" if len(steps_of_changes) == 1 else "steps"
            yield "equilibria", f"also before leaders or loads change, after {steps} {listed}{rest}"
    yield from _fracture(scene)
    time = "" if predicted.seconds is None else f"{_seconds(predicted.seconds)} of stepping, "
    memory = f"{predicted.memory_mib:.3g} MiB of memory, {predicted.output_mib:.3g} MiB of output"
    yield "cost", f"{time}{memory} (estimates)"


def _described(experiment: Experiment, equilibria: str) -> str:
    """Return the description of the solver `equilibrium`."""
    if control := experiment.solver.equilibrium.control:
        quantity = "opening" if isinstance(control, OpeningControl) else "dissipated energy"
        return f"follows the branch of equilibria by the {quantity}; the load is an unknown"
    return f"computes the equilibrium directly{equilibria}; steps would converge to it"


def _fracture(scene: Scene) -> Iterator[Row]:
    """Yield a row with the length of the process zone and the largest lattice constants."""
    fracture, rule = scene.experiment.fracture, scene.experiment.rule
    if not (isinstance(fracture, UsesStiffness) and isinstance(rule, Calibrated)):
        return
    limits = fracture.spacing_limits(rule, scene.setting)
    if limits is None:
        return
    a = min(float(length(slot.rest)) for slots in scene.neighbourhood.slots for slot in slots)
    size, unit = in_lengths(scene.experiment.units)
    each = ", ".join(f"{n:g}° {size * a * limit:.4g}" for n, limit in limits.factors.items())
    varies = " (fields of parameters have other values elsewhere)" * bool(fracture.varying)
    yield (
        "fracture",
        f"process zone E G_c/f_t² = {size * limits.process_zone:.4g} {unit}, "
        f"{limits.process_zone / a:.3g} lattice constants; largest lattice constant in {unit} by "
        f"the angle of the crack normal: {each}{varies}",
    )


def _row_of(title: str, groups: Iterable[str], limit: int | None) -> Iterator[Row]:
    """Yield a row that lists groups, if there are any."""
    texts = [*groups]
    rest = len(texts) - (limit or len(texts))
    if texts:
        yield title, "; ".join([*texts[:limit], *([f"and {rest} more"] if rest > 0 else [])])


def _describe(name: str, count: int, group: LeaderGroup | Load) -> str:
    ((kind, value),) = group.select.model_dump().items()
    place = f" ({kind} {value})" if isinstance(value, str) else ""
    return f"{name}, {_particles(count)}{place}"


def _particles(count: int) -> str:
    return f"{count} particle{'s' * (count != 1)}"


def _motion(group: Driven) -> str:
    return f"by {group.motion.type}{_duration(group)}"


def _duration(group: Driven) -> str:
    """Describe the axes and the steps of a group. Axes are omitted if the group acts along all
    axes, and steps if it acts in all steps."""
    axes, until = "".join(getattr(group, "axes", None) or ()), group.until
    begins = f" from step {group.from_}" * (group.from_ > 1)
    return f" along {axes}" * bool(axes) + begins + f" until step {until}" * (until is not None)


def _force(load: Load, units: Units | None) -> str:
    """Format a load in the units of the experiment: a force in N or kN, and a force per area in
    N/mm²."""
    force, unit = load.force_at(max(load.from_, 1)), ""
    quantity = FORCE if load.force else BODY_FORCE
    if units and not units.missing_entries(quantity):
        force, unit = force * units.scale(quantity), f" {quantity.unit}".replace("^2", "²")
        if load.force and np.abs(force).max() >= 1e3:
            force, unit = force / 1e3, f" k{FORCE.unit}"
    components = ", ".join(f"{component:.6g}" for component in force.tolist())
    return f"{'force' if load.force else 'body force'} [{components}]{unit}"


def _in_regions(scene: Scene) -> Iterator[str]:
    """Yield the number of particles of the body in each region."""
    raster = scene.raster
    x = raster.reference(raster.body_rows)
    for name, region in scene.experiment.regions.items():
        inside = signed_distance(region, raster.cell, *x.T) <= 0.0
        yield f"{name}, {_particles(int(inside.sum()))}"


def _stability(predicted: Forecast) -> Iterator[Row]:
    if predicted.spectral_radius is None:
        yield "stable", "not known before the run"
        return
    verdict = "yes" if predicted.stable else "NO, some modes grow"
    remark = (
        ", linearised at the start" * (not predicted.exact) + ", estimated" * predicted.estimated
    )
    bound = predicted.largest_stable_relaxation
    range_text = f"; stable for a relaxation below {bound:.6g}" if bound else ""
    yield (
        "stable",
        f"{verdict} (spectral radius {predicted.spectral_radius:.6g}{remark}){range_text}",
    )


def _convergence(scene: Scene, predicted: Forecast) -> Iterator[Row]:
    steps = {
        tolerance: needed
        for tolerance in ("1e-3", "1e-6")
        if (needed := predicted.steps_to.get(tolerance)) is not None
    }
    if not (steps and predicted.stable):
        return
    text, count = (
        ", ".join(f"to {tolerance} in {needed}" for tolerance, needed in steps.items()),
        scene.experiment.steps,
    )
    tolerances = [tolerance for tolerance, needed in steps.items() if needed <= count]
    verdict = f"the run of {count} steps reaches {tolerances[-1] if tolerances else 'neither'}"
    if scene.experiment.stepping.settle is not None:
        verdict = f"the run ends once it has converged, or after {count} steps"
    whole = "" if scene.experiment.fracture.type == "none" else " if no bond breaks"
    yield "converges", f"{text} steps{whole}; {verdict}"


def _seconds(seconds: float) -> str:
    if seconds < 1.0:
        return "less than a second"
    if seconds < 100.0:
        return f"about {seconds:.1g} s" if seconds < 10.0 else f"about {seconds:.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 6000.0 else f"about {seconds / 3600:.3g} h"


def _detail_rows(scene: Scene, predicted: Forecast) -> Iterator[Row]:
    """Yield the rows that --verbose adds."""
    experiment = scene.experiment
    records = experiment.record_count
    yield "records", f"{records} states in {experiment.steps} steps, including that at time 0"
    yield (
        "particles",
        f"{predicted.particles}, of which {predicted.followers} are followers in step 1",
    )
    yield "bonds", f"{predicted.bonds}"
    yield "weights", f"relaxation {predicted.relaxation:.6g}, memory {predicted.memory:.6g}"
    if predicted.spectral_radius is not None:
        remark = "exact" if predicted.exact else "linearised at the start"
        if isinstance(experiment.rule, RenewsParticles):
            remark += ", with state variables of particles held constant"
        remark += ", estimated: the steps to 1 %" if predicted.estimated else ""
        smallest = predicted.smallest_eigenvalue
        ends = (
            ""
            if smallest is None
            else f"; smallest eigenvalue of the rule's own step {smallest:.9g}"
        )
        yield "spectrum", f"radius {predicted.spectral_radius:.9g}, {remark}{ends}"
        text = ", ".join(
            f"{tolerance} in {needed}"
            for tolerance, needed in predicted.steps_to.items()
            if needed is not None
        )
        yield from [("steps", f"for convergence to {text}")] if text else []
    if predicted.lag is not None:
        size, unit = in_lengths(experiment.units)
        end = predicted.lag_reached
        reached = "" if end is None else f", and {size * end:.4g} at the end of these steps"
        text = (
            f"{size * predicted.lag:.4g} {unit} from equilibrium if the leaders continue at their"
        )
        yield "distance", f"{text} fastest{reached}"
