"""Bodies with random broken and softened bonds: energy and forces of rigid turns, symmetry and sign
of the stiffness, and that breaking one more bond never stiffens.

Run `python tests/reliability/torn_bodies.py [--count 500] [--seed 0]` from the root of the project.
Exits with 1 if a value exceeds 1e-12.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from tests.components.test_elasticity_torn import (
    LATTICES,
    ORTHOTROPIC,
    RULES,
    forces,
    stiffness,
    torn_scene,
    torn_state,
)

GOAL = 1e-12


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    worst = np.zeros(4)
    for number in range(given.count):
        generator = np.random.default_rng((given.seed, number))
        lattice = LATTICES[generator.integers(len(LATTICES))]
        rules = RULES if lattice["type"] == "hexagonal" else [*RULES, ORTHOTROPIC]
        rule = rules[generator.integers(len(rules))]
        scene = torn_scene(lattice, rule, ["natural", "none"][generator.integers(2)])
        state = torn_state(scene, generator)
        X = scene.raster.reference(scene.raster.body_rows)
        turn = np.stack([-X[:, 1], X[:, 0]], axis=1)
        area = np.ptp(X[:, 0]) * np.ptp(X[:, 1])
        K = stiffness(scene, state)
        size = np.abs(K).max()
        energy = abs(0.5 * (turn * forces(scene, state, turn)).sum()) / (area * max(1.0, size))
        intact = np.argwhere(state.broken_step < 0)
        state.broken_step[tuple(intact[generator.integers(len(intact))])] = 0
        softer = K - stiffness(scene, state)
        found = (
            energy,
            np.abs(K - K.T).max() / size,
            -np.linalg.eigvalsh((K + K.T) / 2)[0] / size,
            -np.linalg.eigvalsh((softer + softer.T) / 2)[0] / size,
        )
        worst = np.maximum(worst, found)
    print(f"{given.count} torn bodies; the worst of each, over the stiffness:")
    for name, value in zip(
        ("energy of a turn", "asymmetry", "negative eigenvalue", "stiffening"), worst, strict=True
    ):
        print(f"  {name}: {value:.1e}")
    return int(worst.max() > GOAL)


if __name__ == "__main__":
    sys.exit(main())
