"""Follow branches of equilibria past the peak of the load, and compare them with closed forms and
laws of mechanics. Exits with 1 if a figure exceeds its goal.

    python tests/reliability/branches.py

A bar of 60 cells of which one softens, and that is held straight, is a series of springs: in 60
steps it snaps back. A notched beam in three-point bending, 1617 particles and 60 steps, is followed
by the opening of the mouth of its notch; its processor time includes the start of the program.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np
import yaml

import pbdkit

ONSET, ENERGY, LENGTH = 1e-3, 4.5e-6, 60.0
FAILURE = 2.0 * ENERGY / ONSET
ONE = {"youngs_modulus": 1.0, "thickness": 1.0}
COMMON = {
    "version": 1,
    "neighbours": {"type": "chebyshev", "shells": 1},
    "frame": {"type": "natural"},
    "steps": 60,
}
BAR = COMMON | {
    "name": "bar",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "rectangle", "width": LENGTH, "height": 1.0},
    "rule": {"type": "elastic", "poisson_ratio": 0.0},
    "regions": {
        "weak": {"type": "rectangle", "width": 0.9, "height": 5.0, "origin": [30.05, -2.0]}
    },
    "fracture": {
        "type": "cohesive",
        "onset": {"otherwise": 1.05 * ONSET, "weak": ONSET},
        "energy": ENERGY,
    },
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "displace", "displacement": [0.01, 0.0]},
        },
        {
            "select": {"nearest": [[float(x), y] for x in range(1, 60) for y in (0.0, 1.0)]},
            "axes": ["y"],
            "motion": {"type": "hold"},
        },
    ],
    "diagnostics": [{"type": "reaction", **ONE}],
}
BEAM = COMMON | {
    "name": "beam",
    "units": {"length": "1 mm", "youngs_modulus": "30 GPa", "thickness": "50 mm"},
    "lattice": {"type": "square", "a": 5.0},
    "body": {"type": "rectangle", "width": 380.0, "height": 100.0},
    "rule": {"type": "elastic", "poisson_ratio": 0.2},
    "fracture": {
        "type": "cohesive",
        "onset": "3 MPa",
        "energy": "0.1 N/mm",
        "cracks": [[[187.5, -5.0], [187.5, 48.0]]],
    },
    "leaders": [
        {"select": {"nearest": [[0, 0]]}, "motion": {"type": "hold"}},
        {"select": {"nearest": [[380, 0]]}, "motion": {"type": "hold"}, "axes": ["y"]},
    ],
    "loads": [{"select": {"nearest": [[190, 100]]}, "force": ["0 N", "-1 kN"]}],
    "diagnostics": [{"type": "load-displacement"}, {"type": "strain-energy"}],
}


def bar(control: dict[str, object]) -> tuple[float, int]:
    """Return the largest difference of the stress from that of springs in series, over the
    strength, and the number of steps in which the bar snaps back."""
    solver = {"type": "equilibrium", "control": control}
    ds = pbdkit.run(BAR | {"solver": solver}, progress=False)
    u, x = (ds.position - ds.reference).values[:, :, 0], ds.reference.values[:, 0]
    near, far, end = (u[:, np.isclose(x, at)].mean(axis=1) for at in (30.0, 31.0, LENGTH))
    opening, softening = far - near, ONSET * (FAILURE - (far - near)) / (FAILURE - ONSET)
    stress = np.where(opening <= ONSET * (1 + 1e-6), opening, softening)
    reaction = ds.reaction.values[:, 1, 0]
    off = np.abs([reaction - stress, (end - opening) / (LENGTH - 1) - stress]).max()
    return float(off / ONSET), int((np.diff(end) < 0).sum())


def beam(folder: Path) -> tuple[float, float, int]:
    """Return the processor time of a run of the beam, the largest violation of the balance of
    energy over the work, and the number of equilibria after the peak."""
    mouth = {"type": "opening", "between": [[185, 0], [190, 0]], "to": "0.3 mm"}
    experiment = BEAM | {"solver": {"type": "equilibrium", "control": mouth}}
    (folder / "beam.yaml").write_text(yaml.safe_dump(experiment))
    before = os.times()
    root = str(Path(__file__).parents[2])
    subprocess.run(
        [sys.executable, "-m", "pbdkit", "run", "beam.yaml"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    after = os.times()
    seconds = sum(after[2:4]) - sum(before[2:4])
    ds = pbdkit.open(folder / "beam.nc")
    force, moved = ds.load_resultant.values[:, 0, 1], ds.load_displacement.values[:, 0, 1]
    work = np.append(0.0, np.cumsum((force[1:] + force[:-1]) / 2 * np.diff(moved)))
    dissipated = ds.dissipated_energy.values * 30e3 * 50.0  # N mm
    off = np.abs(work - ds.strain_energy.values - dissipated).max() / work[-1]
    return seconds, float(off), len(force) - 1 - int(np.abs(force).argmax())


def main() -> int:
    """Print one line for each figure, and return 1 if one exceeds its goal."""
    rows = []
    opening = {"type": "opening", "between": [[30, 0], [31, 0]], "to": 0.99 * FAILURE}
    for control in (opening, {"type": "dissipation", "to": 0.95 * ENERGY}):
        off, back = bar(control)
        name = f"bar by {control['type']}, {back} of 60 steps snap back"
        rows.append((f"{name}: difference from springs in series", off, 0.01))
    with tempfile.TemporaryDirectory() as folder:
        seconds, off, after = beam(Path(folder))
    rows.append((f"beam, {after} of 60 steps after the peak: balance of energy", off, 1e-6))
    rows.append(("beam: processor time in seconds", seconds, 10.0))
    for name, value, goal in rows:
        print(f"{name} {value:.2g} (goal {goal:g}){'' if value <= goal else ' MISSED'}")
    return int(any(value > goal for _, value, goal in rows))


if __name__ == "__main__":
    sys.exit(main())
