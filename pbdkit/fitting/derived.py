"""Quantities derived from a fit, with standard errors.

A derived quantity is a formula f of the unknowns z: of parameters, of Young's modulus, and of
diagnostics of the fitted equilibrium. Its standard error is that of the linearised formula (delta
method), var f = g · C g, with the gradient g of f and the covariance C of all unknowns, the
displacements of measured boundaries included. Displacements depend linearly on these unknowns, or
nearly so, and the derivatives ∂u/∂z are those of the fit, along which quantities are differentiated
by differences.

A diagnostic can have an error that does not depend on the data. If it has the variables `NAME` and
`NAME_error`, the square of the latter is added to the variance of the former.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import spacing_of
from pbdkit.errors import AccuracyWarning, ExperimentError, did_you_mean
from pbdkit.fitting.fit_file import Fit, Force
from pbdkit.fitting.formula import Formula
from pbdkit.fitting.observations import DERIVATIVES, FieldObservation, FieldPrediction
from pbdkit.fitting.problem import IDENTIFIABLE_RATIO, Problem, Solution
from pbdkit.fitting.sensitivity import RestingScene, scene_like
from pbdkit.fitting.uncertainty import Estimate, errors_of, reaction_along
from pbdkit.io.layout import diagnostics_that_provide
from pbdkit.io.physical import Physical
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import Diagnostic, Moment
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.units import QUANTITIES, STRESS
from pbdkit.scene.scene import Scene

YOUNG = "youngs_modulus"
"""Name of the fitted Young's modulus in formulas."""
ERROR = "_error"
"""Ending of the name of a variable that is the error of another one."""
MAX_VALUES = 64
"""Maximum number of values of one derived quantity."""
LARGEST_CHANGE = 2e-3
"""Largest displacement in a difference, in spacings of particles."""
SMALL_CHANGE = 1e-3
"""Change of an unknown in a difference, in standard errors. Errors of one-sided differences are
then far below those of the data."""
COMPLEX_STEP = 1e-30
"""Imaginary step with which formulas are differentiated, relative to the size of the value."""
UNDETERMINED = 1e-6
"""Relative change along a direction that the data do not determine, above which a quantity is not
identifiable."""


@dataclass(frozen=True)
class Derived:
    """A quantity derived from a fit.

    Parameters
    ----------
    estimate : Estimate
        Value and standard error. NaN if the quantity is not defined, for instance where a crack tip
        is too close to an edge.
    of_data : float
        Standard error due to the noise of the measurements.
    of_diagnostic : float
        Error of the diagnostics, which does not depend on the noise.
    """

    estimate: Estimate
    of_data: float
    of_diagnostic: float

    def __str__(self) -> str:
        if np.isnan(self.estimate.value):
            return "not defined"
        return str(self.estimate)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values; None if the quantity is not identifiable or not defined."""
        if not self.estimate.identifiable or np.isnan(self.estimate.value):
            return {"value": None, "error": None, "identifiable": self.estimate.identifiable}
        parts = {"error_of_data": self.of_data, "error_of_diagnostic": self.of_diagnostic}
        return self.estimate.as_dict() | parts


@dataclass(frozen=True)
class Quantity:
    """Values of a named quantity as functions of the unknowns, to first order.

    Parameters
    ----------
    value : array of float, shape (...)
        Values at the fit.
    gradient : array of float, shape (..., unknown)
        Derivatives.
    error : array of float, shape (...)
        Errors that do not depend on the measurements of the fit.
    unit : str
        Unit; empty if the experiment has no units.
    """

    value: Floats
    gradient: Floats
    error: Floats
    unit: str = ""


def derive(fit: Fit, problem: Problem, solution: Solution) -> dict[str, Derived]:
    """Return the derived quantities of a fit, by their formulas.

    The formula of a quantity with several values has the index of each.

    Raises
    ------
    ExperimentError
        If a formula cannot be evaluated.
    """
    formulas = [Formula(text) for text in fit.derived]
    quantities = _quantities(formulas, fit.measured_force, problem, solution)
    result: dict[str, Derived] = {}
    for n, formula in enumerate(formulas):
        try:
            total = _of_formula(formula, quantities)
        except ValueError as error:
            raise ExperimentError(str(error), ("derived", n)) from None
        if total.value.size > MAX_VALUES:
            raise ExperimentError(
                f"'{formula.text}' has {total.value.size} values, and at most {MAX_VALUES} are "
                "derived; select some by an index in brackets",
                ("derived", n),
            )
        for index in np.ndindex(total.value.shape):
            name = formula.indexed(index) if total.value.size > 1 else formula.text
            result[name] = _with_error(
                problem, solution, float(total.value[index]), total.gradient[index],
                float(total.error[index]), total.unit,
            )  # fmt: skip
    return result


def _with_error(
    problem: Problem, solution: Solution, value: float, gradient: Floats, error: float, unit: str
) -> Derived:
    directions = solution.directions
    if not np.isfinite([value, *gradient]).all():
        return Derived(Estimate(np.nan, np.nan, unit=unit), np.nan, np.nan)
    of_data, independent = errors_of(gradient, problem, solution)
    along = directions.vectors[directions.is_null] @ (gradient * directions.scale)
    is_identifiable = bool((np.abs(along) <= UNDETERMINED * abs(value)).all())
    # The bounds of parameters that the data do not determine can be narrow enough.
    is_bounded = bool(solution.unidentified) and of_data < IDENTIFIABLE_RATIO * abs(value)
    total, of_independent = np.hypot(of_data, error), np.hypot(independent, error)
    growth = float(total / of_independent) if of_independent > 0.0 else 1.0
    estimate = Estimate(
        value, float(total), is_identifiable or is_bounded, unit=unit, growth=growth
    )
    return Derived(estimate, of_data, error)


def _of_formula(formula: Formula, quantities: Mapping[str, Quantity]) -> Quantity:
    """Return the quantity of a formula."""
    values: dict[str, NDArray[Any]] = {name: quantities[name].value for name in formula.names}
    value = formula.value(values)
    size = quantities[formula.names[0]].gradient.shape[-1]
    gradient, variance = np.zeros((*value.shape, size)), np.zeros(value.shape)
    for name in formula.names:
        quantity = quantities[name]
        for index in np.ndindex(quantity.value.shape):
            step = COMPLEX_STEP * max(abs(float(quantity.value[index])), 1e-100)
            moved = np.array(quantity.value, complex)
            moved[index] += 1j * step
            slope = formula.value(values | {name: moved}).imag / step
            gradient += slope[..., None] * np.where(
                slope[..., None] == 0.0, 0.0, quantity.gradient[index]
            )
            variance += np.square(np.where(slope == 0.0, 0.0, slope * quantity.error[index]))
    unit = quantities[formula.names[0]].unit if formula.is_name else ""
    return Quantity(value, gradient, np.sqrt(variance), unit)


def _quantities(
    formulas: Sequence[Formula], force: Force | None, problem: Problem, solution: Solution
) -> dict[str, Quantity]:
    """Return the named quantities of formulas."""
    names = {name for formula in formulas for name in formula.names}
    result = {}
    for n, unknown in enumerate(problem.unknowns):
        row = np.eye(problem.size)[n]
        value = np.asarray(solution.z[n])
        result[unknown.parameter.path] = Quantity(value, row, np.zeros(()), unknown.unit)
    if YOUNG in names:
        result[YOUNG] = _modulus(force, problem, solution)
    if names <= {*result}:
        return result
    prediction = solution.at.predictions[0]
    assert isinstance(prediction, FieldPrediction)
    return result | _diagnosed(names - {*result}, prediction, problem, solution)


def _modulus(force: Force | None, problem: Problem, solution: Solution) -> Quantity:
    """Return the fitted Young's modulus."""
    count, units = len(problem.unknowns), problem.observations[0].experiment.units
    unit = STRESS.unit if units else ""
    if problem.with_modulus:
        row = np.eye(problem.size)[count]
        return Quantity(np.asarray(solution.z[count]), row, np.zeros(()), unit)
    assert force is not None
    reaction, gradient = reaction_along(force, problem, solution)
    size = float(np.hypot(*force.value))
    value = size / force.thickness / reaction / (units.length_mm if units else 1.0)
    error = np.asarray(abs(value) * force.noise / size)
    return Quantity(np.asarray(value), -value / reaction * gradient, error, unit)


def refuse_other_names(fit: Fit, problem: Problem) -> None:
    """Raise ExperimentError for names in formulas that are no quantities of the fit."""
    known = {unknown.parameter.path for unknown in problem.unknowns}
    known |= {YOUNG} if fit.measured_force or problem.with_modulus else set()
    observation = problem.observations[0]
    variables = {
        variable.name
        for diagnostic in observation.experiment.diagnostics
        for variable in diagnostic.variables()
    }
    for n, text in enumerate(fit.derived):
        for name in Formula(text).names:
            if name in variables and not isinstance(observation, FieldObservation):
                raise ExperimentError(
                    f"'{name}' is computed from an equilibrium, which requires that the first "
                    "measurement is a field",
                    ("derived", n),
                )
            if name not in known | variables:
                hint = did_you_mean(name, sorted(known | variables))
                if makers := diagnostics_that_provide({name}):
                    hint = f"; add {' or '.join(makers)} to `diagnostics` of the experiment"
                raise ExperimentError(
                    f"'{name}' is neither a variable of the experiment's diagnostics, nor an "
                    f"unknown parameter, nor a fitted {YOUNG}{hint}",
                    ("derived", n),
                )


def _diagnosed(
    names: set[str], prediction: FieldPrediction, problem: Problem, solution: Solution
) -> dict[str, Quantity]:
    """Return variables of the diagnostics of the fitted equilibrium."""
    scene, result = prediction.resting_scene.scene, dict[str, Quantity]()
    for n, diagnostic in enumerate(scene.diagnostics):
        variables = [*Physical(scene.experiment.units).scaled(diagnostic)]
        if not names & {variable.name for variable, _ in variables}:
            continue
        with errors_attributed_to(diagnostic, "at the fit", "diagnostics", n):
            values, gradients = Response(prediction, problem, solution).of(diagnostic)
        named = {v.name: k for k, (v, _) in enumerate(variables)}
        for name in names & {*named}:
            k, error = named[name], named.get(f"{name}{ERROR}")
            factor, unit = _unit_of(*variables[k], scene.experiment)
            spread = np.zeros_like(values[k]) if error is None else factor * np.abs(values[error])
            result[name] = Quantity(factor * values[k], factor * gradients[k], spread, unit)
    return result


def _unit_of(variable: Any, factor: float, experiment: Experiment) -> tuple[float, str]:
    """Return the factor that converts a variable to mm, MPa and N, and its unit."""
    quantity, units = QUANTITIES.get(variable.units), experiment.units
    if units is None:
        return factor, ""
    if quantity and not quantity.youngs_modulus:
        return units.length_mm**quantity.length, quantity.unit
    has_unit = any(variable.units == q.unit for q in QUANTITIES.values())
    return factor, variable.units if has_unit else ""


@dataclass(frozen=True)
class Response:
    """Derivatives of functions of a fitted equilibrium with respect to all unknowns."""

    prediction: FieldPrediction
    problem: Problem
    solution: Solution

    @property
    def resting_scene(self) -> RestingScene:
        """Return the equilibrium at the fitted values."""
        return self.prediction.resting_scene

    def values(self, diagnostic: Diagnostic) -> list[Floats]:
        """Return the variables of a diagnostic."""
        return _measure(diagnostic, StateMoment(self.resting_scene.state, self._tables))

    def of(self, diagnostic: Diagnostic) -> tuple[list[Floats], list[Floats]]:
        """Return the variables of a diagnostic, and their derivatives, (..., unknown)."""
        values = self.values(diagnostic)

        def flat(moment: Moment) -> Floats:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", AccuracyWarning)
                return np.concatenate([value.ravel() for value in _measure(diagnostic, moment)])

        columns = np.stack([*self._columns(flat)], axis=1)
        self.problem.convert_to_units(columns, self.solution.z)
        shapes = [(*value.shape, self.problem.size) for value in values]
        parts = np.split(columns, np.cumsum([value.size for value in values])[:-1])
        return values, [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def _columns(self, function: Callable[[Moment], Floats]) -> Iterator[Floats]:
        """Generate the derivatives with respect to the number of each unknown."""
        problem, errors = self.problem, self.solution.errors
        scene, u = self.resting_scene.scene, self.resting_scene.state.u
        value = function(StateMoment(self.resting_scene.state, self._tables))

        def along(du: Floats, error: float) -> Floats:
            size = float(np.abs(du).max(initial=0.0))
            largest = LARGEST_CHANGE * spacing_of(scene) / max(size, 1e-300)
            step = min(SMALL_CHANGE * error or largest, largest)
            return np.asarray((self._at(function, scene, u + step * du) - value) / step)

        for n, (unknown, du) in enumerate(
            zip(problem.unknowns, self.prediction.changes, strict=True)
        ):
            yield along(du, float(errors[n]) * unknown.scale) + unknown.parameter.derivative(
                scene.experiment,
                lambda experiment: self._at(function, scene_like(scene, experiment), u),
                DERIVATIVES,
            )
        _, own = next(problem.own_slices())
        for n in range(len(problem.unknowns), problem.size):
            is_boundary = 0 <= n - own.start < len(self.prediction.answers)
            yield (
                along(self.prediction.answers[n - own.start], float(errors[n]))
                if is_boundary
                else np.zeros_like(value)
            )

    def _at(self, function: Callable[[Moment], Floats], scene: Scene, u: Floats) -> Floats:
        state = self.resting_scene.state.copy()
        state.u = u
        tables = self._tables if scene is self.resting_scene.scene else Tables(scene)
        return function(StateMoment(state, tables))

    @cached_property
    def _tables(self) -> Tables:
        return Tables(self.resting_scene.scene)


def _measure(diagnostic: Diagnostic, moment: Moment) -> list[Floats]:
    return [np.asarray(v, float) for v in as_values(diagnostic.measure(moment), "measure")]
