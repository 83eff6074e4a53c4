"""Random fields: their statistics, what they are drawn from, and that results hold them."""

import contextlib
import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from interpreted_kernels import interpreting
from jsonschema import Draft202012Validator
from scene_strategies import in_turn
from scipy.stats import norm

import pbdkit
from pbdkit.model.schema import experiment_schema
from pbdkit.plugin.fields import RandomField
from pbdkit.plugin.registry import Registry
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.sweeps.specification import replicate_seeds
from tests.stepping.numba_engine.test_engine import assert_bitwise_equal

MEAN, SCATTER, LENGTH = 0.05, 0.3, 2.0
ASKED = {"mean": MEAN, "scatter": SCATTER, "correlation_length": LENGTH}
PULL = {"type": "velocity", "velocity": [0.05, 0.0], "steps": 20}
GIVEN = {
    "name": "strip",
    "seed": 7,
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 9, "rows": 5},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "springs"},
    "frame": {"type": "natural"},
    "fracture": {"type": "strain", "failure": ASKED},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {"select": {"edge": "right"}, "motion": PULL},
    ],
    "steps": 25,
    "solver": {"type": "stepping", "engine": "numpy"},
    "diagnostics": [{"type": "displacement"}, {"type": "stress", "youngs_modulus": 1.0}],
}
STIFFNESS = {"rule": {"type": "springs", "stiffness": ASKED | {"mean": 1.0}}}


def drawn(field="fracture", name="failure", **parts):
    """The values of a parameter over their grid."""
    part = getattr(pbdkit.Experiment(**GIVEN | parts), field)
    return part.varying[name].drawn.grid


def run(**parts):
    return pbdkit.run(GIVEN | parts, progress=False)


def same(one, other):
    assert {*one.variables} == {*other.variables}
    return all(one[name].values.tobytes() == other[name].values.tobytes() for name in one.variables)


SEEDS = 300
FAR = 4.0 * LENGTH
"""Values at two places so far apart are almost uncorrelated: exp(-16)."""
DISTANCES = np.array([0.0, 0.5, 1.0, 2.0, 3.0])
ENOUGH = 4.0
"""Standard errors that an estimate may be off."""


@pytest.fixture(scope="module")
def samples():
    """(seed, group, distance, row): at some distances along x from the first place of each of four
    groups, which are as far apart as the two rows."""
    x = (2 * FAR * np.arange(4)[:, None] + DISTANCES).ravel()
    field, y = RandomField(**ASKED), np.array([0.0, FAR])
    found = [field.drawn_at(x, y, seed, "fracture").drawn.grid.values for seed in range(SEEDS)]
    return np.reshape(found, (SEEDS, 4, len(DISTANCES), 2))


def standard(values):
    """The Gaussian field under them."""
    variance = np.log1p(SCATTER**2)
    return (np.log(values / MEAN) + variance / 2) / np.sqrt(variance)


def test_mean_and_scatter_match_the_specification(samples):
    """The kurtosis of a lognormal variable, on which the error of its variance depends, is
    q⁴ + 2q³ + 3q² - 3 with q = 1 + scatter²."""
    values, q = samples[:, :, 0], 1.0 + SCATTER**2
    kurtosis = q**4 + 2 * q**3 + 3 * q**2 - 3
    assert abs(values.mean() / MEAN - 1) < ENOUGH * SCATTER / np.sqrt(values.size)
    variance = values.var() / (SCATTER * MEAN) ** 2
    assert abs(variance - 1) < ENOUGH * np.sqrt((kurtosis - 1) / values.size)
    assert samples.min() > 0.0


def test_values_are_lognormal(samples):
    """Compare by the largest distance between two distributions, Kolmogorov's, at the level
    1e-4."""
    g = np.sort(standard(samples[:, :, 0]), axis=None)
    share = np.arange(len(g) + 1) / len(g)
    distance = max(abs(norm.cdf(g) - share[1:]).max(), abs(norm.cdf(g) - share[:-1]).max())
    assert distance < np.sqrt(np.log(2 / 1e-4) / (2 * len(g)))


def test_covariance_decays_with_distance_as_documented(samples):
    """exp(-(r/ℓ)²); nothing is left between groups and rows. The product of two Gaussian variables
    with correlation ρ has the variance 1 + ρ²."""
    g = standard(samples)
    products = {r: g[:, :, 0] * g[:, :, n] for n, r in enumerate(DISTANCES)}
    products |= {FAR: g[:, :, 0, 0] * g[:, :, 0, 1], 2 * FAR: g[:, 0, 0] * g[:, 1, 0]}
    for r, found in products.items():
        expected = np.exp(-((r / LENGTH) ** 2))
        assert abs(found.mean() - expected) < ENOUGH * np.sqrt((1 + expected**2) / found.size)


def test_fields_depend_on_the_seed_alone():
    first = drawn()
    noise = {"type": "noise", "amplitude": 0.01}
    assert first == drawn(initial=noise) == drawn(**STIFFNESS) == drawn(steps=3)
    others = [drawn(seed=seed) for seed in range(5)]
    assert all(one != other for n, one in enumerate(others) for other in [first, *others[:n]])


def test_strength_at_a_place_is_independent_of_spacing_and_body():
    coarse, fine = drawn(), drawn(lattice={"type": "square", "a": 0.5})
    assert np.array_equal(coarse.values[:9, :5], fine.values[::2, ::2])
    part = drawn(body={"type": "rectangle", "width": 2.0, "height": 1.0})
    assert np.array_equal(coarse.values[:5, :3], part.values)


def test_fields_are_correlated_within_a_part_and_independent_between():
    damage = {"type": "damage", "onset": ASKED, "failure": ASKED | {"mean": 2 * MEAN}}
    onset, failure = (drawn(name=n, fracture=damage).values for n in ("onset", "failure"))
    np.testing.assert_allclose(failure, 2 * onset, rtol=1e-14)
    stiff, strong = drawn("rule", "stiffness", **STIFFNESS).values * MEAN, drawn().values
    assert not np.allclose(stiff, strong, rtol=0.1)
    place, products = np.zeros(1), []
    for seed in range(100):
        both = (RandomField(**ASKED).drawn_at(place, place, seed, p) for p in ("rule", "fracture"))
        products.append(np.prod([standard(one.drawn.grid.values) for one in both]))
    assert abs(np.mean(products)) < ENOUGH / np.sqrt(len(products))


ELASTIC = {"type": "elastic", "poisson_ratio": 1 / 3, "stiffness": ASKED | {"mean": 1.0}}
COHESIVE = {"type": "cohesive", "energy": ASKED | {"mean": 4e-6}, "onset": ASKED | {"mean": 1e-3}}


@pytest.mark.parametrize(
    "parts",
    in_turn([
        STIFFNESS,
        {"fracture": {"type": "damage", "onset": ASKED, "failure": ASKED | {"mean": 0.2}}},
        {"lattice": {"type": "hexagonal", "a": 1.0}, "neighbours": {"type": "coordination"}},
        {"rule": {"type": "elastic", "poisson_ratio": ASKED | {"mean": 0.2}}},
        {"rule": ELASTIC, "fracture": COHESIVE},
        {"rule": ELASTIC, "fracture": {"type": "none"}, "solver": {"type": "equilibrium"}},
    ], 2),
    ids=in_turn(
        ["stiffness", "damage", "hexagonal", "poisson ratio", "cohesive", "equilibrium"], 2
    ),
)  # fmt: skip
def test_random_field_equals_a_grid_of_its_values(parts):
    written = pbdkit.Experiment(**GIVEN | parts).model_dump(mode="json")
    of_parts = [(part, name) for part in (written["rule"], written["fracture"]) for name in part]
    fields = [(part, name) for part, name in of_parts if isinstance(part[name], dict)]
    assert fields
    for part, name in fields:
        part[name] = {key: part[name]["drawn"][key] for key in ("x", "y", "values")}
    found = run(**parts)
    assert np.isfinite(found.stress_xx.values[-1]).all()
    assert same(found, pbdkit.run(written, progress=False))


@pytest.mark.parametrize("threads", [1, 3])
def test_kernels_and_numpy_agree_bitwise(threads):
    solver = {"type": "stepping", "threads": threads}
    scene = build_scene(pbdkit.Experiment(**GIVEN | STIFFNESS | {"solver": solver}))
    with interpreting():
        reached = assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1, 12, 12))
    assert (reached.broken_step > 0).any()


def test_bonds_break_above_the_strength_at_their_midpoint():
    experiment = pbdkit.Experiment(**GIVEN)
    ds = pbdkit.run(experiment, progress=False)
    middle = ds.reference.values[ds.bond_ends.values - 1].mean(axis=1)
    strength = experiment.fracture.varying["failure"].at(*middle.T, {})
    torn = ds.broken_step.values > 0
    assert torn.any()
    assert (ds.broken_strain.values[torn] > strength[torn]).all()


def test_results_are_bitwise_reproducible_without_gstools(monkeypatch, call):
    """From the dataset alone, and from its file: few values, as numbers, and many, as bytes."""
    for body in (GIVEN["body"], {"type": "grid", "columns": 18, "rows": 16}):
        given = GIVEN | STIFFNESS | {"body": body}
        Path("strip.json").write_text(json.dumps(given))
        assert call("run", "strip.json", "--force").code == 0
        ds = pbdkit.run(given, progress=False)
        with monkeypatch.context() as without:
            without.setitem(sys.modules, "gstools", None)
            assert same(pbdkit.rerun(ds, progress=False), ds)
            with pbdkit.open("strip.nc") as kept:
                assert same(pbdkit.rerun(kept, progress=False), ds)
            assert call("explain", "strip.nc").code == 0
            refused = call("check", "strip.json")
        assert refused.code == 2
        assert "random fields require GSTools: pip install 'pbdkit[random]'" in refused.err
        assert "strip.json:1:" in refused.err


def test_sampled_field_is_reused_while_its_specification_is_unchanged(monkeypatch):
    written = pbdkit.Experiment(**GIVEN).model_dump(mode="json")
    changes = (
        {"seed": 8},
        {"fracture": {"type": "strain", "failure": ASKED | {"scatter": 0.1}}},
        {"fracture": {"type": "strain", "failure": ASKED | {"correlation_length": 3.0}}},
        {"body": {"type": "grid", "columns": 12, "rows": 6}},
    )
    for change in changes:
        failure = change.get("fracture", GIVEN["fracture"])["failure"]
        asked = written["fracture"] | {"failure": written["fracture"]["failure"] | failure}
        again = pbdkit.Experiment(**written | change | {"fracture": asked})
        assert again == pbdkit.Experiment(**GIVEN | change)
        assert again.fracture != pbdkit.Experiment(**GIVEN).fracture
    monkeypatch.setitem(sys.modules, "gstools", None)
    assert pbdkit.Experiment(**written).model_dump(mode="json") == written
    with pytest.raises(pbdkit.ExperimentError, match="GSTools"):
        pbdkit.Experiment(**written | {"seed": 8})


def test_members_of_a_sweep_sample_independently(tmp_path):
    asked = {
        "vary": {"fracture.failure.scatter": [0.1, 0.3]},
        "replicates": 2,
        "keep": {"variables": ["broken_step", "u"], "times": "last"},
    }
    found = pbdkit.sweep(GIVEN, **asked, folder=tmp_path, workers=1, progress=False)
    several = set()
    for n, scatter in enumerate((0.1, 0.3)):
        for k, seed in enumerate(replicate_seeds(7, 2)):
            failure = ASKED | {"scatter": scatter}
            alone = run(seed=seed, fracture={"type": "strain", "failure": failure})
            member = found.isel(scatter=n, replicate=k)
            assert np.array_equal(member.broken_step, alone.broken_step)
            assert np.array_equal(member.u[-1], alone.u[-1], equal_nan=True)
            several.add(alone.u.values[-1].tobytes())
    assert len(several) == 4
    found.close()
    before = rows(tmp_path)
    pbdkit.sweep(GIVEN, **asked, folder=tmp_path, workers=1, progress=False).close()
    assert rows(tmp_path) == before


def rows(folder):
    """The members that a sweep holds, in the order in which they were put."""
    with contextlib.closing(sqlite3.connect(folder / "sweep.sqlite")) as database:
        return database.execute("SELECT rowid, key FROM member").fetchall()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mean": 0.0}, "fracture.failure.mean: should be greater than 0, got 0.0"),
        ({"mean": "5 mm"}, "fracture.failure.mean: .5 mm. is not a stress"),
        ({"scatter": -0.1}, "fracture.failure.scatter: should be greater than 0, got -0.1"),
        ({"scatter": 20}, "fracture.failure.scatter: should be less than 1, got 20"),
        ({"correlation_length": 0}, "fracture.failure.correlation_length: should be greater than"),
        (
            {"correlation_length": "5 mm"},
            "correlation_length: '5 mm' has a unit, but the lattice unit",
        ),
        ({"scater": 0.1}, "fracture.failure.scater: unknown key; did you mean 'scatter'"),
        ({"drawn": 1}, "fracture.failure.drawn: should be a map of keys, got 1"),
        ({"drawn": ASKED | {"seed": 0, "x": [0], "y": [0], "values": "?"}}, "drawn: .* base 64"),
    ],
)
def test_errors_are_reported_with_their_place(change, text):
    with pytest.raises(pbdkit.ExperimentError, match="^" + text if "fra" in text[:3] else text):
        pbdkit.Experiment(**GIVEN | {"fracture": {"type": "strain", "failure": ASKED | change}})


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"fracture": {"type": "strain", "failure": {"mean": 0.1, "scatter": 0.1}}},
         r"^fracture\.failure\.correlation_length: is missing"),
        ({"rule": {"type": "elastic", "poisson_ratio": ASKED | {"mean": 0.4}}},
         r"^rule\.poisson_ratio: the largest value: should be less than or equal to 0\.5"),
        ({"fracture": {"type": "strain", "failure": ASKED, "scatter": 0.1}},
         r"^fracture\.failure: 'strain' draws a random number for each bond"),
        ({"body": {"type": "grid", "columns": 1100, "rows": 1000}},
         r"^fracture\.failure: 4395801 values exceed 4194304, the maximum .*file"),
        ({"body": {"type": "grid", "columns": 10**9, "rows": 10**9}},
         r"^fracture\.failure: 4e\+18 values exceed 16777216; use a smaller body"),
    ],
)  # fmt: skip
def test_invalid_values_are_refused(parts, text):
    with pytest.raises(pbdkit.ExperimentError, match=text):
        build_scene(pbdkit.Experiment(**GIVEN | parts))


def test_correlation_length_may_have_a_unit():
    failure = ASKED | {"correlation_length": "0.5 mm"}
    fracture = {"type": "strain", "failure": failure}
    assert drawn(units={"length": "0.25 mm"}, fracture=fracture) == drawn()


def test_schema_describes_specification_and_sampled_values():
    schema = Draft202012Validator(experiment_schema(Registry(), installed=False))
    schema.validate(GIVEN)
    schema.validate(pbdkit.Experiment(**GIVEN).model_dump(mode="json"))
    for wrong in ({"scatter": 1.0}, {"correlation_length": "mm"}, {"seed": 1}):
        fracture = {"type": "strain", "failure": ASKED | wrong}
        assert not schema.is_valid(GIVEN | {"fracture": fracture})


def test_gstools_is_imported_only_if_a_field_is_sampled():
    look = "pbdkit.load('modelling/{}'); print('gstools' in sys.modules)"
    looks = [look.format(name) for name in ("graded-bar", "weakest-place")]
    command = [sys.executable, "-c", "\n".join(["import sys, pbdkit", *looks])]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.stdout.split() == ["False", "True"]


def test_strip_breaks_at_its_weakest_place():
    """Its column of least strength lies in the crack, which crosses it from side to side."""
    experiment = pbdkit.load("modelling/weakest-place")
    ds = pbdkit.run(experiment, progress=False)
    columns, rows = experiment.body.columns, experiment.body.rows
    x, y = np.meshgrid(np.arange(columns - 1) + 0.5, np.arange(rows), indexing="ij")
    strength = experiment.fracture.varying["failure"].at(x, y, {})
    weakest = strength.mean(axis=1).argmin() + 0.5
    path = ds.crack_midpoint.values
    assert path[:, 0].min() < weakest < path[:, 0].max()
    assert path[:, 0].max() - path[:, 0].min() < columns / 4
    assert np.array_equal(np.unique(path[:, 1].round()), np.arange(rows))
    assert abs(ds.reaction.values[-1]).max() < 1e-9
