"""The least-squares problem of a fit: residuals over their noise, and how they change with what is
unknown."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbdkit.experiment.model import Experiment
from pbdkit.fitting.boundary import Boundary, boundaries
from pbdkit.fitting.evidence import Evidence
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import Resting
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats

DERIVATIVES = 1e-7
"""How accurate they are, as a share of the largest: far within any noise."""


@dataclass(frozen=True)
class Unknown:
    """A parameter and the bounds between which it is looked for."""

    parameter: Parameter
    low: float
    high: float

    @property
    def span(self) -> float:
        """From bound to bound."""
        return self.high - self.low


@dataclass(frozen=True)
class At:
    """The problem at some z: the scene at rest, the residuals (measured - predicted) / noise of all
    evidence, and their derivatives (residual, unknown)."""

    resting: Resting
    residuals: Floats
    jacobian: Floats
    changes: tuple[Floats, ...] = field(repr=False)
    """The derivative of the displacements by each unknown, as planes."""


@dataclass(frozen=True)
class Problem:
    """z is the parameters, then the coefficients of the boundaries, then the strengths of what the
    measurement shows beside the body's displacement."""

    experiment: Experiment
    scene: Scene
    unknowns: tuple[Unknown, ...]
    boundaries: tuple[Boundary, ...]
    evidence: tuple[Evidence, ...]

    @classmethod
    def of(
        cls,
        scene: Scene,
        unknowns: tuple[Unknown, ...],
        evidence: tuple[Evidence, ...],
        modes: int,
    ) -> Problem:
        """With so many modes along each measured boundary."""
        found = boundaries(scene, modes) if modes else ()
        return cls(scene.experiment, scene, unknowns, found, evidence)

    @cached_property
    def extra(self) -> int:
        """How many strengths there are."""
        return sum(e.distortions.shape[1] for e in self.evidence)

    @cached_property
    def size(self) -> int:
        """Of z."""
        return len(self.unknowns) + sum(b.size for b in self.boundaries) + self.extra

    def start(self) -> Floats:
        """In the middle between bounds, with boundaries as they were measured."""
        steps = self.experiment.steps
        middle = [(u.low + u.high) / 2 for u in self.unknowns]
        return np.concatenate(
            [middle, *(b.start(steps) for b in self.boundaries), np.zeros(self.extra)]
        )

    def bounds(self) -> tuple[Floats, Floats]:
        """Of parameters; the others have none."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        for n, unknown in enumerate(self.unknowns):
            low[n], high[n] = unknown.low, unknown.high
        return low, high

    def experiment_at(self, z: Floats) -> Experiment:
        """The experiment with these numbers."""
        found, n = self.experiment, len(self.unknowns)
        for unknown, value in zip(self.unknowns, z, strict=False):
            found = unknown.parameter.put(found, float(value))
        for boundary in self.boundaries:
            found = boundary.moved(found, z[n : n + boundary.size])
            n += boundary.size
        return found

    def at(self, z: Floats) -> At:
        """All of it. Raises ExperimentError, and UnconvergedError where there is no equilibrium."""
        resting = Resting.of(self.experiment_at(z), self.scene, DERIVATIVES)
        columns, changes = [], []
        for unknown in self.unknowns:
            changes.append(resting.change(unknown.parameter))
            columns.append(self._changed(resting, changes[-1], unknown.parameter))
        for boundary in self.boundaries:
            for n in range(boundary.size):
                changes.append(resting.answer(boundary.planes(resting.scene, n)))
                columns.append(self._changed(resting, changes[-1], None))
        beside, strengths = self._distortions(), z[self.size - self.extra :]
        jacobian = np.column_stack([*columns, beside]) if columns else beside
        parts = [(e.measured - e.predicted(resting)) / e.noise for e in self.evidence]
        residuals = np.concatenate(parts) - beside @ strengths
        return At(resting, residuals, jacobian, tuple(changes))

    def _changed(self, resting: Resting, du: Floats, parameter: Parameter | None) -> Floats:
        return np.concatenate([e.change(resting, du, parameter) / e.noise for e in self.evidence])

    def _distortions(self) -> Floats:
        """(residual, strength): over the noise, those of each evidence on its own rows."""
        whole = np.zeros((sum(len(e.measured) for e in self.evidence), self.extra))
        row = column = 0
        for e in self.evidence:
            rows, columns = e.distortions.shape
            whole[row : row + rows, column : column + columns] = e.distortions / e.noise
            row, column = row + rows, column + columns
        return whole
