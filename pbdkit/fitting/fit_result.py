"""Result of a fit: estimates with their errors, and residuals of the measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import AccuracyWarning, WarningText, did_you_mean
from pbdkit.fitting.correlation import Correlation
from pbdkit.fitting.crack_tip import LocatedTip
from pbdkit.fitting.derived import Derived
from pbdkit.fitting.fit_file import Fit
from pbdkit.fitting.observations import (
    CurveObservation,
    FieldObservation,
    Observation,
    TracksObservation,
)
from pbdkit.fitting.problem import (
    MODULUS,
    Loss,
    Problem,
    Solution,
    reason_of,
    spread_of,
    steps_beyond_bounds,
)
from pbdkit.fitting.residual_pattern import remedy_of_excess
from pbdkit.fitting.uncertainty import (
    Candidate,
    Combination,
    Estimate,
    Profile,
    Sample,
    combinations,
    youngs_modulus,
)
from pbdkit.io.sinks import MemorySink
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.units import FORCE, LENGTH
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

if TYPE_CHECKING:
    import xarray

BEYOND_BOUND = 2.0
"""Distance of the minimum beyond a bound, in standard errors, above which a warning is issued."""
EXCESS_RATIO = 1.5
"""Ratio of residuals to noise above which a warning is issued."""
EXCESS_DEVIATIONS = 4.0
"""Standard deviations by which the ratio of few independent residuals must exceed 1."""


@dataclass(frozen=True)
class FittedField:
    """A measured field and the residuals of the fit.

    Parameters
    ----------
    points : array of float, shape (point, axis)
        Points of the measurement.
    measured : array of float, shape (point, axis)
        Measured displacements minus the fitted distortion.
    residual : array of float, shape (point, axis)
        Measured minus fitted displacements.
    components : tuple of str
        Measured components, in the order of the columns of the arrays.
    """

    points: Floats
    measured: Floats
    residual: Floats
    components: tuple[str, ...] = ("ux", "uy")


@dataclass(frozen=True)
class FittedNumbers:
    """Measured values as a function of time or displacement, and the residuals of the fit.

    Parameters
    ----------
    along : array of float, shape (number,)
        Abscissae: times, displacements, openings or values of a gauge.
    measured, fitted, residual : array of float, shape (number,)
        Measured and fitted values, and the differences between them.
    what, over : str
        Labels of the values and of `along`.
    joined : bool
        Whether the values form one curve, and not several tracks.
    """

    along: Floats
    measured: Floats
    fitted: Floats
    residual: Floats
    what: str
    over: str
    joined: bool


@dataclass(frozen=True)
class ResidualCorrelation:
    """Correlation of the residuals of one measurement at a distance d > 0.

    It is share · exp(-(d / length)^power).

    Parameters
    ----------
    length : float
        Correlation length.
    share : float
        Correlated fraction of the variance; the remainder is independent.
    power : float
        Exponent, 1 or 2.
    effective : float
        Number of independent values with the same variance of the mean.
    unit : str
        Unit of the length; empty if the experiment has no units.
    """

    length: float
    share: float
    power: float
    effective: float
    unit: str = ""

    def __str__(self) -> str:
        length = f"{self.length:.3g} {self.unit}".rstrip()
        return (
            f"residuals are correlated over {length} ({100.0 * self.share:.0f} % of their "
            f"variance): as much information as {self.effective:.0f} independent numbers"
        )


@dataclass(frozen=True)
class Misfit:
    """Residuals of one measurement.

    Parameters
    ----------
    kind
        Kind of the measurement.
    noise
        Standard deviation of the noise.
    ratio
        Standard deviation of the residuals divided by the noise.
    numbers
        Number of measured values.
    left_out, left_out_because
        Number of rows of the file that are not used, and the reason.
    factor, unit
        If the experiment has units, `factor` times the noise is its value in `unit`.
    correlation
        Correlation of the residuals; None if it is not significant.
    remedy
        Description of residuals well above the noise, and a remedy; otherwise empty.
    """

    kind: str
    noise: float
    ratio: float
    numbers: int
    left_out: int
    left_out_because: str = ""
    factor: float = 1.0
    unit: str = ""
    correlation: ResidualCorrelation | None = None
    remedy: str = ""

    @property
    def noise_with_unit(self) -> str:
        """Noise with its unit, as text."""
        return f"{self.factor * self.noise:.3g} {self.unit}".rstrip()

    def __str__(self) -> str:
        text = (
            f"residual of the {self.kind}: {self.ratio:.2f} times the noise of "
            f"{self.noise_with_unit}, over {self.numbers} numbers"
        )
        if not self.left_out:
            return text
        rows = "row is" if self.left_out == 1 else "rows are"
        return f"{text}; {self.left_out} {rows} omitted: {self.left_out_because}"

    @property
    def exceeds_noise(self) -> bool:
        """True if the residuals are well above the noise."""
        limit = 1.0 + EXCESS_DEVIATIONS / np.sqrt(2.0 * max(self.numbers, 1))
        return bool(self.ratio > max(EXCESS_RATIO, limit))


@dataclass(frozen=True)
class Fitted:
    """Result of a fit.

    If the residuals are larger than the noise divided by the square root of the weight, the
    standard errors are multiplied by the ratio of both. If the residuals of a field or a curve are
    significantly correlated, standard errors account for the correlation.

    Parameters
    ----------
    values : mapping of str to Estimate
        Estimates by path.
    correlations : array of float, shape (parameter, parameter)
        Correlations of the estimates.
    youngs_modulus : Estimate or None
        Young's modulus, if the description gives a force.
    misfits : tuple of Misfit
        Residuals of each measurement, independent of its weight.
    ratio : float
        Standard deviation of all residuals divided by the noise.
    problem, solution
        Least-squares problem and its solution.
    profiles : mapping of str to Profile
        Profile likelihoods by path, of the parameters for which the fit requests them.
    combinations : tuple of Combination
        Combinations of parameters that are not identifiable separately. Identifiable combinations
        come first.
    sample : Sample or None
        Sample of the posterior; None if the fit does not request it.
    candidates : tuple of Candidate
        Compared models, the best one first; empty if the fit has no candidates.
    derived : mapping of str to Derived
        Quantities derived from the fit, by formula.
    crack_tip : LocatedTip or None
        Position of the crack tip, if it is unknown.
    beyond_bounds : mapping of str to float
        Distance of the minimum without bounds beyond each bound that the fit has reached, in
        standard errors, by path.
    """

    values: Mapping[str, Estimate]
    correlations: Floats
    youngs_modulus: Estimate | None
    misfits: tuple[Misfit, ...]
    ratio: float
    problem: Problem = field(repr=False)
    solution: Solution = field(repr=False)
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    combinations: tuple[Combination, ...] = ()
    sample: Sample | None = field(default=None, repr=False)
    candidates: tuple[Candidate, ...] = ()
    derived: Mapping[str, Derived] = field(default_factory=dict)
    crack_tip: LocatedTip | None = None
    beyond_bounds: Mapping[str, float] = field(default_factory=dict)

    @property
    def noise(self) -> float:
        """Standard deviation of the noise of the first measurement."""
        return self.misfits[0].noise

    @property
    def experiment(self) -> Experiment:
        """The experiment of the first measurement with the fitted values.

        Each leader group with the motion `measured` has the displacements that were estimated, at
        the positions of its particles. Parameters that are not identifiable have their initial
        values. The experiment is complete: it can be run, changed, and stored as
        ``json.dumps(experiment.model_dump(mode="json"))``, from which it can be loaded again.
        """
        return self.experiments[0]

    @cached_property
    def experiments(self) -> tuple[Experiment, ...]:
        """The experiments of all measurements with the fitted values.

        They differ by the `settings` of the measurements and by their estimated boundaries.
        """
        z = self.solution.z
        return tuple(
            experiment.of_parts(experiment.model_dump(mode="json", by_alias=True))
            for experiment in (
                observation.moved(self.problem.experiment_at(observation, z), z[own])
                for observation, own in self.problem.own_slices()
            )
        )

    @cached_property
    def dataset(self) -> xarray.Dataset:
        """The dataset of `experiment`, computed when it is first used.

        Its last state is the equilibrium that the fit compares with a measured field. Derived
        quantities are the variables `derived_value`, `derived_error` and `derived_unit` along
        `derived`, their formulas.
        """
        memory = MemorySink()
        record(Simulation.of_scene(build_scene(self.experiment)), memory)
        if not self.derived:
            return memory.dataset()
        estimates = [quantity.estimate for quantity in self.derived.values()]
        columns = {
            f"derived_{name}": ("derived", [getattr(estimate, name) for estimate in estimates])
            for name in ("value", "error", "unit")
        }
        return memory.dataset().assign_coords(derived=[*self.derived]).assign(columns)

    @property
    def warnings(self) -> tuple[WarningText, ...]:
        """Warnings of bounds that exclude the minimum, of residuals well above the noise, and of an
        end at kinks of the prediction."""
        several = len(self.misfits) > 1
        texts = [
            f"unknown.{path}: the fit stops at the bound {self._value_of(path):.6g}, and would be "
            f"better beyond it: the minimum is {distance:.1f} standard errors away; widen this "
            "bound, or correct the model if the values beyond it are impossible"
            for path, distance in self.beyond_bounds.items()
            if distance > BEYOND_BOUND
        ]
        texts += [
            _excess_text(misfit, n, several)
            for n, misfit in enumerate(self.misfits)
            if misfit.exceeds_noise
        ]
        if self.solution.is_stalled:
            texts.append(
                f"no step reduces the residuals, although {self.solution.remaining:.1f} standard "
                "errors remain, because the curve has kinks where cells begin to soften; fewer "
                "steps of the experiment make it smoother"
            )
        return tuple(WarningText(text, AccuracyWarning) for text in texts)

    def _value_of(self, path: str) -> float:
        return float(self.solution.z[[*self.values].index(path)])

    @cached_property
    def reasons(self) -> dict[str, str]:
        """Why the data do not determine each parameter that is not identifiable, and remedies."""
        return {
            path: reason_of(self.problem, self.solution, path)
            for path, estimate in self.values.items()
            if not estimate.identifiable
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON.

        Returns
        -------
        dict
            Content of the file that `pbdkit fit` writes.
        """
        named = {path: estimate.as_dict() for path, estimate in self.values.items()}
        for path, reason in self.reasons.items():
            named[path]["reason"] = reason
        modulus = self.youngs_modulus
        return {
            "values": named,
            "correlations": {
                first: {second: float(self.correlations[n, m]) for m, second in enumerate(named)}
                for n, first in enumerate(named)
            },
            "combinations": {
                combination.name: combination.as_dict() for combination in self.combinations
            },
            "youngs_modulus": None if modulus is None else modulus.as_dict(),
            "residual_over_noise": self.ratio,
            "measured": [asdict(misfit) for misfit in self.misfits],
            "modes": [
                {str(group): count for group, count in self.modes(n).items()}
                for n in range(len(self.misfits))
            ],
            "warnings": [*map(str, self.warnings)],
            "evaluations": self.solution.evaluations,
        } | self._on_request()

    def _on_request(self) -> dict[str, Any]:
        content: dict[str, Any] = {}
        if self.derived:
            content["derived"] = {name: entry.as_dict() for name, entry in self.derived.items()}
        if self.crack_tip:
            content["crack_tip"] = self.crack_tip.as_dict()
        if self.profiles:
            content["profiles"] = {path: entry.as_dict() for path, entry in self.profiles.items()}
        if self.sample:
            words = ("mean", "deviation", "error")
            content["sample"] = {
                path: dict(zip(words, numbers, strict=True))
                for path, *numbers in zip(*self._sample_columns, strict=True)
            }
        if self.candidates:
            content["candidates"] = [asdict(entry) for entry in self.candidates]
        return content

    @property
    def _sample_columns(self) -> tuple[list[Any], ...]:
        assert self.sample is not None
        numbers = (self.sample.mean, self.sample.deviation, self.sample.error)
        return [*self.values], *(array.tolist() for array in numbers)

    def field(self, n: int = 0) -> FittedField:
        """Return the residuals of a measured field.

        Parameters
        ----------
        n : int
            Number of the measurement, from 0.

        Returns
        -------
        FittedField
            Points, measured displacements and residuals.

        Raises
        ------
        ValueError
            If the measurement is of another kind.
        """
        observation, rows = [*self.problem.rows()][n]
        if not isinstance(observation, FieldObservation):
            raise ValueError(f"measurement {n} is not a field: {observation.kind}")
        values = self.solution.z[[*self.problem.own_slices()][n][1]]
        evidence = observation.evidence
        strengths = values[len(values) - evidence.distortions.shape[1] :]
        measured = evidence.measured - evidence.distortions @ strengths
        residual = self.solution.at.residuals[rows] * observation.weighted_noise
        count, names = len(evidence.axes), tuple(f"u{'xy'[axis]}" for axis in evidence.axes)
        return FittedField(
            evidence.points, measured.reshape(count, -1).T, residual.reshape(count, -1).T, names
        )

    def modes(self, n: int = 0) -> dict[int, int]:
        """Return the numbers of modes of the measured boundaries of a field.

        Parameters
        ----------
        n : int
            Number of the measurement, from 0.

        Returns
        -------
        dict of int to int
            Numbers of modes by leader group.
        """
        observation = self.problem.observations[n]
        if not isinstance(observation, FieldObservation):
            return {}
        return {boundary.group: boundary.count for boundary in observation.boundaries}

    def distortions(self, n: int = 0) -> dict[str, Estimate]:
        """Return the fitted amplitudes of the distortions of a measured field.

        Parameters
        ----------
        n : int
            Number of the measurement, from 0.

        Returns
        -------
        dict of str to Estimate
            Amplitudes by polynomial, for instance "ux x^2 y^0". In the polynomials, x and y are
            scaled so that they range from -1 to 1 over the points.
        """
        observation, columns = [*self.problem.own_slices()][n]
        if not isinstance(observation, FieldObservation):
            return {}
        terms = observation.evidence.terms
        names = [
            f"{u} x^{p} y^{q}"
            for u, exponents in zip(("ux", "uy"), terms, strict=True)
            for p, q in exponents
        ]
        z, errors = self.solution.z[columns], self.solution.errors[columns]
        pairs = zip(z[len(z) - len(names) :], errors[len(z) - len(names) :], strict=True)
        return {
            name: Estimate(float(value), float(error))
            for name, (value, error) in zip(names, pairs, strict=True)
        }

    def numbers(self, n: int = 0) -> FittedNumbers:
        """Return the residuals of measured tracks or of a curve.

        Parameters
        ----------
        n : int
            Number of the measurement, from 0.

        Returns
        -------
        FittedNumbers
            Measured and fitted values, and residuals.

        Raises
        ------
        ValueError
            If the measurement is a field.
        """
        observation, rows = [*self.problem.rows()][n]
        if not isinstance(observation, TracksObservation | CurveObservation):
            raise ValueError(f"measurement {n} is a {observation.kind}")
        measured = observation.measured * observation.unit
        residual = self.solution.at.residuals[rows] * observation.weighted_noise * observation.unit
        along = np.tile(observation.along, len(measured) // len(observation.along))
        what, over, joined = observation.names
        return FittedNumbers(along, measured, measured - residual, residual, what, over, joined)

    def information(self, n: int = 0) -> dict[str, Floats]:
        """Return how much information each measured value contains about each parameter.

        Parameters
        ----------
        n : int
            Number of the measurement, from 0.

        Returns
        -------
        dict of str to array of float, shape (number,)
            Information by path.

        Notes
        -----
        The information is the square of the derivative of the prediction with respect to the
        parameter. Before it is squared, the derivative is projected on the orthogonal complement of
        the derivatives with respect to all other unknowns.
        """
        jacobian, result = self.solution.at.jacobian, dict[str, Floats]()
        _, rows = [*self.problem.rows()][n]
        for column, path in enumerate(self.values):
            basis, *_ = np.linalg.qr(np.delete(jacobian, column, axis=1))
            part = jacobian[:, column] - basis @ (basis.T @ jacobian[:, column])
            result[path] = np.asarray(part[rows] ** 2)
        return result

    def __str__(self) -> str:
        """A summary: a line for each value with its error, then correlations and residuals."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
            if reason := self.reasons.get(path):
                yield f"  {reason}"
        if self.youngs_modulus:
            yield f"{MODULUS}: {self.youngs_modulus}"
        if self.crack_tip:
            yield f"crack tip: {self.crack_tip}"
        for name, quantity in self.derived.items():
            yield f"{name}: {quantity}"
        yield from map(str, self.combinations)
        for n, first in enumerate(self.values):
            for m, second in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {first} and {second}: {self.correlations[n, m]:.2f}"
        for n, misfit in enumerate(self.misfits):
            yield str(misfit)
            if misfit.correlation:
                yield f"  {misfit.correlation}"
            if counts := self.modes(n):
                each = ", ".join(f"{count} of group {group}" for group, count in counts.items())
                yield f"modes of measured boundaries: {each}"
        if any(misfit.correlation for misfit in self.misfits) and (growths := [*self._growths()]):
            yield f"the correlation increases standard errors: {', '.join(growths)}"
        for path, profile in self.profiles.items():
            yield f"{path}: {profile}, by its profile"
        if self.sample:
            numbers = zip(*self._sample_columns, strict=True)
            for path, mean, deviation, error in numbers:
                yield f"{path}: {Estimate(mean, deviation)}, by the sampler, to ± {error:.1g}"
        yield from map(str, self.candidates)

    def _growths(self) -> Iterator[str]:
        modulus = {MODULUS: self.youngs_modulus} if self.youngs_modulus else {}
        derived = {name: quantity.estimate for name, quantity in self.derived.items()}
        for name, estimate in (dict(self.values) | modulus | derived).items():
            if estimate.identifiable and np.isfinite(estimate.value):
                yield f"{name} by a factor of {estimate.growth:.2f}"


def fitted(fit: Fit, problem: Problem, solution: Solution) -> Fitted:
    """Return the result in terms of the fit file."""
    count = len(problem.unknowns)
    errors = solution.errors[:count]
    values = {
        unknown.parameter.path: Estimate(
            float(value),
            float(error),
            unknown.parameter.path not in solution.unidentified,
            unknown.parameter.path in solution.on_bounds,
            unit=unknown.unit,
            growth=float(growth),
        )
        for unknown, value, error, growth in zip(
            problem.unknowns, solution.z, errors, solution.growth, strict=False
        )
    }
    covariance = solution.covariance[:count, :count]
    correlations = covariance / np.outer(errors, errors)
    residuals = solution.at.residuals.copy()
    for observation, rows in problem.rows():
        residuals[rows] /= np.sqrt(observation.weight)
    of_residuals = solution.correlations or (None,) * len(problem.observations)
    misfits = tuple(
        _residuals_of(observation, residuals[rows], fit.loss, correlation)
        for (observation, rows), correlation in zip(problem.rows(), of_residuals, strict=True)
    )
    ratio = spread_of(residuals, problem.size, fit.loss)
    modulus = youngs_modulus(fit.measured_force, problem, solution)
    several = combinations(problem, solution)
    return Fitted(
        _ByPath(values),
        correlations,
        modulus,
        misfits,
        ratio,
        problem,
        solution,
        combinations=several,
        beyond_bounds=steps_beyond_bounds(problem, solution, fit.loss),
    )


class _ByPath(dict[str, Estimate]):
    """Estimates by the path of the parameter."""

    def __missing__(self, path: str) -> Estimate:
        near = [name for name in self if name.endswith(f".{path}")]
        hint = f"; write '{near[0]}'" if near else did_you_mean(path, self)
        raise KeyError(f"there is no parameter '{path}'{hint} ({', '.join(self)})")


def _excess_text(misfit: Misfit, n: int, several: bool) -> str:
    """Return the warning for residuals that are well above the noise."""
    place = f"measured.{n}" if several else "measured"
    return (
        f"{place}: the residuals of the {misfit.kind} are {misfit.ratio:.1f} times the noise of "
        f"{misfit.noise_with_unit}: {misfit.remedy}. Standard errors are multiplied by the ratio "
        "of all residuals, but do not contain the bias of a wrong experiment"
        + "; if the measurements are of several specimens, set `specimens: true`"
        * several
    )


def _correlation_of(
    observation: Observation, correlation: Correlation | None
) -> ResidualCorrelation | None:
    """Return the correlation of the residuals of an observation in the units of the experiment."""
    places = observation.correlated_places()
    if correlation is None or places is None:
        return None
    components = len(observation.measured) // len(places)
    units = observation.experiment.units
    factor, unit = (units.length_mm, LENGTH.unit) if units else (1.0, "")
    if isinstance(observation, CurveObservation) and observation.over.quantity is not LENGTH:
        factor, unit = 1.0, "steps" * observation.at_times
    return ResidualCorrelation(
        factor * correlation.length,
        correlation.share,
        correlation.power,
        components * correlation.effective_count(places),
        unit,
    )


def _residuals_of(
    observation: Observation, residuals: Floats, loss: Loss, correlation: Correlation | None
) -> Misfit:
    """Summarise the residuals of an observation."""
    misfit = Misfit(
        observation.kind,
        observation.noise * observation.unit,
        spread_of(residuals, 0, loss),
        len(residuals),
        observation.left_out,
        observation.left_out_because,
        *unit_of(observation),
        _correlation_of(observation, correlation),
    )
    if not misfit.exceeds_noise:
        return misfit
    unweighted = replace(observation, weight=1.0)  # As are the residuals here.
    return replace(misfit, remedy=remedy_of_excess(unweighted, residuals, loss))


def unit_of(observation: Observation) -> tuple[float, str]:
    """Return the factor and the unit that convert an observation to the units of the experiment.

    Forces are in N, and lengths in lattice units. Without units, and for strains, the factor is 1,
    and the unit is an empty text.
    """
    units, quantity = observation.experiment.units, observation.quantity
    if units is None or quantity is None:
        return 1.0, ""
    return (1.0, FORCE.unit) if quantity is FORCE else (units.length_mm, LENGTH.unit)
