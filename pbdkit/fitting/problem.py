"""The least-squares problem of a fit: residuals over their noise, and how they change with what is
unknown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.gap import least_gap
from pbdkit.fitting.observation import Near, Observation, Seen
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.resting_field import FieldObservation
from pbdkit.stepping.state import Floats

WIDE = 10.0
"""Bounds in such a ratio have a middle that says nothing."""


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
    """The problem at z: the residuals (measured - predicted) / weighted noise of all observations,
    one after another, their derivatives (residual, unknown), and each observation by itself."""

    z: Floats
    residuals: Floats
    jacobian: Floats
    seen: tuple[Seen, ...]


@dataclass(frozen=True)
class Problem:
    """z is the parameters, then Young's modulus where an observation needs it, then what each
    observation has of its own."""

    unknowns: tuple[Unknown, ...]
    observations: tuple[Observation, ...]

    @cached_property
    def with_modulus(self) -> bool:
        """Whether Young's modulus is unknown too."""
        return any(o.needs_modulus for o in self.observations)

    @cached_property
    def shared(self) -> int:
        """How many unknowns are those of all observations."""
        return len(self.unknowns) + self.with_modulus

    @cached_property
    def size(self) -> int:
        """Of z."""
        return self.shared + sum(o.own for o in self.observations)

    def rows(self) -> Iterator[tuple[Observation, slice]]:
        """Each observation with its residuals among all."""
        first = 0
        for observation in self.observations:
            yield observation, slice(first, first := first + len(observation.measured))

    def owned(self) -> Iterator[tuple[Observation, slice]]:
        """Each observation with what it owns of z."""
        first = self.shared
        for observation in self.observations:
            yield observation, slice(first, first := first + observation.own)

    def start(self) -> Floats:
        """In the middle between bounds; where these are wide, with a field, where the gap to
        equilibrium is least. Boundaries are as they were measured."""
        z, count = np.zeros(self.size), len(self.unknowns)
        low, high = (bound[:count] for bound in self.bounds())
        z[:count] = (low + high) / 2.0
        fields = [o for o in self.observations if isinstance(o, FieldObservation)]
        wide = (low > 0.0) & (high > WIDE * low)
        if fields and wide.any():
            parameters = [u.parameter for u in self.unknowns]
            found = least_gap(fields[0], parameters, low, high)
            z[:count] = np.where(wide, found, z[:count])
        for observation, own in self.owned():
            z[own] = observation.start()
        return self.with_best_modulus(z)

    def with_best_modulus(self, z: Floats) -> Floats:
        """The same with the modulus that fits best there. Raises ExperimentError where the model
        exerts no force."""
        if not self.with_modulus:
            return z
        terms = [o.modulus_terms(self.experiment_at(o, z)) for o in self.observations]
        product, square = np.sum(terms, axis=0)
        if square == 0.0:
            raise ExperimentError("the group exerts no force in this experiment", ("measured",))
        if product < 0.0:
            raise ExperimentError(
                "what was measured of the force has the other sign than in this experiment; turn "
                "it, or name another `group` or `axis`",
                ("measured",),
            )
        z = z.copy()
        z[len(self.unknowns)] = product / square
        return z

    def bounds(self) -> tuple[Floats, Floats]:
        """Of parameters; the others have none."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        for n, unknown in enumerate(self.unknowns):
            low[n], high[n] = unknown.low, unknown.high
        return low, high

    def experiment_at(self, observation: Observation, z: Floats) -> Experiment:
        """The experiment of an observation with these parameters."""
        found = observation.experiment
        for unknown, value in zip(self.unknowns, z, strict=False):
            found = unknown.parameter.put(found, float(value))
        return found

    def at(self, z: Floats, near: At | None = None) -> At:
        """All of it, sooner with what was found `near` there. Raises ExperimentError, and
        UnconvergedError where nothing is predicted."""
        parameters = [u.parameter for u in self.unknowns]
        count = sum(len(o.measured) for o in self.observations)
        jacobian, seen, residuals = np.zeros((count, self.size)), [], np.zeros(count)
        modulus = float(z[len(parameters)]) if self.with_modulus else 1.0
        before = self._near(near, z) if near else [None] * len(self.observations)
        each = zip(self.rows(), self.owned(), before, strict=True)
        for (observation, rows), (_, own), seen_near in each:
            experiment = self.experiment_at(observation, z)
            found = observation.at(experiment, parameters, z[own], modulus, seen_near)
            seen.append(found)
            residuals[rows] = found.residuals
            jacobian[rows, : len(parameters)] = found.by_parameter
            jacobian[rows, own] = found.by_own
            if self.with_modulus:
                jacobian[rows, len(parameters)] = found.by_modulus
        return At(z, residuals, jacobian, tuple(seen))

    def residuals(self, z: Floats) -> Floats:
        """The residuals at z alone. Raises as `at` does."""
        return np.concatenate([self.residuals_of(n, o, z) for n, o in enumerate(self.observations)])

    def residuals_of(self, n: int, part: Observation, z: Floats) -> Floats:
        """Those of some rows of observation n."""
        own = z[[*self.owned()][n][1]]
        modulus = float(z[len(self.unknowns)]) if self.with_modulus else 1.0
        return part.at(self.experiment_at(part, z), (), own, modulus).residuals

    def _near(self, at: At, z: Floats) -> list[Near]:
        ways = [abs(z[n] - at.z[n]) / u.span for n, u in enumerate(self.unknowns)]
        return [Near(seen, float(max(ways, default=0.0))) for seen in at.seen]
