"""Parameters come back from what was measured while an experiment ran: tracks, curves of force."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest

import pbdkit
from pbdkit.fitting.fit import problem_of
from pbdkit.fitting.fit_file import Fit, read_fit
from pbdkit.fitting.observations import TracksObservation
from pbdkit.plotting.fit_figures import draw_fit
from pbdkit.simulation import Simulation

WIDTH, HEIGHT, STEPS = 8.0, 4.0, 16
MODULUS, THICKNESS, NOISE = 1000.0, 2.0, 1e-4


def bar(**more):
    return {
        "name": "bar",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": WIDTH, "height": HEIGHT},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.02, 0.01], "steps": 10},
            },
        ],
        "steps": STEPS,
        "solver": {"type": "stepping", "relaxation": 0.8, "engine": "numpy"},
    } | more


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The files of what a run shows."""
    folder, generator = tmp_path_factory.mktemp("measured"), np.random.default_rng(5)
    asked = {"type": "reaction", "youngs_modulus": MODULUS, "thickness": THICKNESS}
    ds = pbdkit.run(bar(diagnostics=[asked]), progress=False)
    position, x = ds.position.values, ds.position.values[0, :, 0]
    inner = np.flatnonzero((x > 0.0) & (x < WIDTH))
    rows = []
    for time in (2, 5, 9.25, 15):
        low, part = int(time), time % 1
        now = (1 - part) * position[low] + part * position[min(low + 1, STEPS)]
        u = now - position[0] + NOISE * generator.normal(size=now.shape)
        rows += [[time, *position[0, k], *u[k]] for k in inner]
    write(folder / "tracks.csv", ["time", "x", "y", "ux", "uy"], rows)
    force = ds.reaction.sel(leader_group=1, axis="x").values
    force = force + 0.01 * generator.normal(size=force.shape)
    gone = (position - position[0])[:, x == WIDTH, 0].mean(axis=1)
    write(folder / "curve.csv", ["displacement", "force"], np.c_[gone, force][1:10])
    write(folder / "force.csv", ["time", "force"], np.c_[ds.time.values, force])
    return folder


def write(path, header, rows):
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(header)
        lines.writerows(np.asarray(rows).tolist())


def tracks(folder, **more):
    return {"type": "tracks", "file": str(folder / "tracks.csv"), "noise": NOISE} | more


def curve(folder, **more):
    given = {"file": str(folder / "curve.csv"), "noise": 0.01, "thickness": THICKNESS}
    return {"type": "curve", "group": 1} | given | more


TOLD = {"rule.poisson_ratio": [0.0, 0.45], "solver.relaxation": [0.3, 0.95]}
TRUE = {"rule.poisson_ratio": 0.3, "solver.relaxation": 0.8}


def within(found, *, of=TRUE):
    """Within four of their standard errors, which are small."""
    for path, estimate in found.values.items():
        assert estimate.identifiable
        assert estimate.error < 0.01
        assert estimate.value == pytest.approx(of[path], abs=4 * estimate.error)


def test_tracks_in_time_identify_material_and_relaxation(measured):
    found = pbdkit.fit({"experiment": bar(), "unknown": TOLD, "measured": tracks(measured)})
    within(found)
    assert found.ratio == pytest.approx(1.0, abs=0.2)
    assert found.misfits[0].left_out == 0


@pytest.mark.parametrize("against", ["displacement", "time"])
def test_force_curve_also_identifies_youngs_modulus(measured, against):
    given = curve(measured)
    if against == "time":
        given |= {"file": str(measured / "force.csv"), "against": "time"}
        given |= {"columns": ["time", "force"]}
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    found = pbdkit.fit({"experiment": bar(), "unknown": unknown, "measured": given})
    within(found)
    modulus = found.youngs_modulus
    assert modulus.value == pytest.approx(MODULUS, abs=4 * modulus.error)
    assert modulus.error < 1.0
    known = pbdkit.fit(
        {"experiment": bar(), "unknown": unknown, "measured": given | {"youngs_modulus": MODULUS}}
    )
    within(known)
    assert known.youngs_modulus is None
    error = {id(f): f.values["rule.poisson_ratio"].error for f in (found, known)}
    assert error[id(known)] <= error[id(found)]


def test_with_units_forces_are_in_newtons_and_moduli_in_mpa(measured, tmp_path):
    rows = np.loadtxt(measured / "curve.csv", delimiter=",", skiprows=1)
    write(tmp_path / "newtons.csv", ["displacement", "force"], rows * [1.0, 2.0])
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    given = curve(measured) | {"file": str(tmp_path / "newtons.csv")}
    given |= {"noise": 2.0 * given["noise"]} if "noise" in given else {}
    found = pbdkit.fit(
        {
            "experiment": bar(units={"length": "2 mm"}),
            "unknown": unknown,
            "measured": given,
        }
    )
    modulus = found.youngs_modulus
    assert modulus.value == pytest.approx(MODULUS, abs=4 * modulus.error)
    assert re.search(r"^Young's modulus: [\d.]+ ± [\d.]+ MPa$", str(found), re.M)
    assert modulus.as_dict()["unit"] == "MPa"
    assert " N, over " in str(found.misfits[0])
    axes = draw_fit(found).subfigs[0].axes
    assert axes[0].get_title() == "force on group 1 (N)"
    assert axes[0].get_xlabel() == "displacement of group 1 (mm)"
    seen = axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(seen, rows * 2.0)


def test_two_measurements_reduce_the_error(measured):
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    both = [tracks(measured), curve(measured, youngs_modulus=MODULUS)]
    found = [
        pbdkit.fit({"experiment": bar(), "unknown": unknown, "measured": given})
        for given in (*both, both)
    ]
    one, other, together = (f.solution.covariance[0, 0] / max(1, f.ratio) ** 2 for f in found)
    assert 1 / together == pytest.approx(1 / one + 1 / other, rel=0.02)
    assert [met.kind for met in found[2].misfits] == ["tracks", "curve"]


def test_weight_is_equivalent_to_smaller_noise(measured):
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    weighted, finer = (
        pbdkit.fit(
            {
                "experiment": bar(),
                "unknown": unknown,
                "measured": [tracks(measured, **first), curve(measured)],
            }
        )
        for first in ({"weight": 4.0}, {"noise": NOISE / 2})
    )
    one, other = (f.values["rule.poisson_ratio"] for f in (weighted, finer))
    assert one.value == pytest.approx(other.value, rel=1e-12)


@pytest.mark.parametrize("noise", [{}, {"noise": NOISE}])
def test_normalised_residuals_are_independent_of_the_weight(noise, measured):
    """Birge's ratio takes back what a weight above 1 promises; one below 1 makes errors larger."""
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    given = {k: v for k, v in tracks(measured).items() if k != "noise"} | noise
    found = {
        weight: pbdkit.fit(
            {"experiment": bar(), "unknown": unknown, "measured": given | {"weight": weight}}
        )
        for weight in (1.0, 0.25, 4.0)
    }
    whole = found.pop(1.0)
    assert whole.misfits[0].noise == pytest.approx(NOISE, rel=0.1)
    for weight, each in found.items():
        assert each.misfits[0].noise == pytest.approx(whole.misfits[0].noise, rel=1e-6)
        assert each.misfits[0].ratio == pytest.approx(whole.misfits[0].ratio, rel=1e-6)
        assert each.ratio == pytest.approx(whole.ratio, rel=1e-6)
        own = np.sqrt(np.mean(each.numbers().residual ** 2))
        assert each.misfits[0].ratio * each.misfits[0].noise == pytest.approx(own, rel=1e-6)
        errors = [f.values["rule.poisson_ratio"].error for f in (each, whole)]
        assert errors[0] / errors[1] == pytest.approx(max(1.0, weight**-0.5), rel=0.1)


def test_excluded_normalised_residuals_are_independent_of_the_weight(measured):
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    rival = {"settings": {"rule": {"type": "springs"}}, "unknown": {"rule.stiffness": [0.5, 2.0]}}
    one, other = (
        pbdkit.fit({
            "experiment": bar(), "unknown": unknown, "folds": 2, "candidates": {"springs": rival},
            "measured": tracks(measured, weight=weight),
        }).candidates
        for weight in (1.0, 4.0)
    )  # fmt: skip
    for a, b in zip(one, other, strict=True):
        assert (a.name, b.left_out) == (b.name, pytest.approx(a.left_out, rel=1e-4))
        assert b.differs == pytest.approx(a.differs, rel=1e-3, abs=1e-6)


def small(**more):
    """A bar that converges soon, and the solver that finds its equilibrium."""
    body = {"type": "rectangle", "width": 4.0, "height": 2.0}
    return bar(body=body, steps=160, **more)


SETTLING = {"type": "stepping", "relaxation": 0.8, "engine": "numpy", "settle": {"tolerance": 1e-5}}


def posed(experiment, given):
    fit = {"experiment": experiment, "unknown": {"rule.poisson_ratio": [0.0, 0.45]}}
    asked, source = read_fit(Fit, fit | {"measured": given})
    return problem_of(asked, pbdkit.Experiment.build(source))


@pytest.mark.parametrize("kind", ["tracks", "curve"])
def test_converged_run_stays_at_rest(kind, tmp_path):
    """At its last steps, and at steps between; derivatives as well."""
    times = [3.0, 12.5, 100.0, 121.25, 160.0]
    at = [[1.0, 1.0], [2.0, 0.5], [3.0, 2.0]]
    if kind == "tracks":
        rows = [[time, *place, 0.0, 0.0] for time in times for place in at]
        write(tmp_path / "rows.csv", ["time", "x", "y", "ux", "uy"], rows)
        given = {"type": "tracks"}
    else:
        write(tmp_path / "rows.csv", ["time", "force"], [[time, 0.0] for time in times])
        given = {"type": "curve", "group": 1, "youngs_modulus": 1.0, "against": "time"}
        given |= {"columns": ["time", "force"]}
    given |= {"file": str(tmp_path / "rows.csv"), "noise": 1.0}
    every = {"record": {"every": 10}}  # that of a curve
    stays, goes_on = (posed(small(**more, **every), given) for more in ({"solver": SETTLING}, {}))
    z = stays.start()
    short, whole = stays.at(z), goes_on.at(z)
    assert pbdkit.run(small(solver=SETTLING), progress=False).attrs["status"] == "settled"
    largest = np.abs(whole.residuals).max()
    np.testing.assert_allclose(short.residuals, whole.residuals, atol=3e-5 * largest)
    largest = np.abs(whole.jacobian).max()
    np.testing.assert_allclose(short.jacobian, whole.jacobian, atol=1e-3 * largest)


def on_rollers(**more):
    """A bar that is drawn out by .1 % a step, at rest."""
    held = {"type": "hold"}
    drawn = {"type": "velocity", "velocity": [0.001 * WIDTH, 0.0], "steps": 10}
    leaders = [
        {"select": {"edge": "left"}, "motion": held, "axes": ["x"]},
        {"select": {"edge": "right"}, "motion": drawn, "axes": ["x"]},
        {"select": {"nearest": [[0.0, HEIGHT / 2]]}, "motion": held, "axes": ["y"]},
    ]
    return bar(leaders=leaders, steps=10, solver={"type": "equilibrium"}) | more


@pytest.mark.parametrize("times", [[10.0], [0.0, 10.0], [5.0, 7.5, 10.0]])
def test_each_step_required_by_tracks_is_an_equilibrium(times, tmp_path):
    """The reference is the closed form with ν = .25."""
    places = np.array([[3.0, 0.0], [3.0, HEIGHT], [6.5, 0.5]])
    u = np.c_[places[:, 0], -0.25 * (places[:, 1] - HEIGHT / 2)]
    pairs = list(zip(places, u, strict=True))
    rows = [[time, *at, *(0.001 * time * v)] for time in times for at, v in pairs]
    write(tmp_path / "tracks.csv", ["time", "x", "y", "ux", "uy"], rows)
    fit = {
        "experiment": on_rollers(),
        "unknown": {"rule.poisson_ratio": [0.0, 0.49]},
        "measured": {"type": "tracks", "file": str(tmp_path / "tracks.csv"), "noise": 1e-5},
    }
    found = pbdkit.fit(fit)
    assert found.values["rule.poisson_ratio"].value == pytest.approx(0.25, abs=1e-5)
    assert found.ratio < 0.01


def test_missing_state_is_not_read_as_zero_displacement(tmp_path, monkeypatch):
    write(tmp_path / "rows.csv", ["time", "x", "y", "ux", "uy"], [[7.5, 1.0, 1.0, 0.0, 0.0]])
    problem = posed(bar(), {"type": "tracks", "file": str(tmp_path / "rows.csv"), "noise": 1.0})
    every = TracksObservation._recorded
    monkeypatch.setattr(
        TracksObservation,
        "_recorded",
        lambda self, run: (each for each in every(self, run) if each[0] != 8),
    )
    with pytest.raises(pbdkit.ExperimentError, match=r"has no state at time 7\.5"):
        problem.at(problem.start())


def test_curves_contain_equilibria_within_steps(tmp_path):
    """Bonds may break, so that the load is applied in increments."""
    write(tmp_path / "rows.csv", ["displacement", "force"], [[0.02, 0.0], [0.05, 0.0]])
    given = {"type": "curve", "file": str(tmp_path / "rows.csv"), "group": 1, "noise": 1.0}
    made = on_rollers(
        solver={"type": "equilibrium", "increments": 20}, steps=10,
        fracture={"type": "strain", "failure": 0.5}, record={"increments": True},
    )  # fmt: skip
    (observation,) = posed(made, given).observations
    places, forces = observation.curve(Simulation.of_scene(observation.scene))
    np.testing.assert_allclose(places, np.linspace(0.0, 0.01 * WIDTH, 21), atol=1e-9)
    np.testing.assert_allclose(forces, HEIGHT * places / WIDTH, rtol=1e-6, atol=1e-9)


def test_rows_beyond_the_end_of_a_curve_are_named(measured, tmp_path):
    rows = np.loadtxt(measured / "curve.csv", delimiter=",", skiprows=1)
    beyond = np.vstack([rows, [[0.3, 9.0], [0.4, 9.0]]])
    write(tmp_path / "curve.csv", ["displacement", "force"], beyond)
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    given = curve(measured, file=str(tmp_path / "curve.csv"))
    found = pbdkit.fit({"experiment": bar(), "unknown": unknown, "measured": given})
    within(found)
    said = "2 rows are omitted: in the run, the displacement of group 1 goes from 0 to 0.2"
    assert any(line.endswith(said) for line in str(found).splitlines())
    assert found.as_dict()["measured"][0]["left_out_because"] in said


def test_measurement_may_have_its_own_settings(measured, tmp_path):
    """Two tests of one material: the second pulls the other way, and half as far."""
    back = {"leaders.1.motion.velocity": [-0.01, 0.0]}
    ds = pbdkit.run(
        bar(diagnostics=[{"type": "reaction", "youngs_modulus": MODULUS, "thickness": THICKNESS}])
        | {"leaders": [bar()["leaders"][0], bar()["leaders"][1] | {"motion": {
            "type": "velocity", "velocity": [-0.01, 0.0], "steps": 10}}]},
        progress=False,
    )  # fmt: skip
    force = ds.reaction.sel(leader_group=1, axis="x").values
    write(tmp_path / "back.csv", ["time", "force"], np.c_[ds.time.values, force])
    second = curve(
        measured,
        file=str(tmp_path / "back.csv"),
        against="time",
        columns=["time", "force"],
        settings=back,
    )
    unknown = {"rule.poisson_ratio": TOLD["rule.poisson_ratio"]}
    found = pbdkit.fit(
        {"experiment": bar(), "unknown": unknown, "measured": [curve(measured), second]}
    )
    within(found)
    assert found.misfits[1].ratio < 0.5  # it has no noise
    first, other = found.experiments
    assert (first.leaders[1].motion.velocity, other.leaders[1].motion.velocity) == (
        (0.02, 0.01),
        (-0.01, 0.0),
    )
    assert first.rule == other.rule
    assert first.rule.poisson_ratio == found.values["rule.poisson_ratio"].value


def test_derivatives_match_finite_differences(measured):
    fit = {
        "experiment": bar(),
        "unknown": TOLD,
        "measured": [tracks(measured), curve(measured)],
    }
    asked, source = read_fit(Fit, fit)
    problem = problem_of(asked, pbdkit.Experiment.build(source))
    z = problem.start()
    at = problem.at(z)
    for n in range(problem.size):
        step = 1e-4 * max(abs(z[n]), 0.1)
        ends = [problem.residuals(z + sign * step * np.eye(problem.size)[n]) for sign in (1, -1)]
        slope = -(ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(
            at.jacobian[:, n], slope, rtol=1e-5, atol=1e-6 * abs(slope).max()
        )


WRONG = {
    "beyond the run": (lambda f: tracks(f), {"steps": 10}, "times go from 2 to 15"),
    "a curve beyond the run": (
        lambda f: curve(f, file="force.csv", columns=["time", "force"], against="time"),
        {"steps": 12},
        "curve goes from 0 to 16, but in the run, the time .step. goes from 0 to 12",
    ),
    "no such group": (lambda f: curve(f, group=5), {}, "no leader group 5"),
    "does not move": (lambda f: curve(f, group=0), {}, "against: time"),
    "another way": (lambda f: curve(f, axis="y", file="force.csv"), {}, "no 'displacement'"),
    "not the kind": (lambda f: curve(f) | {"type": "curves"}, {}, "did you mean 'curve'"),
}


def test_curve_of_opposite_sign_is_named(measured, monkeypatch):
    monkeypatch.chdir(measured)
    given = curve(measured)
    rows = np.loadtxt(given["file"], delimiter=",", skiprows=1) * [1.0, -1.0]
    np.savetxt("turned.csv", rows, delimiter=",", header="displacement,force", comments="")
    unknown = {"rule.poisson_ratio": [0.0, 0.45]}
    fit = {"experiment": bar(), "unknown": unknown, "measured": given | {"file": "turned.csv"}}
    with pytest.raises(pbdkit.ExperimentError, match="the opposite sign"):
        pbdkit.fit(fit)


@pytest.mark.parametrize("name", WRONG)
def test_invalid_input_is_named(name, measured, monkeypatch):
    monkeypatch.chdir(measured)
    make, more, told = WRONG[name]
    unknown = {"rule.poisson_ratio": [0.0, 0.45]}
    with pytest.raises(pbdkit.ExperimentError, match=told):
        pbdkit.fit({"experiment": bar(**more), "unknown": unknown, "measured": make(measured)})


def test_bonds_that_break_differently_are_refused(measured):
    """The limit decides in which step a bond breaks."""
    slow = bar()["leaders"]
    slow[1]["motion"] |= {"velocity": [0.002, 0.001], "steps": STEPS}
    breaking = bar(leaders=slow, fracture={"type": "strain", "failure": 0.01})
    with pytest.raises(pbdkit.ExperimentError, match=r"fracture.failure breaks other bonds"):
        pbdkit.fit(
            {
                "experiment": breaking,
                "unknown": {"fracture.failure": [0.005, 0.015]},
                "measured": tracks(measured),
            }
        )
