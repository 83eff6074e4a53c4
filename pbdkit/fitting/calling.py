"""A fit from its description to its answer."""

from __future__ import annotations

from dataclasses import replace

from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError
from pbdkit.experiment.given import given_classes
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_value
from pbdkit.experiment.source import Source
from pbdkit.fitting.fitted import Fitted, fitted
from pbdkit.fitting.least_squares import Solution, solved
from pbdkit.fitting.measurements import Measured
from pbdkit.fitting.observation import Observation
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Problem, Unknown
from pbdkit.fitting.resting_field import FieldObservation
from pbdkit.fitting.specification import Fit


def fit_experiment(fit: Fit, experiment: Experiment) -> Fitted:
    """Carries a fit out, on one thread. Raises ExperimentError for what cannot be fitted."""
    with one_thread():
        problem = problem_of(fit, experiment)
        return fitted(fit, *_solved(problem, fit))


def problem_of(fit: Fit, experiment: Experiment) -> Problem:
    """The problem that a fit file poses. Raises ExperimentError."""
    unknowns = tuple(Unknown(Parameter(path), *bounds) for path, bounds in fit.unknown.items())
    for unknown in unknowns:
        unknown.parameter.value_in(experiment)
    observations = []
    for measured in fit.measured:
        found = measured.observation(_with_settings(experiment, measured, fit), fit.modes)
        _refuse_too_few(found, len(unknowns))
        observations.append(found)
    if fit.force and isinstance(observations[0], FieldObservation):
        groups = observations[0].scene.leading
        if fit.force.group >= len(groups):
            text = f"there is no leader group {fit.force.group}"
            raise ExperimentError(text, ("force", "group"))
    return Problem(unknowns, tuple(observations))


def _with_settings(experiment: Experiment, measured: Measured, fit: Fit) -> Experiment:
    if not measured.settings:
        return experiment
    source = Source(experiment.name, experiment.as_written(), {}, fit.folder)
    for path, value in measured.settings.items():
        source = with_value(source, path, value, f"settings: {path}", Experiment.defaults())
    return Experiment.build(source, given_classes(experiment))


def _refuse_too_few(observation: Observation, unknowns: int) -> None:
    if len(observation.measured) < max(1, 2 * unknowns):
        raise ExperimentError(
            f"{len(observation.measured)} numbers of what was measured lie within the body and the "
            "run, and they are too few; columns x and y count in the experiment's lattice units",
            ("measured", "file"),
        )


def _solved(problem: Problem, fit: Fit) -> tuple[Problem, Solution]:
    """By the noise that residuals have, where none is given."""
    solution = solved(problem, problem.start(), fit.loss)
    if fit.measured[0].noise is None:
        (only,) = problem.observations
        noise = solution.ratio * only.noise
        problem = replace(problem, observations=(only.with_noise(noise),))
        solution = solved(problem, solution.z, fit.loss)
    return problem, solution
