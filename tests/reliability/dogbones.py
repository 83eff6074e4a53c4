"""Tensile tests of random dogbones to failure, each an equilibrium at every step.

python tests/reliability/dogbones.py [--trials N] [--seed S] [--largest L]

Drawn are the shape, the lattice, the rule (elastic, springs, orthotropic), the failure strain, and
how the specimen is pulled: by one `displace`, with the equilibria of increments recorded, or by a
velocity over many steps. Of each recorded state: no intact bond is above its limit, no particle has
gone farther than its grips allow, the forces of the grips balance. The force rises in proportion
until the first bond breaks. A run ends as complete, or as separated with all states recorded before
and its reason; every other end is a false refusal. Exits with 1 where something is wrong.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import time
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np

import pbdkit

NEIGHBOURS = {
    "square": {"type": "coordination", "shells": 2},
    "hexagonal": {"type": "coordination", "shells": 1},
}
RULES: dict[str, dict[str, Any]] = {
    "elastic": {"type": "elastic", "poisson_ratio": 0.3},
    "springs": {"type": "springs"},
    "orthotropic": {
        "type": "orthotropic",
        "modulus_ratio": 0.6,
        "poisson_ratio": 0.3,
        "shear_ratio": 0.3,
    },
}
LIMIT, FAR, BALANCE, STRAIGHT = 1e-9, 0.5, 1e-7, 2e-2


def specimen(
    lattice: str,
    rule: str,
    *,
    failure: float,
    once: bool,
    size: tuple[float, float, float, float, float] = (16.0, 7.0, 5.0, 3.0, 4.0),
    steps: int = 12,
    pulled: float = 1.6,
) -> dict[str, Any]:
    """Return a dogbone of a length, width, gauge length, gauge width and radius, held on the left
    and pulled on the right by a multiple of the strain that the gauge bears."""
    length, width, gauge_length, gauge_width, radius = size
    way = pulled * failure * length
    motion: dict[str, Any] = {"type": "displace", "displacement": [way, 0.0]}
    if not once:
        motion = {"type": "velocity", "velocity": [way / steps, 0.0], "steps": steps}
    return {
        "name": "dogbone",
        "lattice": {"type": lattice, "a": 1.0},
        "body": {
            "type": "dogbone",
            "length": length,
            "width": width,
            "gauge_length": gauge_length,
            "gauge_width": gauge_width,
            "radius": radius,
        },
        "neighbours": NEIGHBOURS[lattice],
        "rule": RULES[rule],
        "frame": {"type": "natural"},
        "fracture": {"type": "strain", "failure": failure},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": motion},
        ],
        "steps": 1 if once else steps,
        "record": {"increments": once},
        "solver": {"type": "equilibrium", "increments": 2 * steps},
        "diagnostics": [
            {"type": "displacement"},
            {"type": "reaction", "youngs_modulus": 1.0},
            {"type": "broken"},
        ],
    }


def drawn(rng: np.random.Generator, largest: float) -> dict[str, Any]:
    """Return a random specimen and its experiment."""
    lattice = str(rng.choice(["square", "hexagonal"]))
    rule = str(rng.choice([*RULES][: 3 if lattice == "square" else 2]))
    length = float(rng.integers(14, largest + 1))
    width = float(rng.integers(6, max(7, length // 2)))
    gauge_width = float(rng.integers(3, max(4, int(0.7 * width))))
    gauge_length = float(rng.integers(3, max(4, length // 2)))
    room = (length - gauge_length) / 2.0
    least = (width - gauge_width) / 2.0
    radius = float(rng.uniform(least, max(least, min(room, 3.0 * least))))
    return specimen(
        lattice,
        rule,
        failure=float(rng.choice([0.01, 0.02, 0.05, 0.1])),
        once=bool(rng.integers(2)),
        size=(length, width, gauge_length, gauge_width, radius),
        steps=int(rng.integers(8, 25)),
        pulled=float(rng.uniform(0.8, 2.5)),
    )


def run(experiment: dict[str, Any]) -> Any:
    """The dataset, however it ends."""
    try:
        return pbdkit.run(experiment, progress=False)
    except pbdkit.DivergedError as error:
        return error.dataset


def strains(ds: Any, time: int) -> Any:
    """The strain of each bond at a recorded time, (bond,)."""
    ends, x, rest = ds.bond_ends.values - 1, ds.position.values[time], ds.reference.values
    now, then = (np.linalg.norm(at[ends[:, 1]] - at[ends[:, 0]], axis=1) for at in (x, rest))
    return now / then - 1.0


def faults_of(experiment: dict[str, Any], ds: Any) -> list[str]:
    """Return the faults of the result of a specimen as texts."""
    found, failure = [], experiment["fracture"]["failure"]
    if ds.attrs["status"] not in ("complete", "separated"):
        found.append(f"ends as {ds.attrs['status']}: {ds.attrs['stop_reason']}")
    if ds.attrs["status"] == "separated" and not (ds.broken_bonds.values[-1] or len(ds.time) > 1):
        found.append("nothing is recorded before it came apart")
    right = float(np.nanmax(ds.reference.values[:, 0]))
    grip = ds.u.values[:, ds.reference.values[:, 0] == right, 0].max(axis=1)
    for n, moment in enumerate(ds.time.values.tolist()):
        broken = (ds.broken_step.values >= 0) & (ds.broken_step.values <= np.ceil(moment))
        over = strains(ds, n)[~broken].max(initial=0.0)
        if over > failure * (1.0 + LIMIT):
            found.append(f"at {moment:.4g} an intact bond is strained by {over:.4g} of {failure}")
        if (most := np.abs(ds.u.values[n]).max()) > (1.0 + FAR) * grip[n] + failure:
            found.append(
                f"at {moment:.4g} a particle is {most:.4g} off, and the grip {grip[n]:.4g}"
            )
    force = ds.reaction.values[:, :, 0]
    off = np.abs(force.sum(axis=1)).max()
    if off > BALANCE * np.abs(force).max(initial=1e-300):
        found.append(f"forces are off balance by {off:.2e} of {np.abs(force).max():.2e}")
    whole = (ds.broken_bonds.values == 0) & (grip > 0.0)
    slopes = force[whole, 1] / grip[whole]
    if len(slopes) and np.ptp(slopes) > STRAIGHT * slopes.max() * (1.0 + 10.0 * failure):
        found.append(f"the force of the whole specimen is no line: {slopes.min()} {slopes.max()}")
    return found


def main() -> int:
    """Run the trials and print their findings."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--largest", type=int, default=30)
    given, ends, wrong = asked.parse_args(), collections.Counter[str](), 0
    for n in range(given.trials):
        rng = np.random.default_rng([given.seed, n])
        experiment, begun = drawn(rng, given.largest), time.perf_counter()
        try:
            ds = run(experiment)
            faults = faults_of(experiment, ds)
            ends[f"{experiment['rule']['type']}, {ds.attrs['status']}"] += 1
            end = (
                f"{ds.attrs['status']}, {len(ds.time)} states, {ds.broken_bonds.values[-1]} broken"
            )
        except pbdkit.PbdkitError as error:
            faults, end = [f"is refused: {error}"], "refused"
        wrong += bool(faults)
        took = f"{time.perf_counter() - begun:.1f} s"
        print(f"{n}: {experiment['lattice']['type']} {experiment['rule']['type']} {end} {took}",
              flush=True)  # fmt: skip
        if faults:
            print(f"   {faults[:3]}\n   {json.dumps(experiment)}", flush=True)
    print(f"{given.trials} specimens, {wrong} wrong; {dict(ends)}")
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
