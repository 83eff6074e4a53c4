"""The small scenes in which a component is tried: every lattice with every neighbourhood."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import (
    INTERFACES,
    Component,
    Diagnostic,
    FramePolicy,
    Lattice,
    NeighbourMetric,
)
from pbdkit.registry.checking import interface_of

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
MEAN, NATURAL = {"type": "mean"}, {"type": "natural"}
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
"""The rule with which frames are tried whose edges are free of stress."""
BODY = {"type": "grid", "columns": 6, "rows": 5}
PULLED = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}},
    {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [0.3, 0.1]}},
]
"""The leaders of the scenes that diagnostics measure."""
TEARING = {"type": "threshold", "thresholds": [1.6]}


def experiments_with(component: Component, parts: Mapping[str, Any]) -> Iterator[Experiment]:
    """Small experiments that a component takes part in; `parts`, each one or a list of them, stand
    in for those tried.

    Rules, frames and fracture models meet each of the five lattices with each of four
    neighbourhoods, lattices and neighbour metrics each of the other with two rules; what works cell
    by cell meets frames or rules that do.
    """
    field = next(f for f, i in INTERFACES.items() if i is interface_of(type(component)))
    given = dict(parts) | {field: component}
    if field == "diagnostics":
        given |= {field: [component], "fracture": parts.get("fracture", TEARING)}
        given |= {"leaders": PULLED}
    choices = {
        "lattice": list(LATTICES.values()),
        # The fracture model that diagnostics are tried with has one threshold, for one shell.
        "neighbours": [
            n for n in NEIGHBOURS.values() if field != "diagnostics" or n["shells"] == 1
        ],
        "rule": _rules(component),
        "frame": [MEAN, NATURAL] if getattr(component, "uses_cells", False) else [MEAN],
    }
    tried = [alternatives(given[n]) if n in given else values for n, values in choices.items()]
    base = {"name": "conformance", "body": BODY, "steps": 6}
    for choice in product(*tried):
        yield Experiment(**base | given | dict(zip(choices, choice, strict=True)))


def alternatives(part: Any) -> list[Any]:
    """The parts to be tried one after the other."""
    return list(part) if isinstance(part, (list, tuple)) else [part]


def _rules(component: Component) -> list[dict[str, Any]]:
    wants_material = isinstance(component, Diagnostic) and bool(
        component.needs & {"material", "forces"}
    )
    if wants_material or (isinstance(component, FramePolicy) and component.edges_are_free):
        return [ELASTIC]
    return list(PARTNERS if isinstance(component, (Lattice, NeighbourMetric)) else PARTNERS[:1])


def place_of(experiment: Experiment) -> str:
    """Where something was found, for messages."""
    lattice, neighbours = experiment.lattice, experiment.neighbours
    shells = getattr(neighbours, "shells", None)
    around = f"{neighbours.type} neighbours" + (f" in {shells} shells" if shells else "")
    return f"on the {lattice.type} lattice with {around}"
