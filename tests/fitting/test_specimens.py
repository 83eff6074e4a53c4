"""Several specimens of one material: the mean, its error, and the scatter between specimens."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, t

import pbdkit
from pbdkit.fitting.specimens import random_effects
from pbdkit.fitting.uncertainty import MODULUS
from tests.fitting.test_fit import measured, plate

RATIO = "rule.poisson_ratio"
TRUE = {"a": (0.25, 70.0), "b": (0.30, 60.0), "c": (0.33, 80.0)}
NOISE = 1e-5


@pytest.mark.parametrize(("count", "unit"), [(2, 1.0), (5, 1.0), (5, 1e-6)])
def test_exact_measurements_give_the_mean_and_the_standard_deviation(count, unit):
    values = unit * np.array([3.1, 2.7, 3.6, 2.9, 3.3])[:count]
    mean = random_effects(values, np.full(count, 1e-6 * unit))
    error = values.std(ddof=1) / np.sqrt(count)
    assert (mean.value, mean.error) == pytest.approx((values.mean(), error), rel=1e-4)
    assert mean.deviation == pytest.approx(values.std(ddof=1), rel=1e-4)
    half = t.ppf(0.975, count - 1) * error
    assert mean.interval == pytest.approx((values.mean() - half, values.mean() + half), rel=1e-4)
    # The interval of a standard deviation of normal values, by the quantiles of χ².
    square = (count - 1) * values.var(ddof=1)
    low, high = np.sqrt(square / chi2.ppf([0.975, 0.025], count - 1))
    assert mean.deviation_interval == pytest.approx((low, high), rel=1e-4)


def test_deviation_maximises_the_restricted_likelihood():
    """The likelihood of all differences from the first value does not contain the mean."""
    values, errors = np.array([1.0, 1.9, 1.4, 2.2]), np.array([0.1, 0.5, 0.3, 0.2])
    contrasts = np.array([[-1, 1, 0, 0], [-1, 0, 1, 0], [-1, 0, 0, 1]])

    def criterion(x):
        covariance = contrasts @ np.diag(errors**2 + x[0] ** 2) @ contrasts.T
        differences = contrasts @ values
        _, log = np.linalg.slogdet(covariance)
        return log + differences @ np.linalg.solve(covariance, differences)

    best = minimize(criterion, [0.5], method="Nelder-Mead", options={"xatol": 1e-8}).x[0]
    assert random_effects(values, errors).deviation == pytest.approx(best, rel=1e-4)


def test_specimens_that_agree_keep_the_errors_of_their_measurements():
    mean = random_effects(np.array([1.0, 1.001, 0.999]), np.array([0.1, 0.1, 0.1]))
    assert mean.deviation == 0.0
    assert mean.error == pytest.approx(0.1 / np.sqrt(3))
    assert mean.deviation_interval[0] == 0.0


@pytest.mark.parametrize(("deviation", "error"), [(1.0, 0.0), (1.0, 0.3)])
def test_intervals_contain_the_true_values(deviation, error):
    generator, trials, inside = np.random.default_rng(4), 300, np.zeros(2)
    for _ in range(trials):
        errors = error * generator.uniform(0.7, 1.4, 5) + 1e-9
        values = 10.0 + deviation * generator.normal(size=5) + errors * generator.normal(size=5)
        mean = random_effects(values, errors)
        inside += mean.interval[0] < 10.0 < mean.interval[1]
        low, high = mean.deviation_interval
        inside[1] += (low < deviation < high) - (mean.interval[0] < 10.0 < mean.interval[1])
    assert (inside / trials > 0.91).all()
    assert (inside / trials < 0.985).all()


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """Plates of three Poisson's ratios and moduli, under different forces."""
    folder, listed = tmp_path_factory.mktemp("specimens"), []
    for name, (ratio, modulus) in TRUE.items():
        made = specimen(ratio)
        measured(made, folder / f"{name}.csv", noise=NOISE, count=60)
        asked = {"type": "reaction", "youngs_modulus": modulus, "thickness": 2.0}
        ds = pbdkit.run(made | {"diagnostics": [asked]}, progress=False)
        force = ds.reaction.isel(time=-1).sel(leader_group=1).values.tolist()
        force = {"group": 1, "value": force, "thickness": 2.0}
        file = {"file": str(folder / f"{name}.csv"), "noise": NOISE}
        listed.append(file | {"specimen": name, "force": force})
    unknown = {RATIO: [0.0, 0.49]}
    return {
        "experiment": specimen(0.3),
        "unknown": unknown,
        "measured": listed,
        "specimens": True,
        "modes": 4,
    }


def specimen(ratio):
    rule = {"type": "elastic", "poisson_ratio": ratio}
    return plate(rule, lattice={"type": "square", "a": 2.0})


@pytest.fixture(scope="module")
def fitted(fit):
    return pbdkit.fit(fit)


def test_means_and_scatter_are_those_of_separate_fits(fit, fitted):
    for n, (name, true) in enumerate(TRUE.items()):
        part = {k: v for k, v in fit["measured"][n].items() if k != "specimen"}
        alone = pbdkit.fit({**fit, "measured": part, "specimens": False})
        assert fitted.estimate(name, RATIO) == alone.values[RATIO]
        assert fitted.estimate(name, MODULUS) == alone.youngs_modulus
        assert alone.values[RATIO].value == pytest.approx(true[0], abs=0.003)
        assert alone.youngs_modulus.value == pytest.approx(true[1], rel=0.003)
    true = np.array([*TRUE.values()])
    for n, mean in enumerate((fitted.values[RATIO], fitted.youngs_modulus)):
        spread = true[:, n].std(ddof=1)
        assert mean.value == pytest.approx(true[:, n].mean(), rel=0.01)
        assert mean.error == pytest.approx(spread / np.sqrt(3), rel=0.05)
        assert mean.deviation == pytest.approx(spread, rel=0.05)
        assert (mean.specimens, mean.degrees_of_freedom) == (3, 2)


def test_summary_json_and_dataset_have_the_mean_and_the_scatter(fitted):
    mean, lines = fitted.values[RATIO], str(fitted).splitlines()
    low, high = mean.interval
    assert lines[:3] == [
        f"{RATIO}: {mean.value:.3f} ± {mean.error:.3f}, 95 % from {low:.3f} to {high:.3f}",
        f"  standard deviation between specimens: {mean.deviation:.3f}, 95 % from "
        f"{mean.deviation_interval[0]:.3f} to {mean.deviation_interval[1]:.3f}",
        "  mean of 3 specimens, Student's t with 2 degrees of freedom",
    ]
    assert [line for line in lines if line.startswith("specimen")] == [
        f"specimen {name}:" for name in TRUE
    ]
    stored = json.loads(json.dumps(fitted.as_dict()))
    assert stored["values"][RATIO]["interval"] == [low, high]
    assert stored["youngs_modulus"]["deviation"] == fitted.youngs_modulus.deviation
    assert stored["specimens"]["b"]["values"][RATIO]["value"] == pytest.approx(0.3, abs=0.003)
    table = fitted.estimates
    assert table.sizes == {"specimen": 3, "parameter": 2}
    chosen = table.sel(parameter=RATIO)
    assert float(chosen["mean"]) == mean.value
    assert float(chosen.deviation) == mean.deviation
    assert (float(chosen.low), float(chosen.deviation_high)) == (low, mean.deviation_interval[1])
    assert float(chosen.degrees_of_freedom) == 2.0
    assert float(chosen.value.sel(specimen="c")) == fitted.estimate("c", RATIO).value


def test_parameter_that_no_specimen_determines_is_not_identifiable(fit):
    unknown = {RATIO: [0.0, 0.49], "rule.stiffness": [0.5, 2.0]}
    made = specimen(0.3) | {"rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": 1.0}}
    plain = [{k: v for k, v in one.items() if k != "force"} for one in fit["measured"][:2]]
    found = pbdkit.fit(fit | {"experiment": made, "unknown": unknown, "measured": plain})
    assert found.values[RATIO].identifiable
    mean = found.values["rule.stiffness"]
    assert (mean.identifiable, mean.omitted) == (False, ("a", "b"))
    assert found.as_dict()["values"]["rule.stiffness"]["value"] is None
    assert "rule.stiffness: not identifiable from the data; not identifiable in a, b" in str(found)
    assert np.isnan(found.estimates["mean"].sel(parameter="rule.stiffness"))
    assert found.youngs_modulus is None


def test_picture_has_a_panel_for_each_parameter(fitted):
    pytest.importorskip("matplotlib")
    from pbdkit.plotting.fit_figures import draw_fit

    axes = draw_fit(fitted).axes
    assert [ax.get_title() for ax in axes] == [RATIO, MODULUS]
    assert [text.get_text() for text in axes[0].get_yticklabels()] == [
        *TRUE,
        "mean",
        "mean ± deviation",
    ]


def without(fit, key, n):
    entries = [dict(entry) for entry in fit["measured"]]
    del entries[n][key]
    return entries


WRONG = {
    "names without specimens": (lambda fit: {"specimens": False}, "set `specimens: true`"),
    "a missing name": (
        lambda fit: {"measured": without(fit, "specimen", 1)},
        "measurement 1 names no `specimen`",
    ),
    "one specimen": (lambda fit: {"measured": fit["measured"][:1]}, "at least two specimens"),
    "a profile": (lambda fit: {"profile": [RATIO]}, "describe one specimen"),
    "an error in one": (
        lambda fit: {"measured": [*fit["measured"][:2], fit["measured"][2] | {"margin": 100.0}]},
        "^fit: measured.file: specimen c: only 0 measured numbers",
    ),
    "a force at a second measurement": (
        lambda fit: {"measured": [entry | {"specimen": n // 2} for n, entry in
                                  enumerate([*fit["measured"], fit["measured"][0]])]},
        "give `force` at the first measurement",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_named(name, fit):
    change, message = WRONG[name]
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.fit(fit | change(fit))
