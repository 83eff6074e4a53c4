"""A number of an experiment that can be changed: by its path, as `--set` names it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.errors import ExperimentError
from pbdkit.experiment.given import given_classes
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_value
from pbdkit.experiment.source import Source
from pbdkit.interfaces.fields import TakesFields

Floats = NDArray[np.floating[Any]]
WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
"""Of central differences of order 8, over 1, 2, 3 and 4 steps to both sides (Fornberg)."""
STEP, LEAST = 1e-2, 1e-7
"""The step as a share of a value, or of 1 where that is smaller than a tenth; no smaller one is
taken where a bound is near."""
PARTS = ("rule", "fracture")
"""What alone changes where one of their parameters does."""


@dataclass(frozen=True)
class Parameter:
    """One number of an experiment, by a dotted path: `rule.poisson_ratio`, `loads.0.force.1`,
    `rule.stiffness.inclusion` of a field by region."""

    path: str

    def value_in(self, experiment: Experiment) -> float:
        """The number. Raises ExperimentError where there is none."""
        found: Any = experiment.model_dump(mode="json", by_alias=True)
        for word in self.path.split("."):
            try:
                found = found[int(word) if isinstance(found, list) else word]
            except (KeyError, IndexError, ValueError, TypeError):
                raise ExperimentError(
                    f"'{self.path}' is no number of the experiment: there is no '{word}'"
                ) from None
        if isinstance(found, bool) or not isinstance(found, (int, float)):
            raise ExperimentError(f"'{self.path}' is no number of the experiment")
        return float(found)

    def put(self, experiment: Experiment, value: float) -> Experiment:
        """The experiment with another number there. Raises ExperimentError."""
        part, _, rest = self.path.partition(".")
        name, _, region = rest.partition(".")
        if part in PARTS and isinstance(getattr(experiment, part), TakesFields):
            component = getattr(experiment, part)
            field = component.varying.get(name)
            new = {**field.written(), region: value} if region and field else value
            try:
                changed = component.with_more(**{name: new})
            except ValidationError as error:
                raise ExperimentError(
                    f"{self.path} = {value:.6g}: {error.errors()[0]['msg']}"
                ) from None
            return experiment.model_copy(update={part: changed})
        source = Source(experiment.name, experiment.as_written())
        label = f"{self.path} = {value:.6g}"
        source = with_value(source, self.path, value, label, Experiment.defaults())
        return Experiment.build(source, given_classes(experiment))

    def derivative(self, experiment: Experiment, function: Callable[[Experiment], Any]) -> Any:
        """d function / d parameter at an experiment, of what can be added and multiplied: by
        central differences of order 8, exact to some 1e-12 for what is smooth.

        Raises ExperimentError where the number stands on its bound.
        """
        value = self.value_in(experiment)
        step = STEP * max(abs(value), 0.1)
        while True:
            try:
                ends = [
                    (self.put(experiment, value + n * step), self.put(experiment, value - n * step))
                    for n in range(1, 1 + len(WEIGHTS))
                ]
                break
            except ExperimentError:
                step /= 10.0
                if step < LEAST * max(abs(value), 0.1):
                    raise ExperimentError(
                        f"{self.path}: {value:.6g} stands on its bound, so that it cannot be "
                        "changed both ways; take a number inside"
                    ) from None
        total: Any = 0.0
        for weight, (above, below) in zip(WEIGHTS, ends, strict=True):
            total = total + (weight / step) * (function(above) - function(below))
        return total
