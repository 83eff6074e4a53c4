"""What a YAML file describes, by its keys, and which command takes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.source import Source

ANYBODY = {"version", "name", "seed", "units", "steps", "record"}
"""The keys of an experiment that other files may have too."""
PARTS = ANYBODY | {
    *("lattice", "body", "regions", "neighbours", "rule", "frame", "fracture", "cuts", "initial"),
    *("leaders", "loads", "obstacles", "diagnostics", "solver"),
}
"""All of them."""
EXPERIMENT, SWEEP, FIT = "an experiment", "a sweep", "a fit"


def kind_of(data: Mapping[str, Any]) -> str:
    """What it describes, empty where nobody can tell. Keys that are only misspelt do not matter."""
    if "unknown" in data and "measured" in data:
        return FIT
    if data.keys() & {"lattice", "body", "rule"}:
        return EXPERIMENT
    if data.keys() & {"experiment", "vary", "together"}:
        return SWEEP
    return EXPERIMENT if data.keys() & (PARTS - ANYBODY) or data.keys() <= PARTS else ""


def what_takes(kind: str, name: str) -> str:
    """What to do with a file of that kind."""
    if kind == SWEEP:
        return f"`pbdkit sweep {name}` runs it"
    if kind == EXPERIMENT:
        return f"`pbdkit run {name}` runs it"
    return f"`pbdkit fit {name}` carries it out"


def of_kind(wanted: str, source: Source) -> Source:
    """The source. Raises ExperimentError where it describes something else than is wanted."""
    kind, name = kind_of(source.data), source.name
    if kind == wanted:
        return source
    if kind:
        how = {SWEEP: "; a sweep names it under `experiment`, and under `vary` what differs"}
        more = how.get(wanted, "") if kind == EXPERIMENT else ""
        takes = what_takes(kind, name)
        raise ExperimentError(f"{name}: is {kind}, not {wanted}; {takes}{more}")
    remedy = {
        EXPERIMENT: "one has `lattice`, `body`, `rule` and `steps`; `pbdkit init` writes one",
        SWEEP: "one has `experiment` and `vary`",
        FIT: "one has `experiment`, `unknown` and `measured`",
    }
    first = ", ".join(f"`{key}`" for key in [*source.data][:3])
    raise ExperimentError(f"{name}: is not {wanted}, it has {first}; {remedy[wanted]}")
