"""A number of an experiment that can be changed: by its path, as `--set` names it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import with_value
from pbdkit.plugin.fields import ByRegion, TakesFields

Floats = NDArray[np.floating[Any]]
ORDER_4 = (2 / 3, -1 / 12)
WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
"""Of central differences of order 8, over 1, 2, 3 and 4 steps to both sides (Fornberg); of order 4
over 1 and 2."""
STEP, FARTHER, LEAST = 2e-3, 1e-2, 1e-7
"""The step as a share of a value, or of 1 where that is smaller than a tenth; that of parts that
may decide who is there, which shows farther out; no smaller one is taken where a bound is near."""
SMOOTH, ROUGH = 1e-5, 1e-8
"""Where order 2 is off by this share of order 4, that is off by about its square; from what
accuracy on order 2 serves, by a step of a quarter of its root."""
PARTS = ("rule", "fracture")
"""What alone changes where one of their parameters does."""
ALONE = ("leaders", "loads")
"""What alone changes too, once the whole experiment is found valid."""


@dataclass(frozen=True)
class Parameter:
    """One number of an experiment, by a dotted path: `rule.poisson_ratio`, `loads.0.force.1`,
    `rule.stiffness.inclusion` of a field by region."""

    path: str

    def value_in(self, experiment: Experiment) -> float:
        """The number. Raises ExperimentError where there is none."""
        words = self.path.split(".")
        # Leaders may have thousands of numbers.
        found: Any = experiment.model_dump(
            mode="json", by_alias=True, exclude={"leaders"} - {*words}
        )
        for word in words:
            try:
                found = found[int(word) if isinstance(found, list) else word]
            except (KeyError, IndexError, ValueError, TypeError):
                hint = did_you_mean(word, found) if isinstance(found, dict) else ""
                raise ExperimentError(
                    f"'{self.path}' is no number of the experiment: there is no '{word}'{hint}"
                ) from None
        if isinstance(found, bool) or not isinstance(found, (int, float)):
            raise ExperimentError(f"'{self.path}' is no number of the experiment")
        return float(found)

    def put(self, experiment: Experiment, value: float) -> Experiment:
        """The experiment with another number there. Raises ExperimentError."""
        part, _, rest = self.path.partition(".")
        name, _, region = rest.partition(".")
        component = getattr(experiment, part) if part in PARTS else None
        if isinstance(component, TakesFields):
            field = component.varying.get(name)
            new: Any = None
            if not region and name in component.numbers():
                new = value
            elif region and isinstance(field, ByRegion):
                new = {**field.written(), region: value}
            if new is not None:
                changed = self._changed(component, name, new, value)
                return experiment.model_copy(update={part: changed})
        source = experiment.as_written()
        label = f"{self.path} = {value:.6g}"
        source = with_value(source, self.path, value, label, Experiment.defaults())
        found = Experiment.build(source, given_classes(experiment))
        alone = part in ALONE
        return experiment.model_copy(update={part: getattr(found, part)}) if alone else found

    def _changed(self, component: TakesFields, name: str, new: Any, value: float) -> Any:
        try:
            return component.with_more(**{name: new})
        except ValidationError as error:
            told = error.errors()[0]["msg"]
            raise ExperimentError(f"{self.path} = {value:.6g}: {told}") from None

    def derivative(
        self,
        experiment: Experiment,
        function: Callable[[Experiment], Any],
        accuracy: float = 0.0,
    ) -> Any:
        """d function / d parameter at an experiment, of an array: by central differences of order 4
        where these are exact to some 1e-10, else of order 8; of order 2 where an accuracy of some
        1e-7, as a share, is enough.

        Raises ExperimentError where the number stands on its bound.
        """
        value = self.value_in(experiment)
        part, _, _ = self.path.partition(".")
        among = part in (*PARTS, *ALONE)
        if among and accuracy >= ROUGH:
            step, ((above, below),) = self._ends(experiment, value, math.sqrt(accuracy) / 4.0, 1)
            return (function(above) - function(below)) / (2.0 * step)
        step, ends = self._ends(experiment, value, STEP if among else FARTHER, len(WEIGHTS))
        changes = [function(above) - function(below) for above, below in ends[: len(ORDER_4)]]
        found = sum(weight / step * change for weight, change in zip(ORDER_4, changes, strict=True))
        off = np.abs(found - changes[0] / (2.0 * step)).max(initial=0.0)
        if among and off <= SMOOTH * np.abs(found).max(initial=0.0):
            return found
        changes += [function(above) - function(below) for above, below in ends[len(ORDER_4) :]]
        return sum(weight / step * change for weight, change in zip(WEIGHTS, changes, strict=True))

    def _ends(
        self, experiment: Experiment, value: float, share: float, pairs: int
    ) -> tuple[float, list[tuple[Experiment, Experiment]]]:
        """The step, and the experiments with 1, 2, … more and fewer of it."""
        step = share * max(abs(value), 0.1)
        while True:
            try:
                return step, [
                    (self.put(experiment, value + n * step), self.put(experiment, value - n * step))
                    for n in range(1, 1 + pairs)
                ]
            except ExperimentError:
                step /= 10.0
                if step < LEAST * max(abs(value), 0.1):
                    raise ExperimentError(
                        f"{self.path}: {value:.6g} stands on its bound, so that it cannot be "
                        "changed both ways; take a number inside"
                    ) from None
