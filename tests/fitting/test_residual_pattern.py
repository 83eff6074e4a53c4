"""A fit that does not converge names a remedy that its residuals suggest."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fitting.test_fit import HEIGHT, WIDTH, plate

import pbdkit
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.fitting import problem as problem_module
from pbdkit.fitting.observations import FieldEvidence, FieldObservation
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Problem, Unknown, solved
from pbdkit.fitting.residual_pattern import remedy_of
from pbdkit.scene.scene import build_scene


@pytest.fixture(scope="module")
def field():
    scene = build_scene(pbdkit.Experiment(**plate(lattice={"type": "square", "a": 2.0})))
    points = np.random.default_rng(5).uniform([0.0, 0.0], [WIDTH, HEIGHT], (600, 2))
    evidence = FieldEvidence.of(scene, points, np.zeros_like(points), (((0, 0),), ()))
    return FieldObservation.of(scene, evidence, 1e-3, modes=4)


PATTERNS = {
    "outliers": (
        lambda x, y, noise: np.where(np.arange(len(noise)) % 40 == 0, 30.0, noise),
        r"residuals are outliers, the largest at .*; set `loss: soft_l1`",
    ),
    "distortion": (lambda x, y, noise: noise + 9.0 * x**2, r"distortion: \{ux: \[\[2, 0\]"),
    "noise": (lambda x, y, noise: 6.0 * noise, r"5\.\d times the noise.*`noise: 0\.00[56]"),
    "as large as the noise": (lambda x, y, noise: noise, "fit fewer parameters or `modes`"),
    "boundary": (
        lambda x, y, noise: noise * np.where(x > 0.85, 40.0 * np.sign(np.sin(9.0 * y)), 1.0),
        r"beside leader group 1 at \(20, 5\), which its 4 modes do not follow",
    ),
    "block": (
        lambda x, y, noise: noise * np.where(np.hypot(x + 0.4, y + 0.4) < 0.25, 40.0, 2.0),
        r"concentrated about \(\d.*model what is there",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PATTERNS)
def test_remedy_follows_from_the_pattern(name, field):
    pattern, remedy = PATTERNS[name]
    x, y = (field.evidence.points / [WIDTH / 2, HEIGHT / 2] - 1.0).T
    uniform = np.random.default_rng(6).uniform(-1.7, 1.7, (2, len(x)))
    second = uniform[1] if name == "distortion" else pattern(x, y, uniform[1])
    residuals = np.concatenate([pattern(x, y, uniform[0]), second])
    text = remedy_of([field], [residuals], "linear")
    assert re.search(remedy, text), text


@pytest.mark.parametrize("axis", [0, 1])
def test_remedy_of_a_field_of_one_component(axis, field):
    scene, points = field.scene, field.evidence.points[:301]
    evidence = FieldEvidence.of(scene, points, np.zeros((301, 1)), axes=(axis,))
    observation = FieldObservation.of(scene, evidence, 1e-3, modes=4)
    x, y = (evidence.points / [WIDTH / 2, HEIGHT / 2] - 1.0).T
    noise = np.random.default_rng(6).uniform(-1.7, 1.7, len(x))
    smooth = remedy_of([observation], [noise + 9.0 * x**2], "linear")
    assert f"distortion: {{u{'xy'[axis]}: [[2, 0]" in smooth
    excess = np.where(x > 0.85, 40.0 * np.sign(np.sin(9.0 * y)), 1.0)
    assert "beside leader group 1" in remedy_of([observation], [noise * excess], "linear")


def test_fit_that_stops_names_values_and_remedy(field, monkeypatch):
    """Derivatives of the opposite sign: no step reduces the cost."""
    problem = Problem((Unknown(Parameter("rule.poisson_ratio"), 0.0, 0.49),), (field,))
    start = problem.start()
    predicted = -problem.residuals(np.concatenate([[0.45], start[1:]])) * field.noise
    problem = replace(problem, observations=(replace(field, measured=predicted),))
    true_at = Problem.at

    def opposite(self, z, *arguments, **options):
        at = true_at(self, z, *arguments, **options)
        at.jacobian[:, 0] *= -1.0
        return at

    monkeypatch.setattr(Problem, "at", opposite)
    monkeypatch.setattr(problem_module, "MIN_RADIUS", 0.1)
    with pytest.raises(UnconvergedError, match=r"no step from rule.poisson_ratio = 0\.\d+.*; \w+"):
        solved(problem, start)
