"""Steps of an elastic sheet with bonds that can break, whole and torn, in turns on one thread.

python tests/benchmarks/torn.py [--size 1000] [--turns 5]

Processor time a particle and step by the compiled engine, the best of some turns of 20 steps.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import pbdkit
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numba_engine.sweeps import torn_marks
from pbdkit.stepping.state import State, initial_state

STRAIN = {"type": "strain", "failure": 0.9}
SHEETS = {
    "nothing can break": ({"type": "none"}, 0),
    "nothing is torn": (STRAIN, 0),
    "cracks, one in 30 rows": (STRAIN, 30),
    "cracks, one in 20 rows": (STRAIN, 20),
}


def scene_of(size: int, fracture: dict[str, object]) -> Scene:
    experiment = pbdkit.Experiment(
        name="torn",
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": size, "rows": size},
        neighbours={"type": "chebyshev", "shells": 1},
        rule={"type": "elastic", "poisson_ratio": 0.3},
        frame={"type": "natural"},
        fracture=fracture,
        initial={"type": "noise", "amplitude": 1e-3},
        steps=1000,
    )
    return build_scene(experiment)


def torn(scene: Scene, every: int) -> State:
    """The state at the start with the bonds of every so manyth row of repeat cells broken."""
    state = initial_state(scene)
    if every and state.broken_step is not None:
        state.broken_step[:, ::every] = 0
    return state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=5)
    given = parser.parse_args()
    runs = []
    for name, (fracture, every) in SHEETS.items():
        scene = scene_of(given.size, fracture)
        state, engine = torn(scene, every), CompiledStepper(scene)
        marked = float(np.mean(torn_marks(scene, state))) if every else 0.0
        runs.append([name, marked, engine, engine.advance(state, 2), np.inf])
    for _ in range(given.turns):
        for run in runs:
            begun = time.process_time()
            run[3] = run[2].advance(run[3], 20)
            run[4] = min(run[4], (time.process_time() - begun) / 20)
    for name, marked, _, _, best in runs:
        each = best / given.size**2 * 1e9
        print(f"{name}: {marked:.0%} of the particles beside torn cells, {each:.2f} ns")


if __name__ == "__main__":
    main()
