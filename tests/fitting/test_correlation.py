"""Correlated residuals: they are recognised, and increase standard errors as they must."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import pbdkit
from pbdkit.fitting import correlation
from pbdkit.fitting.correlation import Correlation, estimate_correlation, is_correlated
from pbdkit.fitting.problem import with_correlated_errors
from tests.fitting.test_fit import NOISE, measured, plate

COARSE = {"lattice": {"type": "square", "a": 2.0}}
UNKNOWN = {"rule.poisson_ratio": [0.0, 0.49]}
SMOOTH, ROUGH = Correlation(0.999, 1.5, 2.0), Correlation(0.7, 2.0, 1.0)


def points_and_basis(axes, count=150, components=2):
    """Random points, and an orthonormal basis of the polynomials that a fit may have removed."""
    places = np.random.default_rng(1).uniform(0.0, 15.0, (count, axes))
    columns = np.stack([np.ones(count), *places.T, *np.square(places.T)], axis=1)
    basis, _ = np.linalg.qr(np.kron(np.eye(components), columns))
    return places, basis


def residuals_of(noise, basis):
    """Residuals of independent components after a linear fit, (component, row)."""
    flat = noise.T.ravel()
    return (flat - basis @ (basis.T @ flat)).reshape(noise.shape[1], -1)


@pytest.mark.parametrize(("axes", "components"), [(1, 1), (2, 2)])
def test_independent_residuals_are_rejected_as_often_as_stated(axes, components):
    places, basis = points_and_basis(axes, 60, components)
    parts = basis.reshape(components, 60, -1)
    generator, trials = np.random.default_rng(0), 400
    count = sum(
        is_correlated(residuals_of(generator.normal(size=(60, components)), basis), parts, places)
        for _ in range(trials)
    )
    assert count <= 4 + 3.5 * 2  # 1 % of them, and three and a half standard deviations


@pytest.mark.parametrize("true", [SMOOTH, ROUGH])
def test_estimated_correlation_gives_the_variance_of_means_and_slopes(true):
    """Residuals are less correlated than the noise; the estimate is that of the noise."""
    places, basis = points_and_basis(2)
    parts = basis.reshape(2, len(places), -1)
    factor = np.linalg.cholesky(true.matrix(cdist(places, places)))
    generator, ratios = np.random.default_rng(2), []
    for _ in range(6):
        residuals = residuals_of(factor @ generator.normal(size=(len(places), 2)), basis)
        assert is_correlated(residuals, parts, places)
        estimate = estimate_correlation(residuals, parts, places)
        ratios.append(
            np.diag(estimate.product(parts, places)) / np.diag(true.product(parts, places))
        )
    assert np.exp(np.log(ratios).mean()) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("true", [SMOOTH, ROUGH])
def test_products_on_pairs_and_on_a_raster_are_those_of_the_matrix(true, axes, monkeypatch):
    places, _ = points_and_basis(axes)
    columns = np.random.default_rng(3).normal(size=(2, len(places), 4)).cumsum(axis=1)
    matrix = true.matrix(cdist(places, places))
    exact = sum(part.T @ matrix @ part for part in columns)
    size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    for limit in (10**9, -1):
        monkeypatch.setattr(correlation, "MAX_PAIRS", limit)
        np.testing.assert_allclose(true.product(columns, places) / size, exact / size, atol=0.02)
    ones = true.effective_count(places)
    assert ones == pytest.approx(len(places) ** 2 / matrix.sum(), rel=0.02)


def test_equal_or_few_residuals_are_not_correlated():
    places, basis = points_and_basis(2)
    parts = basis.reshape(2, len(places), -1)
    assert not is_correlated(np.zeros((2, len(places))), parts, places)
    assert not is_correlated(np.ones((2, 5)), parts[:, :5], places[:5])


def correlated_fit(path, true, **more):
    """A fit of Poisson's ratio to a field with correlated noise."""
    made = plate(**COARSE)
    measured(made, path, count=300)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    matrix = true.matrix(cdist(rows[:, :2], rows[:, :2])) if true else np.eye(len(rows))
    noise = np.linalg.cholesky(matrix) @ np.random.default_rng(7).normal(size=(len(rows), 2))
    rows[:, 2:] += NOISE * noise
    np.savetxt(path, rows, delimiter=",", header="x,y,ux,uy", comments="")
    given = {"file": str(path), "noise": NOISE}
    return {"experiment": made, "unknown": UNKNOWN, "measured": given, "modes": 3} | more


@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_error_of_a_fit_is_that_of_the_true_correlation(loss, tmp_path):
    """The sandwich (JᵀJ)⁻¹ JᵀRJ (JᵀJ)⁻¹ with the matrix from which the noise was drawn."""
    found = pbdkit.fit(correlated_fit(tmp_path / "field.csv", ROUGH, loss=loss))
    places = found.problem.observations[0].places()
    matrix = np.kron(np.eye(2), ROUGH.matrix(cdist(places, places)))
    inverse = np.linalg.pinv(found.solution.at.jacobian)
    exact = np.sqrt((inverse @ matrix @ inverse.T)[0, 0])
    estimate = found.values["rule.poisson_ratio"]
    assert estimate.error == pytest.approx(exact, rel=0.25)
    assert estimate.growth > 2.0
    (misfit,) = found.misfits
    assert misfit.correlation.length == pytest.approx(ROUGH.length, rel=0.5)
    assert misfit.correlation.effective < 0.2 * misfit.numbers
    lines = str(found).splitlines()
    assert any(line.startswith("  residuals are correlated over ") for line in lines)
    assert f"rule.poisson_ratio by a factor of {estimate.growth:.2f}" in lines[-1]
    assert found.as_dict()["values"]["rule.poisson_ratio"]["growth"] == estimate.growth


def test_profile_of_correlated_residuals_agrees_with_the_standard_error(tmp_path):
    fit = correlated_fit(tmp_path / "field.csv", ROUGH, profile=["rule.poisson_ratio"])
    found = pbdkit.fit(fit)
    estimate, profile = found.values["rule.poisson_ratio"], found.profiles["rule.poisson_ratio"]
    assert profile.high - profile.low == pytest.approx(3.92 * estimate.error, rel=0.1)


def test_residuals_far_below_the_noise_do_not_change_the_errors(tmp_path):
    """The measurement is exact: its residuals are those of another tolerance, which are smooth."""
    made, path = plate(**COARSE), tmp_path / "field.csv"
    measured(made, path, count=100)
    given = {"file": str(path), "noise": NOISE}
    fit = {"experiment": made, "unknown": UNKNOWN, "measured": given, "modes": 3}
    assert pbdkit.fit(fit).values["rule.poisson_ratio"].growth < 1.05


def test_independent_residuals_do_not_change_the_errors(tmp_path):
    found = pbdkit.fit(correlated_fit(tmp_path / "field.csv", None))
    assert found.solution.correlations == (None,)
    assert found.values["rule.poisson_ratio"].growth == 1.0
    assert found.misfits[0].correlation is None
    assert "correlated" not in str(found)
    again = with_correlated_errors(found.problem, found.solution, "linear")
    assert again.directions is found.solution.directions
