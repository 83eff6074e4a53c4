"""Particle operations on a raster, and the particles on which each of them acts."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass, replace
from typing import Any

from pbdkit.array_types import Indices
from pbdkit.lattice.raster import Raster, Restriction
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import ParticleOperation
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.scene.selection import Selecting


@dataclass(frozen=True)
class Operated:
    """Operation with the rows and places of its particles, and its parameters p."""

    operation: ParticleOperation
    rows: Indices
    place: Indices
    parameters: Any

    def restrict(self, to: Restriction) -> Operated:
        """Return the operation, restricted to the particles of some rows."""
        is_moving = to.is_moving(self.place)
        rows, place = to.rows(self.rows[is_moving]), to.places(self.place[is_moving])
        return replace(self, rows=rows, place=place)


def build_operations(raster: Raster, experiment: Experiment) -> tuple[Operated, ...]:
    """Find the particles of every operation.

    Raises
    ------
    ExperimentError
        If an operation selects no particle or a frame point.
    """
    body, operations = Selecting(raster, experiment.regions), []
    for n, operation in enumerate(experiment.operations):
        rows = raster.body_rows
        if operation.select:
            rows = body.select(operation.select, ("operations", n, "select"))
        with errors_attributed_to(operation, "to return its parameters", "operations", n):
            numbers = operation.parameters()
        parameters = namedtuple("Parameters", numbers)(**numbers)
        operations.append(Operated(operation, rows, raster.place_of(rows), parameters))
    return tuple(operations)
