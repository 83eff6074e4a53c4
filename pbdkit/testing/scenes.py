"""The small scenes in which a component is tried: every lattice with every neighbourhood."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import INTERFACES, Component
from pbdkit.registry.registry import interface_of

LATTICES: dict[str, dict[str, Any]] = {
    "square": {"type": "square", "a": 1.0},
    "rectangular": {"type": "rectangular", "a": 1.0, "b": 1.3},
    "centred-rectangular": {"type": "centred-rectangular", "a": 1.0, "b": 1.2},
    "hexagonal": {"type": "hexagonal", "a": 0.7},
    "oblique": {"type": "oblique", "a": 1.1, "b": 0.9, "angle": 65.0},
}
NEIGHBOURS: dict[str, dict[str, Any]] = {
    f"{name}-{shells}": {"type": name, "shells": shells}
    for name in ("coordination", "chebyshev")
    for shells in (1, 2)
}
PARTNERS = ({"type": "barycentre"}, {"type": "distance-weighted"})
"""The rules with which lattices and neighbours are tried: a linear one, and one that is not."""
BODY = {"type": "grid", "columns": 6, "rows": 5}
TEARING = {"type": "threshold", "thresholds": [1.6]}


def experiments_with(component: Component, parts: Mapping[str, Any]) -> Iterator[Experiment]:
    """Small experiments that a component takes part in; `parts` stand in for those tried.

    Rules, frames and fracture models meet each of the five lattices with each of four
    neighbourhoods, lattices and neighbour metrics each of the other with two rules.
    """
    field = next(f for f, i in INTERFACES.items() if i is interface_of(type(component)))
    given = dict(parts) | {field: component}
    if field == "diagnostics":
        given |= {field: [component], "fracture": parts.get("fracture", TEARING)}
    rules = PARTNERS if field in ("lattice", "neighbours") else PARTNERS[:1]
    tried = {
        "lattice": [given["lattice"]] if "lattice" in given else list(LATTICES.values()),
        "neighbours": [given["neighbours"]] if "neighbours" in given else _neighbours(field),
        "rule": [given["rule"]] if "rule" in given else list(rules),
    }
    base = {"name": "conformance", "body": BODY, "steps": 6}
    for choice in product(*tried.values()):
        yield Experiment(**base | given | dict(zip(tried, choice, strict=True)))


def _neighbours(field: str) -> list[dict[str, Any]]:
    # The fracture model that diagnostics are tried with has one threshold, for one shell.
    return [n for n in NEIGHBOURS.values() if field != "diagnostics" or n["shells"] == 1]


def place_of(experiment: Experiment) -> str:
    """Where something was found, for messages."""
    lattice, neighbours = experiment.lattice, experiment.neighbours
    shells = getattr(neighbours, "shells", None)
    around = f"{neighbours.type} neighbours" + (f" in {shells} shells" if shells else "")
    return f"on the {lattice.type} lattice with {around}"
