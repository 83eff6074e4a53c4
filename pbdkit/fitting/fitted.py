"""What a fit answers with: values and their errors, and how well the data are met."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pbdkit.fitting.evidence import FieldEvidence, ForceEvidence
from pbdkit.fitting.least_squares import Solution
from pbdkit.fitting.problem import Problem
from pbdkit.fitting.specification import Fit, Force
from pbdkit.stepping.state import Floats


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error. `told` is False where the data cannot tell it: then it says
    nothing. `on_bound`: it stands on a bound, beyond which it might fit better."""

    value: float
    error: float
    told: bool = True
    on_bound: bool = False

    def __str__(self) -> str:
        if not self.told:
            return "the data cannot tell it"
        digits = max(0, 1 - int(np.floor(np.log10(self.error)))) if self.error > 0.0 else 6
        text = f"{self.value:.{min(digits, 12)}f} ± {self.error:.{min(digits, 12)}f}"
        return text + (", on its bound" if self.on_bound else "")


@dataclass(frozen=True)
class FittedField:
    """At the points of the measurement, (point, axis): what was measured, without the distortion
    that was found, and what is left of it."""

    points: Floats
    measured: Floats
    residual: Floats


@dataclass(frozen=True)
class Fitted:
    """The answer of a fit.

    `values` by path, `correlations` (parameter, parameter), `youngs_modulus` where a force was
    given. Residuals are measured - fitted; `ratio` is how much larger they are than the noise,
    which standard errors take into account. `left_out` points lie outside of the body or in the
    margin. `solution` and `problem` have all else.
    """

    values: Mapping[str, Estimate]
    correlations: Floats
    youngs_modulus: Estimate | None
    noise: float
    ratio: float
    points: int
    left_out: int
    problem: Problem = field(repr=False)
    solution: Solution = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """All of it in plain values, as the JSON file holds it."""
        named = {path: _plain(estimate) for path, estimate in self.values.items()}
        modulus = self.youngs_modulus
        return {
            "values": named,
            "correlations": {
                one: {other: float(self.correlations[n, m]) for m, other in enumerate(named)}
                for n, one in enumerate(named)
            },
            "youngs_modulus": None if modulus is None else _plain(modulus),
            "noise": self.noise,
            "residual_over_noise": self.ratio,
            "points": self.points,
            "left_out": self.left_out,
            "evaluations": self.solution.evaluations,
        }

    def field(self) -> FittedField:
        """What was measured at each point, and what the fit leaves."""
        evidence = self._evidence
        strengths = self.solution.z[self.problem.size - self.problem.extra :]
        measured = evidence.measured - evidence.distortions @ strengths
        left = self.solution.at.residuals * evidence.noise
        return FittedField(
            evidence.points, measured.reshape(2, -1).T, np.asarray(left.reshape(2, -1).T)
        )

    def information(self) -> dict[str, Floats]:
        """By parameter, how much each point and axis tells of it, (point, axis): the square of what
        its derivative has that no other unknown can make up for."""
        jacobian, found = self.solution.at.jacobian, dict[str, Floats]()
        for n, path in enumerate(self.values):
            others, *_ = np.linalg.qr(np.delete(jacobian, n, axis=1))
            own = jacobian[:, n] - others @ (others.T @ jacobian[:, n])
            found[path] = np.asarray((own**2).reshape(2, -1).T)
        return found

    @property
    def _evidence(self) -> FieldEvidence:
        (found,) = self.problem.evidence
        assert isinstance(found, FieldEvidence)
        return found

    def lines(self) -> Iterator[str]:
        """What to tell first."""
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
        if self.youngs_modulus:
            yield f"Young's modulus: {self.youngs_modulus}"
        for n, one in enumerate(self.values):
            for m, other in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {one} and {other}: {self.correlations[n, m]:.2f}"
        yield (
            f"residual: {self.ratio:.2f} times the noise of {self.noise:.3g}, over {self.points} "
            f"points" + (f"; {self.left_out} were left out" if self.left_out else "")
        )


def _plain(estimate: Estimate) -> dict[str, Any]:
    if not estimate.told:
        return {"value": None, "error": None, "told": False}
    return {
        "value": estimate.value,
        "error": estimate.error,
        "told": True,
        "on_bound": estimate.on_bound,
    }


def fitted(fit: Fit, problem: Problem, solution: Solution, left_out: int, noise: float) -> Fitted:
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
    modulus = _modulus(fit.force, problem, solution) if fit.force else None
    points = sum(len(e.measured) for e in problem.evidence) // 2
    return Fitted(
        values, correlations, modulus, noise, solution.ratio, points, left_out, problem, solution
    )


def _modulus(force: Force, problem: Problem, solution: Solution) -> Estimate:
    """Force over thickness and what the group carries over Young's modulus, along the force."""
    way = np.array(force.value) / np.hypot(*force.value)
    evidence = ForceEvidence(force.group, np.zeros(2), 1.0)
    resting, count = solution.at.resting, len(problem.unknowns)
    carried = float(way @ evidence.predicted(resting))
    parameters = [*(u.parameter for u in problem.unknowns)]
    names = [*parameters, *[None] * (len(solution.at.changes) - count)]
    gradient = np.zeros(problem.size)
    for n, (du, parameter) in enumerate(zip(solution.at.changes, names, strict=True)):
        gradient[n] = way @ evidence.change(resting, du, parameter)
    told = [n for n, u in enumerate(problem.unknowns) if u.parameter.path not in solution.untold]
    known = [*told, *range(count, problem.size)]
    part = np.sqrt(gradient[known] @ solution.covariance[np.ix_(known, known)] @ gradient[known])
    size = float(np.hypot(*force.value))
    value = size / force.thickness / carried
    error = abs(value) * np.hypot(part / carried, force.noise / size)
    matters = any(abs(gradient[n]) > 1e-9 * abs(carried) for n in range(count) if n not in told)
    return Estimate(value, float(error), told=not matters)
