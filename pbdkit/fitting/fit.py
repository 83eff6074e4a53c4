"""Carry out a fit: from the fit file to its result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg  # noqa: F401  # loaded before threads are limited

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError, no_such
from pbdkit.fitting.crack_tip import locate_tip
from pbdkit.fitting.derived import derive, refuse_other_names
from pbdkit.fitting.fit_file import AnyBounds, Fit
from pbdkit.fitting.fit_result import Fitted, fitted
from pbdkit.fitting.modes import least_size, solve
from pbdkit.fitting.observations import FieldObservation, Observation
from pbdkit.fitting.problem import (
    Loss,
    Problem,
    Solution,
    Unknown,
    hat_diagonal,
    spread_of,
    with_correlated_errors,
    with_other_branch,
)
from pbdkit.fitting.specimens import FittedSpecimens, combine_specimens
from pbdkit.fitting.uncertainty import (
    Candidate,
    SolvedProblem,
    compare_models,
    profile_likelihood,
    refuse_no_sampler,
    sample_posterior,
)
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import with_value
from pbdkit.plugin.component import Component

ComponentClasses = Iterable[type[Component]]
BASE_MODEL = "as given"
"""Name of the experiment of the fit in the comparison with candidates."""
INSET = 1e-6
"""The experiment must be valid at this distance from a bound.

It is a fraction of the interval between the bounds.
"""
TINY = 1e-6
"""Initial noise, as a fraction of the measured values.

It is used before the noise is estimated from the residuals. Residuals smaller than this fraction of
the values are rounding errors.
"""

COARSE = 1e-2
"""Initial noise of several measurements, relative to the measured values. The noise of others may
be known, and the first fit must not follow one of them alone."""
MAX_NOISE_ITERATIONS = 30
"""Maximum number of fits by which the noise of several measurements is estimated."""
NOISE_RTOL = 0.01
"""Relative change of the noise at which the estimate has converged."""
MIN_REDUNDANCY = 1.0
"""Smallest number of values, minus that of the unknowns which they determine, for an estimate of
their noise."""


def fit_experiment(
    fit: Fit, experiment: Experiment, components: ComponentClasses = ()
) -> Fitted | FittedSpecimens:
    """Fit the unknown parameters of an experiment, on one thread.

    Parameters
    ----------
    fit
        The fit file.
    experiment
        Experiment with the unknown parameters.
    components
        Component classes that the `settings` in the fit file may use.

    Returns
    -------
    Fitted or FittedSpecimens
        Estimates, standard errors and residuals; a FittedSpecimens if the fit has several
        specimens.

    Raises
    ------
    ExperimentError
        If the parameters cannot be fitted.
    """
    classes = (*given_classes(experiment), *components)
    try:
        with one_thread():
            if fit.specimens:
                return _fit_specimens(fit, experiment, classes)
            return _fit(fit, experiment, classes)
    except ExperimentError as error:
        raise fit.located(error, experiment) from None


def _fit_specimens(
    fit: Fit, experiment: Experiment, components: ComponentClasses
) -> FittedSpecimens:
    """Fit each specimen, and combine the estimates."""
    fits = {}
    for name, part in fit.by_specimen().items():
        try:
            fits[name] = _fit(part, experiment, components)
        except UnconvergedError as error:
            raise UnconvergedError(f"specimen {name}: {error}") from None
        except ExperimentError as error:
            raise ExperimentError(f"specimen {name}: {error}", error.where) from None
    return combine_specimens(fits)


def _fit(fit: Fit, experiment: Experiment, components: ComponentClasses) -> Fitted:
    if fit.sampler:
        refuse_no_sampler()
    located = None
    if fit.crack_tip:
        fit, experiment = _with_settings_applied(fit, experiment, components)
    problem = problem_of(fit, experiment, components=components)
    refuse_other_names(fit, problem)
    if fit.crack_tip:
        solve_with = partial(_solve_with, fit, components)
        problem, solution, located = locate_tip(fit.crack_tip, experiment, solve_with)
    else:
        problem, solution = _solve(problem, fit)
    names = [*fit.unknown]
    profiles = {
        path: profile_likelihood(problem, solution, names.index(path), fit.loss)
        for path in fit.profile
    }
    sample = sample_posterior(problem, solution, **dict(fit.sampler)) if fit.sampler else None
    candidates = _compare_candidates(
        fit, experiment, SolvedProblem(BASE_MODEL, problem, solution), components
    )
    result = fitted(fit, problem, solution)
    return replace(
        result,
        profiles=profiles,
        sample=sample,
        candidates=candidates,
        derived=derive(fit, problem, solution),
        crack_tip=located,
    )


def _solve_with(
    fit: Fit,
    components: ComponentClasses,
    experiment: Experiment,
    change: Callable[[FieldObservation], FieldObservation],
) -> tuple[Problem, Solution]:
    """Fit an experiment after a change of its field observation."""
    problem = problem_of(fit, experiment, components=components)
    (observation,) = problem.observations
    assert isinstance(observation, FieldObservation)
    return _solve(replace(problem, observations=(change(observation),)), fit)


def _compare_candidates(
    fit: Fit, experiment: Experiment, base: SolvedProblem, components: ComponentClasses
) -> tuple[Candidate, ...]:
    """Compare the experiment with the candidates of the fit."""
    if not fit.candidates:
        return ()
    models, noises = [base], [observation.noise for observation in base.problem.observations]
    for name, rival in fit.candidates.items():
        place = f"candidates.{name}.settings"
        changed = _with_settings(experiment, rival.settings, fit, place, components)
        try:
            problem = problem_of(fit, changed, rival.unknown, components)
        except ExperimentError as error:
            hint = "" if rival.unknown else "; a candidate may have a separate `unknown`"
            raise ExperimentError(f"{error}{hint}", ("candidates", name)) from None
        pairs = zip(problem.observations, noises, strict=True)
        problem = replace(
            problem,
            observations=tuple(observation.with_noise(noise) for observation, noise in pairs),
        )
        models.append(SolvedProblem(name, *solve(problem, problem.start(), fit.loss)))
    return compare_models(models, fit.folds, fit.loss, seed=0)


def problem_of(
    fit: Fit,
    experiment: Experiment,
    unknown_bounds: Mapping[str, AnyBounds] | None = None,
    components: ComponentClasses = (),
) -> Problem:
    """Return the least-squares problem of a fit file.

    Parameters
    ----------
    unknown_bounds
        Bounds of the unknown parameters by path; by default those of the fit.

    Raises
    ------
    ExperimentError
        If the experiment has no such parameters, or cannot predict the measurements.
    """
    pairs = (fit.unknown if unknown_bounds is None else unknown_bounds).items()
    unknowns = tuple(_unknown(path, bounds, experiment) for path, bounds in pairs)
    for unknown in unknowns:
        _refuse_beyond(unknown, experiment)
    observations = []
    for measurement in fit.measured:
        settings = measurement.settings
        changed = _with_settings(experiment, settings, fit, "measured.settings", components)
        observation = replace(
            measurement.observation(changed, fit.modes), weight=measurement.weight
        )
        _refuse_too_few(observation, len(unknowns))
        observations.append(observation)
    force = fit.measured_force
    if force and isinstance(observations[0], FieldObservation):
        groups = observations[0].scene.leading
        if force.group >= len(groups):
            text = no_such("leader group", force.group, len(groups))
            raise ExperimentError(text, ("force", "group"))
    problem = Problem(unknowns, tuple(observations))
    _refuse_changing_units(problem, fit)
    _refuse_underdetermined(problem)
    return problem


def _with_settings(
    experiment: Experiment,
    settings: Mapping[str, Any],
    fit: Fit,
    place: str,
    components: ComponentClasses,
) -> Experiment:
    if not settings:
        return experiment
    source = experiment.as_written()
    if source.files.folder is None:
        source.files = fit.files
    for path, value in settings.items():
        source = with_value(source, path, value, f"{place}: {path}", Experiment.defaults())
    return Experiment.build(source, components)


def _with_settings_applied(
    fit: Fit, experiment: Experiment, components: ComponentClasses
) -> tuple[Fit, Experiment]:
    """Return a fit of one measurement without `settings`, and the experiment with them.

    The cut of a crack tip is then moved in the experiment that predicts the measurement.
    """
    (measurement,) = fit.measured
    settings = measurement.settings
    changed = _with_settings(experiment, settings, fit, "measured.settings", components)
    plain = measurement.model_copy(update={"settings": {}})
    return fit.model_copy(update={"measured": (plain,)}), changed


def _refuse_too_few(observation: Observation, unknowns: int) -> None:
    if len(observation.measured) < max(1, 2 * unknowns):
        raise ExperimentError(
            (
                f"only {len(observation.measured)} measured numbers lie within the body and the "
                "run, which are too few; columns x and y must be in the experiment's lattice units"
            ),
            ("measured", "file"),
        )


def _unknown(path: str, bounds: AnyBounds, experiment: Experiment) -> Unknown:
    """Return an unknown. Errors of its bounds name their place in the fit file."""
    try:
        return Unknown.of(path, bounds, experiment)
    except ExperimentError as error:
        raise ExperimentError(str(error), ("unknown", path)) from None


def _refuse_changing_units(problem: Problem, fit: Fit) -> None:
    """Refuse values in units that depend on another modulus than that of `units`."""
    moduli = [u.modulus for u in problem.unknowns if u.modulus is not None]
    for measurement in fit.measured if moduli else ():
        modulus = getattr(measurement, "youngs_modulus", None)
        if modulus is not None and not np.isclose(modulus, moduli[0]):
            raise ExperimentError(
                f"{modulus:g} differs from {moduli[0]:g} of units.youngs_modulus, by which bounds "
                "with a unit are divided; use the same value",
                ("measured", "youngs_modulus"),
            )
    if moduli and problem.with_modulus and (fit.profile or fit.sampler):
        raise ExperimentError(
            "a `profile` or `sampler` requires a known modulus if bounds are stresses, forces or "
            "energies; give `youngs_modulus` of the curve",
            ("unknown",),
        )


def _refuse_beyond(unknown: Unknown, experiment: Experiment) -> None:
    for end in (unknown.low, unknown.high):
        value = end + INSET * (unknown.low + unknown.high - 2.0 * end)
        try:
            unknown.put(experiment, value)
        except ExperimentError as error:
            path = unknown.parameter.path
            text = f"a bound is not valid in the experiment: {error}"
            raise ExperimentError(text, ("unknown", path)) from None


def _refuse_underdetermined(problem: Problem) -> None:
    count = sum(len(observation.measured) for observation in problem.observations)
    if count < (size := least_size(problem)):
        separate = size - problem.shared
        raise ExperimentError(
            f"{count} measured numbers cannot determine {size} unknowns, {separate} of "
            "which are `modes` of boundaries and terms of `distortion`; use fewer of these",
            ("measured", "file"),
        )


def _solve(problem: Problem, fit: Fit) -> tuple[Problem, Solution]:
    """Solve the problem. Noise that is not given is estimated from the residuals.

    Standard errors account for another branch of the predictions and for correlated residuals.
    """
    problem, solution = _minimum(problem, fit)
    solution = with_other_branch(problem, solution, fit.loss)
    return problem, with_correlated_errors(problem, solution, fit.loss)


def _minimum(problem: Problem, fit: Fit) -> tuple[Problem, Solution]:
    """Return the problem with the noise of each measurement, and its solution."""
    unknown = [n for n, measurement in enumerate(fit.measured) if measurement.noise is None]
    if not unknown:
        return solve(problem, problem.start(), fit.loss)
    if len(problem.observations) > 1:
        return _solve_for_noises(problem, fit, unknown)
    (observation,) = problem.observations
    problem = replace(
        problem, observations=(observation.with_noise(TINY * _size(observation.measured)),)
    )
    problem, solution = solve(problem, problem.start(), "linear")
    _redundancies(problem, solution, unknown)
    # A robust loss identifies outliers by means of the noise, so that the fit and the noise are
    # computed twice.
    for _ in range(1 if fit.loss == "linear" else 2):
        (observation,) = problem.observations
        ratio = max(solution.ratio / np.sqrt(observation.weight), TINY)
        problem = replace(
            problem, observations=(observation.with_noise(ratio * observation.noise),)
        )
        problem, solution = solve(problem, solution.z, fit.loss)
    return problem, solution


def _solve_for_noises(
    problem: Problem, fit: Fit, unknown: Sequence[int]
) -> tuple[Problem, Solution]:
    """Solve a problem with several measurements, of which the noise of some is unknown.

    Parameters
    ----------
    unknown
        Indices of the measurements with unknown noise.

    Notes
    -----
    Variance components are estimated by iteration (Förstner 1979): the variance of a measurement is
    the sum of its squared residuals, divided by its redundancy. The redundancy is the number of
    values minus the trace of the part of the hat matrix that belongs to them.
    """
    sizes = {n: _size(problem.observations[n].measured) for n in unknown}
    noises = {n: COARSE * size for n, size in sizes.items()}
    z = None
    for _ in range(MAX_NOISE_ITERATIONS):
        problem = _with_noises(problem, noises)
        problem, solution = solve(problem, problem.start() if z is None else z, fit.loss)
        ratios, previous = _noise_ratios(problem, solution, fit.loss, unknown), noises
        noises = {n: max(ratios[n] * previous[n], TINY * sizes[n]) for n in unknown}
        if max(abs(np.log(noises[n] / previous[n])) for n in unknown) <= NOISE_RTOL:
            return problem, solution
        z = solution.z
    raise UnconvergedError(
        f"the noise of the measurements has not converged after {MAX_NOISE_ITERATIONS} fits; give "
        "the `noise` of each"
    )


def _with_noises(problem: Problem, noises: Mapping[int, float]) -> Problem:
    observations = [
        observation.with_noise(noises.get(n, observation.noise))
        for n, observation in enumerate(problem.observations)
    ]
    return replace(problem, observations=tuple(observations))


def _noise_ratios(
    problem: Problem, solution: Solution, loss: Loss, unknown: Sequence[int]
) -> dict[int, float]:
    """Return the standard deviation of the residuals of some measurements, over their noise."""
    ratios, parts = dict[int, float](), [*problem.rows()]
    for n, redundancy in _redundancies(problem, solution, unknown).items():
        observation, rows = parts[n]
        residuals = solution.at.residuals[rows] / np.sqrt(observation.weight)
        spread = spread_of(residuals, 0, loss)
        scale = np.sqrt(len(residuals) / redundancy) if loss == "linear" else 1.0
        ratios[n] = float(spread * scale)
    return ratios


def _redundancies(problem: Problem, solution: Solution, unknown: Sequence[int]) -> dict[int, float]:
    """Return the number of values of some measurements minus that of the unknowns which they
    determine.

    Raises
    ------
    ExperimentError
        If the unknowns adapt to all values of a measurement.
    """
    hat, redundancies = hat_diagonal(solution.at.jacobian), dict[int, float]()
    parts = [hat[rows] for _, rows in problem.rows()]
    for n in unknown:
        redundancies[n] = len(parts[n]) - float(parts[n].sum())
        if redundancies[n] < MIN_REDUNDANCY:
            raise ExperimentError(
                f"the {len(parts[n])} values of measurement {n} determine {parts[n].sum():.1f} "
                "unknowns, so that their noise cannot be estimated; give its `noise`",
                ("measured",),
            )
    return redundancies


def _size(measured: Floats) -> float:
    return float(np.sqrt(np.mean(measured**2))) or 1.0
