"""Several specimens of one material: means over specimens, and the scatter between them.

Each specimen is fitted separately. Its estimate y_i with standard error s_i is assumed to be
normally distributed about the true value of the specimen, and the true values about the mean μ of
all specimens, with standard deviation τ (random effects).

The variance τ² maximises the restricted likelihood. The mean is weighted by w_i = 1 / (s_i² + τ²).
Its variance is max(1, q) / Σ w_i with q = Σ w_i (y_i - μ)² / (k - 1), and its interval has the
quantiles of Student's t with k - 1 degrees of freedom for k specimens (Hartung and Knapp 2001,
Statistics in Medicine 20, 3875; Sidik and Jonkman 2002, ibid. 21, 3153). The factor is at least 1,
because specimens that agree by chance do not reduce the errors of their measurements (Röver, Knapp
and Friede 2015, BMC Medical Research Methodology 15, 99). If the errors of the measurements are
small, this is the interval of the mean of k values. The interval of τ contains the values for which
Σ w_i (y_i - μ)² lies between the quantiles of χ² with k - 1 degrees of freedom (Viechtbauer 2007,
Statistics in Medicine 26, 37).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError, WarningText
from pbdkit.fitting.fit_result import Fitted
from pbdkit.fitting.problem import IDENTIFIABLE_RATIO, MODULUS
from pbdkit.fitting.uncertainty import Estimate

if TYPE_CHECKING:
    import xarray

TAIL = 0.025
"""Probability on each side of a 95 % interval."""
MAX_DEVIATION = 10.0
"""Largest standard deviation between specimens, divided by that of the estimates."""
COLUMNS = (
    "mean", "standard_error", "low", "high", "degrees_of_freedom", "deviation", "deviation_low",
    "deviation_high",
)  # fmt: skip
"""Variables of the dataset of estimates that are numbers for each parameter."""
MAX_DOUBLINGS = 60
"""Maximum number of doublings of the upper end of the interval of a standard deviation."""


@dataclass(frozen=True)
class SpecimenMean:
    """Mean of a parameter over specimens, and the scatter between them.

    Parameters
    ----------
    value, error : float
        Mean, and its standard error.
    interval : tuple of float
        95 % interval of the mean.
    deviation : float
        Standard deviation between specimens, without the errors of the measurements.
    deviation_interval : tuple of float
        95 % interval of this standard deviation.
    specimens : int
        Number of specimens in which the parameter is identifiable.
    omitted : tuple of str
        Names of the other specimens, which do not contribute.
    identifiable : bool
        False if fewer than two specimens determine the parameter, or if the error of the mean is
        too large.
    unit : str
        Unit of all numbers; empty if the experiment has no units.
    """

    value: float
    error: float
    interval: tuple[float, float]
    deviation: float
    deviation_interval: tuple[float, float]
    specimens: int
    omitted: tuple[str, ...] = ()
    identifiable: bool = True
    unit: str = ""

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of Student's t."""
        return self.specimens - 1

    def lines(self, name: str) -> Iterator[str]:
        """Yield the lines of a summary."""
        omitted = f"; not identifiable in {', '.join(self.omitted)}" if self.omitted else ""
        if not self.identifiable:
            yield f"{name}: not identifiable from the data{omitted}"
            return
        mean = Estimate(self.value, self.error)
        digits = mean.decimals
        low, high = (f"{end:.{digits}f}" for end in self.interval)
        least, most = (f"{end:.{digits}f}" for end in self.deviation_interval)
        unit = f" {self.unit}".rstrip()
        yield f"{name}: {mean}{unit}, 95 % from {low} to {high}"
        yield (
            f"  standard deviation between specimens: {self.deviation:.{digits}f}{unit}, 95 % from "
            f"{least} to {most}"
        )
        yield (
            f"  mean of {self.specimens} specimens, Student's t with {self.degrees_of_freedom} "
            f"degree{'s' * (self.degrees_of_freedom > 1)} of freedom{omitted}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values; None if the value is not identifiable."""
        numbers = asdict(self) | {"degrees_of_freedom": self.degrees_of_freedom}
        if not self.identifiable:
            numbers |= dict.fromkeys(
                ("value", "error", "interval", "deviation", "deviation_interval")
            )
        return numbers


def random_effects(values: Floats, errors: Floats, unit: str = "") -> SpecimenMean:
    """Combine the estimates of at least two specimens.

    Parameters
    ----------
    values, errors : (specimen,)
        Estimates and their standard errors.
    unit
        Unit of both.
    """
    from scipy.stats import t

    deviation = _restricted_deviation(values, errors)
    mean, weights = _weighted_mean(values, errors, deviation)
    freedom = len(values) - 1
    excess = float(weights @ np.square(values - mean)) / freedom
    error = float(np.sqrt(max(1.0, excess) / weights.sum()))
    half = float(t.ppf(1.0 - TAIL, freedom)) * error
    return SpecimenMean(
        mean,
        error,
        (mean - half, mean + half),
        deviation,
        _deviation_interval(values, errors),
        len(values),
        unit=unit,
    )


def _weighted_mean(values: Floats, errors: Floats, deviation: float) -> tuple[float, Floats]:
    """Return the mean, and the weights 1 / (s² + τ²)."""
    weights = 1.0 / (np.square(errors) + deviation**2)
    return float(weights @ values / weights.sum()), weights


def _restricted_deviation(values: Floats, errors: Floats) -> float:
    """Return the standard deviation τ that maximises the restricted likelihood."""
    from scipy.optimize import minimize_scalar

    scatter = float(np.std(values, ddof=1))
    if scatter == 0.0:
        return 0.0

    def criterion(deviation: float) -> float:
        mean, weights = _weighted_mean(values, errors, deviation)
        squares = float(weights @ np.square(values - mean))
        return squares - float(np.log(weights).sum()) + float(np.log(weights.sum()))

    bounds = (1e-9 * scatter, MAX_DEVIATION * scatter)
    best = minimize_scalar(criterion, bounds=bounds, options={"xatol": 1e-6 * scatter})
    is_zero = (errors > 0.0).all() and criterion(0.0) <= best.fun
    return 0.0 if is_zero else float(best.x)


def _deviation_interval(values: Floats, errors: Floats) -> tuple[float, float]:
    """Return the 95 % interval of the standard deviation τ."""
    from scipy.optimize import brentq
    from scipy.stats import chi2

    scatter, freedom = float(np.std(values, ddof=1)), len(values) - 1
    if scatter == 0.0:
        return 0.0, 0.0

    def excess(deviation: float, quantile: float) -> float:
        mean, weights = _weighted_mean(values, errors, deviation)
        return float(weights @ np.square(values - mean)) - quantile

    ends = []
    for quantile in chi2.ppf([1.0 - TAIL, TAIL], freedom):
        low, high = 1e-9 * scatter, scatter
        if excess(low, quantile) <= 0.0:
            ends.append(0.0)
            continue
        for _ in range(MAX_DOUBLINGS):
            if excess(high, quantile) < 0.0:
                break
            high *= 2.0
        ends.append(float(brentq(excess, low, high, (quantile,))))
    return ends[0], ends[1]


@dataclass(frozen=True)
class FittedSpecimens:
    """Result of a fit to several specimens of one material.

    Parameters
    ----------
    values : mapping of str to SpecimenMean
        Means and scatter of the parameters by path.
    youngs_modulus : SpecimenMean or None
        Mean and scatter of Young's modulus, if forces are measured.
    derived : mapping of str to SpecimenMean
        Means and scatter of derived quantities by formula.
    fits : mapping of str to Fitted
        Fit of each specimen by name.
    """

    values: Mapping[str, SpecimenMean]
    youngs_modulus: SpecimenMean | None
    derived: Mapping[str, SpecimenMean]
    fits: Mapping[str, Fitted]

    @property
    def means(self) -> dict[str, SpecimenMean]:
        """Means of the parameters, of Young's modulus and of derived quantities by name."""
        modulus = {MODULUS: self.youngs_modulus} if self.youngs_modulus else {}
        return {**self.values, **modulus, **self.derived}

    @property
    def warnings(self) -> tuple[WarningText, ...]:
        """Warnings of the fits of all specimens."""
        return tuple(
            WarningText(f"specimen {name}: {text}", text.category)
            for name, fit in self.fits.items()
            for text in fit.warnings
        )

    def estimate(self, specimen: str, name: str) -> Estimate:
        """Return the estimate of a parameter or another quantity for one specimen.

        Parameters
        ----------
        specimen : str
            Name of the specimen.
        name : str
            Path of the parameter, "Young's modulus", or the formula of a derived quantity.

        Returns
        -------
        Estimate
            Estimate with its standard error.

        Raises
        ------
        KeyError
            If there is no such specimen or parameter.
        """
        fit = self.fits[specimen]
        modulus = {MODULUS: fit.youngs_modulus} if fit.youngs_modulus else {}
        derived = {formula: entry.estimate for formula, entry in fit.derived.items()}
        return {**fit.values, **modulus, **derived}[name]

    @cached_property
    def estimates(self) -> xarray.Dataset:
        """Dataset of all estimates.

        The variables `value` and `error` have the dimensions specimen and parameter. All others
        have the dimension parameter: `mean`, `standard_error` and its interval from `low` to
        `high`, with the `degrees_of_freedom` of Student's t, and `deviation` between specimens with
        its interval from `deviation_low` to `deviation_high`. Numbers that are not identifiable are
        NaN. `unit` is a coordinate of the parameters.
        """
        import xarray

        names, specimens = [*self.means], [*self.fits]
        table = np.full((2, len(specimens), len(names)), np.nan)
        for i, specimen in enumerate(specimens):
            for j, name in enumerate(names):
                estimate = self.estimate(specimen, name)
                if estimate.identifiable:
                    table[:, i, j] = estimate.value, estimate.error
        columns = np.array(
            [
                (
                    mean.value,
                    mean.error,
                    *mean.interval,
                    mean.degrees_of_freedom,
                    mean.deviation,
                    *mean.deviation_interval,
                )
                if mean.identifiable
                else (np.nan,) * len(COLUMNS)
                for mean in self.means.values()
            ]
        )
        by_parameter = {word: ("parameter", columns[:, n]) for n, word in enumerate(COLUMNS)}
        both = ("specimen", "parameter")
        return xarray.Dataset(
            {"value": (both, table[0]), "error": (both, table[1]), **by_parameter},
            {
                "specimen": specimens,
                "parameter": names,
                "unit": ("parameter", [mean.unit for mean in self.means.values()]),
            },
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON.

        Returns
        -------
        dict
            Content of the file that `pbdkit fit` writes.
        """
        modulus = self.youngs_modulus
        return {
            "values": {path: mean.as_dict() for path, mean in self.values.items()},
            "youngs_modulus": None if modulus is None else modulus.as_dict(),
            "derived": {formula: mean.as_dict() for formula, mean in self.derived.items()},
            "specimens": {name: fit.as_dict() for name, fit in self.fits.items()},
            "warnings": [*map(str, self.warnings)],
        }

    def __str__(self) -> str:
        """A summary: mean, scatter and degrees of freedom of each value, then each specimen."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for name, mean in self.means.items():
            yield from mean.lines(name)
        for specimen, fit in self.fits.items():
            yield f"specimen {specimen}:"
            yield from (f"  {line}" for line in str(fit).splitlines())


def combine_specimens(fits: Mapping[str, Fitted]) -> FittedSpecimens:
    """Combine the fits of at least two specimens."""
    first = next(iter(fits.values()))
    values = {
        unknown.parameter.path: _mean_of(
            {name: fit.values[unknown.parameter.path] for name, fit in fits.items()}, unknown.span
        )
        for unknown in first.problem.unknowns
    }
    for name, fit in fits.items():
        if differing := sorted({*first.derived} ^ {*fit.derived}):
            raise ExperimentError(
                f"the specimens have different numbers of values: {differing[0]} exists in one of "
                f"{next(iter(fits))} and {name} only; select values that exist in all, as K_I[0]",
                ("derived",),
            )
    derived = {
        formula: _mean_of({name: fit.derived[formula].estimate for name, fit in fits.items()})
        for formula in first.derived
    }
    moduli = {name: fit.youngs_modulus for name, fit in fits.items() if fit.youngs_modulus}
    modulus = _mean_of(moduli) if len(moduli) == len(fits) else None
    return FittedSpecimens(values, modulus, derived, fits)


def _mean_of(estimates: Mapping[str, Estimate], span: float | None = None) -> SpecimenMean:
    """Return the mean over those specimens in which a quantity is identifiable.

    Parameters
    ----------
    estimates
        Estimates by name of the specimen.
    span
        Interval between the bounds; None for a modulus, which has no bounds.
    """
    identified = {
        name: entry
        for name, entry in estimates.items()
        if entry.identifiable and np.isfinite(entry.value)
    }
    omitted = tuple(name for name in estimates if name not in identified)
    unit = next(iter(estimates.values())).unit
    if len(identified) < 2:
        nan = (np.nan, np.nan)
        return SpecimenMean(*nan, nan, np.nan, nan, len(identified), omitted, False, unit)
    values, errors = np.array([(entry.value, entry.error) for entry in identified.values()]).T
    mean = random_effects(values, errors, unit)
    size = abs(mean.value) if span is None else span
    is_identifiable = mean.error < IDENTIFIABLE_RATIO * size
    return SpecimenMean(**vars(mean) | {"omitted": omitted, "identifiable": is_identifiable})
