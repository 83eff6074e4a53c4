"""Number of steps to an equilibrium, and their parallel execution."""

import json
from pathlib import Path

import numpy as np
from claims import Claim
from runs import run, run_parts

MEASURED = Path(__file__).parents[1] / "validation" / "performance.json"


def cost() -> list[Claim]:
    """Return the claims on the cost of a step and the number of steps."""
    sizes = (10, 20, 40)
    steps = [_settling(n) for n in sizes]
    growth = steps[2] / steps[1]
    return [
        Claim(
            "computational costs are low because we do not solve differential equations",
            "A step is one sum over the neighbours, but many steps are needed. A held sheet of "
            f"{', '.join(f'{n} × {n}' for n in sizes)} particles is within 1 % of its equilibrium "
            f"after {', '.join(map(str, steps))} steps. For twice the size, the number of steps is "
            f"{growth:.1f} times as large. A sparse direct solver computes the equilibrium by "
            "solving the same equations once.",
            growth < 1.5,
            "sheets of about ten particles a side",
            steps[0] < 400,
        ),
        _shared(),
    ]


def _shared() -> Claim:
    """Return the claim about parallel processors, measured with threads; no GPU was measured."""
    one, two = (run("paper/a", "solver.engine=compiled", f"solver.threads={n}") for n in (1, 2))
    differ = float(np.abs(one.position - two.position).max())
    rows = json.loads(MEASURED.read_text("utf-8"))["threads"]
    gains = {r["size"]: r["one_ns"] / r["two_ns"] for r in rows if r["rule"] == "barycentre"}
    return Claim(
        "the job can be parallelized between the GPU cores",
        "Nothing was measured on a GPU. Every follower is computed only from the intermediate "
        "configuration. Therefore the followers can be distributed among threads in any way: two "
        f"threads of a processor give the same positions (difference in case a: {differ:g}). The "
        "time on one thread divided by the time on two threads is "
        f"{', '.join(f'{g:.2f} ({n}² particles)' for n, g in gains.items())} "
        "([performance](performance.md#threads)).",
        False,
        "threads of a processor, in sheets of "
        f"{' and '.join(f'{n}²' for n, g in gains.items() if g > 1.5)}; a GPU is not measured",
        differ == 0.0 and max(gains.values()) > 1.5,
    )


def _settling(size: int) -> int:
    """Return the steps after a pull until a sheet is within 1 % of the pull from equilibrium."""
    leaders = [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "displace", "displacement": [1.0, 0.0]},
        },
    ]
    body = {"type": "grid", "columns": size, "rows": 3}
    u = run_parts(body=body, leaders=leaders, steps=2 * size * size).u[:, :, 1, 0]
    off = np.abs(u - np.linspace(0, 1, size)).max(axis=1)
    return int(np.flatnonzero(off > 0.01)[-1]) + 1
