"""``pbdkit check``."""

from __future__ import annotations

import json

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option


@click.command()
@experiment_argument
@set_option
@json_option
def check(experiment: str, settings: tuple[str, ...], as_json: bool) -> None:
    """Validate an experiment and say what will happen, without running it."""
    from pbdkit.analysis.forecast import forecast
    from pbdkit.api import load
    from pbdkit.results.rehearsal import rehearse
    from pbdkit.scene.scene import build_scene

    loaded = load(experiment, settings=settings)
    scene = build_scene(loaded)
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
    click.echo(f"  memory     about {found.memory_mib:.3g} MiB")
    click.echo(f"  output     about {found.output_mib:.3g} MiB")
    if found.spectral_radius is not None:
        verdict = "stable" if found.stable else "not stable"
        near = "" if found.exact else ", linearised at the start"
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
    for warning in found.warnings:
        click.echo(f"warning: {warning}")
