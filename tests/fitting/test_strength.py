"""Strengths are recovered from repeats; results agree with closed forms of weakest links."""

from __future__ import annotations

import json
import runpy
import sys
from math import gamma
from pathlib import Path

import numpy as np
import pytest
import xarray
from scipy.stats import weibull_min

import pbdkit
from pbdkit.fitting import strength as strength_simulation
from pbdkit.fitting.fit_file import Peaks, is_strength_fit
from pbdkit.fitting.strength import (
    LAWS,
    BondStrains,
    Breaks,
    ElasticResponse,
    Specimens,
    bond_strains,
    seeded,
    strengths,
    weibull_sums,
)
from pbdkit.lattice.raster import FRAME
from pbdkit.model.reading import Source
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

ROOT = Path(__file__).parents[2]
Weibull = runpy.run_path(str(ROOT / "plugins/pbdkit-weibull/pbdkit_weibull.py"))["Weibull"]
ANY = Peaks(peaks=(1.0, 1.0, 1.0), of="displacement")
WEIBULL = {"fracture.scale": [0.002, 0.5], "fracture.modulus": [1.0, 60.0]}
UNIFORM = {"fracture.failure": [0.002, 0.5], "fracture.scatter": [0.02, 0.98]}


def chain(bonds, **more):
    """Bonds in series, drawn out evenly by 1 % at full load."""
    return {
        "name": "chain",
        "lattice": {"type": "rectangular", "a": 1.0, "b": 2.0},
        "body": {"type": "grid", "columns": bonds + 1, "rows": 1},
        "rule": {"type": "barycentre"},
        "frame": {"type": "none"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "displace", "displacement": [0.01 * bonds, 0.0]},
            },
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "increments": 20},
    } | more


def sheet(fracture, columns=5, rows=3, far=0.2):
    """Springs under tension, clamped at both ends."""
    return chain(columns - 1) | {
        "lattice": {"type": "square", "a": 1.0},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": {"type": "elastic", "poisson_ratio": 1 / 3},
        "frame": {"type": "natural"},
        "fracture": fracture,
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [far, 0]}},
        ],
        "solver": {"type": "equilibrium", "increments": 20, "tolerance": 1e-6},
    }


STRAIN = {"type": "strain", "failure": 0.02, "scatter": 0.3}
WHOLE = {"type": "strain", "failure": 1e60}


def even(bonds):
    """Return bonds that all have the same strain, along the load."""
    return BondStrains(np.array([0.01]), np.array([1e-4]), np.array([float(bonds)]))


def drawn(bonds, count, seed, scale=0.02, modulus=8.0):
    """Strengths of as many chains: the weakest of their bonds."""
    return scale * np.random.default_rng(seed).weibull(modulus, (count, bonds)).min(axis=1)


def fit_of(peaks, *, bonds=16, unknown=WEIBULL, **more):
    measured = {"peaks": list(peaks), "of": "displacement", **more.pop("measured", {})}
    return {
        "kind": "strength", "experiment": chain(bonds), "law": "weibull", "unknown": unknown,
        "measured": measured,
    } | more  # fmt: skip


def test_likelihood_of_a_uniform_bar_is_weibull():
    """The reference is ln of the density of the weakest of n bonds, with the scale s n^(-1/m)."""
    loads, m, s = np.array([0.8, 1.1, 1.7]), np.array([3.0, 9.0]), 0.02
    sums, slopes = weibull_sums(even(50), Breaks(loads, np.ones(3, bool)), m)
    for n, each in enumerate(m):
        density = slopes[n] - each * np.log(s) - np.exp(sums[n] - each * np.log(s))
        own = weibull_min(each, scale=s * 50 ** (-1 / each) / 0.01)
        np.testing.assert_allclose(density, own.logpdf(loads), rtol=1e-12, atol=1e-12)


def test_identical_bonds_are_counted_with_multiplicity():
    experiment = pbdkit.Experiment(**chain(16))
    strains = ElasticResponse.of(experiment, ANY).strains
    merged = strains.merged()
    assert len(strains.p) == 16
    assert merged.count.tolist() == [16.0]
    assert merged.at(np.array([1.0, 2.0])).ravel() == pytest.approx([0.01, 0.02], rel=1e-6)
    assert merged.load_at(np.array([0.03])) == pytest.approx([3.0], rel=1e-6)


def test_strains_of_rotating_bonds_are_exact():
    p, q = 0.2, 0.5
    strains, load = BondStrains(np.array([p]), np.array([q]), np.ones(1)), np.array([0.7])
    d = np.array([p, np.sqrt(q - p * p)])
    assert strains.at(load)[0, 0] == pytest.approx(np.hypot(*([1.0, 0.0] + 0.7 * d)) - 1.0)
    slope = (strains.at(load + 1e-6) - strains.at(load - 1e-6)) / 2e-6
    assert strains.rate(load) == pytest.approx(slope, rel=1e-8)
    assert strains.load_at(strains.at(load)[0]) == pytest.approx(load)


@pytest.mark.parametrize("law", ["weibull", "uniform"])
def test_strengths_are_recovered(law):
    """Within 4.5 standard errors, of 200 chains; the long trial counts how often intervals
    hold."""
    numbers = np.random.default_rng(2)
    true = {"weibull": (0.02, 8.0), "uniform": (0.02, 0.3)}[law]
    loads = drawn(16, 200, 2)
    if law == "uniform":
        loads = 0.02 * (1 + 0.3 * numbers.uniform(-1, 1, (200, 16))).min(axis=1)
    unknown = {"weibull": WEIBULL, "uniform": UNIFORM}[law]
    found = pbdkit.fit_strength(fit_of(16 * loads, law=law, unknown=unknown))
    for estimate, value in zip(found.values.values(), true, strict=True):
        assert abs(estimate.value - value) < 4.5 * estimate.error
        assert estimate.low < estimate.value < estimate.high
        assert estimate.error < 0.2 * value
    assert np.allclose(np.diag(found.correlations), 1.0)


def test_error_of_large_samples_matches_fisher_information():
    """ln m of n specimens has the error √(6/n)/π; intervals are 3.92 of them wide."""
    found = pbdkit.fit_strength(fit_of(16 * drawn(16, 2000, 5)))
    modulus = found.values["fracture.modulus"]
    expected = np.sqrt(6 / 2000) / np.pi
    assert modulus.error / modulus.value == pytest.approx(expected, rel=0.05)
    assert (modulus.high - modulus.low) / modulus.value == pytest.approx(3.92 * expected, rel=0.05)


def test_modulus_is_independent_of_size_and_scale_follows_theory():
    """Chains of 10 and of 1000 bonds with the same peaks: s grows by 100^(1/m), draw by draw."""
    loads = drawn(10, 40, 3)
    small, large = (
        LAWS["weibull"].draws(even(n), Breaks(loads / 0.01, np.ones(40, bool)),
                              ((1e-4, 10.0), (1.0, 60.0)))
        for n in (10, 1000)
    )  # fmt: skip
    (s, m), (s_large, m_large) = small.values.T, large.values.T
    np.testing.assert_allclose(m, m_large, rtol=1e-6)
    np.testing.assert_allclose(s_large / s, 100 ** (1 / m), rtol=1e-5)


def test_mean_strength_of_specimens_scales_as_the_root_of_size():
    """s Γ(1 + 1/m) n^(-1/m), at the strengths that were found."""
    found = pbdkit.fit_strength(fit_of(16 * drawn(16, 400, 7)))
    s, m = (each.value for each in found.values.values())
    for bonds in (4, 64, 256):
        mean = drawn(bonds, 4000, 9).mean()
        assert s * gamma(1 + 1 / m) * bonds ** (-1 / m) == pytest.approx(mean, rel=0.04)


def test_censored_specimens_count():
    """Tests that end at 0.8 of the scale of chains: counted as breaks they would overestimate the
    modulus, left out they would underestimate the strength."""
    strength = drawn(16, 300, 4)
    end = 0.8 * 0.02 * 16 ** (-1 / 8)
    seen = np.minimum(strength, end)
    broke = (strength <= end).astype(int)
    assert 30 < broke.sum() < 90
    found = pbdkit.fit_strength(fit_of(16 * seen, measured={"broke": broke.tolist()}))
    for estimate, value in zip(found.values.values(), (0.02, 8.0), strict=True):
        assert abs(estimate.value - value) < 4.5 * estimate.error
    assert f"from 300 specimens, {300 - broke.sum()} of which did not break" in str(found)
    wrong = pbdkit.fit_strength(fit_of(16 * seen)).values["fracture.modulus"]
    assert wrong.value - 8.0 > 4.5 * found.values["fracture.modulus"].error


def test_the_first_break_of_a_run_is_where_it_is_computed():
    """Against the bonds that the equilibrium solver breaks in fine increments."""
    experiment = pbdkit.Experiment(**sheet(STRAIN), seed=4)
    elastic = ElasticResponse.of(pbdkit.Experiment(**sheet(WHOLE)), ANY)
    scene = build_scene(experiment)
    limits = strengths(scene, initial_state(scene))
    load = elastic.strains.load_at(limits).min()
    for factor, some in ((0.999, False), (1.001, True)):
        solver = {"type": "equilibrium", "increments": 2}
        less = sheet(STRAIN, far=0.2 * load * factor) | {"seed": 4, "solver": solver}
        ds = pbdkit.run(less, progress=False)
        assert (ds.broken_step > 0).any() == some


def test_broken_specimen_carries_the_load_of_the_run():
    """In the increments after its first break, run by run with one more of them: the peak force is
    the largest of these, or up to an increment above."""
    elastic = ElasticResponse.of(pbdkit.Experiment(**sheet(WHOLE)), ANY)
    specimens = Specimens.of(pbdkit.Experiment(**sheet(STRAIN)), ANY, elastic)
    reaction = {"type": "reaction", "youngs_modulus": 1.0, "thickness": 1.0}
    for seed in (1,):
        found = specimens.tear(seeded(specimens.scene.experiment, seed))
        forces = []
        for n in range(int(found.first.displacement / 0.01) + 1, 13):
            solver = {"type": "equilibrium", "increments": n, "tolerance": 1e-6}
            more = {"seed": seed, "diagnostics": [reaction], "solver": solver}
            ds = pbdkit.run(sheet(STRAIN, far=0.01 * n) | more, progress=False)
            forces.append(ds.reaction.isel(time=-1, leader_group=1, axis=0).item())
        assert max(forces) <= found.peak.force * (1 + 1e-6)
        largest = max(*forces, found.first.force)
        assert found.peak.force <= largest + elastic.full.force / 20
        assert found.failed


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_peak_is_known_to_an_increment_without_strains_of_bonds(seed):
    """The strains of bonds before the first break give the peak between increments."""
    experiment = pbdkit.Experiment(**sheet(STRAIN))
    elastic = ElasticResponse.of(pbdkit.Experiment(**sheet(WHOLE)), ANY)
    peaks = []
    for known in (elastic, None):
        specimens = Specimens.of(experiment, ANY, known)
        peaks.append(specimens.tear(seeded(experiment, seed)).peak)
    exact, found = peaks
    assert exact.force - elastic.full.force / 20 < found.force <= exact.force * (1 + 1e-6)


def test_broken_and_unbreakable_bonds_are_excluded():
    cracked = sheet(WHOLE | {"cracks": [[[1.5, -1.0], [1.5, 0.5]]]})
    scene = build_scene(pbdkit.Experiment(**cracked))
    state = initial_state(scene)
    state.u[...] = np.random.default_rng(0).normal(size=state.u.shape)
    strains = bond_strains(scene, state)
    broken = state.broken_step.reshape(len(state.broken_step), -1)
    gone = broken[scene.bonds.plane, scene.bonds.place] >= 0
    assert gone.any()
    assert (strains.q[gone] == 0.0).all()
    assert (strains.q[~gone] > 0.0).all()
    assert np.isinf(strains.load_at(np.full(len(gone), 0.1))[gone]).all()


@pytest.mark.parametrize("breaks", [False, True])
def test_breakable_frame_bonds_count(breaks):
    """In a body that is drawn out with its frame all bonds are strained; those to the frame are
    spared by `frame_bonds: false`, and so they are none of the links that may fail."""
    framed = sheet(WHOLE | {"frame_bonds": breaks}) | {
        "rule": {"type": "barycentre"}, "frame": {"type": "mean"},
    }  # fmt: skip
    scene = build_scene(pbdkit.Experiment(**framed))
    state = initial_state(scene)
    rows = np.arange(scene.raster.count)
    u = 0.01 * scene.raster.reference(rows).T
    state.u.reshape(2, -1)[:, scene.raster.place_of(rows)] = u
    strains = bond_strains(scene, state)
    framed = (scene.raster.table_kind[scene.bonds.ends] == FRAME).any(axis=1)
    assert framed.any()
    assert strains.p[~framed] == pytest.approx(0.01)
    assert strains.p[framed] == pytest.approx(0.01 if breaks else 0.0)
    assert strains.merged().count.sum() == (len(framed) if breaks else (~framed).sum())


def test_warning_if_the_first_break_is_not_the_failure():
    specimens = 0.03 * np.random.default_rng(1).weibull(8.0, 30)
    fit = {
        "kind": "strength", "experiment": sheet(STRAIN), "unknown": UNIFORM,
        "measured": {"peaks": specimens.tolist(), "of": "force"}, "method": "likelihood",
        "check": 4,
    }  # fmt: skip
    found = pbdkit.fit(fit)
    assert not found.checked.holds
    assert "the first break is not the failure" in str(found)
    assert found.as_dict()["first_break_is_failure"] is False


def test_simulation_recovers_closed_form_strengths_of_chains(monkeypatch):
    """The estimates are within 4.5 of their errors, which are larger than those of the likelihood:
    mean and spread of ln peak do not contain all information."""
    peaks = 16 * drawn(16, 60, 8)
    by_likelihood = pbdkit.fit_strength(fit_of(peaks))
    model = [Weibull]
    made = chain(16, fracture={"type": "weibull", "scale": 0.02, "modulus": 8.0})

    def torn(self, experiment):
        strength = drawn(16, 1, experiment.seed, experiment.fracture.scale,
                         experiment.fracture.modulus)  # fmt: skip

        class Seen:
            def peak_of(self, of):
                return 16 * strength[0]

        return Seen()

    monkeypatch.setattr(Specimens, "tear", torn)
    monkeypatch.setattr("pbdkit.fitting.strength.has_forces", lambda scene: True)
    nothing = np.full((2, 2), np.nan)
    monkeypatch.setattr("pbdkit.fitting.strength.reactions", lambda moment: nothing)
    monkeypatch.setattr(strength_simulation, "MIN_LOAD_RATIO", 0.0)
    narrow = {"fracture.scale": [0.01, 0.05], "fracture.modulus": [3.0, 20.0]}
    fit = fit_of(peaks, experiment=made, unknown=narrow, method="simulation", simulations=2000)
    found = pbdkit.fit_strength(fit, components=model)
    for (path, one), true in zip(by_likelihood.values.items(), (0.02, 8.0), strict=True):
        other = found.values[path]
        assert abs(other.value - true) < 4.5 * other.error
        assert 0.8 * one.error < other.error < 2.0 * one.error


def test_a_spread_of_weibull_is_the_coefficient_of_variation():
    for m in (1.0, 2.0, 10.0):
        own = weibull_min(m)
        assert LAWS["weibull"].variation(1.0, np.array(m)) == pytest.approx(own.std() / own.mean())
    assert LAWS["uniform"].variation(1.0, np.array(0.3)) == pytest.approx(0.3 / 3**0.5)


def test_curves_and_peaks_give_the_same_result(tmp_path):
    peaks = 16 * drawn(16, 12, 6)
    lines = ["specimen,u,f"]
    for n, peak in enumerate(peaks):
        lines += [f"{n},{share * peak:.17g},{min(share, 1.9 - share)}" for share in (0.5, 1.0, 1.2)]
    (tmp_path / "curves.csv").write_text("\n".join(lines))
    given = {"file": str(tmp_path / "curves.csv"), "curve": ["specimen", "u", "f"],
             "of": "displacement"}  # fmt: skip
    whole, alone = (
        pbdkit.fit_strength(fit_of(peaks) | {"measured": measured})
        for measured in (given, fit_of(peaks)["measured"])
    )
    assert whole.as_dict() == alone.as_dict()


def test_shipped_fit_recovers_its_parameters(call, tmp_path):
    result = call("fit", "fibres", "-o", str(tmp_path / "fibres.json"))
    assert result.code == 0, result.err
    found = json.loads((tmp_path / "fibres.json").read_text())
    for path, true in (("fracture.scale", 0.02), ("fracture.modulus", 8.0)):
        assert found["values"][path]["low"] < true < found["values"][path]["high"]
    assert (found["specimens"], found["broke"]) == (32, 30)
    assert "2 of which did not break" in result.out
    refused = call("fit", "fibres", "-o", str(tmp_path / "f.json"), "--plot", "f.png")
    assert "has no picture" in refused.err


def test_kinds_of_fits_are_distinguished():
    assert is_strength_fit("fibres")
    assert is_strength_fit({"kind": "strength"})
    assert not is_strength_fit("plate-with-hole")
    assert not is_strength_fit("nowhere")
    with pytest.raises(pbdkit.ExperimentError, match="a strength fit uses peak loads"):
        pbdkit.fit("fibres", measured=xarray.Dataset())


def test_a_sample_of_the_long_trial(monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "tests/reliability")
    import strength_coverage

    asked = ["strength_coverage", "drawn", "--law", "weibull", "--trials", "20"]
    monkeypatch.setattr(sys, "argv", asked)
    with pytest.raises(SystemExit) as end:
        strength_coverage.main()
    printed = capsys.readouterr().out
    assert end.value.code == 0, printed
    assert printed.count(" | ") == 13


WRONG = {
    "no peaks": ({"measured": {"peaks": [], "of": "force"}}, "either a file or a list of peaks"),
    "too few": ({"measured": {"peaks": [1.0, 2.0], "of": "force"}}, "at least 3"),
    "below 0": ({"measured": {"peaks": [1.0, 2.0, -1.0], "of": "force"}}, "specimen 3 is -1"),
    "numbers of breaks": (
        {"measured": {"peaks": [1.0, 2.0, 3.0], "broke": [1, 1], "of": "force"}},
        "expected one number for each of 3 peaks, got 2",
    ),
    "no such file": ({"measured": {"file": "no.csv", "of": "force"}}, r"\.csv: does not exist"),
    "no quantity": ({"measured": {"peaks": [1.0, 2.0, 3.0]}}, "of"),
    "bounds at 0": ({"unknown": {"fracture.scale": [0.0, 1.0]}}, "above 0, got 0"),
    "one parameter": (
        {"unknown": {"fracture.scale": [0.01, 1.0]}}, "both fracture.scale and fracture.modulus",
    ),
    "no law": ({"law": None}, "give law: weibull or uniform"),
    "another law": ({"experiment": sheet(STRAIN)}, "are distributed as uniform, not as weibull"),
    "bounds elsewhere": (
        {"law": "uniform", "unknown": {"fracture.failure": [1.0, 2.0],
                                       "fracture.scatter": [0.1, 0.2]}},
        "no strengths between the bounds",
    ),
    "no such group": (
        {"measured": {"peaks": [0.1, 0.2, 0.3], "of": "displacement", "group": 5}},
        "no leader group 5",
    ),
    "a group that holds": (
        {"measured": {"peaks": [0.1, 0.2, 0.3], "of": "displacement", "group": 0}},
        "group 0 does not move",
    ),
    "no forces": (
        {"measured": {"peaks": [0.1, 0.2, 0.3], "of": "force"}}, "'barycentre' defines no forces",
    ),
    "a rule that is not linear": (
        {"experiment": sheet(STRAIN) | {"rule": {"type": "springs"}}, "law": None,
         "unknown": UNIFORM}, "use method: simulation",
    ),
    "nothing moves": (
        {"experiment": chain(4) | {"leaders": [{"select": {"edge": "left"},
                                                "motion": {"type": "hold"}}]}},
        "group 0 does not move",
    ),
    "short load": (
        {"experiment": sheet(STRAIN, far=0.001), "law": None, "unknown": UNIFORM,
         "method": "simulation"},
        "by a factor of at least",
    ),
    "censored simulation": (
        {"experiment": sheet(STRAIN), "law": None, "unknown": UNIFORM, "method": "simulation",
         "measured": {"peaks": [0.1, 0.2, 0.3, 0.4], "broke": [1, 1, 1, 0], "of": "force"}},
        "cannot be simulated",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_named(name):
    changed, told = WRONG[name]
    fit = fit_of(16 * drawn(16, 10, 1)) | changed
    with pytest.raises(pbdkit.ExperimentError, match=told):
        pbdkit.fit_strength({key: value for key, value in fit.items() if value is not None})


def test_truncating_bounds_are_named():
    narrow = WEIBULL | {"fracture.modulus": [9.5, 60.0]}
    found = pbdkit.fit_strength(fit_of(16 * drawn(16, 40, 1), unknown=narrow))
    assert found.values["fracture.modulus"].cut
    assert not found.values["fracture.scale"].cut
    assert "truncated by its bounds" in str(found.values["fracture.modulus"])


def test_experiment_may_be_passed_separately():
    fit = fit_of(16 * drawn(16, 10, 1))
    del fit["experiment"]
    experiment = pbdkit.Experiment.build(Source("x", chain(16)))
    found = pbdkit.fit_strength(fit, experiment=experiment)
    assert found.specimens == 10
    assert found.checked is None
