"""Least-squares problem of a fit, solved by Gauss-Newton iterations.

Residuals are divided by their noise. The iteration is restricted to identifiable directions.

The initial guess minimises the equilibrium gap. For the true parameters θ, the measured
displacements u are in equilibrium: the moves m(u, θ) are zero at all particles of which all
neighbours are measured. Because m is nearly linear in θ, θ is computed by solving a few linear
problems, without computing an equilibrium (Claire, Hild and Roux 2004). The guess is biased by
noise. Its advantage is that it does not depend on the bounds, whereas the middle of the bounds may
be far from the solution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.equilibrium.system import Moves
from pbdkit.errors import ExperimentError
from pbdkit.fitting.correlation import Correlation, estimate_correlation, is_correlated
from pbdkit.fitting.observations import FieldObservation, NearbyPrediction, Observation, Prediction
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.residual_pattern import remedy_of
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.units import is_stress_or_force, number_with_unit
from pbdkit.stepping.state import initial_state

GAP_ITERATIONS = 3
"""Number of linear problems for the initial guess."""

INSET = 1e-3
"""Distance of the guess from the bounds, relative to the interval."""
MIN_POINTS = 3
"""Number of points that determine a plane."""

NEAREST = 12
"""Number of points to which a plane is fitted."""

FAR = 2.0
"""Distance from the nearest point beyond which displacements are unknown.

It is relative to the distance between the points.
"""


def least_gap(
    field: FieldObservation, parameters: Sequence[Parameter], low: Floats, high: Floats
) -> Floats:
    """Return the parameters between bounds that minimise the equilibrium gap, (parameter,).

    The middle of the bounds is returned if too few displacements are known, or only those along one
    axis.
    """
    middle, inset = (low + high) / 2.0, INSET * (high - low)
    values = middle
    if len(field.evidence.points) < MIN_POINTS or len(field.evidence.axes) < field.scene.axes:
        return middle
    state = initial_state(field.scene)
    u = _on_particles(field)

    def moves(experiment: Experiment) -> Floats:
        scene = scene_like(field.scene, experiment).at(experiment.steps)
        with np.errstate(invalid="ignore"):
            moves_at = Moves(scene, compiles=False).at(replace(state, u=u.copy()), experiment.steps)
        return np.asarray(moves_at)

    try:
        for _ in range(GAP_ITERATIONS):
            experiment = field.experiment
            for parameter, value in zip(parameters, values, strict=True):
                experiment = parameter.put(experiment, float(value))
            gap = moves(experiment)
            is_known = np.isfinite(gap)
            if is_known.sum() < 2 * len(values):
                return middle
            slopes = [parameter.derivative(experiment, moves)[is_known] for parameter in parameters]
            step, *_ = np.linalg.lstsq(np.stack(slopes, axis=1), -gap[is_known], rcond=1e-9)
            values = np.clip(values + step, low + inset, high - inset)
    except ExperimentError:
        return middle
    return np.asarray(values)


def _on_particles(field: FieldObservation) -> Floats:
    """Interpolate measured displacements at the particles by planes through the nearest points.

    The result is NaN at particles without a point nearby.
    """
    from scipy.spatial import KDTree

    scene, raster = field.scene, field.scene.raster
    rows, points = raster.body_rows, field.evidence.points
    places, measured = raster.reference(rows), field.measured.reshape(2, -1).T
    tree = KDTree(points)
    spacing, _ = tree.query(points, 2)
    distance, nearest = tree.query(places, min(NEAREST, len(points)))
    offsets = points[nearest] - places[:, None]
    basis = np.concatenate([np.ones((*nearest.shape, 1)), offsets], axis=2)
    products = np.einsum("pki,pkj->pij", basis, basis)
    products += 1e-9 * np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    projections = np.einsum("pki,pka->pia", basis, measured[nearest])
    values = np.linalg.solve(products, projections)[:, 0]
    values[distance[:, 0] > FAR * np.median(spacing[:, 1])] = np.nan
    u = np.full((scene.axes, *raster.shape), np.nan)
    flat = u.reshape(scene.axes, -1)
    flat[:, raster.place_of(rows)] = values.T
    if frame := scene.at(scene.experiment.steps).frame:
        frame.follow(flat, flat)
    return u


WIDE = 10.0
"""Ratio of the upper to the lower bound above which the bounds are wide.

The initial guess is then not the middle of the bounds.
"""


@dataclass(frozen=True)
class Unknown:
    """An unknown parameter and its bounds.

    Parameters
    ----------
    parameter
        The parameter.
    low, high
        Bounds.
    unit
        Unit of the bounds; empty if they are numbers of the experiment.
    scale
        Number of the experiment divided by the value in this unit.
    modulus
        Young's modulus in `units` if the number is the value divided by Young's modulus, else None.
    """

    parameter: Parameter
    low: float
    high: float
    unit: str = ""
    scale: float = 1.0
    modulus: float | None = None

    @classmethod
    def of(cls, path: str, bounds: tuple[Any, Any], experiment: Experiment) -> Unknown:
        """Return the unknown at a path, with bounds that are numbers or texts with a unit.

        Raises
        ------
        ExperimentError
            If there is no such number in the experiment, or the unit is wrong.
        """
        parameter, (low, high) = Parameter(path), bounds
        parameter.value_in(experiment)
        if not isinstance(high, str):
            return cls(parameter, low, high)
        value, unit = number_with_unit(high)
        scale = parameter.number(experiment, high) / value
        modulus = None
        if is_stress_or_force(unit) and experiment.units:
            modulus = experiment.units.value("youngs_modulus")
        return cls(parameter, number_with_unit(low)[0], value, unit, scale, modulus)

    def number(self, value: float, modulus: float | None = None) -> float:
        """Return the number of the experiment for a value and, if it is unknown, the modulus."""
        number = self.scale * float(value)
        return (
            number if modulus is None or self.modulus is None else number * self.modulus / modulus
        )

    def put(self, experiment: Experiment, value: float, modulus: float | None = None) -> Experiment:
        """Return the experiment with a value. Raises ExperimentError if it is invalid."""
        return self.parameter.put(experiment, self.number(value, modulus))

    @property
    def span(self) -> float:
        """Return the interval between the bounds."""
        return self.high - self.low

    @property
    def is_wide(self) -> bool:
        """Return whether the bounds span more than an order of magnitude."""
        return self.low > 0.0 and self.high > WIDE * self.low

    def scale_at(self, value: float) -> float:
        """Return the scale of changes: the interval, or the value if the bounds are wide."""
        return abs(value) if self.is_wide else self.span


@dataclass(frozen=True)
class Linearisation:
    """The least-squares problem, linearised at z.

    Parameters
    ----------
    z : (unknown,)
        Values of the unknowns.
    residuals : (residual,)
        (measured - predicted) / weighted noise of all observations.
    jacobian : (residual, unknown)
        Derivatives of the predictions, divided by the weighted noise.
    predictions
        Prediction of each observation.
    scales
        Whether numbers of the experiment depend on an unknown Young's modulus.
    branch : (unknown,), optional
        Distance of the minimum on another branch of the predictions, times the square root of the
        probability of this branch.
    """

    z: Floats
    residuals: Floats
    jacobian: Floats
    predictions: tuple[Prediction, ...]
    scales: bool = False
    branch: Floats | None = None

    @property
    def is_exact(self) -> bool:
        """Return whether no derivatives are those of a linearisation at other values."""
        return all(prediction.is_exact for prediction in self.predictions)

    @property
    def is_linear(self) -> bool:
        """Return whether residuals are linear in all unknowns except the parameters."""
        return not self.scales and all(prediction.is_linear for prediction in self.predictions)


@dataclass(frozen=True)
class Problem:
    """Least-squares problem of a fit.

    The vector z of unknowns contains the parameters, then Young's modulus if an observation needs
    it, and then the unknowns that each observation has for itself.

    Parameters
    ----------
    unknowns
        Parameters and their bounds.
    observations
        Measurements.
    """

    unknowns: tuple[Unknown, ...]
    observations: tuple[Observation, ...]

    @cached_property
    def with_modulus(self) -> bool:
        """Return whether Young's modulus is unknown."""
        return any(observation.needs_modulus for observation in self.observations)

    @cached_property
    def is_smooth(self) -> bool:
        """Return whether all predictions are smooth functions of the parameters."""
        return all(observation.is_smooth for observation in self.observations)

    @cached_property
    def shared(self) -> int:
        """Return the number of unknowns that all observations share."""
        return len(self.unknowns) + self.with_modulus

    @cached_property
    def size(self) -> int:
        """Return the number of unknowns."""
        return self.shared + sum(observation.own_unknowns for observation in self.observations)

    def rows(self) -> Iterator[tuple[Observation, slice]]:
        """Yield each observation with the slice of its residuals."""
        first = 0
        for observation in self.observations:
            yield observation, slice(first, first := first + len(observation.measured))

    def own_slices(self) -> Iterator[tuple[Observation, slice]]:
        """Yield each observation with the slice of the unknowns that only this observation has."""
        first = self.shared
        for observation in self.observations:
            yield observation, slice(first, first := first + observation.own_unknowns)

    def start(self) -> Floats:
        """Return initial values.

        If bounds are wide and a field is measured, the parameters minimise the equilibrium gap.
        Otherwise they are in the middle of their bounds or, if the experiment is not valid there,
        have the values of the experiment. Boundaries have their measured displacements.
        """
        z, count = np.zeros(self.size), len(self.unknowns)
        low, high = (bound[:count] for bound in self.bounds())
        z[:count] = (low + high) / 2.0
        fields = [item for item in self.observations if isinstance(item, FieldObservation)]
        parameters = [u.parameter for u in self.unknowns]
        scale = np.array([u.scale for u in self.unknowns])
        is_wide = [unknown.is_wide for unknown in self.unknowns]
        if fields and any(is_wide):
            guess = least_gap(fields[0], parameters, scale * low, scale * high) / scale
            z[:count] = np.where(is_wide, guess, z[:count])
        if self.with_modulus:
            z[count] = next((u.modulus for u in self.unknowns if u.modulus), 1.0)
        try:
            for observation in self.observations:
                self.experiment_at(observation, z)
        except ExperimentError:
            experiment, inset = self.observations[0].experiment, INSET * (high - low)
            values = [parameter.value_in(experiment) for parameter in parameters] / scale
            z[:count] = np.clip(values, low + inset, high - inset)
        for observation, section in self.own_slices():
            z[section] = observation.start()
        return self.with_best_modulus(z)

    def with_best_modulus(self, z: Floats) -> Floats:
        """Return z with the modulus that fits best.

        Raises
        ------
        ExperimentError
            If the model exerts no force.
        """
        if not self.with_modulus:
            return z
        terms = [
            observation.modulus_terms(self.experiment_at(observation, z))
            for observation in self.observations
        ]
        product, square = np.sum(terms, axis=0)
        if square == 0.0:
            raise ExperimentError("the group exerts no force in this experiment", ("measured",))
        if product < 0.0:
            raise ExperimentError(
                (
                    "the measured force has the opposite sign of that in this experiment; change "
                    "it, or use another `group` or `axis`"
                ),
                ("measured",),
            )
        z = z.copy()
        z[len(self.unknowns)] = product / square
        return z

    def bounds(self) -> tuple[Floats, Floats]:
        """Return the bounds of the unknowns, which are infinite except for those of parameters."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        for n, unknown in enumerate(self.unknowns):
            low[n], high[n] = unknown.low, unknown.high
        return low, high

    def experiment_at(self, observation: Observation, z: Floats) -> Experiment:
        """Return the experiment of an observation with values of the parameters."""
        experiment, modulus = observation.experiment, self._modulus(z)
        for unknown, value in zip(self.unknowns, z, strict=False):
            experiment = unknown.put(experiment, value, modulus)
        return experiment

    def _modulus(self, z: Floats) -> float | None:
        """Return Young's modulus at z, or None if it is not unknown."""
        return float(z[len(self.unknowns)]) if self.with_modulus else None

    def at(
        self, z: Floats, near: Linearisation | None = None, *, is_exact: bool = False
    ) -> Linearisation:
        """Linearise the problem at z.

        Parameters
        ----------
        near
            Linearisation at similar values, which accelerates the solution.
        is_exact
            Whether derivatives of this linearisation are not reused.

        Raises
        ------
        ExperimentError
            If an experiment is invalid.
        UnconvergedError
            If there is no prediction.
        """
        parameters = [u.parameter for u in self.unknowns]
        count = sum(len(item.measured) for item in self.observations)
        jacobian, predictions, residuals = np.zeros((count, self.size)), [], np.zeros(count)
        modulus = float(z[len(parameters)]) if self.with_modulus else 1.0
        guesses = self._near(near, z, is_exact) if near else [None] * len(self.observations)
        entries = zip(self.rows(), self.own_slices(), guesses, strict=True)
        for (observation, rows), (_, section), guess in entries:
            experiment = self.experiment_at(observation, z)
            prediction = observation.at(experiment, parameters, z[section], modulus, guess)
            predictions.append(prediction)
            residuals[rows] = prediction.residuals
            jacobian[rows, : len(parameters)] = prediction.by_parameter
            jacobian[rows, section] = prediction.by_own
            if self.with_modulus:
                jacobian[rows, len(parameters)] = prediction.by_modulus
        self.convert_to_units(jacobian, z)
        return Linearisation(z, residuals, jacobian, tuple(predictions), self._scales)

    @cached_property
    def _scales(self) -> bool:
        """Return whether numbers of the experiment depend on an unknown Young's modulus."""
        return self.with_modulus and any(u.modulus is not None for u in self.unknowns)

    def convert_to_units(self, jacobian: Floats, z: Floats) -> None:
        """Convert derivatives with respect to numbers of the experiment to those with respect to
        values in units, (row, unknown), in place.

        If such a value is a stress or a force, the number of the experiment is its quotient by
        Young's modulus, so that it changes with an unknown modulus too.
        """
        modulus, count = self._modulus(z), len(self.unknowns)
        for n, unknown in enumerate(self.unknowns):
            if unknown.unit:
                jacobian[:, n] *= unknown.number(1.0, modulus)
                if modulus is not None and unknown.modulus is not None:
                    jacobian[:, count] -= z[n] / modulus * jacobian[:, n]

    def residuals(self, z: Floats) -> Floats:
        """Return the residuals at z. Raises the same errors as `at`."""
        return np.concatenate(
            [
                self.residuals_of(n, observation, z)
                for n, observation in enumerate(self.observations)
            ]
        )

    def residuals_of(self, n: int, part: Observation, z: Floats) -> Floats:
        """Return the residuals of a part of observation n."""
        own_values = z[[*self.own_slices()][n][1]]
        modulus = float(z[len(self.unknowns)]) if self.with_modulus else 1.0
        return part.at(self.experiment_at(part, z), (), own_values, modulus).residuals

    def _near(self, at: Linearisation, z: Floats, is_exact: bool) -> list[NearbyPrediction]:
        distances = [
            abs(z[n] - at.z[n]) / min(u.span, u.scale_at(at.z[n]))
            for n, u in enumerate(self.unknowns)
        ]
        if self._scales:
            distances.append(abs(z[len(self.unknowns)] / at.z[len(self.unknowns)] - 1.0))
        away = np.inf if is_exact else float(max(distances, default=0.0))
        return [NearbyPrediction(prediction, away) for prediction in at.predictions]


Loss = Literal["linear", "soft_l1", "huber", "cauchy"]
IDENTIFIABLE_RATIO = 0.25
"""Largest standard error of an identifiable parameter, relative to the interval between its bounds.

A parameter that is uniformly distributed between its bounds has a standard deviation of 0.29 of
this interval.
"""
UNIFORM_PRECISION = 12.0
"""Inverse of the variance of a uniform distribution on an interval of length 1."""
AT_BOUND = 1e-6
"""Distance from a bound up to which a value is at the bound, relative to the interval."""
MAX_ITERATIONS = 50
"""Maximum number of Gauss-Newton iterations."""

MAX_ITERATIONS_SECANT = 15
"""Maximum number of iterations for predictions that are not smooth."""
MIN_RADIUS = 1e-5
"""Smallest radius of the trust region, relative to the scale of each parameter."""
MIN_GAIN = 0.1
"""Fraction of the predicted decrease of the cost that a step must achieve."""
GOOD_GAIN = 0.7
"""Fraction of the predicted decrease from which the trust region becomes larger."""
SETTLED = 1e-3
"""Relative decrease of the cost below which the linear unknowns are not changed."""
STALLED = 0.5
"""Largest remaining step, in standard errors, of a fit that has converged if no step reduces the
cost.

The cost then has a kink: where bonds are broken, the stiffness of cells is not a smooth function of
the parameters of `orthotropic`.
"""

SLACK = 1e-9
"""Relative increase of the cost that is treated as a rounding error."""
MAX_REWEIGHTINGS = 100
"""Maximum number of iteratively reweighted linear problems."""

STEADY = 1e-5
"""Largest change of the residuals, in units of the noise, after which the weights have
converged."""

RANK = 1e-5
"""Relative tolerance of singular values, for columns of unit length.

It is equal to the accuracy of derivatives.
"""
PRIOR_RANK = 1e-12
"""Relative tolerance of singular values of the square root of the information."""
INVOLVED = 1e-2
"""Component of a null direction below which an unknown is not a part of the direction.

It is relative to the largest component.
"""
NULL_VARIANCE = 1e12
"""Variance along null directions."""
MODULUS = "Young's modulus"
"""Name of Young's modulus."""
CONVERGED = 1e-2
"""Largest step, in standard errors, of a converged fit."""
CONVERGED_SECANT = 0.15
"""Largest step of a converged fit of predictions that are not smooth."""
KINK = 0.5
"""Increase of the cost that is accepted for predictions that are not smooth, in units of the mean
square residual, so that small jumps of the predictions do not end the fit."""
MAX_STALLED_SECANT = 1.5
"""Largest step, in standard errors, with which such a fit ends with a warning, not an error."""
MIN_RADIUS_SECANT = 2e-3
"""Value of `MIN_RADIUS` for predictions that are not smooth."""
FROZEN = 1e-3
"""Change of all residuals between the bounds below which an unknown is fixed.

It is in units of the noise.
"""
MIN_SLOPE = 0.05
"""Smallest admissible mean slope ψ' of a loss. Below it nearly all residuals are outliers."""
MIN_RATIO = 0.5
"""Ratio of residuals to noise below which the remaining variance of the noise is independent."""
OUTLIERS = 1.345
"""Residual, in units of the noise, above which a loss reduces its weight (Huber)."""


@dataclass(frozen=True)
class Directions:
    """Linearly independent directions in the space of the unknowns z, with variances.

    Parameters
    ----------
    vectors : (direction, unknown)
        Directions, in units of `scale`.
    variance : (direction,)
        Variance along each direction.
    scale : (unknown,)
        Scale of the unknowns.
    """

    vectors: Floats
    variance: Floats
    scale: Floats

    @property
    def covariance(self) -> Floats:
        """Return the covariance of z."""
        return (self.vectors.T * self.variance) @ self.vectors * np.outer(self.scale, self.scale)

    @property
    def is_null(self) -> NDArray[np.bool_]:
        """Return a mask of the directions that do not change the residuals, (direction,)."""
        return self.variance >= NULL_VARIANCE

    @property
    def unsure(self) -> NDArray[np.bool_]:
        """Return a mask of unknowns that the data do not determine sufficiently, (direction,
        unknown).

        An unknown is marked for each direction along which the standard error of the unknown itself
        is too large.
        """
        return np.abs(self.vectors) * np.sqrt(self.variance)[:, None] > IDENTIFIABLE_RATIO

    @property
    def spread(self) -> Floats:
        """Return the standard errors of z, in units of `scale`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) / self.scale)

    def errors(self, step: Floats) -> Floats:
        """Return the component of a step along each direction, in standard errors; 0 along null
        directions."""
        along = (self.vectors @ (step / self.scale)) / np.sqrt(self.variance)
        return np.where(self.is_null, 0.0, along)

    def error_of(self, gradient: Floats, unidentified: Sequence[int] = ()) -> float:
        """Return the standard error of a function of z, computed from its gradient.

        Null directions are excluded.

        Parameters
        ----------
        gradient : (unknown,)
            Derivatives of the function.
        unidentified
            Indices of parameters that the data do not determine. They are assumed to be uniformly
            distributed between their bounds, which adds to the information of the data.
        """
        gradient = gradient * self.scale
        vectors, variance = self.vectors[~self.is_null], self.variance[~self.is_null]
        if not len(unidentified):
            return float(np.sqrt(np.square(vectors @ gradient) @ variance))
        bounded = np.sqrt(UNIFORM_PRECISION) * np.eye(len(gradient))[[*unidentified]]
        factor = np.vstack([vectors / np.sqrt(variance)[:, None], bounded])
        return float(np.linalg.norm(gradient @ np.linalg.pinv(factor, rcond=PRIOR_RANK)))


@dataclass(frozen=True)
class Solution:
    """Solution of a fit.

    Parameters
    ----------
    z : (unknown,)
        Best values.
    at
        Problem linearised at the best values.
    directions
        Linearly independent directions in the space of the unknowns, with the variance along each.
    ratio
        Standard deviation of the residuals divided by their noise.
    unidentified, on_bounds
        Paths of the parameters that are not identifiable, and of the parameters that are at their
        bounds. Both are independent of each other.
    evaluations
        Number of linearisations.
    correlations
        Correlation of the residuals of each observation; None if it is not significant. Empty if
        the residuals were not tested.
    independent
        Directions with the variance for independent residuals, if a correlation is significant.
    remaining
        Component of the remaining step, in standard errors, along the direction with the largest.
    """

    z: Floats
    at: Linearisation
    directions: Directions
    ratio: float
    unidentified: tuple[str, ...]
    on_bounds: tuple[str, ...]
    evaluations: int
    correlations: tuple[Correlation | None, ...] = ()
    independent: Directions | None = None
    remaining: float = 0.0

    @property
    def is_stalled(self) -> bool:
        """Return whether a fit of predictions that are not smooth ends far from its next step."""
        return self.remaining > STALLED

    @cached_property
    def covariance(self) -> Floats:
        """Return the covariance of z."""
        return self.directions.covariance

    @cached_property
    def growth(self) -> Floats:
        """Return the factor by which correlations increase the standard errors of z, (unknown,)."""
        if self.independent is None:
            return np.ones(len(self.z))
        return np.asarray(np.sqrt(np.diag(self.covariance) / np.diag(self.independent.covariance)))

    @property
    def errors(self) -> Floats:
        """Return the standard errors of z."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def solved(problem: Problem, start: Floats, loss: Loss = "linear") -> Solution:
    """Solve the problem by Gauss-Newton iterations in a trust region.

    In each iteration the linearised problem with its loss is solved between the bounds and within
    the trust region of the parameters. The iteration ends when z has converged along all
    identifiable directions. Along all other directions z has its initial values.

    Parameters
    ----------
    start : (unknown,)
        Initial values.
    loss
        Loss function.

    Raises
    ------
    UnconvergedError
        If the iteration does not converge.

    Notes
    -----
    Residuals are linear in all unknowns except the parameters if the rule is linear. In each
    iteration the cost is then minimised over these unknowns (variable projection), and the trust
    region restricts the parameters only.

    The covariance is (JᵀJ)⁻¹. It is multiplied by the square of the ratio if residuals are larger
    than their noise (Birge). With a loss, it is that of M-estimators (Huber).
    """
    low, high = problem.bounds()
    z = np.clip(start, low, high)
    region = _Region(problem, loss, np.full(len(z), np.inf))
    at = region.linearise(z, None)
    for _ in range(MAX_ITERATIONS if problem.is_smooth else MAX_ITERATIONS_SECANT):
        step = _linear_step(at, low - at.z, high - at.z, loss)
        directions, unidentified = _identify_directions(problem, at, loss)
        remaining = np.abs(directions.errors(step)).max(initial=0.0)
        trial: Linearisation | None = None
        if remaining > (CONVERGED if problem.is_smooth else CONVERGED_SECANT):
            trial = region.search(at)
        elif not (at.is_exact or problem.is_smooth):
            trial = region.relinearise(at)
        if trial is None:
            break
        at = trial
    if remaining > (STALLED if problem.is_smooth else MAX_STALLED_SECANT):
        raise UnconvergedError(region.explain(at))
    ratio = spread_of(at.residuals, problem.size, loss)
    on_bounds = _on_bounds(problem, at.z)
    return Solution(
        at.z,
        at,
        directions,
        ratio,
        unidentified,
        on_bounds,
        region.evaluations,
        remaining=float(remaining),
    )


@dataclass
class _Region:
    """Trust region of the parameters, a box about the current values.

    Parameters
    ----------
    problem, loss
        The problem and its loss.
    others : (unknown,)
        Largest changes of all other unknowns. They are infinite if these unknowns are linear.
    radius
        Half of the length of each side, relative to the scale of the parameter.
    evaluations
        Number of linearisations.
    failure
        Reason why there was no prediction at the last trial without one.
    """

    problem: Problem
    loss: Loss
    others: Floats
    radius: float = 1.0
    evaluations: int = 0
    failure: Exception | None = None

    def search(self, at: Linearisation) -> Linearisation | None:
        """Return the linearisation after a step that reduces the cost, or None if there is none."""
        (low, high), count = self.problem.bounds(), len(self.problem.unknowns)
        cost = cost_of(at.residuals, self.loss)
        slack = SLACK * cost
        if not self.problem.is_smooth:
            slack += KINK * cost / max(1, len(at.residuals) - self.problem.size)
        smallest = MIN_RADIUS if self.problem.is_smooth else MIN_RADIUS_SECANT
        while self.radius >= smallest:
            sides = self._sides(at.z)
            step = _linear_step(
                at, np.maximum(low - at.z, -sides), np.minimum(high - at.z, sides), self.loss
            )
            gain = cost - cost_of(at.residuals - at.jacobian @ step, self.loss)
            share = np.abs(step[:count] / sides[:count]).max(initial=0.0)
            trial = self._try(at, step)
            decrease = cost - cost_of(trial.residuals, self.loss) if trial else -np.inf
            if trial and decrease >= MIN_GAIN * gain - slack:
                if decrease >= GOOD_GAIN * gain:
                    self.radius = max(self.radius, 2.0 * share * self.radius)
                    self.others = np.full(len(step), np.inf)
                return trial
            if not at.is_exact:
                at = self.relinearise(at)
                continue
            self.radius *= share / 4.0 if share else 0.25
            if not at.is_linear:
                self.others = np.abs(step) / 4.0
        return None

    def linearise(self, z: Floats, near: Linearisation | None) -> Linearisation:
        """Linearise at z, after minimisation over the unknowns that are not parameters.

        This minimisation is omitted if residuals are not linear in these unknowns.
        """
        self.evaluations += 1
        at = self.problem.at(z, near)
        if not at.is_linear:
            return at
        step = _step_of_others(self.problem, at, self.loss)
        cost = cost_of(at.residuals, self.loss)
        if cost - cost_of(at.residuals - at.jacobian @ step, self.loss) <= SETTLED * cost:
            return at
        self.evaluations += 1
        return self.problem.at(z + step, at)

    def relinearise(self, at: Linearisation) -> Linearisation:
        """Return the linearisation at the same values, with derivatives at these values."""
        self.evaluations += 1
        return self.problem.at(at.z, at, is_exact=True)

    def _sides(self, z: Floats) -> Floats:
        sides = self.others.copy()
        for n, unknown in enumerate(self.problem.unknowns):
            sides[n] = self.radius * unknown.scale_at(float(z[n]))
        return sides

    def _try(self, at: Linearisation, step: Floats) -> Linearisation | None:
        """Linearise after a step; None if there is no prediction."""
        try:
            return self.linearise(at.z + step, at)
        except (UnconvergedError, ExperimentError) as error:
            self.failure = error
            return None

    def explain(self, at: Linearisation) -> str:
        """Return why the fit has not converged, and a remedy."""
        pairs = zip(self.problem.unknowns, at.z, strict=False)
        values = ", ".join(f"{unknown.parameter.path} = {value:.4g}" for unknown, value in pairs)
        text = f"no step from {values} reduces the cost"
        if self.radius >= MIN_RADIUS:
            text = f"the fit has not converged after {MAX_ITERATIONS} iterations, at {values}"
        if self.failure:
            return f"{text}; near these values there is no prediction: {self.failure}"
        if bounds := _on_bounds(self.problem, at.z):
            return f"{text}; widen the bounds of {', '.join(bounds)}, at which the fit stops"
        residuals = [at.residuals[rows] for _, rows in self.problem.rows()]
        return f"{text}; {remedy_of(self.problem.observations, residuals, self.loss)}"


def _step_of_others(problem: Problem, at: Linearisation, loss: Loss) -> Floats:
    """Solve the linearised problem for all unknowns that are not parameters."""
    free = np.full(problem.size, np.inf)
    free[: len(problem.unknowns)] = 0.0
    return _linear_step(at, -free, free, loss)


def _linear_step(at: Linearisation, low: Floats, high: Floats, loss: Loss) -> Floats:
    """Solve the linearised problem between bounds by iteratively reweighted least squares."""
    size = np.linalg.norm(at.jacobian, axis=0)
    is_free = size * np.minimum(high - low, 1e100) > FROZEN
    size, low, high = size[is_free], low[is_free], high[is_free]
    scaled, y = at.jacobian[:, is_free] / size, np.zeros(size.shape)
    for _ in range(1 if loss == "linear" else MAX_REWEIGHTINGS):
        weight = np.sqrt(_weight(at.residuals - scaled @ y, loss))
        basis, triangle = np.linalg.qr(scaled * weight[:, None])
        projection = basis.T @ (at.residuals * weight)
        left_vectors, sizes, vectors = _singular(triangle)
        previous, y = y, vectors.T @ (left_vectors.T @ projection / sizes)
        if (y < low * size).any() or (y > high * size).any():
            # Steps along null directions are damped, but their residuals are not omitted.
            null = np.eye(len(y)) - vectors.T @ vectors
            matrix = np.vstack([triangle, RANK * sizes.max(initial=0.0) * null])
            values = np.concatenate([projection, np.zeros(len(y))])
            y = np.asarray(_solve_bounded(matrix, values, low * size, high * size))
        if (np.abs(y - previous) <= STEADY).all():
            break
    step = np.zeros(len(is_free))
    step[is_free] = y / size
    return step


def weighted_system(at: Linearisation, loss: Loss) -> tuple[Floats, Floats]:
    """Return Jacobian and residuals, multiplied by the square roots of the weights of a loss.

    The weights are those of residuals divided by their spread if it exceeds the noise.
    """
    size = max(1.0, spread_of(at.residuals, 0, loss))
    weight = np.sqrt(_weight(at.residuals / size, loss))
    return at.jacobian * weight[:, None], at.residuals * weight


def _solve_bounded(matrix: Floats, values: Floats, low: Floats, high: Floats) -> Floats:
    """Return the least-squares solution between bounds.

    Unknowns without bounds are eliminated, because they may be many and nearly dependent.
    """
    from scipy.optimize import lsq_linear

    is_bounded, y = np.isfinite(low) | np.isfinite(high), np.zeros(len(low))
    others = matrix[:, ~is_bounded]
    basis, _ = np.linalg.qr(others)
    columns = matrix[:, is_bounded]
    y[is_bounded] = lsq_linear(
        columns - basis @ (basis.T @ columns),
        values - basis @ (basis.T @ values),
        (low[is_bounded], high[is_bounded]),
        method="bvls",
    ).x
    y[~is_bounded] = np.linalg.lstsq(others, values - columns @ y[is_bounded], rcond=None)[0]
    return y


def _singular(columns: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the singular value decomposition after scaling columns to unit length.

    Null directions are omitted.
    """
    basis, triangle = np.linalg.qr(columns)
    left_vectors, sizes, vectors = np.linalg.svd(triangle, full_matrices=False)
    is_regular = sizes > RANK * sizes.max(initial=0.0)
    return basis @ left_vectors[:, is_regular], sizes[is_regular], vectors[is_regular]


def hat_diagonal(jacobian: Floats) -> Floats:
    """Return the diagonal of the hat matrix, (residual,): the number of unknowns that each value
    determines. Their sum is the number of independent unknowns."""
    size = np.linalg.norm(jacobian, axis=0)
    basis, _, _ = _singular(jacobian / np.where(size > 0.0, size, 1.0))
    return np.asarray(np.square(basis).sum(axis=1))


def _weight(residuals: Floats, loss: Loss) -> Floats:
    """Return the weights of residuals."""
    z = np.square(residuals / OUTLIERS)
    if loss == "linear":
        return np.ones(len(z))
    if loss == "huber":
        return np.asarray(1.0 / np.sqrt(np.maximum(z, 1.0)))
    return np.asarray(1.0 / np.sqrt(1.0 + z) if loss == "soft_l1" else 1.0 / (1.0 + z))


def cost_of(residuals: Floats, loss: Loss) -> float:
    """Return -2 log L of residuals divided by their noise: Σ r², or its equivalent for a loss."""
    z = np.square(residuals / OUTLIERS)
    if loss == "huber":
        z = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
    elif loss == "soft_l1":
        z = 2.0 * (np.sqrt(1.0 + z) - 1.0)
    elif loss == "cauchy":
        z = np.log1p(z)
    return float(z.sum()) * OUTLIERS**2


def spread_of(residuals: Floats, unknowns: float, loss: Loss) -> float:
    """Return the standard deviation of residuals divided by their noise. With a loss, it is
    estimated from the median of their magnitudes.

    `unknowns` is the number of degrees of freedom that the fit has removed.
    """
    if loss == "linear":
        return float(np.sqrt(residuals @ residuals / max(1, len(residuals) - unknowns)))
    return float(1.4826 * np.median(np.abs(residuals)))


def _identify_directions(
    problem: Problem,
    at: Linearisation,
    loss: Loss,
    correlations: Sequence[Correlation | None] = (),
) -> tuple[Directions, tuple[str, ...]]:
    """Return directions with their variance, and the parameters that are not identifiable.

    Residuals are assumed to be at least as large as their noise. Parameters are scaled by the
    interval between their bounds, Young's modulus by its value.

    Parameters
    ----------
    correlations
        Correlation of the residuals of each observation; None, or nothing, for independent
        residuals.
    """
    count, size = len(problem.unknowns), np.linalg.norm(at.jacobian, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    scale = 1.0 / size
    scale[:count] = [unknown.span for unknown in problem.unknowns]
    if problem.with_modulus:
        scale[count] = abs(at.z[count]) or 1.0
    basis, sizes, vectors = _singular(at.jacobian / size)
    rank = len(sizes)
    rotation, sizes, vectors = np.linalg.svd(sizes[:, None] * vectors * (size * scale))
    variance = np.full(len(vectors), NULL_VARIANCE)
    if any(correlations):
        product = _correlated_product(problem, basis @ rotation, correlations)
        factor = _variance_of_loss(at.residuals, float(np.trace(product)), loss)
        axes, deviations = _principal_axes(product, sizes)
        variance[:rank] = np.minimum(factor * deviations**2, NULL_VARIANCE)
        vectors[:rank] = axes.T @ vectors[:rank]
    else:
        factor = _variance_of_loss(at.residuals, problem.size, loss)
        variance[:rank] = np.minimum(factor / sizes**2, NULL_VARIANCE)
    if at.branch is not None:
        along = vectors[:rank] @ (at.branch / scale)
        widened, axes = np.linalg.eigh(np.diag(variance[:rank]) + np.outer(along, along))
        variance[:rank] = np.minimum(widened, NULL_VARIANCE)
        vectors[:rank] = axes.T @ vectors[:rank]
    shares = np.abs(vectors[rank:] * (size * scale))
    vectors[rank:][shares < INVOLVED * shares.max(axis=1, initial=0.0)[:, None]] = 0.0
    directions = Directions(vectors, variance, scale)
    is_unidentified = directions.spread[:count] > IDENTIFIABLE_RATIO
    names = [unknown.parameter.path for unknown in problem.unknowns]
    return directions, tuple(
        name for name, flag in zip(names, is_unidentified, strict=True) if flag
    )


def _correlated_product(
    problem: Problem, basis: Floats, correlations: Sequence[Correlation | None]
) -> Floats:
    """Return QᵀRQ for the correlation matrix R of the residuals and an orthonormal basis Q.

    Its trace is the number of degrees of freedom of the noise that the unknowns have removed from
    the residuals.
    """
    result = np.zeros((basis.shape[1], basis.shape[1]))
    for (observation, rows), correlation in zip(problem.rows(), correlations, strict=True):
        part, places = basis[rows], observation.correlated_places()
        if correlation is None or places is None:
            result += part.T @ part
        else:
            result += correlation.product(part.reshape(-1, len(places), part.shape[1]), places)
    return result


def _principal_axes(product: Floats, sizes: Floats) -> tuple[Floats, Floats]:
    """Return the principal axes of the covariance S⁻¹ product S⁻¹, and the standard deviation along
    each. S is the diagonal matrix of singular values."""
    values, vectors = np.linalg.eigh(product)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    axes, deviations, _ = np.linalg.svd(root / sizes[:, None])
    return axes, deviations


def with_correlated_errors(problem: Problem, solution: Solution, loss: Loss) -> Solution:
    """Return the solution with standard errors that account for correlations of the residuals.

    They do not change if no correlation is significant.
    """
    at = solution.at
    size = np.linalg.norm(at.jacobian, axis=0)
    basis, *_ = _singular(at.jacobian / np.where(size > 0.0, size, 1.0))
    scores, _ = _influence(at.residuals, problem.size, loss)
    correlations = []
    for observation, rows in problem.rows():
        places, correlation = observation.correlated_places(), None
        if places is not None:
            residuals = scores[rows].reshape(-1, len(places))
            part = basis[rows].reshape(*residuals.shape, -1)
            if is_correlated(residuals, part, places):
                correlation = estimate_correlation(residuals, part, places)
                # Far below the noise, residuals are not a sample of it.
                ratio = spread_of(at.residuals[rows], 0, loss) / np.sqrt(observation.weight)
                share = correlation.share * min(1.0, ratio / MIN_RATIO) ** 2
                correlation = replace(correlation, share=share)
        correlations.append(correlation)
    if not any(correlations):
        return replace(solution, correlations=tuple(correlations))
    directions, unidentified = _identify_directions(problem, at, loss, correlations)
    return replace(
        solution,
        directions=directions,
        unidentified=unidentified,
        correlations=tuple(correlations),
        independent=solution.directions,
    )


def with_other_branch(problem: Problem, solution: Solution, loss: Loss) -> Solution:
    """Return the solution with standard errors that account for another branch of the predictions.

    They do not change if the predictions are smooth. Otherwise each parameter is changed by its
    standard error in both directions. If the predictions jump in between, the minimum on the branch
    there is computed with the derivatives at the solution. With its distance d and its cost χ², the
    covariance C becomes C + w d dᵀ, where w is the likelihood exp(-χ² / 2) divided by the sum of
    the likelihoods of both minima. The largest such change is used.
    """
    if problem.is_smooth:
        return solution
    at, (low, high), count = solution.at, problem.bounds(), len(problem.unknowns)
    cost, rise = cost_of(at.residuals, loss), rise_of_loss(at.residuals, problem.size, loss)
    branch = np.zeros(problem.size)
    errors = solution.errors[:count]
    for n, change in [*enumerate(-errors), *enumerate(errors)]:
        z = at.z.copy()
        z[n] = np.clip(z[n] + change, low[n], high[n])
        try:
            beside = replace(at, z=z, residuals=problem.residuals(z))
        except (UnconvergedError, ExperimentError):
            continue
        step = _linear_step(beside, low - z, high - z, loss)
        excess = (cost_of(beside.residuals - at.jacobian @ step, loss) - cost) / rise
        weight = (1.0 - np.tanh(excess / 4.0)) / 2.0
        distance = np.sqrt(weight) * (z + step - at.z)
        size, largest = (
            np.linalg.norm(solution.directions.errors(each)) for each in (distance, branch)
        )
        if size > largest:
            branch = distance
    at = replace(at, branch=branch)
    directions, unidentified = _identify_directions(problem, at, loss)
    return replace(solution, at=at, directions=directions, unidentified=unidentified)


def _variance_of_loss(residuals: Floats, unknowns: float, loss: Loss) -> float:
    """Return the factor by which a loss changes the variance, mean ψ² / (mean ψ')².

    The scores ψ are in units of the noise.
    """
    square, slope = _scores(residuals, unknowns, loss)
    return square / slope**2


def rise_of_loss(residuals: Floats, unknowns: float, loss: Loss) -> float:
    """Return the ratio of the increase of -2 log L to that of χ²: mean ψ² / mean ψ'."""
    square, slope = _scores(residuals, unknowns, loss)
    return square / slope


def _scores(residuals: Floats, unknowns: float, loss: Loss) -> tuple[float, float]:
    """Return mean ψ², in units of the noise, and mean ψ' of the residuals.

    The residuals are assumed to be at least as large as the noise. For a linear loss, mean ψ² is
    the square of Birge's ratio.
    """
    if loss == "linear":
        return max(1.0, spread_of(residuals, unknowns, loss)) ** 2, 1.0
    psi, slope = _influence(residuals, unknowns, loss)
    return float(np.mean(psi**2) * OUTLIERS**2), max(float(np.mean(slope)), MIN_SLOPE)


def _influence(residuals: Floats, unknowns: float, loss: Loss) -> tuple[Floats, Floats]:
    """Return ψ and ψ' of each residual, (residual,). For a linear loss, ψ is the residual."""
    if loss == "linear":
        return residuals, np.ones(len(residuals))
    spread = spread_of(residuals, unknowns, loss)
    z = residuals / min(1.0, max(spread, 1e-300)) / OUTLIERS
    if loss == "huber":
        return np.clip(z, -1.0, 1.0), np.asarray(np.abs(z) <= 1.0, float)
    if loss == "soft_l1":
        return z / np.sqrt(1.0 + z * z), (1.0 + z * z) ** -1.5
    return z / (1.0 + z * z), (1.0 - z * z) / (1.0 + z * z) ** 2


def steps_beyond_bounds(problem: Problem, solution: Solution, loss: Loss) -> dict[str, float]:
    """Return the distance of the minimum of the linearised problem beyond each bound that the fit
    has reached, in standard errors, by path."""
    if not solution.on_bounds:
        return {}
    at, free, steps = solution.at, np.full(problem.size, np.inf), dict[str, float]()
    step = _linear_step(at, -free, free, loss) / solution.errors
    for unknown, value, distance in zip(problem.unknowns, at.z, step, strict=False):
        if unknown.parameter.path in solution.on_bounds:
            outward = -1.0 if value - unknown.low < unknown.high - value else 1.0
            steps[unknown.parameter.path] = max(0.0, float(outward * distance))
    return steps


def reason_of(problem: Problem, solution: Solution, path: str) -> str:
    """Return why the data do not determine a parameter, and a remedy."""
    paths = [unknown.parameter.path for unknown in problem.unknowns]
    n, directions = paths.index(path), solution.directions
    effect = np.linalg.norm(solution.at.jacobian[:, n]) * problem.unknowns[n].span
    if effect <= FROZEN:
        return (
            "no measured value depends on it; remove it from `unknown`, or measure a quantity that "
            "depends on it, such as a curve of forces"
        )
    involved = (directions.vectors[directions.is_null] != 0.0) & (
        directions.vectors[directions.is_null][:, [n]] != 0.0
    )
    if involved.any():
        others = [name for m, name in enumerate(paths) if m != n and involved[:, m].any()]
        if problem.with_modulus and involved[:, len(paths)].any():
            others.append(MODULUS)
        names = ", ".join(others) or "`modes` of boundaries and terms of `distortion`"
        return (
            f"changes of {names} have the same effect on all measured values; fix some of them, or "
            "measure a quantity that distinguishes them"
        )
    unknown, error = problem.unknowns[n], solution.errors[n]
    return (
        f"its standard error, {error:.2g}, exceeds a quarter of the interval between its bounds, "
        f"{unknown.low:.6g} to {unknown.high:.6g}; measure more values or with less noise, fit "
        "fewer unknowns, or widen the bounds if they are narrow"
    )


def _on_bounds(problem: Problem, z: Floats) -> tuple[str, ...]:
    paths = []
    for unknown, value in zip(problem.unknowns, z, strict=False):
        if min(value - unknown.low, unknown.high - value) <= AT_BOUND * unknown.span:
            paths.append(unknown.parameter.path)
    return tuple(paths)
