"""Parts of fits against closed forms: bounds, curves, profiles, marginals and likelihoods."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear
from scipy.stats import gumbel_r, norm, uniform

import pbdkit
from pbdkit.components.gauges import Extensometer
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting import correlation, fit, observations, problem, strength, uncertainty
from pbdkit.fitting.channels import ControlledOpening
from pbdkit.fitting.crack_tip import CrackLine
from pbdkit.fitting.fit_result import Fitted
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import Linearisation
from pbdkit.model.solver import OpeningControl

RNG = np.random.default_rng(3)


def linearisation(residuals: Any, jacobian: Any, z: Any = None) -> Linearisation:
    z = np.zeros(jacobian.shape[1]) if z is None else z
    return Linearisation(z, residuals, jacobian, ())


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


def elastic(ratio: float) -> pbdkit.Experiment:
    return pbdkit.Experiment(
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": 4, "rows": 4},
        neighbours={"type": "chebyshev", "shells": 1},
        rule={"type": "elastic", "poisson_ratio": ratio},
        leaders=[],
        steps=1,
    )


def test_derivatives_of_smooth_functions_need_few_values() -> None:
    """Differences of order 4 are exact for polynomials of order 4."""
    source, parameter, counts = elastic(0.3), Parameter("rule.poisson_ratio"), []
    for power in (1, 2, 30):
        values: list[float] = []

        def function(experiment: Any, values: Any = values, power: Any = power) -> Any:
            values.append(parameter.value_in(experiment))
            return np.array([values[-1] ** power])

        (slope,) = parameter.derivative(source, function, 1e-10)
        assert slope == pytest.approx(power * 0.3 ** (power - 1), rel=1e-8)
        counts.append(len(values))
    assert counts[0] == counts[1] == 4


@pytest.mark.parametrize("room", [1e-2, 1e-4, 1e-6])
def test_derivatives_near_a_bound_have_smaller_steps(room: float) -> None:
    """The rule accepts ratios up to 1/2."""
    parameter = Parameter("rule.poisson_ratio")
    (slope,) = parameter.derivative(
        elastic(0.5 - room), lambda e: np.array([parameter.value_in(e) ** 2]), 1e-6
    )
    assert slope == pytest.approx(2.0 * (0.5 - room), rel=1e-6)


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


@pytest.mark.parametrize("room", [50.0, 0.1])
@pytest.mark.parametrize(
    ("combination", "is_product"),
    [(lambda z: z[0] * z[1], True), (lambda z: z[0] + z[1], False), (None, True)],
    ids=["product", "sum", "unknown"],
)
def test_a_combination_is_a_product_if_the_residuals_depend_on_it(
    combination: Any, is_product: bool, room: float
) -> None:
    """A combination that cannot be evaluated elsewhere is given as a product. Bounds, and a
    parameter that is no part of it, do not affect the result."""
    z = np.array([2.0, 3.0, 1.0])

    def residuals(moved: Any) -> Any:
        if combination is None:
            raise UnconvergedError("no equilibrium")
        return np.array([2e3 * (combination(moved) - combination(z))])

    stub = SimpleNamespace(bounds=lambda: (np.full(3, 0.1), z + room))
    stub.residuals = residuals
    solution = SimpleNamespace(z=z, at=SimpleNamespace(residuals=np.zeros(1)))
    direction = np.array([1.0, -1.0 if is_product else -2.0 / 3.0, 0.0])
    assert uncertainty._is_product(stub, solution, np.arange(3), direction) == is_product


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


@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy"])
@pytest.mark.parametrize("noise", [0.1, 1.0, 20.0])
def test_the_spread_of_normal_residuals_is_their_standard_deviation(
    loss: Any, noise: float
) -> None:
    residuals = noise * norm.ppf((np.arange(2000) + 0.5) / 2000)
    assert problem.spread_of(residuals, 0.0, loss) == pytest.approx(noise, rel=5e-3)


def test_squared_errors_of_a_step_add_up_to_its_distance_in_the_covariance() -> None:
    """Σ errors² = sᵀ C⁻¹ s, if every direction is determined."""
    vectors, _ = np.linalg.qr(RNG.normal(size=(3, 3)))
    directions = problem.Directions(vectors, np.array([1e-4, 0.3, 20.0]), np.array([2.0, 1.0, 5.0]))
    step = RNG.normal(size=3)
    exact = step @ np.linalg.solve(directions.covariance, step)
    assert np.sum(directions.errors(step) ** 2) == pytest.approx(exact)


def test_only_values_at_a_bound_are_named() -> None:
    unknowns = [
        SimpleNamespace(low=-1.0, high=3.0, span=4.0, parameter=SimpleNamespace(path=path))
        for path in ("low", "inside", "high")
    ]
    stub: Any = SimpleNamespace(unknowns=unknowns)
    assert problem._on_bounds(stub, np.array([-1.0, 1.0, 3.0])) == ("low", "high")


@pytest.mark.parametrize("end", [0.3, 2.0, -0.3])
def test_the_range_of_a_prescribed_opening_begins_or_ends_at_0(end: float) -> None:
    points = ((0.0, 0.0), (0.0, 3.0))
    control = OpeningControl(between=points, to=end)
    solver = SimpleNamespace(equilibrium=SimpleNamespace(control=control))
    scene: Any = SimpleNamespace(experiment=SimpleNamespace(solver=solver))
    channel = ControlledOpening(Extensometer(between=points))
    assert channel.range_in(scene) == (min(end, 0.0), max(end, 0.0))


@pytest.mark.parametrize("side", [0.25, 1.0, 3.0])
def test_places_of_a_lattice_have_the_spacing_of_its_rows(side: float) -> None:
    """The end of a cut before a place lies half a row behind it."""
    line = CrackLine(np.array([2.0, 1.0]), np.array([0.6, 0.8]), side * np.arange(-3.0, 4.0))
    for place in range(1, 6):
        assert line.spacing(place) == pytest.approx(side)
        beyond = line.end + line.places[place] * line.direction
        np.testing.assert_allclose(
            line.cut_end(place), beyond - side / 2.0 * line.direction, atol=1e-12
        )


def test_residuals_count_as_correlated_if_they_exceed_independent_ones() -> None:
    """The threshold lies 2.326 standard deviations above the mean of Moran's statistic, which is
    negative if a fit has removed smooth functions."""
    count, columns = 40, 12
    places = np.arange(float(count))[:, None]
    basis, _ = np.linalg.qr(
        np.polynomial.legendre.legvander(np.linspace(-1, 1, count), columns - 1)
    )
    weights = correlation._neighbour_weights(places).toarray()
    free = np.linalg.svd(np.eye(count) - basis @ basis.T)[0][:, : count - columns]
    values, vectors = np.linalg.eigh(free.T @ weights @ free)
    draws = np.square(np.random.default_rng(2).normal(size=(20000, len(values))))
    statistic = draws @ values / draws.sum(axis=1)
    for deviations in (2.326 - 0.2, 2.326 + 0.2):
        level = statistic.mean() + deviations * statistic.std()
        share = (level - values[0]) / (values[-1] - values[0])
        residuals = free @ (np.sqrt(1.0 - share) * vectors[:, 0] + np.sqrt(share) * vectors[:, -1])
        found = correlation.is_correlated(residuals[None], basis[None], places)
        assert found == (deviations > 2.326)


@pytest.mark.parametrize("count", [7, 8])
def test_the_correlation_is_estimated_from_all_rows_up_to_the_limit(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setattr(correlation, "MAX_ROWS", 8)
    rows = correlation._selected_rows(RNG.normal(size=(count, 2)))
    np.testing.assert_array_equal(rows, np.arange(count))


def test_strains_are_reached_at_their_loads() -> None:
    """The load at which a bond reaches a strain is the inverse of its strain under a load."""
    p, q = np.array([0.3, -0.2, 0.0]), np.array([0.4, 0.9, 0.2])
    bonds = strength.BondStrains(p, q, np.ones(3))
    for strain in (1e-4, 0.02, 0.5):
        load = bonds.load_at(np.full(3, strain))
        np.testing.assert_allclose(np.diag(bonds.at(load)), strain, rtol=1e-9)


@pytest.mark.parametrize("distribution", [norm(), gumbel_r()], ids=["normal", "skewed"])
def test_the_likelihood_of_peaks_is_the_density_of_their_mean_and_spread(distribution: Any) -> None:
    """The mean of -2 log L over samples is 2 + log det C for their covariance C, and larger for
    every other covariance."""
    draws = np.random.default_rng(5).random((4000, 100))
    mean, _, skewness, excess = (float(v) for v in distribution.stats("mvsk"))
    samples = 3.0 + 0.2 * (distribution.ppf(draws) - mean) / distribution.std()
    model = strength.PeakDistribution(
        low=np.zeros(1),
        high=np.ones(1),
        mean=np.array([3.0, 0.0, 0.0]),
        log_variance=np.array([2.0 * np.log(0.2), 0.0, 0.0]),
        inverse=np.zeros((3, 3)),
        skewness=skewness,
        kurtosis=3.0 + excess,
    )
    at = np.array([[0.5]])
    mean_deviance = -2.0 * np.mean([model.likelihood(at, y)[0] for y in samples])
    moments = np.stack([samples.mean(axis=1), np.log(samples.std(axis=1, ddof=1))])
    exact = 2.0 + np.linalg.slogdet(np.cov(moments))[1]
    assert mean_deviance == pytest.approx(exact, abs=0.03)


def test_the_distribution_of_peaks_maximises_the_normal_likelihood() -> None:
    """The gradient of the likelihood is 0 for the coefficients of mean and variance."""
    logs = RNG.uniform(-1.0, 1.0, (400, 1))
    y = 1.0 + 0.5 * logs[:, 0] + np.exp(-1.0 + 0.4 * logs[:, 0]) * RNG.normal(size=400)
    model = strength.PeakDistribution.of(logs, y)
    x = model.terms(logs)
    z = (y - x @ model.mean) * np.exp(-x @ model.log_variance / 2.0)
    score = x.T @ (z * np.exp(-x @ model.log_variance / 2.0)), x.T @ (z**2 - 1.0) / 2.0
    np.testing.assert_allclose(score, 0.0, atol=1e-3 * len(y))
    assert (model.skewness, model.kurtosis) == pytest.approx(
        (np.mean((z - z.mean()) ** 3) / z.std() ** 3, np.mean((z - z.mean()) ** 4) / z.var() ** 2)
    )


@pytest.mark.parametrize("is_smooth", [True, False])
def test_each_linearisation_is_counted(is_smooth: bool) -> None:
    """Also those after a step of the other unknowns, and those with derivatives at their values."""
    J, r = RNG.normal(size=(9, 3)), RNG.normal(size=9)
    counts: Any = []

    def at(z: Any, near: Any, is_exact: bool = False) -> Linearisation:
        counts.append(is_exact)
        jacobian = J * (1.0 + 0.1 * np.cos(z[0]) * np.array([1.0, 0.0, 0.0]))
        residuals = r - J @ z - 0.1 * np.sin(z[0]) * J[:, 0]
        prediction: Any = SimpleNamespace(is_exact=is_exact or is_smooth, is_linear=True)
        return Linearisation(z, residuals, jacobian, (prediction,))

    parameter: Any = SimpleNamespace(path="rule.a")
    free = np.full(3, np.inf)
    stub: Any = SimpleNamespace(
        unknowns=(problem.Unknown(parameter, -50.0, 50.0),),
        size=3,
        with_modulus=False,
        is_smooth=is_smooth,
        at=at,
        bounds=lambda: (-free, free),
    )
    solution = problem.solved(stub, np.zeros(3))
    assert solution.evaluations == len(counts) > 2
    assert any(counts) != is_smooth
    np.testing.assert_allclose(solution.at.jacobian.T @ solution.at.residuals, 0.0, atol=0.05)


@pytest.mark.parametrize("jump", [0.0, 3.0])
def test_errors_contain_another_branch(jump: float) -> None:
    """Predictions jump within a standard error, so that the minimum beyond is displaced by `jump`
    at the same cost: both minima are equally likely, and half of its square is added."""
    J, r = np.ones((9, 1)), RNG.normal(size=9)
    r -= r.mean()
    prediction: Any = SimpleNamespace(is_exact=True, is_linear=True)

    def residuals(z: Any) -> Any:
        return r - J @ (z - jump * (z > 0.1))

    free = np.full(1, np.inf)
    parameter: Any = SimpleNamespace(path="rule.a")
    stub: Any = SimpleNamespace(
        unknowns=(problem.Unknown(parameter, -50.0, 50.0),),
        size=1,
        with_modulus=False,
        is_smooth=False,
        at=lambda z, near, is_exact=False: Linearisation(z, residuals(z), J, (prediction,)),
        residuals=residuals,
        bounds=lambda: (-free, free),
    )
    solution = problem.solved(stub, np.zeros(1))
    variance = max(1.0, r @ r / 8) / 9
    np.testing.assert_allclose(solution.covariance, variance)
    solution = problem.with_other_branch(stub, solution, "linear")
    np.testing.assert_allclose(solution.covariance, variance + jump**2 / 2)


def test_measured_zeros_have_a_size() -> None:
    """Initial noise is a fraction of it, by which residuals are divided."""
    assert fit._size(np.zeros(4)) > 0.0
    assert fit._size(np.array([3.0, -3.0])) == 3.0


def test_each_unknown_uses_up_one_value() -> None:
    """The redundancies of all measurements add up to the number of values minus that of the
    unknowns; a measurement without redundancy has no estimate of its noise."""
    J = RNG.normal(size=(7, 2))
    J[:2] *= 0.1
    stub: Any = SimpleNamespace(rows=lambda: [(None, slice(0, 2)), (None, slice(2, 7))])
    at: Any = SimpleNamespace(at=linearisation(np.zeros(7), J))
    redundancies = fit._redundancies(stub, at, [0, 1])
    assert sum(redundancies.values()) == pytest.approx(5.0)
    J[:2] *= 1e4
    with pytest.raises(ExperimentError, match=r"the 2 values of measurement 0 determine 2\.0"):
        fit._redundancies(stub, at, [0])


def test_sums_and_products_are_compared_at_a_fraction_of_the_distance_to_the_bounds() -> None:
    """Against the direction the nearest bound is at 0.01, and along it at 0.02 / 0.5."""
    z, direction, tried = np.ones(2), np.array([1.0, 0.5]), []
    low, high = np.array([0.99, 0.9]), np.array([1.1, 1.02])
    given = SimpleNamespace(bounds=lambda: (low, high), residuals=lambda z: tried.append(z) or z)
    at = SimpleNamespace(z=z, at=SimpleNamespace(residuals=z))
    uncertainty._is_product(given, at, np.arange(2), direction)
    change = uncertainty.MAX_BOUND_FRACTION * 0.02 / 0.5 * direction
    np.testing.assert_allclose(tried, [np.exp(change), 1.0 + change], rtol=1e-12)
