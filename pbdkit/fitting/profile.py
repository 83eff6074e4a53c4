"""How much worse data are met where a parameter has another value: profile likelihoods.

For each value all else is fitted anew. By how much -2 log L rises over its least value then, is
below 3.84 within the interval that holds the true value in 95 of 100 cases (Wilks), however the
parameter bends the predictions. With a loss the rise is that of M-estimators: it counts over
mean ψ² / mean ψ'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.fitting.least_squares import Loss, Solution, cost_of, rise_of_loss, solved
from pbdkit.fitting.problem import Problem
from pbdkit.stepping.state import Floats

REACH, POINTS = 3.0, 9
"""How many standard errors to both sides are looked at, and at how many values."""
RISE = 3.841
"""The 95 % quantile of χ² with one degree of freedom."""


@dataclass(frozen=True)
class Profile:
    """Values of a parameter, (value,), and by how much -2 log L rises there, (value,), with the
    ends of the 95 % interval; None where data do not bound it within the bounds of the fit, and
    within REACH standard errors."""

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
    """The profile of parameter n. Raises UnconvergedError."""
    unknown, best = problem.unknowns[n], float(solution.z[n])
    reach = min(REACH * float(solution.errors[n]), unknown.span)
    values = np.unique(np.clip(np.linspace(best - reach, best + reach, POINTS), *_ends(unknown)))
    residuals = solution.at.residuals
    least, unit = cost_of(residuals, loss), rise_of_loss(residuals, problem.size, loss)
    rises, z = np.zeros(len(values)), {True: solution.z, False: solution.z}
    for k in sorted(range(len(values)), key=lambda k: abs(values[k] - best)):
        side = bool(values[k] > best)
        cost, z[side] = _fitted_at(problem, n, float(values[k]), z[side], loss)
        rises[k] = (cost - least) / unit
    above, below = values >= best, values <= best
    high = _crossing(values[above], rises[above])
    low = _crossing(values[below][::-1], rises[below][::-1])
    return Profile(values, rises, low, high)


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
