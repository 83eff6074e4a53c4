"""Strength and energy of bars with a weak zone that are torn under `cohesive`.

    python tests/reliability/cohesive_strength.py [square] [hexagonal] [--angle DEGREES] [--law LAW]

A bar is pulled along x to beyond its failure under `solver: equilibrium`. In a zone one band of
cells wide the onset is 1.5 % lower. The angle is that of the lattice's axis to the bar; bars along
an axis are grids, others polygons that the outline cuts. Printed are the largest force over area ·
onset · E and the work over area · energy · E, for some ℓ = energy/onset² over the spacing.
Exits with 1 if a strength differs by more than 3 %, or the energy of a bar along an axis of the
square lattice by more than 8 % (at other angles the goal for the energy is not met).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np

import pbdkit

ONSET, WEAK = 1e-3, 0.985
RULES = {
    "elastic, ν = 0": {"type": "elastic", "poisson_ratio": 0.0},
    "elastic, ν = .2": {"type": "elastic", "poisson_ratio": 0.2},
    "elastic, ν = 1/3": {"type": "elastic", "poisson_ratio": 1 / 3},
    "springs": {"type": "springs"},
}
LENGTHS = (7, 30, 140, 500)
LONGER = {"linear": 1.0, "bilinear": 2.0, "exponential": 3.2}
"""Elongation at the end, by the softening law, over that of the linear law."""
WEAK_ZONES = {
    ("square", 0.0): (-0.55, 0.55),
    ("square", 45.0): (-0.37, 1.08),
    ("hexagonal", 0.0): (-0.3, 0.8),
}
"""Positions along the bar of the centres of weak cells, by lattice and angle: a crack across the
bar meets one column of squares along their axis, and two rows if cells touch by corners."""


def bar(lattice, rule, ell, angle=0.0, length=7.0, height=4.0, increments=36, law="linear"):
    """The experiment of a bar, and the force and the elongation of its recorded states."""
    turn = np.radians(angle)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    half = [s * length / 2 * along + t * height / 2 * across for s, t in CORNERS]
    spot = np.array([0.5, 0.5 if angle else 0.0])  # a cell lies in the middle of the zone

    def zone(begin, end):
        corners = [(begin, -height), (end, -height), (end, height), (begin, height)]
        points = [(s * along + t * across + spot).tolist() for s, t in corners]
        return {"type": "polygon", "vertices": points}

    ends = length / 2 - 0.6
    ways = np.array([1.1 * length, (2.3 * ell + length) * LONGER[law]]) * ONSET
    motion = {
        "type": "path",
        "steps": [increments // 2, increments],
        "displacements": (ways[:, None] * along).tolist(),
    }
    return {
        "name": "bar",
        "lattice": {"type": lattice, "a": 1.0, "origin": [0.0, 0.0]},
        "body": {"type": "polygon", "vertices": [(p + spot).tolist() for p in half]},
        "neighbours": {"type": "chebyshev" if lattice == "square" else "coordination"},
        "rule": rule,
        "frame": {"type": "natural"},
        "regions": {
            "weak": zone(*WEAK_ZONES.get((lattice, angle), (-0.37, 0.37))),
            "left": zone(-length, -ends),
            "right": zone(ends, length),
            "near-left": zone(-length, -ends + 1.1),
            "near-right": zone(ends - 1.1, length),
        },
        "fracture": {
            "type": "cohesive",
            "energy": ell * ONSET**2,
            "law": law,
            "onset": {
                "otherwise": ONSET,
                "weak": WEAK * ONSET,
                "near-left": 2.0 * ONSET,  # clamps concentrate the stress
                "near-right": 2.0 * ONSET,
            },
        },
        "leaders": [
            {"select": {"region": "left"}, "motion": {"type": "hold"}},
            {"select": {"region": "right"}, "motion": motion},
        ],
        "steps": increments,
        "solver": {"type": "equilibrium", "tolerance": 1e-5, "increments": increments},
        "record": {"every": 1},
        "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0, "thickness": 1.0}],
    }


CORNERS = (-1, -1), (1, -1), (1, 1), (-1, 1)
"""Corners of the bar, in units of half its length and height."""


def measured(lattice, rule, ell, angle=0.0, height=4.0, **more):
    """Return (strength over onset · E, energy over the prescribed energy, force at the end over the
    largest)."""
    given = bar(lattice, rule, ell, angle, height=height, **more)
    ds = pbdkit.run(given, progress=False)
    turn = np.radians(angle)
    force = np.abs(ds.reaction.sel(leader_group=1).values @ [np.cos(turn), np.sin(turn)])
    motion = given["leaders"][1]["motion"]
    ways = np.hypot(*np.transpose(motion["displacements"]))
    way = np.interp(ds.time.values, [0, *motion["steps"]], [0.0, *ways])
    work = np.trapezoid(force, way)
    peak = force.max()
    return peak / height / ONSET, work / height / (ell * ONSET**2), force[-1] / peak


def main() -> int:
    """One line a bar."""
    asked, held = sys.argv[1:], True
    angle = float(asked[asked.index("--angle") + 1]) if "--angle" in asked else 0.0
    law = asked[asked.index("--law") + 1] if "--law" in asked else "linear"
    bars = {} if law == "linear" else {"law": law, "length": 5.0, "height": 2.0, "increments": 40}
    for lattice in ("square", "hexagonal"):
        for name, rule in RULES.items() if lattice in asked else ():
            for ell in LENGTHS:
                strength, energy, left = measured(lattice, rule, ell, angle, **bars)
                held &= abs(strength - 1) < 0.03
                held &= abs(energy - 1) < 0.08 or lattice == "hexagonal" or angle != 0.0
                print(
                    f"{lattice} at {angle:g}°, {name}, ℓ/h {ell}: strength {strength:.3f}, "
                    f"energy {energy:.3f}, force left {left:.3f}",
                    flush=True,
                )
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
