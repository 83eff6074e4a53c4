"""Operations of particles on a raster: the particles to which each of them happens."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import Any

from pbdkit.lattice.raster import Raster
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import ParticleOperation
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.frame import Indices
from pbdkit.scene.selection import Selecting


@dataclass(frozen=True)
class Operated:
    """An operation with the rows and places of its particles, and its numbers p."""

    operation: ParticleOperation
    rows: Indices
    place: Indices
    parameters: Any


def build_operations(raster: Raster, experiment: Experiment) -> tuple[Operated, ...]:
    """Return every operation with its particles. Raises ExperimentError for one that selects
    nobody or a frame point."""
    body, found = Selecting(raster, experiment.regions), []
    for n, operation in enumerate(experiment.operations):
        rows = raster.body_rows
        if operation.select:
            rows = body.select(operation.select, ("operations", n, "select"))
        with blaming(operation, "when asked for its parameters", "operations", n):
            numbers = operation.parameters()
        parameters = namedtuple("Parameters", numbers)(**numbers)
        found.append(Operated(operation, rows, raster.place_of(rows), parameters))
    return tuple(found)
