"""A bar with a boundary layer: the strain-gradient rule against its exact solution."""

from __future__ import annotations

from typing import Any

import numpy as np
from finite_elements.lattices import HAIR, NATURAL

import pbdkit

LENGTH = 0.1


def experiment(cells: int, rows: int = 3) -> dict[str, Any]:
    """A bar of length 1 pulled by 1, ν = 0, so that u_x(x) alone is left; its ends rest in slope
    too, which the rule has by itself where leaders stand still."""
    ends = [[-HAIR, -1.0, HAIR, 9.0], [1 - HAIR, -1.0, 1 + HAIR, 9.0]]
    pull = {"type": "displace", "displacement": [1.0, 0.0]}
    return {
        "name": "layer",
        "lattice": {"type": "square", "a": 1 / cells},
        "body": {"type": "rectangle", "width": 1.0, "height": rows / cells},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "strain-gradient", "poisson_ratio": 0.0, "length": LENGTH},
        "frame": NATURAL,
        "leaders": [
            {"select": {"box": ends[0]}, "motion": {"type": "hold"}},
            {"select": {"box": ends[1]}, "motion": pull},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-6},
    }


def exact(x):
    """u'' - l² u'''' = 0 with u(0) = u'(0) = u'(1) = 0, u(1) = 1: a + bx + two exponentials."""
    decay, decayed = np.exp(-1 / LENGTH), 1 / LENGTH
    conditions = [
        [1, 0, 1, decay],
        [1, 1, decay, 1],
        [0, 1, -decayed, decay * decayed],
        [0, 1, -decay * decayed, decayed],
    ]
    a, b, c, d = np.linalg.solve(conditions, [0, 1, 0, 0])
    return a + b * x + c * np.exp(-x / LENGTH) + d * np.exp((x - 1) / LENGTH)


def error(cells: int) -> float:
    """The relative L2 error of the displacements at the sites."""
    dataset = pbdkit.run(experiment(cells), progress=False)
    u = (dataset.position[-1] - dataset.reference).values
    expected = np.stack([exact(dataset.reference.values[:, 0]), np.zeros(len(u))], axis=1)
    return float(np.linalg.norm(u - expected) / np.linalg.norm(expected))
