"""Compare equilibria of sheets with breaking bonds, by the compiled kernel and by numpy, in turns.

python tests/benchmarks/breaking.py [--turns N] [--only damage threshold]

Processor time of whole searches, from the scene on, imports and compiling done; the best of some
turns. The damaged sheet is that of docs/validation/fracture.md, in 30 increments.
"""

from __future__ import annotations

import argparse
import time
from typing import Any
from unittest.mock import patch

import numpy as np

import pbdkit
from pbdkit.equilibrium import breaking_kernel
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import State

SHEETS: dict[str, dict[str, Any]] = {
    "damage": {
        "body": {"type": "grid", "columns": 16, "rows": 10},
        "fracture": {
            "type": "damage",
            "onset": 0.2,
            "failure": 1.0,
            "scatter": 0.3,
            "frame_bonds": False,
        },
        "motion": {"type": "velocity", "velocity": [0.1, 0.0], "steps": 60},
    },
    "threshold": {
        "body": {"type": "grid", "columns": 100, "rows": 60},
        "fracture": {
            "type": "threshold",
            "thresholds": [1.4],
            "frame_bonds": False,
            "cracks": [[[50.2, 20.0], [50.2, 30.0]]],
        },
        "motion": {"type": "velocity", "velocity": [0.5, 0.0], "steps": 60},
    },
}


def sheet(body: dict[str, Any], fracture: dict[str, Any], motion: dict[str, Any]) -> Scene:
    return build_scene(
        pbdkit.Experiment(
            version=1,
            name="breaking",
            seed=3,
            lattice={"type": "hexagonal", "a": 1.0},
            body=body,
            rule={"type": "barycentre"},
            fracture=fracture,
            leaders=[
                {"select": {"edge": "left"}, "motion": {"type": "hold"}},
                {"select": {"edge": "right"}, "motion": motion},
            ],
            steps=60,
            solver={"type": "equilibrium", "increments": 30},
        )
    )


def found(scene: Scene, by_numpy: bool) -> tuple[float, State]:
    """Seconds of the processor, and the equilibrium."""
    begun = time.process_time()
    if by_numpy:
        with patch.object(breaking_kernel, "breaking_kernel_of", return_value=None):
            state, _ = equilibrium_state(scene)
    else:
        state, _ = equilibrium_state(scene)
    return time.process_time() - begun, state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=SHEETS, default=list(SHEETS))
    asked = parser.parse_args()
    for name in asked.only:
        scene = sheet(**SHEETS[name])
        found(scene, by_numpy=False)  # compiles
        turns = [[found(scene, by_numpy) for by_numpy in (True, False)] for _ in range(asked.turns)]
        slow, quick = (min(seconds for seconds, _ in way) for way in zip(*turns, strict=True))
        (_, one), (_, other) = turns[-1]
        assert one.broken_step is not None
        assert other.broken_step is not None
        values = [abs(b - a).max() for a, b in zip(one.bond_values, other.bond_values, strict=True)]
        apart = abs(one.u - other.u).max(), max(values, default=0.0)
        print(
            f"{name}: numpy {slow:.3g} s, kernel {quick:.3g} s, {slow / quick:.3g} times faster; "
            f"{np.count_nonzero(other.broken_step > 0)} bonds broke, the same: "
            f"{np.array_equal(one.broken_step, other.broken_step)}; displacements differ by "
            f"{apart[0]:.2g}, what bonds remember by {apart[1]:.2g}",
            flush=True,
        )


if __name__ == "__main__":
    main()
