"""Quantities derived from a fit, and their standard errors."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fitting.test_channels import bar, written
from fitting.test_fit import NOISE, measured, plate

import pbdkit
from pbdkit.fitting.derived import Response
from pbdkit.fitting.fit_file import Force
from pbdkit.fitting.formula import Formula
from pbdkit.fitting.uncertainty import reaction_along
from pbdkit.io.snapshot import StateMoment, Tables

RATIO = "rule.poisson_ratio"
FORCE = Force(group=1, value=(100.0, 0.0), thickness=3.0, noise=2.0)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    path = tmp_path_factory.mktemp("derived") / "field.csv"
    generator = np.random.default_rng(3)
    made = plate(noise=NOISE, generator=generator, lattice={"type": "square", "a": 2.0}) | {
        "units": {"length": "0.5 mm", "thickness": "3 mm"},
        "diagnostics": [
            {"type": "strain-energy", "youngs_modulus": 1000.0},
            {"type": "reaction", "youngs_modulus": 1000.0},
            {"type": "displacement"},
        ],
    }
    measured(made, path, noise=NOISE, generator=generator)
    return pbdkit.fit(
        {
            "experiment": made,
            "unknown": {RATIO: [0.0, 0.49]},
            "measured": {
                "file": str(path),
                "noise": NOISE,
                "distortion": {"ux": [[2, 0]]},
            },
            "force": FORCE.model_dump(),
            "modes": 3,
            "derived": [
                "youngs_modulus",
                "3 * youngs_modulus",
                f"youngs_modulus / (2 * (1 + {RATIO}))",
                RATIO,
                "strain_energy",
                "reaction[1]",
                "reaction[1, 0] / reaction[0, 0]",
            ],
        }
    )


def test_errors_of_formulas_are_those_of_the_linearised_formula(fitted):
    modulus, ratio = fitted.youngs_modulus, fitted.values[RATIO]
    derived = {name: d.estimate for name, d in fitted.derived.items()}
    assert derived["youngs_modulus"].value == pytest.approx(modulus.value, rel=1e-12)
    assert derived["youngs_modulus"].error == pytest.approx(modulus.error, rel=1e-9)
    assert derived["youngs_modulus"].unit == "MPa"
    assert derived["3 * youngs_modulus"].error == pytest.approx(3 * modulus.error, rel=1e-9)
    assert derived[RATIO] == ratio
    shear = derived[f"youngs_modulus / (2 * (1 + {RATIO}))"]
    assert shear.value == pytest.approx(modulus.value / 2 / (1 + ratio.value), rel=1e-12)
    reaction, gradient = reaction_along(FORCE, fitted.problem, fitted.solution)
    of_log = -gradient / reaction - np.eye(len(gradient))[0] / (1 + ratio.value)
    variance = of_log @ fitted.solution.covariance @ of_log + (2.0 / 100.0) ** 2
    assert shear.error / shear.value == pytest.approx(np.sqrt(variance), rel=1e-9)


def test_gradients_of_a_force_in_units_with_an_unknown_modulus(tmp_path):
    """The number of the experiment is the force divided by the modulus, as is the reaction."""
    body = bar(
        units={"length": "1 mm", "thickness": "5 mm", "youngs_modulus": "2000 MPa"},
        leaders=bar()["leaders"][:2],
        loads=[{"select": {"edge": "right"}, "force": ["400 N", "0 N"]}],
        steps=1,
        diagnostics=[{"type": "reaction"}],
    )
    ds = pbdkit.run(body, progress=False).isel(time=-1)
    u = (ds.position - ds.reference).values
    noise = 1e-4 * np.random.default_rng(1).normal(size=u.shape)
    end = u[ds.reference.values[:, 0] == 12.0, 0].mean()
    field = written(tmp_path / "f.csv", "x,y,ux,uy", *ds.reference.values.T, *(u + noise).T)
    curve = written(
        tmp_path / "c.csv", "displacement,force", [0.3 * end, 0.6 * end], [110.0, 250.0]
    )
    fit = {
        "experiment": body,
        "unknown": {"loads.0.force.0": ["100 N", "900 N"]},
        "measured": [
            {"file": field, "noise": 1e-4},
            {"type": "curve", "file": curve, "load": 0, "noise": 10.0},
        ],
        "derived": ["reaction[0, 0]"],
    }
    result = pbdkit.fit(fit)
    force, modulus = result.solution.z[:2]
    response = Response(result.solution.at.predictions[0], result.problem, result.solution)
    (values,), (gradients,) = response.of(result.experiment.diagnostics[0])
    expected = values[0, 0] * np.array([1.0 / force, -1.0 / modulus])
    np.testing.assert_allclose(gradients[0, 0], expected, rtol=1e-4)


def test_diagnostics_are_those_of_the_fitted_body(fitted):
    end = fitted.dataset.isel(time=-1)
    energy, second = fitted.derived["strain_energy"], fitted.derived["reaction[1, 0]"]
    assert energy.estimate.value == pytest.approx(float(end.strain_energy), rel=1e-9)
    assert float(end.derived_error.sel(derived="strain_energy")) == energy.estimate.error
    assert energy.estimate.unit == ""  # `units` has no modulus.
    assert second.estimate.value == pytest.approx(float(end.reaction[1, 0]), rel=1e-9)
    assert fitted.derived["reaction[1, 0] / reaction[0, 0]"].estimate.value == pytest.approx(-1)


def test_derivatives_are_those_of_other_equilibria(fitted):
    problem, solution = fitted.problem, fitted.solution
    prediction = solution.at.predictions[0]
    energy, reaction, _ = prediction.resting_scene.scene.diagnostics

    def at(z, diagnostic):
        resting = problem.at(z).predictions[0].resting_scene
        return np.asarray(diagnostic.measure(StateMoment(resting.state, Tables(resting.scene)))[0])

    response = Response(prediction, problem, solution)
    for diagnostic in (energy, reaction):
        (_, *_), (gradient, *_) = response.of(diagnostic)
        for n in range(0, problem.size, 4):
            step = np.zeros(problem.size)
            step[n] = 1e-3 * solution.errors[n]
            change = at(solution.z + step, diagnostic) - at(solution.z - step, diagnostic)
            expected = change / (2 * step[n])
            size = np.abs(gradient * solution.errors).max()
            difference = (gradient[..., n] - expected) * solution.errors[n]
            assert np.abs(difference).max() < 2e-3 * size  # Derivatives of boundaries are reused.


def test_results_contain_derived_quantities(fitted):
    content = json.loads(json.dumps(fitted.as_dict()))["derived"]
    assert content["strain_energy"]["error"] == fitted.derived["strain_energy"].estimate.error
    assert f"strain_energy: {fitted.derived['strain_energy']}" in str(fitted).splitlines()


@pytest.mark.parametrize(
    ("text", "values", "expected"),
    [
        ("2 * (a + b.c) ** 2 / -4", {"a": 1.0, "b.c": 2.0}, -4.5),
        ("a[1]", {"a": np.array([1.0, 7.0])}, 7.0),
        ("x.0.y - x.0.z", {"x.0.y": 3.0, "x.0.z": 1.0}, 2.0),
        ("1e3 * a", {"a": 1.0}, 1000.0),
    ],
)
def test_formulas(text, values, expected):
    formula = Formula.read(text)
    assert formula.value({name: np.asarray(v) for name, v in values.items()}) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a + ", "is not a formula"),
        ("f(a)", "is not a formula"),
        ("a if b else c", "is not a formula"),
        ("a[b]", "is not a formula"),
        ("'a'", "is not a formula"),
        ("3.0", "contains no name"),
        ("a" * 300, "at most 200 characters"),
        ("__import__", "is neither a variable"),
        ("stran_energy", "did you mean 'strain_energy'"),
        ("strain_energy[0]", "strain_energy"),
        ("u", "values, and at most 64"),
    ],
)
def test_faulty_formulas_are_reported_with_their_place(text, message, fitted, tmp_path):
    field = fitted.field()
    path = tmp_path / "field.csv"
    table = np.hstack([field.points, field.measured])
    np.savetxt(path, table, "%.17g", ",", header="x,y,ux,uy", comments="")
    fit = {
        "experiment": fitted.experiment,
        "unknown": {RATIO: [0.2, 0.4]},
        "measured": {"file": str(path), "noise": NOISE},
        "modes": 0,
        "derived": [text],
    }
    with pytest.raises(pbdkit.ExperimentError, match=message) as caught:
        pbdkit.fit(
            {k: v for k, v in fit.items() if k != "experiment"}, experiment=fitted.experiment
        )
    assert "derived" in str(caught.value)
