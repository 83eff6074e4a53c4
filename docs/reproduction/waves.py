"""Decay of waves of columns, by neighbourhood."""

import math

import numpy as np
from runs import Floats, run_parts


def softening(ks: Floats, metric: str, shells: int) -> Floats:
    """Return (1 - λ(k)) / k² of waves of columns, relative to long waves; λ is the factor a
    step."""
    found = np.array([_decay(float(k), metric, shells) for k in (1e-3, *ks)])
    return found[1:] / found[0]


def _decay(k: float, metric: str, shells: int) -> float:
    """Return (1 - λ) / k² from two steps: leaders make the wave, then all are followers."""
    columns, middle = 13, 6
    groups = [
        {
            "select": {"box": [i - 0.1, -1.0, i + 0.1, 9.0]},
            "motion": {"type": "displace", "displacement": [math.cos(k * (i - middle)), 0.0]},
            "until": 1,
        }
        for i in range(columns)
    ]
    body = {"type": "grid", "columns": columns, "rows": 6}
    near = {"type": metric, "shells": shells}
    u = run_parts(body=body, neighbours=near, leaders=groups, steps=2).u[:, middle, 3, 0]
    return float(1 - u[2] / u[1]) / k**2
