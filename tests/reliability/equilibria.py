"""Compare equilibria of random scenes with references.

python tests/reliability/equilibria.py springs|fracture|bounds [--trials N] [--seed S]

springs: large loads (pressed, pulled, sheared, turned) against stepping with the load in --parts
parts, each until convergence. fracture: a load in one step against the same load in as many steps
as it has increments: which bonds break. bounds: grids against a direct solver: the ratio of
the error bound to the true error, and cases in which it is below. Exits with 1 if something
differs.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np

import pbdkit

HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
CHEBYSHEV = {"type": "chebyshev", "shells": 1}
LATTICES: dict[str, dict[str, Any]] = {
    "square": {"lattice": {"type": "square", "a": 1.0}, "neighbours": CHEBYSHEV},
    "hexagonal": {
        "lattice": {"type": "hexagonal", "a": 1.0},
        "neighbours": {"type": "coordination", "shells": 1},
    },
    "rectangular": {"lattice": {"type": "rectangular", "a": 3.0, "b": 1.0},
                    "neighbours": CHEBYSHEV},
}  # fmt: skip
Counts = collections.Counter[str]


def sheet(columns: int, rows: int, motion: dict[str, Any], **parts: Any) -> dict[str, Any]:
    """A sheet held on the left and moved on the right."""
    return {
        "name": "sheet",
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "leaders": [HOLD, {"select": {"edge": "right"}, "motion": motion}],
        "steps": 1,
        "diagnostics": [{"type": "displacement"}],
        "solver": {"type": "equilibrium"},
    } | parts


def run(experiment: dict[str, Any]) -> Any:
    """The dataset; None where it ends unconverged."""
    try:
        return pbdkit.run(experiment, progress=False)
    except pbdkit.DivergedError:
        return None


def springs(rng: np.random.Generator, parts: int, found: Counts) -> None:
    """One load, straight and by slow steps."""
    columns, rows = map(int, rng.integers([5, 3], [13, 7]))
    length, kind = columns - 1, str(rng.choice(["pressed", "pulled", "sheared", "turned"]))
    ways = {
        "pressed": [-rng.uniform(0.02, 0.25) * length, 0.1 * rng.normal()],
        "pulled": [rng.uniform(0.05, 0.6) * length, 0.3 * rng.normal()],
        "sheared": [0.2 * rng.normal(), rng.uniform(0.05, 0.4) * length],
    }
    if kind == "turned":
        turn = {"type": "rotation", "centre": [length / 2, rows / 2]}
        angle = float(rng.uniform(5.0, 70.0))
        once = turn | {"angle": angle, "steps": 1}
        slow = turn | {"angle": angle / parts, "steps": parts}
    else:
        way = [float(along) for along in ways[kind]]
        once = {"type": "displace", "displacement": way}
        slow = {"type": "velocity", "velocity": [w / parts for w in way], "steps": parts}
    lattice = str(rng.choice(["square", "hexagonal"]))
    of = LATTICES[lattice] | {"rule": {"type": "springs"}, "frame": {"type": "natural"}}
    straight = run(sheet(columns, rows, once, **of))
    if straight is None:
        found[f"{kind}: unconverged"] += 1
        return
    settle = {"type": "stepping", "settle": {"tolerance": 1e-6}}
    steps = {"steps": 2 * parts, "record": {"every": 2 * parts}, "solver": settle}
    stepped = run(sheet(columns, rows, slow, **of, **steps))
    u = straight.u.values[-1]
    off = np.inf if stepped is None else np.abs(stepped.u.values[-1] - u).max()
    same = off <= 1e-4 * max(1.0, np.abs(u).max())
    found[f"{kind}: {'the same' if same else 'differs'}"] += 1
    if not same:
        print("differs:", kind, lattice, columns, rows, once, f"by {off:.2g}", flush=True)


def fracture(rng: np.random.Generator, _: int, found: Counts) -> None:
    """One load, in one step and in as many as there are increments."""
    columns, rows = map(int, rng.integers(4, 9, 2))
    way = (rng.normal(size=2) * [3.0, 1.0]).tolist()
    count, limit = int(rng.integers(20, 80)), float(rng.uniform(1.2, 2.0))
    parts = {
        "lattice": LATTICES["square"]["lattice"],
        "rule": {"type": "barycentre"},
        "fracture": {"type": "threshold", "thresholds": [limit]},
        "solver": {"type": "equilibrium", "increments": count},
    }
    slow = {"type": "velocity", "velocity": [w / count for w in way], "steps": count}
    runs = (
        run(sheet(columns, rows, {"type": "displace", "displacement": way}, **parts)),
        run(sheet(columns, rows, slow, **parts | {"steps": count})),
    )
    if any(one is None for one in runs):
        found["unconverged"] += 1
        return
    one, other = (np.flatnonzero(ds.broken_step.values >= 0).tolist() for ds in runs)
    found["the same" if one == other else "differs"] += 1
    if one != other:
        print("differs:", columns, rows, limit, way, count, len(one), len(other), flush=True)


def bounds(rng: np.random.Generator, _: int, found: Counts) -> None:
    """One elastic or averaging sheet by grids and directly."""
    columns, rows = int(rng.integers(24, 60)), int(rng.integers(8, 50))
    of = LATTICES[str(rng.choice(list(LATTICES)))]
    elastic = {"type": "elastic", "poisson_ratio": float(rng.uniform(-0.5, 0.45))}
    rule = elastic if rng.random() < 0.5 else {"type": "barycentre"}
    frames = ["mean", "none", "first", *["natural"] * (rule is elastic)]
    of = of | {"rule": rule, "frame": {"type": str(rng.choice(frames))}}
    motion = {"type": "displace", "displacement": rng.normal(size=2).tolist()}
    known = []
    for method, tolerance in (("lu", 1e-10), ("multigrid", float(10 ** rng.uniform(-6, -1)))):
        solver = {"type": "equilibrium", "method": method, "tolerance": tolerance}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            known.append(run(sheet(columns, rows, motion, **of, solver=solver)))
    exact, near = known
    if exact is None or near is None:
        found["unconverged"] += 1
        return
    error_bound = json.loads(near.attrs["certificate"])
    error = np.hypot(*(near.u.values[-1] - exact.u.values[-1]).T).max()
    ratio = error_bound["distance"] / error if error > 1e-11 else 1.0
    bins = (1.0, 3.0, 10.0, 30.0, np.inf)
    name = next(f"up to {b:g} times" for b in bins[1:] if ratio <= b)
    found[f"{error_bound['bound']}: {name}" if ratio >= 1.0 else "differs"] += 1
    if ratio < 1.0:
        print("below the true error:", of, columns, rows, motion, error_bound, error, flush=True)


TRIALS: dict[str, Callable[[np.random.Generator, int, Counts], None]] = {
    "springs": springs,
    "fracture": fracture,
    "bounds": bounds,
}


def main() -> int:
    """Count the outcomes of the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trial", choices=TRIALS)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parts", type=int, default=40_000, help="of the load of springs")
    asked = parser.parse_args()
    warnings.simplefilter("ignore", pbdkit.PbdkitWarning)
    found: Counts = collections.Counter()
    for n in range(asked.trials):
        TRIALS[asked.trial](np.random.default_rng([asked.seed, n]), asked.parts, found)
    for what, count in sorted(found.items()):
        print(f"{what:32} {count}")
    return 1 if any("differs" in what for what in found) else 0


if __name__ == "__main__":
    sys.exit(main())
