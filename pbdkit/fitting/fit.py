"""A fit from its description to its answer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError
from pbdkit.fitting.observations import FieldObservation, Observation
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Problem, Solution, Unknown, solved
from pbdkit.fitting.result import Fitted, fitted
from pbdkit.fitting.specification import Fit
from pbdkit.fitting.uncertainty import (
    Candidate,
    Posed,
    compared,
    profiled,
    refuse_no_sampler,
    sampled,
)
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import with_value
from pbdkit.plugin.component import Component
from pbdkit.stepping.state import Floats

ComponentClasses = Iterable[type[Component]]
GIVEN = "as given"
"""What the experiment of the fit is called among candidates."""
INSET = 1e-6
"""How far within bounds, as a share of their span, a number has to be one of the experiment's."""
TINY = 1e-6
"""The noise as a share of what was measured, until residuals tell it: all of them are larger.
Below that share of it again they are rounding."""


def fit_experiment(fit: Fit, experiment: Experiment, components: ComponentClasses = ()) -> Fitted:
    """Carries a fit out, on one thread; its `settings` may name these components. Raises
    ExperimentError for what cannot be fitted."""
    import scipy.linalg  # noqa: F401  # what is loaded later would work on all threads

    known = (*given_classes(experiment), *components)
    try:
        with one_thread():
            return _fitted(fit, experiment, known)
    except ExperimentError as error:
        raise _placed(error, experiment) from None


def _placed(error: ExperimentError, experiment: Experiment) -> ExperimentError:
    """With the place in the fit file, or in its experiment."""
    if error.located or not error.where:
        return error
    if error.where[0] not in Fit.model_fields:
        return experiment.located(error)
    place = ".".join(map(str, error.where))
    return ExperimentError(f"{place}: {error}", error.where)


def _fitted(fit: Fit, experiment: Experiment, components: ComponentClasses) -> Fitted:
    if fit.sampler:
        refuse_no_sampler()
    problem, solution = _solved(problem_of(fit, experiment, components=components), fit)
    names = [*fit.unknown]
    profiles = {
        path: profiled(problem, solution, names.index(path), fit.loss) for path in fit.profile
    }
    sample = sampled(problem, solution, **dict(fit.sampler)) if fit.sampler else None
    candidates = _compared(fit, experiment, Posed(GIVEN, problem, solution), components)
    found = fitted(fit, problem, solution)
    return replace(found, profiles=profiles, sample=sample, candidates=candidates)


def _compared(
    fit: Fit, experiment: Experiment, own: Posed, components: ComponentClasses
) -> tuple[Candidate, ...]:
    """The experiment as it is given, and all that the fit names."""
    if not fit.candidates:
        return ()
    posed, noises = [own], [o.noise for o in own.problem.observations]
    for name, rival in fit.candidates.items():
        where = f"candidates.{name}.settings"
        changed = _with_settings(experiment, rival.settings, fit, where, components)
        try:
            problem = problem_of(fit, changed, rival.unknown, components)
        except ExperimentError as error:
            hint = "" if rival.unknown else "; a candidate may name an `unknown` of its own"
            raise ExperimentError(f"{error}{hint}", ("candidates", name)) from None
        pairs = zip(problem.observations, noises, strict=True)
        problem = replace(problem, observations=tuple(o.with_noise(n) for o, n in pairs))
        posed.append(Posed(name, problem, solved(problem, problem.start(), fit.loss)))
    return compared(posed, fit.folds, fit.loss, seed=0)


def problem_of(
    fit: Fit,
    experiment: Experiment,
    asked: Mapping[str, tuple[float, float]] | None = None,
    components: ComponentClasses = (),
) -> Problem:
    """The problem that a fit file poses, or that with something else unknown. Raises
    ExperimentError."""
    pairs = (asked or fit.unknown).items()
    unknowns = tuple(Unknown(Parameter(path), *bounds) for path, bounds in pairs)
    for unknown in unknowns:
        unknown.parameter.value_in(experiment)
        _refuse_beyond(unknown, experiment)
    observations = []
    for measured in fit.measured:
        settings = measured.settings
        changed = _with_settings(experiment, settings, fit, "measured.settings", components)
        found = replace(measured.observation(changed, fit.modes), weight=measured.weight)
        _refuse_too_few(found, len(unknowns))
        observations.append(found)
    if fit.force and isinstance(observations[0], FieldObservation):
        groups = observations[0].scene.leading
        if fit.force.group >= len(groups):
            text = f"there is no leader group {fit.force.group}"
            raise ExperimentError(text, ("force", "group"))
    problem = Problem(unknowns, tuple(observations))
    _refuse_underdetermined(problem)
    return problem


def _with_settings(
    experiment: Experiment,
    settings: Mapping[str, Any],
    fit: Fit,
    where: str,
    components: ComponentClasses,
) -> Experiment:
    if not settings:
        return experiment
    source = experiment.as_written()
    if source.beside.folder is None:
        source.beside = fit.beside
    for path, value in settings.items():
        source = with_value(source, path, value, f"{where}: {path}", Experiment.defaults())
    return Experiment.build(source, components)


def _refuse_too_few(observation: Observation, unknowns: int) -> None:
    if len(observation.measured) < max(1, 2 * unknowns):
        raise ExperimentError(
            f"{len(observation.measured)} numbers of what was measured lie within the body and the "
            "run, and they are too few; columns x and y count in the experiment's lattice units",
            ("measured", "file"),
        )


def _refuse_beyond(unknown: Unknown, experiment: Experiment) -> None:
    for end in (unknown.low, unknown.high):
        inside = end + INSET * (unknown.low + unknown.high - 2.0 * end)
        try:
            unknown.parameter.put(experiment, inside)
        except ExperimentError as error:
            path = unknown.parameter.path
            text = f"bounds go beyond what the experiment allows: {error}"
            raise ExperimentError(text, ("unknown", path)) from None


def _refuse_underdetermined(problem: Problem) -> None:
    count = sum(len(o.measured) for o in problem.observations)
    if count < problem.size:
        own = problem.size - problem.shared
        raise ExperimentError(
            f"{count} numbers of what was measured cannot tell {problem.size} unknowns, {own} of "
            "which are `modes` of boundaries and terms of `distortion`; take fewer of these",
            ("measured", "file"),
        )


def _solved(problem: Problem, fit: Fit) -> tuple[Problem, Solution]:
    """By the noise that residuals have, where none is given."""
    if fit.measured[0].noise is not None:
        return problem, solved(problem, problem.start(), fit.loss)
    (only,) = problem.observations
    problem = replace(problem, observations=(only.with_noise(TINY * _size(only.measured)),))
    solution = solved(problem, problem.start())
    for _ in range(1 if fit.loss == "linear" else 2):  # a loss tells outliers by the noise
        (only,) = problem.observations
        ratio = max(solution.ratio / np.sqrt(only.weight), TINY)
        problem = replace(problem, observations=(only.with_noise(ratio * only.noise),))
        solution = solved(problem, solution.z, fit.loss)
    return problem, solution


def _size(measured: Floats) -> float:
    return float(np.sqrt(np.mean(measured**2))) or 1.0
