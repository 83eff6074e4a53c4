"""Parameters are recovered from data that they generated; parameters that are not identifiable are
reported."""

from __future__ import annotations

import csv
import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.errors import AccuracyWarning, PbdkitWarning
from pbdkit.fitting.observations import Interpolation
from pbdkit.fitting.sensitivity import RestingScene
from pbdkit.scene.scene import build_scene

NOISE = 4e-4
WIDTH, HEIGHT = 20.0, 10.0


def side(x, height=HEIGHT):
    """Points on an end of the plate, and how they move: smoothly, not evenly."""
    y = np.linspace(0.0, height, 11)
    s = 2.0 * y / height - 1.0
    u = np.c_[0.02 * (x / WIDTH) + 2e-3 * s + 1e-3 * s**2, -0.003 * s + 1e-3 * s**3]
    return {"points": np.c_[np.full(11, x), y].tolist(), "displacements": u.tolist()}


def plate(rule=None, *, noise=0.0, generator=None, **more):
    leaders = []
    for edge, x in (("left", 0.0), ("right", WIDTH)):
        motion = side(x)
        if generator is not None:
            given = np.array(motion["displacements"])
            motion["displacements"] = (given + noise * generator.normal(size=given.shape)).tolist()
        leaders.append({"select": {"edge": edge}, "motion": {"type": "measured", **motion}})
    return {
        "name": "plate",
        "lattice": {"type": "square", "a": 2.0},
        "body": {
            "type": "difference",
            "of": [
                {"type": "rectangle", "width": WIDTH, "height": HEIGHT},
                {"type": "disc", "radius": 2.0, "centre": [10.0, 5.0]},
            ],
        },
        "regions": {"half": {"type": "rectangle", "width": 10.0, "height": HEIGHT}},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": rule or {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": leaders,
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-9},
    } | more


def measured(experiment, path, *, noise=0.0, count=400, generator=None):
    """Writes what the equilibrium of an experiment shows at random points."""
    generator = generator or np.random.default_rng(0)
    resting = RestingScene.of(pbdkit.Experiment(**experiment))
    points = generator.uniform([0.0, 0.0], [WIDTH, HEIGHT], (count, 2))
    found = Interpolation.at(resting.scene, points)
    u = found.of(resting.state.u, resting.scene)
    u += noise * generator.normal(size=u.shape)
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["x", "y", "ux", "uy"])
        lines.writerows(np.c_[points[found.inside], u].tolist())
    return resting


MATERIALS = {
    "Poisson's ratio": (
        {"type": "elastic", "poisson_ratio": 0.31}, {"rule.poisson_ratio": (0.31, [0.0, 0.49])},
    ),
    "stiffness of a region": (
        {"type": "elastic", "poisson_ratio": 0.2, "stiffness": {"otherwise": 1.0, "half": 1.7}},
        {"rule.poisson_ratio": (0.2, [0.0, 0.49]), "rule.stiffness.half": (1.7, [0.3, 3.0])},
    ),
    "orthotropic": (
        {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.6, "shear_ratio": 0.3},
        {"rule.poisson_ratio": (0.2, [0.0, 0.4]), "rule.modulus_ratio": (0.6, [0.3, 1.2]),
         "rule.shear_ratio": (0.3, [0.1, 0.6])},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MATERIALS)
def test_parameters_are_recovered_from_synthetic_data(name, tmp_path):
    rule, unknown = MATERIALS[name]
    made = plate(rule)
    measured(made, tmp_path / "field.csv")
    fit = {
        "experiment": made,
        "unknown": {path: bounds for path, (_, bounds) in unknown.items()},
        "measured": {"file": str(tmp_path / "field.csv"), "noise": 1e-7},
    }
    found = pbdkit.fit(fit)
    for path, (value, _) in unknown.items():
        assert found.values[path].identifiable
        assert found.values[path].value == pytest.approx(value, abs=2e-5)
    assert found.ratio < 1.0


def test_force_identifies_youngs_modulus(tmp_path):
    made = plate()
    resting = measured(made, tmp_path / "field.csv")
    ds = pbdkit.run(
        made | {"diagnostics": [{"type": "reaction", "youngs_modulus": 70e3, "thickness": 2.0}]},
        progress=False,
    )
    force = ds.reaction.isel(time=-1).sel(leader_group=1).values
    assert resting.scene.raster.count == ds.sizes["particle"]
    found = pbdkit.fit(
        {
            "experiment": made,
            "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
            "measured": {"file": str(tmp_path / "field.csv"), "noise": 1e-7},
            "force": {"group": 1, "value": force.tolist(), "thickness": 2.0},
        }
    )
    assert found.youngs_modulus.value == pytest.approx(70e3, rel=1e-4)


def test_force_noise_enters_the_error_of_youngs_modulus(tmp_path):
    """E is F over what the group carries at E = 1: their relative errors add as squares."""
    made = plate()
    measured(made, tmp_path / "field.csv", noise=NOISE)
    unknown = {"rule.poisson_ratio": [0.0, 0.49]}
    given = {"file": str(tmp_path / "field.csv"), "noise": NOISE}
    force = {"group": 1, "value": [3.0, 0.4], "thickness": 2.0}
    size = np.hypot(3.0, 0.4)
    fit = {"experiment": made, "unknown": unknown, "measured": given}
    exact, noisy, noisier = (
        pbdkit.fit(fit | {"force": force | {"noise": share * size}}).youngs_modulus
        for share in (0.0, 0.01, 0.2)
    )
    assert exact.error > 1e-3 * exact.value
    for share, each in ((0.01, noisy), (0.2, noisier)):
        assert each.value == exact.value
        expected = np.hypot(exact.error, share * exact.value)
        assert each.error == pytest.approx(expected, rel=1e-9)


def test_errors_match_repeated_experiments():
    """The field and the prescribed displacements have noise, as both are measured; the long trial
    has more repeats. The error of Poisson's ratio agrees with its standard error."""
    generator = np.random.default_rng(3)
    from pbdkit.fitting.observations import FieldEvidence, FieldObservation
    from pbdkit.fitting.parameter import Parameter
    from pbdkit.fitting.problem import Problem, Unknown, solved

    resting = RestingScene.of(pbdkit.Experiment(**plate()))
    points = generator.uniform([0.0, 0.0], [WIDTH, HEIGHT], (600, 2))
    inside = Interpolation.at(resting.scene, points)
    points, true = points[inside.inside], inside.of(resting.state.u, resting.scene)
    off = []
    for _ in range(8):
        noisy = pbdkit.Experiment(**plate(noise=NOISE, generator=generator))
        scene = build_scene(noisy)
        field = true + NOISE * generator.normal(size=true.shape)
        evidence = FieldEvidence.of(scene, points, field)
        observation = FieldObservation.of(scene, evidence, NOISE, modes=4)
        unknown = Unknown(Parameter("rule.poisson_ratio"), 0.0, 0.49)
        problem = Problem((unknown,), (observation,))
        solution = solved(problem, problem.start())
        off.append((solution.z[0] - 0.3) / solution.errors[0])
    # The sum of 8 squares of normal numbers lies between these in 999 of 1 000 cases.
    assert 0.7 < np.sum(np.square(off)) < 27.9


UNTOLD = {
    "stiffness without a force": (
        {"type": "elastic", "poisson_ratio": 0.3, "stiffness": 1.0},
        {"rule.poisson_ratio": [0.0, 0.49], "rule.stiffness": [0.5, 2.0]},
        {"rule.stiffness": "no measured value depends on it; remove it from `unknown`"},
    ),
    "both halves": (
        {"type": "elastic", "poisson_ratio": 0.3, "stiffness": {"otherwise": 1.0, "half": 2.0}},
        {"rule.stiffness.half": [0.5, 4.0], "rule.stiffness.otherwise": [0.5, 4.0]},
        {
            "rule.stiffness.half": "changes of rule.stiffness.otherwise have the same effect",
            "rule.stiffness.otherwise": "changes of rule.stiffness.half have the same effect",
        },
    ),
    "a length below the spacing": (
        {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.05},
        {"rule.length": [0.01, 0.1]},
        {"rule.length": "exceeds a quarter of the interval between its bounds, 0.01 to 0.1"},
    ),
}


@pytest.mark.parametrize("name", UNTOLD)
def test_unidentifiable_parameters_are_reported(name, tmp_path):
    rule, unknown, untold = UNTOLD[name]
    made = plate(rule)
    if rule["type"] == "strain-gradient":
        made |= {"frame": {"type": "mean"}}
    measured(made, tmp_path / "field.csv", noise=NOISE)
    found = pbdkit.fit(
        {
            "experiment": made,
            "unknown": unknown,
            "measured": {"file": str(tmp_path / "field.csv"), "noise": NOISE},
        }
    )
    assert {path for path, estimate in found.values.items() if not estimate.identifiable} == {
        *untold
    }
    lines = str(found).splitlines()
    for path, reason in untold.items():
        content = found.as_dict()["values"][path]
        assert content["value"] is None
        assert reason in content["reason"] == found.reasons[path]
        place = lines.index(f"{path}: not identifiable from the data")
        assert lines[place + 1] == f"  {content['reason']}"


def in_series(**more):
    """A bar of two materials, one behind the other, drawn out."""
    rule = {"type": "elastic", "poisson_ratio": 0.2, "stiffness": {"otherwise": 1.0, "half": 2.5}}
    drawn = {"type": "displace", "displacement": [0.1, 0.02]}
    return (
        plate(rule)
        | {
            "body": {"type": "rectangle", "width": WIDTH, "height": HEIGHT},
            "leaders": [
                {"select": {"edge": "left"}, "motion": {"type": "hold"}},
                {"select": {"edge": "right"}, "motion": drawn},
            ],
        }
        | more
    )


def fitted(made, path, unknown, noise, **more):
    measured(made, path, noise=noise, count=60)
    given = {"file": str(path), "noise": noise}
    return pbdkit.fit({"experiment": made, "unknown": unknown, "measured": given} | more)


BOTH = {"rule.stiffness.otherwise": [0.2, 8.0], "rule.stiffness.half": [0.3, 5.0]}


@pytest.mark.parametrize("noise", in_turn([1e-4, 1e-7], 2))
@pytest.mark.parametrize("more", [{}, {"rule.poisson_ratio": [0.0, 0.45]}])
def test_ratio_is_identified_if_neither_of_its_parts_is(noise, more, tmp_path):
    """The best fit is that with one of them known, and so is the error of the ratio."""
    made, path = in_series(), tmp_path / "field.csv"
    one = fitted(made, path, {"rule.stiffness.half": [0.3, 5.0]} | more, noise)
    both = fitted(made, path, BOTH | more, noise)
    residuals = [f.solution.at.residuals for f in (one, both)]
    np.testing.assert_allclose(*residuals, atol=0.02)
    assert not any(both.values[path].identifiable for path in BOTH)
    assert all(both.values[path].identifiable for path in more)
    ratio, product = both.combinations
    assert ratio.name == "rule.stiffness.otherwise / rule.stiffness.half"
    assert product.name == "rule.stiffness.otherwise · rule.stiffness.half"
    assert (ratio.estimate.identifiable, product.estimate.identifiable) == (True, False)
    alone, together = one.values["rule.stiffness.half"], ratio.estimate
    assert together.value == pytest.approx(1.0 / alone.value, rel=0.02 * alone.error)
    assert together.error / together.value == pytest.approx(alone.error / alone.value, rel=0.02)
    assert f"{product.name}: not identifiable from the data" in str(both).splitlines()
    assert both.as_dict()["combinations"][ratio.name]["exponents"] == {
        "rule.stiffness.otherwise": 1.0,
        "rule.stiffness.half": -1.0,
    }


def loaded(force):
    loads = [{"select": {"edge": "right"}, "force": [each, 0.0]} for each in force]
    rule = {"type": "elastic", "poisson_ratio": 0.2, "stiffness": 2.0}
    return in_series(rule=rule, leaders=in_series()["leaders"][:1], loads=loads)


SUMS = {
    "of a force and a stiffness": (
        [0.05], {"loads.0.force.0": [-0.2, 0.2], "rule.stiffness": [0.3, 5.0]},
        "loads.0.force.0 / rule.stiffness", 0.025,
    ),
    "of forces": (
        [0.04, 0.01], {"loads.0.force.0": [0.001, 0.2], "loads.1.force.0": [0.001, 0.1]},
        "loads.0.force.0 + loads.1.force.0", 0.05,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SUMS)
def test_identifiable_combination_is_a_product_or_a_sum(name, tmp_path):
    force, unknown, formula, value = SUMS[name]
    found = fitted(loaded(force), tmp_path / "field.csv", unknown, 1e-4)
    told, untold = found.combinations
    assert told.name == formula
    assert (told.estimate.identifiable, untold.estimate.identifiable) == (True, False)
    assert told.estimate.error < 2e-3 * value
    assert told.estimate.value == pytest.approx(value, abs=4 * told.estimate.error)


def test_single_unidentifiable_parameter_gives_no_combination(tmp_path):
    unknown = {"rule.stiffness": [0.5, 2.0], "rule.poisson_ratio": [0.0, 0.45]}
    rule = {"type": "elastic", "poisson_ratio": 0.2, "stiffness": 1.0}
    found = fitted(in_series(rule=rule), tmp_path / "field.csv", unknown, 1e-4)
    assert [estimate.identifiable for estimate in found.values.values()] == [False, True]
    assert found.combinations == ()


@pytest.mark.parametrize("bounds", [[0.0, 0.49], [0.29, 0.31], [0.37, 0.49]])
def test_bounds_of_an_unidentified_parameter_do_not_hide_youngs_modulus(bounds, tmp_path):
    """60 points determine E to 1 %, and Poisson's ratio to 0.02, which exceeds a quarter of one of
    the intervals. One interval does not contain the true value, 0.3: its end is no criterion."""
    made, path = plate(), tmp_path / "field.csv"
    measured(made, path, noise=NOISE, count=60)
    given = {"file": str(path), "noise": NOISE}
    fit = {"experiment": made, "unknown": {"rule.poisson_ratio": bounds}, "measured": given}
    found = pbdkit.fit(fit | {"modes": 3, "force": {"group": 1, "value": [0.2, 0.0]}})
    estimate, young = found.values["rule.poisson_ratio"], found.youngs_modulus
    assert estimate.identifiable == (bounds[1] == 0.49)
    assert estimate.on_bound == (bounds[0] > 0.0)
    assert young.identifiable
    assert young.error == pytest.approx(0.01 * young.value, rel=0.1)


def test_bounds_that_exclude_the_minimum_are_named(tmp_path):
    """The distance of the minimum, 0.3, beyond the bound is the one that wide bounds give."""
    made, path = plate(), tmp_path / "field.csv"
    measured(made, path, noise=NOISE)

    def fitted_between(*bounds):
        given = {"file": str(path), "noise": NOISE}
        fit = {"experiment": made, "unknown": {"rule.poisson_ratio": bounds}, "measured": given}
        found = pbdkit.fit(fit | {"modes": 2})
        start = "unknown.rule.poisson_ratio: "
        return found, [text for text in found.warnings if text.startswith(start)]

    wide, texts = fitted_between(0.0, 0.49)
    assert not texts
    assert not wide.beyond_bounds
    for bounds, bound in (((0.0, 0.1), 0.1), ((0.4, 0.49), 0.4)):
        found, (text,) = fitted_between(*bounds)
        assert f"stops at the bound {bound}" in text
        assert "widen this bound" in text
        distance = abs(wide.values["rule.poisson_ratio"].value - bound) / found.solution.errors[0]
        assert found.beyond_bounds["rule.poisson_ratio"] == pytest.approx(distance, rel=0.3), bound


@pytest.mark.parametrize(("stated", "warned"), [(NOISE, False), (NOISE / 4.0, True)])
def test_residuals_well_above_the_noise_are_reported(stated, warned, tmp_path):
    made, path = plate(), tmp_path / "field.csv"
    measured(made, path, noise=NOISE, count=100)
    given = {"file": str(path), "noise": stated}
    fit = {"experiment": made, "unknown": {"rule.poisson_ratio": [0.0, 0.49]}, "measured": given}
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always", PbdkitWarning)
        found = pbdkit.fit(fit)
    assert [each.category for each in issued] == [AccuracyWarning] * warned
    assert found.as_dict()["warnings"] == [str(each.message) for each in issued]
    for each in issued:
        assert re.match(
            r"measured: the residuals of the field are [34]\.\d times the noise of 0\.0001: .*"
            "use another model, or `noise: 0.0004`",
            str(each.message),
        )


def test_robust_loss_downweights_outliers(tmp_path):
    made, path = plate(lattice={"type": "square", "a": 1.0}), tmp_path / "field.csv"
    measured(made, path, noise=NOISE)
    with path.open() as file:
        rows = list(csv.reader(file))
    for row in rows[1::15]:
        row[2] = str(float(row[2]) + 0.02)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    fit = {
        "experiment": made,
        "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
        "measured": {"file": str(path), "noise": NOISE},
    }
    far = {
        loss: abs(pbdkit.fit(fit | {"loss": loss}).values["rule.poisson_ratio"].value - 0.3)
        for loss in ("linear", "huber", "soft_l1", "cauchy")
    }
    assert max(far["huber"], far["soft_l1"], far["cauchy"]) < 0.3 * far["linear"]


def test_without_given_noise_it_is_estimated_from_residuals(tmp_path):
    made = plate()
    measured(made, tmp_path / "field.csv", noise=NOISE)
    found = pbdkit.fit(
        {
            "experiment": made,
            "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
            "measured": {"file": str(tmp_path / "field.csv")},
        }
    )
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    assert found.ratio == pytest.approx(1.0, rel=0.01)


def test_command_writes_the_result_of_the_python_call(call, tmp_path):
    """The shipped fit on a coarser lattice; `finite_elements.test_updating` has its own."""
    for suffix in ("yaml", "csv"):
        text = (Path(pbdkit.__file__).parent / "fits" / f"plate-with-hole.{suffix}").read_text()
        Path(f"coarse.{suffix}").write_text(
            text.replace("a: 0.25", "a: 1.0").replace("plate-with-hole.csv", "coarse.csv")
        )
    result = call("fit", "coarse.yaml", "-o", str(tmp_path / "plate.json"))
    assert result.code == 0, result.err
    found = json.loads((tmp_path / "plate.json").read_text())
    assert 0.30 < found["values"]["rule.poisson_ratio"]["value"] < 0.32
    assert 215e3 < found["youngs_modulus"]["value"] < 227e3
    assert found["residual_over_noise"] < 1.2
    assert "rule.poisson_ratio: 0.3" in result.out
    assert re.search(r"^Young's modulus: 2\d{5} ± \d+ MPa$", result.out, re.M)
    assert "times the noise of 0.0003 mm, over" in result.out


WRONG = {
    "no such parameter": ({"unknown": {"rule.poison_ratio": [0.0, 0.4]}}, "no 'poison_ratio'"),
    "bounds the wrong way": (
        {"unknown": {"rule.poisson_ratio": [0.4, 0.1]}},
        "expected .lower bound",
    ),
    "nothing unknown": ({"unknown": {}}, "unknown"),
    "no such file": ({"measured": {"file": "none.csv"}}, r"\.csv: does not exist"),
    "no such column": ({"measured": {"columns": ["x", "y", "u", "v"]}}, "no 'u'"),
    "points elsewhere": ({"measured": {"margin": 100.0}}, "only 0 measured numbers"),
    "no such group": (
        {"force": {"group": 7, "value": [1.0, 0.0]}},
        "^fit: force.group: there is no leader group 7",
    ),
    "a force that is none": ({"force": {"group": 1, "value": [0.0, 0.0]}}, "modulus; omit it"),
    "a force the other way": ({"force": {"group": 1, "value": [-1.0, 0.0]}}, "change its sign"),
    "bounds too wide": ({"unknown": {"rule.poisson_ratio": [0.2, 0.9]}}, "a bound is not valid"),
    "fewer modes than none": ({"modes": -1}, "modes: should be greater"),
    "a term twice": ({"measured": {"distortion": {"ux": [[1, 0], [1, 0]]}}}, "twice"),
}


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_named(name, tmp_path):
    changed, told = WRONG[name]
    path = tmp_path / "field.csv"
    measured(plate(), path)
    fit = {
        "experiment": plate(),
        "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
        "measured": {"file": str(path), "noise": 1e-3},
    }
    for key, value in changed.items():
        fit[key] = {**fit["measured"], **value} if key == "measured" else value
    with pytest.raises(pbdkit.ExperimentError, match=told):
        pbdkit.fit(fit)


ROWS = {
    "in metres": (lambda rows: 1e-3 * rows, {}, "lattice units"),
    "fewer than unknowns": (
        lambda rows: rows[20:23],
        {"distortion": {"ux": [[p, q] for p in (0, 1) for q in range(4)]}},
        "cannot determine 9 unknowns",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_invalid_rows_are_named(name, tmp_path):
    change, more, told = ROWS[name]
    path = tmp_path / "field.csv"
    measured(plate(), path)
    rows = change(np.loadtxt(path, delimiter=",", skiprows=1))
    np.savetxt(path, rows, delimiter=",", header="x,y,ux,uy", comments="")
    given = {"file": str(path), "noise": 1e-3} | more
    unknown = {"rule.poisson_ratio": [0.0, 0.49]}
    with pytest.raises(pbdkit.ExperimentError, match=told):
        pbdkit.fit({"experiment": plate(), "unknown": unknown, "measured": given, "modes": 0})


@pytest.mark.parametrize("noise", [{}, {"noise": 1e-6}])
def test_single_point_at_rest_is_harmless(noise, tmp_path):
    path = tmp_path / "field.csv"
    path.write_text("x,y,ux,uy\n3,2,0,0\n")
    bar = {
        "name": "bar",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": 8.0, "height": 4.0},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "steps": 1,
        "solver": {"type": "equilibrium"},
    }
    unknown = {"rule.poisson_ratio": [0.01, 0.49]}
    given = {"file": str(path)} | noise
    found = pbdkit.fit({"experiment": bar, "unknown": unknown, "measured": given})
    assert not found.values["rule.poisson_ratio"].identifiable


def test_plot_has_one_row_per_axis_without_overlapping_text(tmp_path):
    pytest.importorskip("matplotlib")
    from pbdkit.plotting.fit_figures import draw_fit

    made = plate()
    measured(made, tmp_path / "field.csv", noise=NOISE)
    found = pbdkit.fit(
        {
            "experiment": made,
            "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
            "measured": {"file": str(tmp_path / "field.csv"), "noise": NOISE},
        }
    )
    figure = draw_fit(found)
    figure.canvas.draw()
    titles = [ax.title for ax in figure.axes if ax.get_title()]
    assert [t.get_text() for t in titles] == [  # the plate is wide: side by side
        f"u{axis} {what}"
        for what in ("measured", "fitted", "residual / noise", "sensitivity to rule.poisson_ratio")
        for axis in "xy"
    ]
    boxes = [title.get_window_extent() for title in titles]
    assert all(figure.bbox.containsx(b.x0) and figure.bbox.containsx(b.x1) for b in boxes)
    assert not any(a.overlaps(b) for n, a in enumerate(boxes) for b in boxes[:n])
    left = found.field().residual
    assert np.std(left) == pytest.approx(NOISE, rel=0.1)


def test_dataset_is_fitted_like_the_file_with_its_columns(tmp_path):
    import xarray

    made = plate()
    measured(made, tmp_path / "field.csv", noise=NOISE, count=100)
    columns = np.genfromtxt(tmp_path / "field.csv", delimiter=",", names=True)
    table = xarray.Dataset({name: ("point", columns[name]) for name in columns.dtype.names})
    fit = {"experiment": made, "unknown": {"rule.poisson_ratio": [0.0, 0.49]}, "modes": 0}
    file = {"file": str(tmp_path / "field.csv"), "noise": NOISE}
    of_file = pbdkit.fit(fit | {"measured": file})
    of_table = pbdkit.fit(fit | {"measured": {"noise": NOISE}}, measured=table)
    assert of_table.as_dict() == of_file.as_dict()
    assert str(of_table).startswith("rule.poisson_ratio: 0.")
    for wrong, said in (
        (table.rename(ux="u_x"), "measured: the dataset has no variable 'ux'"),
        (table.where(table.ux != table.ux[3]), "finite ones only"),
        (table.assign(uy=("other", [0.0])), r"must have one size, got x \d+, y \d+, ux \d+, uy 1$"),
    ):
        with pytest.raises(pbdkit.ExperimentError, match=said):
            pbdkit.fit(fit, measured=wrong)


PLACES = {
    "another parameter": (
        "rule.poisson_ratio",
        "rule.poison_ratio",
        "fit.yaml:13:11: unknown.rule.poison_ratio: .* there is no 'poison_ratio'; did you mean",
    ),
    "bounds in the wrong order": (
        "[0.0, 0.49]",
        "[0.49, 0.0]",
        r"fit.yaml:13:11: .*: expected \[lower bound, upper bound\], .*; write \[0.0, 0.49\]",
    ),
    "a variable of a diagnostic": (
        "measured:",
        "derived: [K_I]\nmeasured:",
        r"fit.yaml:14:11: derived.0: 'K_I' .*; add \{type: stress-intensity.*\} to `diagnostics`",
    ),
    "one specimen": (
        "measured:",
        "specimens: true\nmeasured:",
        "fit.yaml:14:1: specimens: requires measurements of at least two specimens; .*, or omit",
    ),
    "no such cut": (
        "measured:",
        "crack_tip: {cut: 1, within: 2.5 mm}\nmeasured:",
        "fit.yaml:14:13: crack_tip.cut: there is no cut 1; the experiment has no cuts",
    ),
}


@pytest.mark.parametrize("name", PLACES)
def test_errors_have_a_place_in_the_fit_file(name, tmp_path):
    old, new, message = PLACES[name]
    text = """experiment:
  units: {length: 2 mm}
  lattice: {type: square, a: 1.0}
  body: {type: rectangle, width: 8.0, height: 4.0}
  neighbours: {type: chebyshev, shells: 1}
  rule: {type: elastic, poisson_ratio: 0.3}
  frame: {type: natural}
  leaders:
    - {select: {edge: left}, motion: {type: hold}}
    - {select: {edge: right}, motion: {type: displace, displacement: [0.25, 0.0]}}
  steps: 1
  solver: {type: equilibrium}
unknown: {rule.poisson_ratio: [0.0, 0.49]}
measured: {file: field.csv, noise: 1.0e-3}
"""
    rows = [f"{x},{y},{0.03 * x},{-0.009 * (y - 2)}" for x in range(1, 8) for y in range(1, 4)]
    (tmp_path / "field.csv").write_text("\n".join(["x,y,ux,uy", *rows]))
    path = tmp_path / "fit.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.fit(path)
