"""Parts of fits against closed forms: bounds, curves, profiles, marginals and likelihoods."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear
from scipy.stats import uniform

import pbdkit
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting import fit, observations, problem, strength, uncertainty
from pbdkit.fitting.fit_result import Fitted
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Linearisation

RNG = np.random.default_rng(3)


def linearisation(residuals: Any, jacobian: Any) -> Linearisation:
    return Linearisation(np.zeros(jacobian.shape[1]), residuals, jacobian, ())


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_modes_of_a_boundary_do_not_depend_on_its_place_and_size(scale: float) -> None:
    t = np.linspace(-1.0, 1.0, 9)[:, None]
    line = scale * (t * [0.8, 0.6])
    modes = observations._polynomials(line, 4, 0)
    np.testing.assert_allclose(
        np.abs(modes), np.abs(np.polynomial.legendre.legvander(t[:, 0], 3)), atol=1e-9
    )
    bent = line + scale * 1e-2 * t**2 * [-0.6, 0.8]
    with pytest.raises(ExperimentError, match="must lie on a line"):
        observations._polynomials(bent, 4, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("turn", [3, 5, 8])
def test_a_curve_ends_where_its_abscissa_turns(sign: float, turn: int) -> None:
    steps = np.where(np.arange(7) < turn - 1, 0.7, -0.3) * sign
    places = 2.0 + np.concatenate([[0.0], np.cumsum(steps)])
    x, forces = observations._monotonic_part(places, 10.0 * places)
    assert (np.diff(x) > 0.0).all()
    np.testing.assert_allclose(forces, 10.0 * x)
    np.testing.assert_allclose(np.sort(places[:turn]), x)


def test_derivatives_of_smooth_functions_need_few_values() -> None:
    """Differences of order 4 are exact for polynomials of order 4."""
    source = pbdkit.Experiment(
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": 4, "rows": 4},
        neighbours={"type": "chebyshev", "shells": 1},
        rule={"type": "elastic", "poisson_ratio": 0.3},
        leaders=[],
        steps=1,
    )
    parameter, counts = Parameter("rule.poisson_ratio"), []
    for power in (1, 2, 30):
        values: list[float] = []

        def function(experiment: Any, values: Any = values, power: Any = power) -> Any:
            values.append(parameter.value_in(experiment))
            return np.array([values[-1] ** power])

        (slope,) = parameter.derivative(source, function, 1e-10)
        assert slope == pytest.approx(power * 0.3 ** (power - 1), rel=1e-8)
        counts.append(len(values))
    assert counts[0] == counts[1] == 4


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 0.5), (0.0, 1e3), (5.0, 6.0)])
def test_bounds_are_tested_just_inside(low: float, high: float) -> None:
    values = []
    parameter = SimpleNamespace(put=lambda _, value: values.append(value), path="rule.x")
    fit._refuse_beyond(problem.Unknown(parameter, low, high), None)
    assert low < min(values) < low + 1e-5 * (high - low)
    assert high > max(values) > high - 1e-5 * (high - low)


def test_the_guess_without_a_field_is_the_middle() -> None:
    field = SimpleNamespace(evidence=SimpleNamespace(points=[]))
    low, high = np.array([1.0, -4.0]), np.array([2.0, -2.0])
    np.testing.assert_array_equal(problem.least_gap(field, [], low, high), [1.5, -3.0])


@pytest.mark.parametrize("units", [1e-3, 1.0, 1e3])
def test_a_linear_step_is_the_least_squares_solution_between_bounds(units: float) -> None:
    for _ in range(10):
        J, r = RNG.normal(size=(12, 3)), RNG.normal(size=12)
        low, high = -RNG.uniform(0.05, 0.6, 3), RNG.uniform(0.05, 0.6, 3)
        step = problem._linear_step(
            linearisation(r, J / units), low * units, high * units, "linear"
        )
        exact = lsq_linear(J, r, (low, high), tol=1e-14).x
        np.testing.assert_allclose(step / units, exact, atol=1e-7)


def test_a_step_between_bounds_reduces_the_cost_with_nearly_dependent_columns() -> None:
    """At its bound, a parameter p is replaced by the nearly dependent unknowns a and b.

    The columns b - a = 3e-5 p + 1.2e-5 t. The component along t belongs to a null direction of all
    columns, but it is not small if the residuals along p are removed by b - a.
    """
    p, a, t = np.linalg.qr(RNG.normal(size=(12, 3)))[0].T
    J = np.stack([p, a, a + 3e-5 * p + 1.2e-5 * t], axis=1)
    high = np.array([0.1, np.inf, np.inf])
    for size in (1.0, 1e3, 1e6):
        r = size * (p - 2.0 * t)
        step = problem._linear_step(linearisation(r, J), -high, high, "linear")
        assert abs(step[0]) <= 0.1
        assert problem.cost_of(r - J @ step, "linear") < problem.cost_of(r, "linear")


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_a_robust_step_minimises_the_loss(loss: Any) -> None:
    """Reweighting ends at the minimum of the cost, with outliers."""
    J, free = RNG.normal(size=(40, 3)), np.full(3, 1e3)
    r = RNG.normal(size=40) + np.where(np.arange(40) % 7 == 0, 12.0, 0.0)
    step = problem._linear_step(linearisation(r, J), -free, free, loss)
    scale = problem.OUTLIERS
    exact = least_squares(
        lambda y: r - J @ y, np.zeros(3), loss=loss, f_scale=scale, xtol=1e-15, ftol=1e-15
    )
    np.testing.assert_allclose(step, exact.x, atol=1e-5)
    assert problem.cost_of(r - J @ exact.x, loss) == pytest.approx(2.0 * exact.cost)


@pytest.mark.parametrize("noise", [1e-6, 1e-3, 1.0])
def test_null_directions_do_not_depend_on_the_noise(noise: float) -> None:
    """Three residuals that depend on 2 a + b and on c determine neither a nor b."""
    J = np.array([[2.0, 1.0, 0.0], [4.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    unknowns = [
        SimpleNamespace(span=1.0, parameter=SimpleNamespace(path=path)) for path in ("a", "b", "c")
    ]
    stub = SimpleNamespace(unknowns=unknowns, with_modulus=False, size=3)
    at = linearisation(np.zeros(3), J / noise)
    directions, names = problem._identify_directions(stub, at, "linear")
    (null,) = directions.vectors[directions.is_null]
    np.testing.assert_allclose(null / null[1], [-0.5, 1.0, 0.0], atol=1e-12)
    assert {"a", "b"} <= {*names}


def test_information_adds_up_to_the_inverse_variance() -> None:
    """Σ information of a parameter = 1 / (JᵀJ)⁻¹ of it, with all others estimated as well."""
    J = RNG.normal(size=(9, 3))
    stub = SimpleNamespace(
        solution=SimpleNamespace(at=linearisation(np.zeros(9), J)),
        problem=SimpleNamespace(rows=lambda: [(None, slice(0, 9))]),
        values={"a": 0.0, "b": 0.0, "c": 0.0},
    )
    information = Fitted.information(stub)
    total = [values.sum() for values in information.values()]
    np.testing.assert_allclose(total, 1.0 / np.diag(np.linalg.inv(J.T @ J)))


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_profile_of_a_parabola_ends_at_1_96_standard_deviations(direction: float) -> None:
    values = 5.0 + direction * np.array([0.0, 0.3, 0.9, 1.4])
    rises = ((values - 5.0) / 0.5) ** 2
    assert uncertainty._crossing(values, rises) == pytest.approx(
        5.0 + direction * 0.5 * math.sqrt(3.841)
    )
    assert uncertainty._crossing(values[:3], rises[:3]) is None
    assert uncertainty._crossing(values[3:], rises[3:]) is None


def test_a_profile_that_is_flat_near_the_fit_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rise 5 x⁴ reaches 3.841 at x = (3.841 / 5)^¼."""

    def fit_at(_: Any, n: int, value: float, start: Any, loss: str) -> Any:
        return 2.0 + 0.5 * 5.0 * value**4, start

    monkeypatch.setattr(uncertainty, "_fit_at", fit_at)
    monkeypatch.setattr(uncertainty, "_unit", lambda *_: (0.5, 2.0))
    coarse = np.array([[0.0, 0.0], [0.4, 5.0 * 0.4**4], [3.0, 5.0 * 3.0**4]])
    stub = SimpleNamespace(z=None)
    side = uncertainty._refine(coarse, None, stub, 0, "linear")
    np.testing.assert_allclose(side[:, 1], 5.0 * side[:, 0] ** 4)
    exact = (3.841 / 5.0) ** 0.25
    assert uncertainty._crossing(*side.T) == pytest.approx(exact, rel=0.05)
    assert uncertainty._crossing(*coarse.T) != pytest.approx(exact, rel=0.05)


@pytest.mark.parametrize("size", [0.5, 1.0, 3.0])
def test_the_marginal_of_a_linear_problem_is_gaussian(
    monkeypatch: pytest.MonkeyPatch, size: float
) -> None:
    """∫ exp(-|r - J q|²/2s²) dq ∝ exp(-r·(1 - J J⁺) r/2s²) / √det JᵀJ."""
    J, r = RNG.normal(size=(8, 2)) * [1.0, 1e3], RNG.normal(size=8)
    rest = SimpleNamespace(size=2, at=lambda _: linearisation(r, J))
    monkeypatch.setattr(uncertainty, "Problem", lambda *_: rest)
    stub = SimpleNamespace(observations=(), unknowns=())
    found = uncertainty._marginal(stub, np.zeros(2), np.zeros(0), size)
    remainder = r @ (r - J @ np.linalg.pinv(J) @ r)
    exact = -0.5 * remainder / size**2 - 0.5 * np.linalg.slogdet(J.T @ J)[1]
    assert found == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize(
    ("combination", "is_product"),
    [(lambda z: z[0] * z[1], True), (lambda z: z[0] + z[1], False), (None, True)],
    ids=["product", "sum", "unknown"],
)
def test_a_combination_is_a_product_if_the_residuals_depend_on_it(
    combination: Any, is_product: bool
) -> None:
    """A combination that cannot be evaluated elsewhere is given as a product."""
    z = np.array([2.0, 3.0])

    def residuals(moved: Any) -> Any:
        if combination is None:
            raise UnconvergedError("no equilibrium")
        return np.array([20.0 * (combination(moved) - combination(z))])

    stub = SimpleNamespace(bounds=lambda: (np.array([0.1, 0.1]), np.array([50.0, 50.0])))
    stub.residuals = residuals
    solution = SimpleNamespace(z=z, at=SimpleNamespace(residuals=np.zeros(1)))
    direction = np.array([1.0, -1.0]) if is_product else np.array([1.0, -2.0 / 3.0])
    rows = np.array([0, 1])
    assert uncertainty._is_product(stub, solution, rows, direction) == is_product


def test_the_likelihood_of_uniform_strengths_is_that_of_the_first_failure() -> None:
    """The density of the first failure is Σ_b n_b f_b/S_b · Π S_b^n_b, per unit of the load."""
    a, w = 0.2, 0.6
    strain = np.array([[0.3, 0.1, 0.55], [0.7, 0.25, 0.05]])
    rate, count = np.array([[1.0, 0.4, 2.0], [0.5, 0.7, 1.0]]), np.array([2.0, 1.0, 3.0])
    broke = np.array([True, True])
    strengths = uniform(a, w)
    hazard = (count * rate * strengths.pdf(strain) / strengths.sf(strain)).sum(axis=1)
    exact = np.log(hazard).sum() + (count * strengths.logsf(strain)).sum()
    assert strength._uniform(strain, rate, count, broke, a, w) == pytest.approx(exact)
    survived = np.array([True, False])
    exact -= np.log(hazard[1])
    assert strength._uniform(strain, rate, count, survived, a, w) == pytest.approx(exact)
    with np.errstate(all="raise"):
        assert strength._uniform(strain - 0.4, rate, count, broke, a, w) == -math.inf
        assert strength._uniform(strain + 0.2, rate, count, broke, a, w) == -math.inf


@pytest.mark.parametrize("d", [0.01, 0.3])
def test_the_harmless_excess_is_a_quarter_of_the_standard_error(d: float) -> None:
    """The standard error of the mean of ln e^±d is d."""
    checked = strength.Checked.of([0.0, 0.1], np.exp([1.0 + d, 1.0 - d]))
    assert checked.limit == pytest.approx(0.25 * d)
    assert checked.bore_more == 1


@pytest.mark.parametrize("span", [0.1, 3.0])
def test_an_unidentified_parameter_is_uniform_between_its_bounds(span: float) -> None:
    """The sum of two is measured with an error of 0.01, and the second alone is unknown: the first
    has its variance, that of a uniform distribution."""
    vectors = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    variance = np.array([0.5e-4, problem.NULL_VARIANCE]) / span**2
    directions = problem.Directions(vectors, variance, np.full(2, span))
    error = directions.error_of(np.array([1.0, 0.0]), [1])
    assert error == pytest.approx(np.sqrt(1e-4 + span**2 / 12.0))
    assert directions.error_of(np.array([1.0, 1.0]), [0, 1]) == pytest.approx(0.01, rel=0.1)
