"""Channels of a test: gauges, curves of one quantity over another, and unknowns of fracture."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import pbdkit
from pbdkit.fitting.fit import problem_of
from pbdkit.fitting.fit_file import Fit, read_fit

LENGTH, HEIGHT, RATIO = 12.0, 4.0, 0.3
MODULUS, THICKNESS = 2000.0, 5.0


def bar(**more):
    """A bar that is stretched by 2 % without lateral constraint: strain and stress are uniform."""
    return {
        "name": "bar",
        "units": {"length": "1 mm", "thickness": f"{THICKNESS} mm"},
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": LENGTH, "height": HEIGHT},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": RATIO},
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}, "axes": ["x"]},
            {"select": {"nearest": [[0.0, 2.0]]}, "motion": {"type": "hold"}, "axes": ["y"]},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.06, 0.0], "steps": 4},
                "axes": ["x"],
            },
        ],
        "steps": 4,
        "solver": {"type": "equilibrium"},
    } | more


def strain(angle, axial):
    """The strain of the bar along a direction."""
    angle = np.radians(angle)
    return axial * (np.cos(angle) ** 2 - RATIO * np.sin(angle) ** 2)


AXIAL = 0.005 * np.arange(5)
"""Axial strains of the bar in steps 0 to 4."""


def gauge(**more):
    return {"type": "strain-gauge", "at": [6.3, 1.9], "length": 2.5, "angle": 30.0} | more


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, -200.0])
def test_gauges_of_a_uniform_field(angle):
    gauges = [{"type": "extensometer", "between": [[2, 1], [10, 3]]}, gauge(angle=angle)]
    ds = pbdkit.run(bar(diagnostics=gauges), progress=False)
    np.testing.assert_allclose(ds.gauge_strain, strain(angle, AXIAL), rtol=1e-6, atol=1e-12)
    tilt = np.degrees(np.arctan2(2, 8))
    np.testing.assert_allclose(ds.extension, np.hypot(2, 8) * strain(tilt, AXIAL), rtol=1e-6)
    along_y = [{"type": "extensometer", "between": [[2, 1], [10, 3]], "direction": [0, 2]}]
    ds = pbdkit.run(bar(diagnostics=along_y), progress=False)
    np.testing.assert_allclose(ds.extension, -2 * RATIO * AXIAL, rtol=1e-6, atol=1e-12)


WRONG = {
    "one particle": (
        {"type": "extensometer", "between": [[2, 1], [2.2, 1]]},
        "both points are nearest to particle",
    ),
    "no direction": (
        {"type": "extensometer", "between": [[2, 1], [4, 1]], "direction": [0, 0]},
        "the direction is zero",
    ),
    "outside": (gauge(at=[11.9, 2.0]), r"the end \(12.98.*\) of the strain gauge is not in a cell"),
}


@pytest.mark.parametrize("name", WRONG)
def test_invalid_gauges_are_refused(name):
    diagnostic, message = WRONG[name]
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(bar(diagnostics=[diagnostic]), progress=False)


def written(path, header, *columns):
    np.savetxt(path, np.transpose(columns), "%.12g", ",", header=header, comments="")
    return str(path)


def test_modulus_alone_from_force_over_a_gauge_in_any_direction(tmp_path):
    """The force along the axis of the bar is E t H ε, and 0.6 of it along (0.6, 0.8)."""
    force = MODULUS * THICKNESS * HEIGHT * AXIAL[1:]
    file = written(tmp_path / "curve.csv", "strain,force", strain(30, AXIAL[1:]), 0.6 * force)
    measured = {
        "type": "curve",
        "file": file,
        "columns": ["strain", "force"],
        "against": gauge(),
        "group": 2,
        "axis": [1.2, 1.6],
    }
    fit = {"experiment": bar(), "unknown": {}, "measured": measured}
    result = pbdkit.fit(fit)
    assert result.youngs_modulus.value == pytest.approx(MODULUS, rel=1e-6)
    assert "Young's modulus: 2000" in str(result)
    with pytest.raises(pbdkit.ExperimentError, match="there is nothing to fit"):
        pbdkit.fit(fit | {"measured": measured | {"youngs_modulus": 1.0}})


def test_length_of_the_correlation_has_the_unit_of_the_abscissa(tmp_path):
    axial = np.linspace(0.0005, 0.019, 40)
    smooth = np.convolve(np.random.default_rng(0).normal(size=48), np.ones(9), "valid")
    force = MODULUS * THICKNESS * HEIGHT * axial + smooth
    measured = {"type": "curve", "columns": ["at", "force"], "group": 2}
    units = {}
    for name, against, places in (
        ("strain", gauge(angle=0.0), axial),
        ("displacement", "displacement", LENGTH * axial),
        ("time", "time", 200.0 * axial),
    ):
        file = written(tmp_path / f"{name}.csv", "at,force", places, force)
        given = measured | {"file": file, "against": against}
        result = pbdkit.fit({"experiment": bar(), "unknown": {}, "measured": given})
        units[name] = result.misfits[0].correlation.unit
    assert units == {"strain": "", "displacement": "mm", "time": "steps"}


def test_noise_is_not_estimated_from_as_many_values_as_unknowns(tmp_path):
    file = written(tmp_path / "curve.csv", "displacement,force", [0.1], [300.0])
    measured = {"type": "curve", "file": file, "group": 2}
    fit = {"experiment": bar(), "unknown": {}, "measured": measured}
    with pytest.raises(pbdkit.ExperimentError, match="noise cannot be estimated; give its `noise`"):
        pbdkit.fit(fit)
    modulus = pbdkit.fit(fit | {"measured": measured | {"noise": 3.0}}).youngs_modulus
    assert modulus.error == pytest.approx(0.01 * modulus.value, rel=1e-6)
    noise = np.array([2e-6, 0.0, -1e-6, 0.0])
    strains = written(tmp_path / "s.csv", "at,s", 12 * AXIAL[1:], AXIAL[1:] + noise)
    second = {"type": "curve", "file": strains, "group": 2, "columns": ["at", "s"]}
    second |= {"quantity": gauge(angle=0.0)}
    both = pbdkit.fit(fit | {"measured": [measured | {"noise": 3.0}, second]})
    assert both.youngs_modulus.error == pytest.approx(modulus.error, rel=1e-6)


UNCLEAR = {
    "sampler": ({"sampler": {}}, "a `sampler` requires `unknown` parameters"),
    "bounds": ({"unknown": {"rule.poisson_ratio": [0.4, 0.1]}}, "unknown.rule.poisson_ratio: exp"),
    "modes": ({"modes": "aut"}, "modes: should be a number or 'auto'"),
    "count": ({"modes": [1, "two"]}, "modes.1: should be a number or 'auto'"),
    "axis": ({"measured": {"axis": "z"}}, "measured.axis: should be 'x' or 'y'"),
    "against": ({"measured": {"against": "openin"}}, "measured.against: .*did you mean 'opening'"),
    "gauge": ({"measured": {"against": {"type": "strain"}}}, "measured.against.type: unknown type"),
    "thickness": (
        {"measured": {"quantity": gauge(), "thickness": 2.0}},
        "measured.thickness: converts forces, but a gauge is measured; remove it",
    ),
    "axes": ({"measured": {"axes": ["y", "x"]}}, r"measured.axes: expected \[x\], \[y\] or \[x, y"),
}


@pytest.mark.parametrize("name", UNCLEAR)
def test_faulty_keys_are_reported_in_one_line(name, tmp_path):
    parts, message = UNCLEAR[name]
    file = written(tmp_path / "curve.csv", "displacement,force", [1.0, 2.0], [1.0, 2.0])
    measured = {"file": file} | ({} if name == "axes" else {"type": "curve", "group": 2})
    given = {"experiment": bar(), "unknown": {}} | parts
    given["measured"] = measured | parts.get("measured", {})
    with pytest.raises(pbdkit.ExperimentError, match=f"fit: {message}") as error:
        pbdkit.fit(given)
    assert len(str(error.value).splitlines()) == 1


def test_ratio_from_strain_gauges_and_an_extensometer(tmp_path):
    generator = np.random.default_rng(3)
    noise = 2e-5 * generator.normal(size=4)
    file = written(
        tmp_path / "curve.csv", "extension,strain", 8 * AXIAL[1:], strain(90, AXIAL[1:]) + noise
    )
    measured = {
        "type": "curve",
        "file": file,
        "columns": ["extension", "strain"],
        "quantity": gauge(angle=90.0),
        "against": {"type": "extensometer", "between": [[2, 2], [10, 2]]},
    }
    unknown = {"rule.poisson_ratio": [0.0, 0.49]}
    result = pbdkit.fit({"experiment": bar(), "unknown": unknown, "measured": measured})
    estimate = result.values["rule.poisson_ratio"]
    assert estimate.value == pytest.approx(RATIO, abs=4 * estimate.error)
    assert 0.0 < estimate.error < 0.01
    assert result.numbers().what == "strain"
    assert result.numbers().over == "extension"


REFUSED = {
    "no source": ({}, "group: is missing; give the `group` or the `load`"),
    "two sources": ({"group": 2, "load": 0}, "the curve has a `group` and a `load`"),
    "no axis": ({"group": 2, "axis": [0, 0]}, "the axis is a zero vector"),
    "no load": ({"load": 0}, "there is no load 0"),
    "no control": ({"group": 2, "against": "opening"}, r"its `control` is not \{type: opening"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_curves_are_refused(name, tmp_path):
    more, message = REFUSED[name]
    file = written(tmp_path / "curve.csv", "displacement,force", AXIAL, AXIAL)
    measured = {"type": "curve", "file": file} | more
    unknown = {"rule.poisson_ratio": [0.0, 0.49]}
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.fit({"experiment": bar(), "unknown": unknown, "measured": measured})


def field(generator, noise):
    points = generator.uniform([1, 0.5], [11, 3.5], (80, 2))
    u = 0.02 * np.c_[points[:, 0], -RATIO * (points[:, 1] - 2.0)]
    return points, u + noise * generator.normal(size=u.shape)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_one_component_of_a_field(axis, tmp_path):
    points, u = field(np.random.default_rng(1), 1e-4)
    column = u[:, "xy".index(axis)]
    file = written(tmp_path / "field.csv", f"x,y,u{axis}", *points.T, column)
    fit = {
        "experiment": bar(),
        "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
        "measured": {"file": file, "axes": [axis]},
    }
    result = pbdkit.fit(fit)
    estimate = result.values["rule.poisson_ratio"]
    assert estimate.identifiable is (axis == "y")
    if axis == "y":
        assert estimate.value == pytest.approx(RATIO, abs=4 * estimate.error)
        slope = 0.02 * (points[:, 1] - 2.0)
        residual = column + RATIO * slope
        error = np.std(residual) / np.linalg.norm(slope)
        assert estimate.error == pytest.approx(error, rel=0.05)
    assert result.field().components == (f"u{axis}",)
    assert result.field().measured.shape == (80, 1)
    wrong = fit["measured"] | {"columns": ["x", "y", "ux", "uy"]}
    with pytest.raises(pbdkit.ExperimentError, match="columns: expected 3 columns"):
        pbdkit.fit(fit | {"measured": wrong})


def test_noise_of_several_measurements_is_estimated(tmp_path):
    """A field in x, one in y with another noise: each noise is that of its own residuals."""
    generator = np.random.default_rng(2)
    points, u = field(generator, 0.0)
    noises = 1e-4, 2e-5
    measured = [
        {
            "file": written(
                tmp_path / f"{n}.csv",
                "x,y,u",
                *points.T,
                u[:, n] + noise * generator.normal(size=80),
            ),
            "axes": ["xy"[n]],
            "columns": ["x", "y", "u"],
        }
        for n, noise in enumerate(noises)
    ]
    fit = {"experiment": bar(), "unknown": {"rule.poisson_ratio": [0.0, 0.49]}}
    result = pbdkit.fit(fit | {"measured": measured})
    for misfit, noise in zip(result.misfits, noises, strict=True):
        assert misfit.noise == pytest.approx(noise, rel=0.3)
        assert misfit.ratio == pytest.approx(1.0, abs=0.05)
    given = [measured[0] | {"noise": result.misfits[0].noise}, measured[1]]
    half = pbdkit.fit(fit | {"measured": given})
    assert half.misfits[1].noise == pytest.approx(result.misfits[1].noise, rel=0.02)
    estimate = result.values["rule.poisson_ratio"]
    assert half.values["rule.poisson_ratio"].error == pytest.approx(estimate.error, rel=0.05)


def strip(**more):
    """A notched strip, of which the mouth of the notch opens."""
    return {
        "name": "strip",
        "units": {"length": "1 mm", "youngs_modulus": "30 GPa", "thickness": "10 mm"},
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": 9.0, "height": 4.0},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.2},
        "frame": {"type": "natural"},
        "fracture": {
            "type": "cohesive",
            "strength": "3 MPa",
            "energy": "2 N/m",
            "law": [[0, 1], [0.8, 0.4], [3.6, 0]],
            "cracks": [[[4.5, -1.0], [4.5, 1.5]]],
        },
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "loads": [{"select": {"edge": "right"}, "force": ["1 N", 0.0]}],
        "steps": 6,
        "solver": {
            "type": "equilibrium",
            "control": {"type": "opening", "between": [[4, 0], [5, 0]], "to": "0.002 mm"},
        },
    } | more


BOUNDS = {"fracture.strength": ["2 MPa", "4.4 MPa"], "fracture.energy": ["1.6 N/m", "2.6 N/m"]}


@pytest.fixture(scope="module")
def softening(tmp_path_factory):
    """The measured load of the strip over the opening."""
    ds = pbdkit.run(strip(), progress=False)
    load = ds.load_factor.values
    assert load.argmax() < 5
    path = tmp_path_factory.mktemp("strip") / "strip.csv"
    file = written(path, "opening,load", ds.opening.values[1:], load[1:])
    return {
        "type": "curve",
        "file": file,
        "columns": ["opening", "load"],
        "load": 0,
        "against": "opening",
        "youngs_modulus": 30000.0,
    }


def test_energy_and_strength_from_a_softening_curve(softening):
    measured = softening | {"noise": 0.01}
    result = pbdkit.fit({"experiment": strip(), "unknown": BOUNDS, "measured": measured})
    strength, energy = result.values.values()
    assert strength.value == pytest.approx(3.0, abs=max(0.2 * strength.error, 1e-3))
    assert energy.value == pytest.approx(2.0, abs=max(0.2 * energy.error, 1e-3))
    assert (strength.unit, energy.unit) == ("MPa", "N/m")
    first, *_ = str(result).splitlines()
    assert re.fullmatch(r"fracture.strength: [23]\.\d+ ± 0\.\d+ MPa", first)


def test_kink_of_the_softening_law(softening):
    unknown = {"fracture.law.1.1": [0.2, 0.58]}
    measured = softening | {"noise": 0.01}
    result = pbdkit.fit({"experiment": strip(), "unknown": unknown, "measured": measured})
    estimate = result.values["fracture.law.1.1"]
    assert estimate.value == pytest.approx(0.4, abs=max(0.2 * estimate.error, 1e-3))
    assert result.warnings == ()
    stalled = replace(result, solution=replace(result.solution, remaining=0.8))
    (warning,) = stalled.as_dict()["warnings"]
    assert warning.startswith("no step reduces the residuals, although 0.8 standard errors remain")


def test_derivatives_with_an_unknown_modulus(softening):
    """A strength in MPa is divided by the modulus, so that its prediction depends on both."""
    measured = softening | {"noise": 1.0}
    del measured["youngs_modulus"]
    unknown = {"fracture.strength": BOUNDS["fracture.strength"]}
    fit, _ = read_fit(Fit, {"unknown": unknown, "measured": measured}, has_experiment=True)
    problem = problem_of(fit, pbdkit.Experiment(**strip()))
    z = np.array([3.0, 31000.0])
    by_modulus = problem.at(z).jacobian[:, 1]
    step = np.array([0.0, 0.02 * 31000.0])
    change = problem.residuals(z - step) - problem.residuals(z + step)
    np.testing.assert_allclose(by_modulus, change / (2 * step[1]), rtol=0.05, atol=1e-5)
    assert problem.unknowns[0].number(3.0, 31000.0) == pytest.approx(3.0 / 31000.0)


FAULTS = {
    "units": ({"fracture.strength": ["1 MPa", "6 GPa"]}, "expected bounds in the same unit"),
    "dimension": ({"fracture.strength": ["1 mm", "6 mm"]}, "6 mm' is not a stress"),
    "order": ({"fracture.strength": ["6 MPa", "1 MPa"]}, "expected .lower bound, upper bound."),
}


@pytest.mark.parametrize("name", FAULTS)
def test_wrong_bounds_are_refused(name, softening):
    unknown, message = FAULTS[name]
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.fit({"experiment": strip(), "unknown": unknown, "measured": softening})


def test_another_modulus_than_that_of_units_is_refused(softening):
    unknown = {"fracture.strength": BOUNDS["fracture.strength"]}
    measured = softening | {"youngs_modulus": 31000.0}
    with pytest.raises(pbdkit.ExperimentError, match="31000 differs from 30000"):
        pbdkit.fit({"experiment": strip(), "unknown": unknown, "measured": measured})


def test_profiles_of_stresses_with_an_unknown_modulus_are_refused(softening):
    unknown = {"fracture.strength": BOUNDS["fracture.strength"]}
    measured = {key: value for key, value in softening.items() if key != "youngs_modulus"}
    fit = {"experiment": strip(), "unknown": unknown, "measured": measured}
    with pytest.raises(pbdkit.ExperimentError, match="requires a known modulus if bounds are"):
        pbdkit.fit(fit | {"profile": ["fracture.strength"]})
