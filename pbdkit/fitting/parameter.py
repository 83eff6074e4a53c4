"""Parameters of an experiment, addressed by a path as in `--set`, and derivatives with respect to
them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import with_value
from pbdkit.plugin.fields import ByRegion, TakesFields

ORDER_4 = (2 / 3, -1 / 12)
"""Weights of central differences of order 4, at distances of 1 and 2 steps (Fornberg)."""
WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
"""Weights of central differences of order 8, at distances of 1 to 4 steps (Fornberg)."""
STEP = 2e-3
"""Step of differences as a fraction of the value. For values below 0.1 it is a fraction of 0.1."""

LARGE_STEP = 1e-2
"""Step of differences for parts of the experiment that can change which particles exist.

Errors of the prediction are larger for these parts.
"""

SECANT_STEP = 2.5e-3
"""Step of differences, as a fraction of the value, of predictions that jump to other branches."""

BRANCH = 0.5
"""Difference between the quotients in both directions, over the smaller one, above which the
function follows another branch in the direction of the larger one."""

MIN_STEP = 1e-7
"""Smallest step as a fraction of the value, used near a bound."""
SMOOTH = 1e-5
"""Relative difference of the results of orders 2 and 4 up to which order 4 is sufficient.

The relative error of order 4 is then about the square of this number.
"""

ROUGH = 1e-8
"""Smallest required relative accuracy for which order 2 is used.

The step is then a quarter of the square root of the accuracy.
"""
PARTS = ("rule", "fracture")
"""Parts of an experiment that are replaced without any other change."""
SEPARATE_PARTS = ("leaders", "loads")
"""Parts that, after the experiment has been validated, are replaced without any other change."""


@dataclass(frozen=True)
class Parameter:
    """A parameter that is a single number in an experiment.

    Parameters
    ----------
    path
        Dotted path, for example `rule.poisson_ratio` or `loads.0.force.1`.
        `rule.stiffness.inclusion` is the value of a parameter that varies by region, in the region
        `inclusion`.
    """

    path: str

    def value_in(self, experiment: Experiment) -> float:
        """Return the value of the parameter.

        Raises
        ------
        ExperimentError
            If there is no number at the path.
        """
        words = self._names(experiment)
        # Leader groups may have thousands of values, which are converted only if necessary.
        value: Any = experiment.model_dump(
            mode="json", by_alias=True, exclude={"leaders"} - {*words}
        )
        for word in words:
            try:
                value = value[int(word) if isinstance(value, list) else word]
            except (KeyError, IndexError, ValueError, TypeError):
                hint = did_you_mean(word, value) if isinstance(value, dict) else ""
                raise ExperimentError(
                    f"'{self.path}' is not a number of the experiment: there is no '{word}'{hint}"
                ) from None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ExperimentError(f"'{self.path}' is not a number of the experiment")
        return float(value)

    def put(self, experiment: Experiment, value: float) -> Experiment:
        """Return the experiment with another value of the parameter.

        Raises
        ------
        ExperimentError
            If the value is invalid.
        """
        part, *rest = self._names(experiment)
        name, region = rest[0] if rest else "", ".".join(rest[1:])
        component = getattr(experiment, part) if part in PARTS else None
        if isinstance(component, TakesFields):
            field = component.varying.get(name)
            field_value: Any = None
            if not region and name in component.numbers():
                field_value = value
            elif region and isinstance(field, ByRegion):
                field_value = {**field.written(), region: value}
            if field_value is not None:
                changed = self._changed(component, name, field_value, value)
                return experiment.model_copy(update={part: changed})
        changed_experiment = self._rebuilt(experiment, value, f"{self.path} = {value:.6g}")
        is_separate = part in (*PARTS, *SEPARATE_PARTS)
        return (
            experiment.model_copy(update={part: getattr(changed_experiment, part)})
            if is_separate
            else changed_experiment
        )

    def number(self, experiment: Experiment, text: str) -> float:
        """Return the number in the experiment that a text with a unit stands for.

        Raises
        ------
        ExperimentError
            If the text is not a valid value of the parameter.
        """
        label = f"{self.path} = {text}"
        try:
            return self.value_in(self._rebuilt(experiment, text, label))
        except ExperimentError as error:
            fault = str(error).removeprefix(f"{label}: ").removeprefix(f"{self.path}: ")
            raise ExperimentError(fault, error.where) from None

    def _rebuilt(self, experiment: Experiment, value: float | str, label: str) -> Experiment:
        """Return the experiment, built from its source with another value."""
        words, source = self._names(experiment), experiment.as_written()
        if names := _other_names(experiment, words[0]):
            part = {names.get(name, name): entry for name, entry in source.data[words[0]].items()}
            source = replace(source, data={**source.data, words[0]: part})
        source = with_value(source, ".".join(words), value, label, Experiment.defaults())
        return Experiment.build(source, given_classes(experiment))

    def _names(self, experiment: Experiment) -> list[str]:
        """Return the parts of the path, in which another name of a parameter is replaced."""
        words = self.path.split(".")
        if len(words) > 1:
            words[1] = _other_names(experiment, words[0]).get(words[1], words[1])
        return words

    def _changed(self, component: TakesFields, name: str, field_value: Any, value: float) -> Any:
        try:
            return component.with_more(**{name: field_value})
        except ValidationError as error:
            text = error.errors()[0]["msg"]
            raise ExperimentError(f"{self.path} = {value:.6g}: {text}") from None

    def derivative(
        self,
        experiment: Experiment,
        function: Callable[[Experiment], Any],
        accuracy: float = 0.0,
    ) -> Any:
        """Differentiate a function with respect to the parameter, by central differences.

        Parameters
        ----------
        experiment
            Experiment at which the derivative is taken.
        function
            Function that returns an array, given an experiment.
        accuracy
            Required relative accuracy.

        Notes
        -----
        Order 2 is used if an accuracy of about 1e-7 suffices. Otherwise order 4 is used if its
        error is at most about 1e-10, and else order 8.

        Raises
        ------
        ExperimentError
            If the number is at a bound.
        """
        value = self.value_in(experiment)
        part, _, _ = self.path.partition(".")
        is_separate = part in (*PARTS, *SEPARATE_PARTS)
        if is_separate and accuracy >= ROUGH:
            step, ((above, below),) = self._ends(experiment, value, math.sqrt(accuracy) / 4.0, 1)
            return (function(above) - function(below)) / (2.0 * step)
        step, ends = self._ends(
            experiment, value, STEP if is_separate else LARGE_STEP, len(WEIGHTS)
        )
        changes = [function(above) - function(below) for above, below in ends[: len(ORDER_4)]]
        result = sum(
            weight / step * change for weight, change in zip(ORDER_4, changes, strict=True)
        )
        error = np.abs(result - changes[0] / (2.0 * step)).max(initial=0.0)
        if is_separate and error <= SMOOTH * np.abs(result).max(initial=0.0):
            return result
        changes += [function(above) - function(below) for above, below in ends[len(ORDER_4) :]]
        return sum(weight / step * change for weight, change in zip(WEIGHTS, changes, strict=True))

    def difference(self, experiment: Experiment, function: Callable[[Experiment], Any]) -> Any:
        """Return the quotient of differences of a function that jumps to other branches.

        The parameter is changed by a fraction of its value in both directions, or in one of them if
        there is no value in the other one. If both quotients differ, the function has followed
        another branch in the direction of the larger one, and the smaller one is used.

        Parameters
        ----------
        experiment
            Experiment at which the quotient is taken.
        function
            Function that returns an array, given an experiment.

        Raises
        ------
        UnconvergedError
            If the function has no value at the experiment, or none in both directions.
        """
        value, centre = self.value_in(experiment), function(experiment)
        step, changes = SECANT_STEP * (abs(value) or 1.0), []
        for signed in (step, -step):
            with suppress(ExperimentError, UnconvergedError):
                end = function(self.put(experiment, value + signed))
                changes.append((end - centre) / signed)
        if not changes:
            raise UnconvergedError(f"there is no prediction for {self.path} near {value:g}")
        changes.sort(key=lambda change: float(np.linalg.norm(change)))
        first, last = changes[0], changes[-1]
        is_branch = np.linalg.norm(last - first) > BRANCH * np.linalg.norm(first) > 0.0
        return first if is_branch else (first + last) / 2.0

    def _ends(
        self, experiment: Experiment, value: float, fraction: float, pairs: int
    ) -> tuple[float, list[tuple[Experiment, Experiment]]]:
        """Return the step of the differences, and pairs of experiments in which the parameter is
        larger and smaller by 1, 2, … steps."""
        step = fraction * max(abs(value), 0.1)
        while True:
            try:
                return step, [
                    (self.put(experiment, value + n * step), self.put(experiment, value - n * step))
                    for n in range(1, 1 + pairs)
                ]
            except ExperimentError:
                step /= 10.0
                if step < MIN_STEP * max(abs(value), 0.1):
                    raise ExperimentError(
                        f"{self.path}: {value:.6g} is at its bound, so that it cannot be changed "
                        "in both directions; choose a number inside the bounds"
                    ) from None


def _other_names(experiment: Experiment, part: str) -> Mapping[str, str]:
    """Return the names of the parameters of a part by their other names."""
    component = getattr(experiment, part, None)
    names: Mapping[str, str] = getattr(component, "other_names", {})
    return names
