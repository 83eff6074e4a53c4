"""A value with its error, and Young's modulus, which follows from forces."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.fitting.evidence import Carried
from pbdkit.fitting.least_squares import TELLS, Solution
from pbdkit.fitting.problem import Problem
from pbdkit.fitting.resting_field import FieldSeen
from pbdkit.fitting.specification import Force
from pbdkit.interfaces.units import STRESS


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error. `told` is False where the data cannot tell it: then it says
    nothing. `on_bound`: it stands on a bound, beyond which it might fit better. `unit` is that of
    both, empty where the experiment has no units."""

    value: float
    error: float
    told: bool = True
    on_bound: bool = False
    unit: str = ""

    def __str__(self) -> str:
        if not self.told:
            return "the data cannot tell it"
        digits = max(0, 1 - int(np.floor(np.log10(self.error)))) if self.error > 0.0 else 6
        text = f"{self.value:.{min(digits, 12)}f} ± {self.error:.{min(digits, 12)}f}"
        return text + f" {self.unit}" * bool(self.unit) + ", on its bound" * self.on_bound

    def as_dict(self) -> dict[str, Any]:
        """In plain values; none of what the data cannot tell."""
        return asdict(self) if self.told else {"value": None, "error": None, "told": False}


def youngs_modulus(force: Force | None, problem: Problem, solution: Solution) -> Estimate | None:
    """What curves tell of it, else what follows from a force; None where there is neither. In MPa
    where the experiment has units."""
    count, units = len(problem.unknowns), problem.observations[0].experiment.units
    unit = STRESS.unit if units else ""
    if problem.with_modulus:
        value, error = float(solution.z[count]), float(solution.errors[count])
        return Estimate(value, error, told=error < TELLS * abs(value), unit=unit)
    if force is None:
        return None
    found, size = _of_force(force, problem, solution), units.length_mm if units else 1.0
    return replace(found, value=found.value / size, error=found.error / size, unit=unit)


def _of_force(force: Force, problem: Problem, solution: Solution) -> Estimate:
    """Force over thickness and what the group carries over Young's modulus, along the force."""
    way = np.array(force.value) / np.hypot(*force.value)
    count, seen = len(problem.unknowns), solution.at.seen[0]
    assert isinstance(seen, FieldSeen)
    carried = Carried(seen.resting, force.group)
    unit, gradient = float(way @ carried.predicted), np.zeros(problem.size)
    for n, (du, unknown) in enumerate(zip(seen.changes, problem.unknowns, strict=True)):
        gradient[n] = way @ carried.change(du, unknown.parameter)
    carried = Carried(seen.answering, force.group)  # answers in balance with this state alone
    for n, du in enumerate(seen.answers, start=count):
        gradient[n] = way @ carried.change(du)
    untold = [n for n, u in enumerate(problem.unknowns) if u.parameter.path in solution.untold]
    matters = (np.abs(gradient[untold]) > 1e-9 * abs(unit)).any()
    gradient[untold] = 0.0
    part = solution.directions.error_of(gradient)
    if unit <= 0.0:
        raise ExperimentError(
            f"group {force.group} carries no force that way in this experiment, rather one the "
            "other way; turn its sign, or look for it at another group",
            ("force", "value"),
        )
    size = float(np.hypot(*force.value))
    value = size / force.thickness / unit
    error = abs(value) * np.hypot(part / unit, force.noise / size)
    return Estimate(value, float(error), told=not matters)
