"""How much worse data are met where a parameter has another value: profile likelihoods.

For each value all else is fitted anew. By how much -2 log L rises over its least value then, is
below 3.84 within the interval that holds the true value in 95 of 100 cases (Wilks), however the
parameter bends the predictions. With a loss the rise is that of M-estimators: it counts over
mean ψ² / mean ψ'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.fitting.least_squares import Loss, Solution, cost_of, rise_of_loss, solved
from pbdkit.fitting.problem import Problem
from pbdkit.stepping.state import Floats

STEP, EVEN, MOST = 0.75, 4, 12
"""Values are so many standard errors apart, and after so many twice as far each time."""
WIDEST = 0.1
"""The largest first step, as a share of the way between bounds."""
STRAIGHT, REFINEMENTS = 1.5, 30
"""The root of the rise counts as straight over so much of it; the most values that are looked at
until it is."""
ENOUGH = 8.0
"""The rise after which no farther value is looked at."""
RISE = 3.841
"""The 95 % quantile of χ² with one degree of freedom."""


@dataclass(frozen=True)
class Profile:
    """Values of a parameter, (value,), and by how much -2 log L rises there, (value,), with the
    ends of the 95 % interval; None where data do not bound it within the bounds of the fit."""

    values: Floats
    rises: Floats
    low: float | None
    high: float | None

    def as_dict(self) -> dict[str, Any]:
        """In plain values."""
        return {
            "values": self.values.tolist(),
            "rises": self.rises.tolist(),
            "interval": [self.low, self.high],
        }

    def __str__(self) -> str:
        low, high = (f"{v:.6g}" if v is not None else "no bound" for v in (self.low, self.high))
        return f"95 % interval from {low} to {high}"


def profiled(problem: Problem, solution: Solution, n: int, loss: Loss) -> Profile:
    """The profile of parameter n: outward from the fit until it has risen enough, on both sides."""
    best = (float(solution.z[n]), 0.0)
    sides = [
        _refined(
            np.array([best, *_walk(problem, solution, n, way, loss)]), problem, solution, n, loss
        )
        for way in (-1.0, 1.0)
    ]
    low, high = (_crossing(*side.T) for side in sides)
    values, rises = np.concatenate([sides[0][:0:-1], sides[1]]).T
    return Profile(values, rises, low, high)


def _walk(
    problem: Problem, solution: Solution, n: int, way: float, loss: Loss
) -> Iterator[tuple[float, float]]:
    """Values one way, and the rise at each, as far as all else can be fitted."""
    low, high = _ends(problem.unknowns[n])
    value, z = float(solution.z[n]), solution.z
    step = min(STEP * float(solution.errors[n]), WIDEST * (high - low))
    unit, least = _unit(problem, solution, loss)
    for count in range(MOST):
        value = min(max(value + way * step, low), high)
        try:
            cost, z = _fitted_at(problem, n, value, z, loss)
        except UnconvergedError:
            return
        yield value, (cost - least) / unit
        if value in (low, high) or cost - least > ENOUGH * unit:
            return
        step *= 1.0 if count < EVEN else 2.0


def _refined(side: Floats, problem: Problem, solution: Solution, n: int, loss: Loss) -> Floats:
    """Values and rises going outward, (value, 2), with more of them where the rise comes to RISE:
    where it is flat at first, it is not straight there."""
    unit, least = _unit(problem, solution, loss)
    for _ in range(REFINEMENTS):
        roots = np.sqrt(np.maximum(side[:, 1], 0.0))
        beyond = np.flatnonzero(roots >= np.sqrt(RISE))
        if not beyond.size or (k := int(beyond[0])) == 0 or roots[k] - roots[k - 1] <= STRAIGHT:
            break
        value = float(side[k - 1 : k + 1, 0].mean())
        try:
            cost, _ = _fitted_at(problem, n, value, solution.z, loss)
        except UnconvergedError:
            break
        side = np.insert(side, k, (value, (cost - least) / unit), axis=0)
    return side


def _unit(problem: Problem, solution: Solution, loss: Loss) -> tuple[float, float]:
    """The rise of -2 log L that counts as 1, and its least value."""
    residuals = solution.at.residuals
    return rise_of_loss(residuals, problem.size, loss), cost_of(residuals, loss)


def _ends(unknown: Any) -> tuple[float, float]:
    """The bounds, and a little within them: derivatives look to both sides."""
    inset = 1e-9 * unknown.span
    return unknown.low + inset, unknown.high - inset


def _fitted_at(
    problem: Problem, n: int, value: float, start: Floats, loss: Loss
) -> tuple[float, Floats]:
    """The least cost with parameter n at a value, and the whole z there."""
    parameter = problem.unknowns[n].parameter
    observations = tuple(
        replace(o, experiment=parameter.put(o.experiment, value)) for o in problem.observations
    )
    others = Problem((*problem.unknowns[:n], *problem.unknowns[n + 1 :]), observations)
    rest = np.delete(start, n)
    if others.size:
        found = solved(others, rest, loss)
        at, rest = found.at, found.z
    else:
        at = others.at(rest)
    return cost_of(at.residuals, loss), np.insert(rest, n, value)


def _crossing(values: Floats, rises: Floats) -> float | None:
    """Where the rise, going outward, first comes to RISE: its root is nearly straight."""
    roots = np.sqrt(np.maximum(rises, 0.0))
    beyond = np.flatnonzero(roots >= np.sqrt(RISE))
    if not beyond.size or beyond[0] == 0:
        return None
    k = int(beyond[0])
    return float(np.interp(np.sqrt(RISE), roots[k - 1 : k + 1], values[k - 1 : k + 1]))
