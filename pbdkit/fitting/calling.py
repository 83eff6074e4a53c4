"""A fit from its description to its answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Sites
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.fitting.evidence import FieldEvidence
from pbdkit.fitting.fitted import Fitted, fitted
from pbdkit.fitting.least_squares import solved
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Problem, Unknown
from pbdkit.fitting.specification import Fit
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import Floats

GUESS = 1.0
"""The noise where none is given, until residuals tell it."""


def fit_experiment(fit: Fit, experiment: Experiment) -> Fitted:
    """Carries a fit out, on one thread. Raises ExperimentError for what cannot be fitted."""
    with one_thread():
        return _fitted(fit, experiment)


def _fitted(fit: Fit, experiment: Experiment) -> Fitted:
    if experiment.solver.makes_steps:
        experiment = experiment.model_copy(update={"solver": Equilibrium()})
    unknowns = tuple(Unknown(Parameter(path), *bounds) for path, bounds in fit.unknown.items())
    for unknown in unknowns:
        unknown.parameter.value_in(experiment)
    scene = build_scene(experiment)
    if fit.force and fit.force.group >= len(scene.leading):
        raise ExperimentError(f"there is no leader group {fit.force.group}", ("force", "group"))
    evidence = _field(fit, scene)
    if len(evidence.measured) < 2 * len(unknowns):
        raise ExperimentError(
            f"{len(evidence.points)} points lie within the body, and they are too few; columns x "
            "and y count in the experiment's lattice units",
            ("measured", "file"),
        )
    problem = Problem.of(scene, unknowns, (evidence,), fit.modes)
    solution = solved(problem, problem.start(), fit.loss)
    noise = evidence.noise
    if fit.measured.noise is None:
        noise = solution.ratio * GUESS
        problem = replace(problem, evidence=(replace(evidence, noise=noise),))
        solution = solved(problem, solution.z, fit.loss)
    left_out = len(fit.measured.points) - len(evidence.points)
    return fitted(fit, problem, solution, left_out, noise)


def _field(fit: Fit, scene: Scene) -> FieldEvidence:
    given = fit.measured
    points, displacements = given.points, given.displacements
    if given.margin:
        inside = _depth(scene.experiment, points) >= given.margin
        points, displacements = points[inside], displacements[inside]
    terms = given.distortion.ux, given.distortion.uy
    return FieldEvidence.of(scene, points, displacements, given.noise or GUESS, terms)


def _depth(experiment: Experiment, points: Floats) -> Floats:
    """How far within the body points lie; below 0 outside."""
    cell, origin = experiment.lattice.cell(), experiment.lattice.origin
    index = np.linalg.solve(np.array(cell.vectors, float).T, (points - origin).T)
    index *= np.array(cell.period)[:, None]
    return -np.asarray(experiment.body.distance(Sites(tuple(index), tuple(points.T))))
