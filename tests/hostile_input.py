"""Experiments with something wrong or extreme written into them."""

import copy
import math
from typing import Any

VALUES: list[Any] = [
    0, 1, -1, 2, 7, 32, 100, 2**31, 2**62, 2**63, 2**64, 10**30, -(2**63), 0.5, 5e-324, 1e-300,
    1e-20, 1e9, 1e17, 1e20, 1e100, -1e100, 1e300, 1e308, -1e308, math.nan, math.inf, True, None,
    "", "x", "\x1b[31m", "x" * 100_000, "\ud800", [], {}, [1], [[1, 2], [3, 4]], {"type": "hold"},
    {"type": "nope"}, [1e308, 1e308], "auto", "first", "none", "hexagonal",
]  # fmt: skip
PARTS: list[tuple[str, Any]] = [
    ("neighbours", {"type": "euclidean", "radius": 1.5, "weights": [1.0, 1.0]}),
    ("neighbours", {"type": "chebyshev", "shells": 2}),
    ("neighbours", {"type": "euclidean", "radius": 1.5, "reevaluate": True}),
    ("lattice", {"type": "oblique", "a": 1.0, "b": 0.9, "angle": 65.0, "origin": [0.0, 0.0]}),
    ("lattice", {"type": "hexagonal", "a": 1.0}),
    ("lattice", {"type": "rectangular", "a": 1.0, "b": 1.3}),
    ("frame", {"type": "natural"}),
    ("frame", {"type": "mean", "lag": 1, "layers": 2}),
    ("frame", {"type": "mirror", "layers": 1}),
    ("rule", {"type": "elastic", "poisson_ratio": 0.3}),
    ("rule", {"type": "mixed-coordinate", "K": -0.01, "axis": "x"}),
    ("rule", {"type": "distance-weighted"}),
    ("rule", {"type": "strain-gradient", "length": 0.5, "poisson_ratio": 0.2}),
    ("initial", {"type": "noise", "amplitude": 0.1}),
    ("initial", {"type": "affine", "gradient": [[0.1, 0.0], [0.0, 0.1]], "shift": [0.0, 1.0]}),
    ("body", {"type": "disc", "radius": 4.0, "centre": [0.0, 0.0]}),
    ("body", {"type": "polygon", "vertices": [[0.0, 0.0], [5.0, 0.0], [3.0, 6.0]]}),
    ("fracture", {"type": "threshold", "thresholds": [3.0], "placement": 1.0}),
    ("fracture", {"type": "strain", "failure": 0.1}),
    ("diagnostics", [{"type": "track", "numbers": [67]}, {"type": "strain"}, {"type": "broken"}]),
    ("solver", {"type": "stepping", "relaxation": 0.9, "memory": 0.5}),
    ("solver", {"type": "equilibrium", "tolerance": 1e-6, "increments": 10}),
    ("record", {"at": [0, 1, 5]}),
    (
        "leaders",
        [
            {
                "select": {"nearest": [[3.0, 3.0]]},
                "motion": {"type": "rotation", "centre": [0.0, 0.0], "angle": 3.0, "steps": 5},
                "from": 2,
                "until": 7,
            },
            {
                "select": {"numbers": [67]},
                "motion": {"type": "oscillation", "amplitude": [0.1, 0.0], "period": 10.0},
            },
        ],
    ),
]


def mutant(random: Any, bases: list[dict[str, Any]]) -> dict[str, Any]:
    """One of the experiments with some parts exchanged, and some values."""
    data = copy.deepcopy(random.choice(bases))
    for _ in range(random.choice([0, 1, 1, 2, 3])):
        name, part = random.choice(PARTS)
        data[name] = copy.deepcopy(part)
    for _ in range(random.choice([0, 1, 1, 1, 2])):
        *parents, last = random.choice(list(_paths(data))[1:])
        place = data
        for key in parents:
            place = place[key]
        chance = random.random()
        if chance < 0.1 and isinstance(place, dict):
            del place[last]
        elif chance < 0.15 and isinstance(place, dict):
            place[random.choice(["\ud800", "x" * 1000, "\x1b"])] = 1
        else:
            place[last] = copy.deepcopy(random.choice(VALUES))
    return data


def _paths(data: Any, path: tuple[Any, ...] = ()) -> Any:
    yield path
    if isinstance(data, dict):
        entries: Any = data.items()
    else:
        entries = enumerate(data) if isinstance(data, list) else ()
    for key, value in entries:
        yield from _paths(value, (*path, key))
