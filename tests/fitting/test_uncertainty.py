"""Results of a fit on request: profiles, a sampler, other models; and its start."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

import pbdkit
from pbdkit.fitting.fit import problem_of
from pbdkit.fitting.fit_file import Fit, read_fit
from pbdkit.fitting.problem import rise_of_loss
from pbdkit.fitting.uncertainty import _marginal
from tests.fitting.test_fit import NOISE, fitted, in_series, measured, plate

POISSON = {"rule.poisson_ratio": [0.0, 0.49]}


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "field.csv"
    measured(plate(), path, noise=NOISE)
    given = {"file": str(path), "noise": NOISE}
    return {"experiment": plate(), "unknown": POISSON, "measured": given, "modes": 3}


def test_linear_profile_agrees_with_the_standard_error(fit):
    found = pbdkit.fit(fit | {"profile": ["rule.poisson_ratio"]})
    estimate, profile = found.values["rule.poisson_ratio"], found.profiles["rule.poisson_ratio"]
    assert profile.low == pytest.approx(estimate.value - 1.96 * estimate.error, rel=0.02)
    assert profile.high == pytest.approx(estimate.value + 1.96 * estimate.error, rel=0.02)
    parabola = ((profile.values - estimate.value) / estimate.error) ** 2
    np.testing.assert_allclose(profile.rises, parabola, rtol=0.1, atol=1e-3)
    assert any("by its profile" in line for line in str(found).splitlines())
    assert found.as_dict()["profiles"]["rule.poisson_ratio"]["interval"] == [
        profile.low,
        profile.high,
    ]


@pytest.mark.parametrize("loss", ["soft_l1", "cauchy"])
def test_a_profile_agrees_with_the_standard_error_of_a_loss(loss, fit):
    found = pbdkit.fit(fit | {"loss": loss, "profile": ["rule.poisson_ratio"]})
    estimate, profile = found.values["rule.poisson_ratio"], found.profiles["rule.poisson_ratio"]
    assert profile.high - profile.low == pytest.approx(3.92 * estimate.error, rel=0.1)


def test_increase_of_a_loss_matches_its_scores():
    """Huber's, of normal residuals: ψ² is z² within k, else k², and ψ' the share within."""
    from scipy.stats import norm

    z, k = norm.ppf((np.arange(200_000) + 0.5) / 200_000), 1.345
    within = 2.0 * norm.cdf(k) - 1.0
    square = within - 2.0 * k * norm.pdf(k) + k**2 * (1.0 - within)
    assert rise_of_loss(z, 0, "huber") == pytest.approx(square / within, rel=1e-3)


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_understated_noise_does_not_change_the_errors(loss, fit):
    """They come from the residuals: those of half the noise are as good, or a little worse."""
    found = [
        pbdkit.fit(fit | {"loss": loss, "measured": fit["measured"] | {"noise": noise}})
        for noise in (NOISE, NOISE / 2)
    ]
    right, understated = (f.values["rule.poisson_ratio"].error for f in found)
    assert right * 0.95 < understated < right * 1.5


def test_profile_with_two_parameters_refits_the_other(fit):
    """The profile of one of two correlated parameters is wider than a cut through the valley."""
    rule = {"type": "elastic", "poisson_ratio": 0.3, "stiffness": {"otherwise": 1.0, "half": 1.0}}
    unknown = {"rule.poisson_ratio": [0.0, 0.49], "rule.stiffness.half": [0.3, 3.0]}
    given = fit | {"experiment": plate(rule), "unknown": unknown}
    found = pbdkit.fit(given | {"profile": ["rule.stiffness.half"]})
    estimate, profile = found.values["rule.stiffness.half"], found.profiles["rule.stiffness.half"]
    assert profile.high - profile.low == pytest.approx(3.92 * estimate.error, rel=0.05)


def test_identified_ratio_transfers_bounds_between_its_parts(tmp_path):
    """The stiffness of one half is that of the other, which is between its bounds, times 2.5."""
    bounds = {"rule.stiffness.otherwise": [0.4, 1.2], "rule.stiffness.half": [0.3, 5.0]}
    asked = {"profile": ["rule.stiffness.half"]}
    found = fitted(in_series(), tmp_path / "field.csv", bounds, 1e-3, **asked)
    profile = found.profiles["rule.stiffness.half"]
    assert (profile.low, profile.high) == pytest.approx((2.5 * 0.4, 2.5 * 1.2), rel=0.05)


def test_unidentified_parameters_have_unbounded_intervals(fit):
    rule = {"type": "elastic", "poisson_ratio": 0.3, "stiffness": 1.0}
    given = fit | {"experiment": plate(rule), "unknown": {"rule.stiffness": [0.5, 2.0]}}
    profile = pbdkit.fit(given | {"profile": ["rule.stiffness"]}).profiles["rule.stiffness"]
    assert (profile.low, profile.high) == (None, None)
    assert "from no bound to no bound" in str(profile)


def test_posterior_of_a_linear_problem_is_normal(fit):
    """On a grid, without a sampler: its mean is the estimate, its deviation the standard error."""
    found = pbdkit.fit(fit)
    estimate = found.values["rule.poisson_ratio"]
    values = estimate.value + estimate.error * np.linspace(-2.0, 2.0, 7)
    logs = [_marginal(found.problem, found.solution.z, np.array([v]), 1.0) for v in values]
    second, first, _ = np.polyfit(values, logs, 2)
    assert -first / (2 * second) == pytest.approx(estimate.value, abs=0.05 * estimate.error)
    assert found.ratio < 1.0
    assert np.sqrt(-0.5 / second) == pytest.approx(estimate.error, rel=0.03)


def test_posterior_of_parameters_is_marginalised(fit):
    """Boundaries are straight unknowns: the integral of exp(-½ r²) over them is as large as the
    root of the determinant of JᵀJ is small, which changes with Poisson's ratio."""
    problem, z = pbdkit.fit(fit).problem, pbdkit.fit(fit).solution.z
    logs, volumes = [], []
    for value in (0.02, 0.46):
        here = np.concatenate([[value], z[1:]])
        r = problem.residuals(here)
        others = np.eye(len(here))[1:]
        columns = np.stack([r - problem.residuals(here + each) for each in others], axis=1)
        size = np.linalg.norm(columns, axis=0)
        _, log_determinant = np.linalg.slogdet((columns / size).T @ (columns / size))
        volumes.append(0.5 * log_determinant + np.log(size).sum())
        least, *_ = np.linalg.lstsq(columns, r, rcond=None)
        left = r - columns @ least
        logs.append(-0.5 * left @ left - volumes[-1])
    found = [_marginal(problem, z, np.array([value]), 1.0) for value in (0.02, 0.46)]
    assert abs(volumes[1] - volumes[0]) > 0.05
    assert found[1] - found[0] == pytest.approx(logs[1] - logs[0], abs=1e-3)


def test_repeating_an_observation_leaves_the_posterior_unchanged(fit):
    """A shift of all is one of the boundaries, and one of the images."""
    twice = fit["measured"] | {"distortion": {"ux": [[0, 0]], "uy": [[0, 0]]}}
    values = 0.3 + 0.01 * np.linspace(-1.0, 1.0, 5)
    logs = []
    for given in (fit, fit | {"measured": twice}):
        found = pbdkit.fit(given)
        z = found.solution.z
        logs.append([_marginal(found.problem, z, np.array([v]), 1.0) for v in values])
    once, more = (np.array(each) - max(each) for each in logs)
    np.testing.assert_allclose(more, once, atol=0.05)


def test_sampler_draws_from_the_posterior(fit):
    pytest.importorskip("emcee")
    found = pbdkit.fit(fit | {"sampler": {"walkers": 8, "steps": 16}})
    estimate, sample = found.values["rule.poisson_ratio"], found.sample
    assert sample.draws.shape == (8 * 12, 1)
    assert 0.2 < sample.acceptance < 0.95
    assert abs(sample.mean[0] - estimate.value) < estimate.error
    assert 0.0 < sample.error[0] < estimate.error
    assert sample.deviation[0] == pytest.approx(estimate.error, rel=0.5)
    short = fit | {"modes": 1, "sampler": {"walkers": 4, "steps": 10}}
    once, again = (pbdkit.fit(short).sample.draws.tobytes() for _ in range(2))
    assert once == again


def test_missing_sampler_is_named_before_the_fit(fit, monkeypatch):
    monkeypatch.setattr("pbdkit.errors.find_spec", lambda library: None)
    monkeypatch.setattr("pbdkit.fitting.fit.solve", None)
    with pytest.raises(pbdkit.ExperimentError, match=r"pip install 'pbdkit\[sample\]'"):
        pbdkit.fit(fit | {"sampler": {"walkers": 8, "steps": 24}})


def test_correct_model_predicts_best(tmp_path):
    """The isotropic rule predicts left-out points of an orthotropic plate worse."""
    rule = {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.5, "shear_ratio": 0.3}
    made = plate(rule)
    measured(made, tmp_path / "field.csv", noise=NOISE / 4)
    found = pbdkit.fit(
        {
            "experiment": plate(),
            "unknown": POISSON,
            "measured": {"file": str(tmp_path / "field.csv"), "noise": NOISE / 4},
            "modes": 3,
            "candidates": {
                "orthotropic": {
                    "settings": {"rule": rule},
                    "unknown": {"rule.modulus_ratio": [0.2, 1.5], "rule.shear_ratio": [0.1, 0.6]},
                },
            },
        }
    )
    order = [candidate.name for candidate in found.candidates]
    assert order == ["orthotropic", "as given"]
    best, worst = found.candidates
    assert best.differs == 0.0
    assert 0.8 < best.left_out < 1.6  # blocks at the ends depend on others alone
    assert best.behind == 0.0
    assert worst.behind > 3 * worst.behind_error
    assert best.values["rule.modulus_ratio"] == pytest.approx(0.5, abs=0.05)
    assert [c["name"] for c in found.as_dict()["candidates"]] == order
    assert any(line.startswith("orthotropic: mean squared") for line in str(found).splitlines())


class Lazy(pbdkit.FollowerRule):
    """A rule of a third party, which moves a share of the way to the mean of its neighbours."""

    type: Literal["lazy"] = "lazy"
    share: float = 0.5

    @staticmethod
    def gather(d, r, w, p):
        """Return the contribution of a neighbour."""
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        """Return the move of the particle."""
        return p.share * total[0] / total[1]


def test_third_party_rule_is_a_candidate(fit):
    """Its equilibrium is that of barycentres, so that its share is not identifiable."""
    settings = {"rule": {"type": "lazy", "share": 0.5}, "frame.type": "mean"}
    rival = {"settings": settings, "unknown": {"rule.share": [0.2, 0.9]}}
    found = pbdkit.fit(fit | {"candidates": {"lazy": rival}, "folds": 2}, components=[Lazy])
    assert [candidate.name for candidate in found.candidates] == ["as given", "lazy"]
    own = pbdkit.fit(
        fit | {"experiment": plate(settings["rule"]) | {"frame": {"type": "mean"}}}
        | {"unknown": rival["unknown"]},
        components=[Lazy],
    )  # fmt: skip
    assert not own.values["rule.share"].identifiable


def test_wide_bounds_start_at_the_smallest_misfit(tmp_path):
    """The middle of 0.01 to 100 is far off; the gap determines the order of magnitude."""
    rule = {"type": "elastic", "poisson_ratio": 0.2, "stiffness": {"otherwise": 1.0, "half": 1.7}}
    made = plate(rule)
    measured(made, tmp_path / "field.csv", noise=NOISE)
    fit = {
        "experiment": made,
        "unknown": {"rule.stiffness.half": [0.01, 100.0]},
        "measured": {"file": str(tmp_path / "field.csv"), "noise": NOISE},
        "modes": 4,
    }
    asked, source = read_fit(Fit, fit)
    start = problem_of(asked, pbdkit.Experiment.build(source)).start()[0]
    assert 0.5 < start < 3.0
    found = pbdkit.fit(fit)
    estimate = found.values["rule.stiffness.half"]
    assert estimate.value == pytest.approx(1.7, abs=4 * estimate.error)
    assert found.solution.evaluations < 12


WRONG = {
    "a profile of what is known": ({"profile": ["rule.stiffness"]}, "which is not unknown"),
    "a sampler with a loss": (
        {"loss": "huber", "sampler": {}}, "set `loss: linear`",
    ),
    "a candidate that is none": (
        {"candidates": {"other": {"settings": {"rule.poisson": 0.3}}}}, "poisson",
    ),
    "a candidate without its unknown": (
        {"candidates": {"other": {"settings": {"rule": {"type": "springs"}}}}},
        "^fit: candidates.other: .*not a number of the experiment.* a separate `unknown`",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_named(name, fit):
    more, told = WRONG[name]
    with pytest.raises(pbdkit.ExperimentError, match=told):
        pbdkit.fit(fit | more)
