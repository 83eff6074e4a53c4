"""What a fit answers with: values and their errors, and how well the data are met."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pbdkit.fitting.observations import (
    CurveObservation,
    FieldObservation,
    Observation,
    TracksObservation,
)
from pbdkit.fitting.problem import MODULUS, Loss, Problem, Solution, spread_of
from pbdkit.fitting.specification import Fit
from pbdkit.fitting.uncertainty import (
    Candidate,
    Combination,
    Estimate,
    Profile,
    Sample,
    combinations,
    youngs_modulus,
)
from pbdkit.plugin.units import FORCE, LENGTH
from pbdkit.stepping.state import Floats


@dataclass(frozen=True)
class FittedField:
    """At the points of the measurement, (point, axis): what was measured, without the distortion
    that was found, and what is left of it."""

    points: Floats
    measured: Floats
    residual: Floats


@dataclass(frozen=True)
class FittedNumbers:
    """Numbers along a time or displacement, (number,), as they were measured, fitted, and what is
    left; what they are, and what they go over. `joined` where they are one curve."""

    along: Floats
    measured: Floats
    fitted: Floats
    residual: Floats
    what: str
    over: str
    joined: bool


@dataclass(frozen=True)
class Met:
    """How well one measurement is met: its kind, the noise of its numbers, how much larger its
    residuals are, how many numbers count, and how many rows are left out for which reason. The
    noise times `factor` is in `unit`, where the experiment has units."""

    kind: str
    noise: float
    ratio: float
    numbers: int
    left_out: int
    left_out_because: str = ""
    factor: float = 1.0
    unit: str = ""

    def __str__(self) -> str:
        noise = f"{self.factor * self.noise:.3g} {self.unit}".rstrip()
        text = (
            f"residual of the {self.kind}: {self.ratio:.2f} times the noise of {noise}, over "
            f"{self.numbers} numbers"
        )
        if not self.left_out:
            return text
        return f"{text}; {self.left_out} rows are left out: {self.left_out_because}"


@dataclass(frozen=True)
class Fitted:
    """The answer of a fit.

    `values` by path, `correlations` (parameter, parameter), `youngs_modulus` where a force was
    given; `combinations` of parameters that are not told one by one, those that are told and those
    that are not. Residuals are measured - fitted; `ratio` is the standard deviation of all of them
    over the noise, and `met` says so of each measurement: whatever its weight. Standard errors are
    larger where residuals are larger than the noise over the root of the weight. `profiles` by
    path, `sample` and `candidates`, the best first, where they were asked for. `solution` and
    `problem` have all else.
    """

    values: Mapping[str, Estimate]
    correlations: Floats
    youngs_modulus: Estimate | None
    met: tuple[Met, ...]
    ratio: float
    problem: Problem = field(repr=False)
    solution: Solution = field(repr=False)
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    combinations: tuple[Combination, ...] = ()
    sample: Sample | None = field(default=None, repr=False)
    candidates: tuple[Candidate, ...] = ()

    @property
    def noise(self) -> float:
        """Of the first measurement."""
        return self.met[0].noise

    def as_dict(self) -> dict[str, Any]:
        """All of it in plain values, as the JSON file holds it."""
        named = {path: estimate.as_dict() for path, estimate in self.values.items()}
        modulus = self.youngs_modulus
        return {
            "values": named,
            "correlations": {
                one: {other: float(self.correlations[n, m]) for m, other in enumerate(named)}
                for n, one in enumerate(named)
            },
            "combinations": {each.name: each.as_dict() for each in self.combinations},
            "youngs_modulus": None if modulus is None else modulus.as_dict(),
            "residual_over_noise": self.ratio,
            "measured": [asdict(met) for met in self.met],
            "evaluations": self.solution.evaluations,
        } | self._on_request()

    def _on_request(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if self.profiles:
            found["profiles"] = {path: each.as_dict() for path, each in self.profiles.items()}
        if self.sample:
            words = ("mean", "deviation", "error")
            found["sample"] = {
                path: dict(zip(words, numbers, strict=True))
                for path, *numbers in zip(*self._sampled, strict=True)
            }
        if self.candidates:
            found["candidates"] = [asdict(each) for each in self.candidates]
        return found

    @property
    def _sampled(self) -> tuple[list[Any], ...]:
        assert self.sample is not None
        numbers = (self.sample.mean, self.sample.deviation, self.sample.error)
        return [*self.values], *(each.tolist() for each in numbers)

    def field(self, n: int = 0) -> FittedField:
        """What was measured at each point of measurement n, a field, and what the fit leaves.
        Raises ValueError for another kind."""
        observation, rows = [*self.problem.rows()][n]
        if not isinstance(observation, FieldObservation):
            raise ValueError(f"measurement {n} is no field: {observation.kind}")
        own = self.solution.z[[*self.problem.owned()][n][1]]
        evidence = observation.evidence
        strengths = own[len(own) - evidence.distortions.shape[1] :]
        measured = evidence.measured - evidence.distortions @ strengths
        left = self.solution.at.residuals[rows] * observation.weighted_noise
        return FittedField(
            evidence.points, measured.reshape(2, -1).T, np.asarray(left.reshape(2, -1).T)
        )

    def distortions(self, n: int = 0) -> dict[str, Estimate]:
        """How much of each distortion field n shows, by what it is in proportion to, "ux x^2 y^0",
        with x and y from -1 to 1 over the points."""
        observation, own = [*self.problem.owned()][n]
        if not isinstance(observation, FieldObservation):
            return {}
        terms = observation.evidence.terms
        names = [
            f"{u} x^{p} y^{q}" for u, of in zip(("ux", "uy"), terms, strict=True) for p, q in of
        ]
        z, errors = self.solution.z[own], self.solution.errors[own]
        pairs = zip(z[len(z) - len(names) :], errors[len(z) - len(names) :], strict=True)
        return {
            name: Estimate(float(v), float(e)) for name, (v, e) in zip(names, pairs, strict=True)
        }

    def numbers(self, n: int = 0) -> FittedNumbers:
        """What was measured in tracks or a curve n, and what the fit leaves. Raises ValueError for
        a field."""
        observation, rows = [*self.problem.rows()][n]
        if not isinstance(observation, TracksObservation | CurveObservation):
            raise ValueError(f"measurement {n} is a {observation.kind}")
        measured = observation.measured * observation.unit
        left = self.solution.at.residuals[rows] * observation.weighted_noise * observation.unit
        along = np.tile(observation.along, len(measured) // len(observation.along))
        what, over, joined = observation.names
        return FittedNumbers(along, measured, measured - left, left, what, over, joined)

    def information(self, n: int = 0) -> dict[str, Floats]:
        """By parameter, how much each number of measurement n tells of it, (number,): the square of
        what its derivative has that no other unknown can make up for."""
        jacobian, found = self.solution.at.jacobian, dict[str, Floats]()
        _, rows = [*self.problem.rows()][n]
        for column, path in enumerate(self.values):
            others, *_ = np.linalg.qr(np.delete(jacobian, column, axis=1))
            own = jacobian[:, column] - others @ (others.T @ jacobian[:, column])
            found[path] = np.asarray(own[rows] ** 2)
        return found

    def lines(self) -> Iterator[str]:
        """What to tell first."""
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
        if self.youngs_modulus:
            yield f"{MODULUS}: {self.youngs_modulus}"
        yield from map(str, self.combinations)
        for n, one in enumerate(self.values):
            for m, other in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {one} and {other}: {self.correlations[n, m]:.2f}"
        yield from map(str, self.met)
        for path, profile in self.profiles.items():
            yield f"{path}: {profile}, by its profile"
        if self.sample:
            numbers = zip(*self._sampled, strict=True)
            for path, mean, deviation, error in numbers:
                yield f"{path}: {Estimate(mean, deviation)}, by the sampler, to ± {error:.1g}"
        yield from map(str, self.candidates)


def fitted(fit: Fit, problem: Problem, solution: Solution) -> Fitted:
    """The answer in words of the fit file."""
    count = len(problem.unknowns)
    errors = solution.errors[:count]
    values = {
        unknown.parameter.path: Estimate(
            float(value),
            float(error),
            unknown.parameter.path not in solution.untold,
            unknown.parameter.path in solution.on_bounds,
        )
        for unknown, value, error in zip(problem.unknowns, solution.z, errors, strict=False)
    }
    covariance = solution.covariance[:count, :count]
    correlations = covariance / np.outer(errors, errors)
    left = solution.at.residuals.copy()
    for observation, rows in problem.rows():
        left[rows] /= np.sqrt(observation.weight)
    met = tuple(_met(each, left[rows], fit.loss) for each, rows in problem.rows())
    ratio = spread_of(left, problem.size, fit.loss)
    modulus = youngs_modulus(fit.force, problem, solution)
    several = combinations(problem, solution)
    return Fitted(
        values, correlations, modulus, met, ratio, problem, solution, combinations=several
    )


def _met(observation: Observation, residuals: Floats, loss: Loss) -> Met:
    """How well an observation is met, by its residuals over the noise."""
    return Met(
        observation.kind,
        observation.noise * observation.unit,
        spread_of(residuals, 0, loss),
        len(residuals),
        observation.left_out,
        observation.left_out_because,
        *unit_of(observation),
    )


def unit_of(observation: Observation) -> tuple[float, str]:
    """By what the numbers of an observation are multiplied to be in its experiment's units, and
    these: forces are given in N, lengths in lattice units; 1 and nothing without units."""
    units = observation.experiment.units
    if units is None:
        return 1.0, ""
    is_force = isinstance(observation, CurveObservation)
    return (1.0, FORCE.unit) if is_force else (units.length_mm, LENGTH.unit)
