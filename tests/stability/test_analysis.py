"""Predictions before a run, against closed forms and against runs."""

import json
import math
from itertools import product

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import assume, given, strategies as st
from property_cases import LATTICES, RULES
from scene_strategies import AT_LENGTH, calibrated_experiments, experiments, in_turn, samples

import pbdkit
from pbdkit.cli import program
from pbdkit.linear.operator import step_operator
from pbdkit.linear.stencil import wave_bound
from pbdkit.model.shipped import shipped_names
from pbdkit.scene.scene import build_scene
from pbdkit.stability.analysis import Analysis
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

HELD = [{"select": {"edge": e}, "motion": {"type": "hold"}} for e in ("left", "right")]


def sheet(columns=12, rows=10, **parts):
    return {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": {"type": "barycentre"},
        "leaders": HELD,
        "steps": 60,
    } | parts


def unknowns(scene, u, rows):
    place = scene.raster.place_of(rows)
    return np.stack([plane.ravel()[place] for plane in u], axis=1).ravel()


@samples(40)
@given(st.one_of(experiments(), calibrated_experiments()))
def test_operator_reproduces_the_steps_of_the_stepper(experiment):
    """On random scenes, torn ones too; a nonlinear rule at the state where it is linearised."""
    try:
        scene = build_scene(pbdkit.Experiment(**experiment | {"steps": 10}))
        assume(not experiment["neighbours"].get("reevaluate"))
        stepper, state = Stepper(scene), initial_state(scene)
        state = stepper.advance(state, 4)
        operator = step_operator(scene, state, step=5)
        before_step = [u.copy() for u in (state.u, state.previous)]
        broken = None if state.broken_step is None else state.broken_step.copy()
        softened = [value.copy() for value in state.bond_values]
        state = stepper.advance(state)
    except pbdkit.ExperimentError:
        assume(False)
    now, before = (unknowns(scene, u, operator.followers) for u in before_step)
    assume(broken is None or np.array_equal(broken, state.broken_step))
    assume(all(map(np.array_equal, softened, state.bond_values)))
    led = unknowns(scene, state.u, operator.leaders)
    old_led = unknowns(scene, state.previous, operator.leaders)
    # Frame points that follow leaders see them where they stood before the step, or one earlier.
    assume(np.array_equal(led, old_led))
    assume(np.array_equal(led, unknowns(scene, before_step[1], operator.leaders)))
    predicted = (
        operator.current @ now
        + operator.previous @ before
        + operator.leader @ led
        + operator.source
    )
    actual = unknowns(scene, state.u, operator.followers)
    scale = max(1.0, np.abs(actual).max(initial=0.0), np.abs(before).max(initial=0.0))
    np.testing.assert_allclose(predicted, actual, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize(("columns", "rows"), [(8, 5), (12, 10), (40, 33)])
def test_square_spectrum(columns, rows):
    """½(cos a + cos b), a = pπ/N, b = qπ/rows (both end columns held, copying frame)."""
    analysis = pbdkit.analyse(sheet(columns, rows))
    n = columns - 1
    largest = 0.5 * (math.cos(math.pi / n) + 1.0)
    smallest = 0.5 * (math.cos(math.pi * (n - 1) / n) + math.cos(math.pi * (rows - 1) / rows))
    assert analysis.spectral_radius == pytest.approx(largest, abs=1e-12)
    assert analysis.smallest_eigenvalue == pytest.approx(smallest, abs=1e-12)
    assert analysis.largest_stable_relaxation == pytest.approx(2 / (1 - smallest), abs=1e-11)


def test_chebyshev_spectrum():
    """(2cos a + 2cos b + 4 cos a cos b) / 8."""
    analysis = pbdkit.analyse(sheet(14, 9, neighbours={"type": "chebyshev"}))
    a = np.cos(np.pi * np.arange(1, 13) / 13)[:, None]
    b = np.cos(np.pi * np.arange(9) / 9)[None, :]
    exact = (2 * a + 2 * b + 4 * a * b) / 8
    assert analysis.spectral_radius == pytest.approx(np.abs(exact).max(), abs=1e-12)
    assert analysis.smallest_eigenvalue == pytest.approx(exact.min(), abs=1e-12)


@pytest.mark.parametrize("columns", [12, 20])
def test_predicted_steps_to_a_tolerance_match_the_count(columns):
    experiment = sheet(columns, columns, initial={"type": "noise", "amplitude": 0.1}, steps=5000)
    scene = build_scene(pbdkit.Experiment(**experiment))
    predicted = Analysis(scene).steps_to["1e-6"]
    stepper, state = Stepper(scene), initial_state(scene)
    slowest = _slowest_mode(scene)
    state.u[...] = slowest
    state.previous[...] = slowest
    start, counted = np.abs(state.u).max(), 0
    while np.abs(state.u).max() > 1e-6 * start:
        state, counted = stepper.advance(state), counted + 1
    assert counted == pytest.approx(predicted, rel=0.05)


def _slowest_mode(scene):
    u = np.zeros((2, *scene.raster.shape))
    rows = scene.raster.body_rows
    column = scene.raster.site_of(rows)[:, 0]
    u[0].ravel()[scene.raster.place_of(rows)] = np.sin(np.pi * column / column.max())
    scene.frame.follow(u.reshape(2, -1), u.reshape(2, -1))
    return u


class Four(pbdkit.NeighbourMetric):
    """The neighbours one cell vector away."""

    type: str = "four"

    def shells_around(self, cell, sublattice):
        steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
        return [[cell.offset(sublattice, sublattice, step) for step in steps]]


def oblique(angle):
    return {"type": "oblique", "a": 1.0, "b": 1.0, "angle": angle}


BOUNDS = {
    "square 4": ({}, 2 / 3),
    "chebyshev 8": ({"neighbours": {"type": "chebyshev"}}, 0.774),
    "chebyshev 24": ({"neighbours": {"type": "chebyshev", "shells": 2}}, 0.876),
    "hexagonal 6": ({"lattice": {"type": "hexagonal", "a": 1.0}}, 0.853),
    "rectangular 1:2": (
        {
            "lattice": {"type": "rectangular", "a": 1.0, "b": 2.0},
            "neighbours": {"type": "euclidean", "radius": 1.0, "weights": [1.0, 0.25]},
        },
        0.6,
    ),
    "hexagonal 18": (
        {
            "lattice": {"type": "hexagonal", "a": 1.0},
            "neighbours": {"type": "coordination", "shells": 3},
        },
        0.950,
    ),
    "centred 1:2": (
        {
            "lattice": {"type": "centred-rectangular", "a": 1.0, "b": 2.0},
            "neighbours": {"type": "euclidean", "radius": 0.8, "weights": [1.0, 0.25]},
        },
        0.556,
    ),
    "oblique 60": ({"lattice": oblique(60.0), "neighbours": Four()}, 0.571),
    "oblique 5": ({"lattice": oblique(5.0), "neighbours": Four()}, 0.5005),
}


@pytest.mark.parametrize(("parts", "bound"), BOUNDS.values(), ids=BOUNDS)
def test_the_distance_weighted_rule_is_reported_unstable_with_its_bound(parts, bound):
    scene = build_scene(pbdkit.Experiment(**sheet(rule={"type": "distance-weighted"}, **parts)))
    assert wave_bound(scene).largest_stable_relaxation(0.0) == pytest.approx(bound, rel=0.01)
    assert not Analysis(scene).stable
    assert any("is stable below" in w for w in Analysis(scene).warnings())


@pytest.mark.parametrize(("lattice", "rule"), in_turn(product(LATTICES, RULES), 6))
def test_one_percent_inside_the_bound_converges_and_outside_diverges(lattice, rule):
    parts = {"lattice": LATTICES[lattice], "rule": RULES[rule]}
    start = {"type": "noise", "amplitude": 1e-9}
    bound = pbdkit.analyse(sheet(7, 6, **parts)).largest_stable_relaxation
    moved = {}
    for factor in (0.99, 1.01):
        solver = {"type": "stepping", "relaxation": factor * bound}
        given = sheet(7, 6, solver=solver, initial=start, steps=600, **parts)
        assert pbdkit.analyse(given).stable == (factor < 1)
        scene = build_scene(pbdkit.Experiment(**given))
        state = Stepper(scene).advance(initial_state(scene), 600)
        # Mixed coordinates: across the loading axis they are driven.
        along = {"mixed-coordinate": state.u[0], "mixed-coordinate-y": state.u[1]}
        moved[factor] = np.abs(along.get(rule, state.u)).max()
    assert moved[0.99] < 1e-9
    assert not moved[1.01] < 1e-6


def test_optimal_momentum_converges_fastest():
    analysis = pbdkit.analyse(sheet())
    best = analysis.best_memory
    radii = [
        pbdkit.analyse(sheet(solver={"type": "stepping", "memory": b})).spectral_radius
        for b in (best, best - 0.02, best + 0.02)
    ]
    assert radii[0] == pytest.approx(math.sqrt(best), abs=1e-6)
    assert radii[0] < min(radii[1:])


def test_parts_without_a_leader_are_named():
    parts = {"type": "grid", "columns": 4, "rows": 4}
    apart = {
        "type": "union",
        "of": [parts, {"type": "rectangle", "width": 3.0, "height": 3.0, "origin": [20.0, 0.0]}],
    }
    given = sheet(
        body=apart, leaders=[{"select": {"box": [-1, -1, 0.5, 9]}, "motion": {"type": "hold"}}]
    )
    (part,) = pbdkit.analyse(given).parts_without_leader
    assert len(part) == 16
    (warning,) = pbdkit.analyse(given).warnings()
    assert warning.startswith("leaders: a part of 16 particles (with number ")


def test_undamped_mode_is_found():
    """Two particles that only see each other change places for ever (hard case 13)."""
    given = sheet(2, 1, rule={"type": "mean-displacement"}, frame={"type": "none"}, leaders=[])
    assert any("use a relaxation below 1" in w for w in pbdkit.analyse(given).warnings())


FEWER = {} if AT_LENGTH else {"modelling/double-cantilever": ["solver.increments=3"]}
"""Settings of experiments of many increments: the first ones."""


@pytest.mark.parametrize("name", in_turn([n for n in shipped_names() if "to-failure" not in n], 8))
def test_predictions_for_shipped_experiments_hold(name):
    """Stable ones stay within the hull of their leaders' ways, with room; all shipped ones are that
    are made of steps, and those that go straight to equilibrium stay there too. Bodies that are
    torn in steps of equilibria have tests of their own."""
    experiment = pbdkit.load(name)
    straight = experiment.solver.type == "equilibrium"
    assert straight or pbdkit.analyse(experiment).stable is not False
    steps = max([400, *(cut.at + 100 for cut in experiment.cuts)])
    settings = ["record={every: 50}", "diagnostics=[{type: displacement}]"]
    settings += FEWER.get(name, []) if straight else [f"steps={steps}"]
    ds = pbdkit.run(pbdkit.load(name, settings=settings), progress=False)
    assert ds.attrs["status"] == "complete"
    assert abs(ds.u).max() < 100
    predicted = json.loads(ds.attrs["prediction"])
    assert straight or predicted.get("stable") is not False


def test_possible_divergence_gives_a_warning_and_an_attribute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    changes = ["solver.relaxation=1.2", "rule={type: barycentre}", "steps=5"]
    arguments = [word for change in changes for word in ("--set", change)]
    result = CliRunner().invoke(program, ["run", "paper/b", *arguments])
    assert "solver.relaxation: 1.2 can diverge" in result.output
    assert "stable below 1" in result.output
    with pbdkit.open("paper-b.nc") as ds:
        assert json.loads(ds.attrs["prediction"])["stable"] is False


class Hypotenuse(pbdkit.FollowerRule):
    """The distance-weighted rule by a function that takes no complex numbers."""

    type: str = "hypotenuse"

    @staticmethod
    def gather(d, r, w, p):
        there = r + d
        distance = np.hypot(*there)
        return distance * there, distance

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class Absolute(Hypotenuse):
    """A rule with the same values that drops the imaginary part silently."""

    type: str = "absolute"

    @staticmethod
    def gather(d, r, w, p):
        there = r + d
        distance = np.sqrt(np.abs(there.x) ** 2 + np.abs(there.y) ** 2)
        return distance * there, distance


@pytest.mark.parametrize("rule", [Hypotenuse(type="hypotenuse"), Absolute(type="absolute")])
def test_functions_without_complex_step_are_detected(rule):
    given = sheet(rule=rule)
    assert wave_bound(build_scene(pbdkit.Experiment(**given))).smallest == pytest.approx(
        -2, abs=1e-6
    )
    exact = pbdkit.analyse(sheet(rule={"type": "distance-weighted"}))
    assert pbdkit.analyse(given).spectral_radius == pytest.approx(exact.spectral_radius, abs=1e-6)
    assert pbdkit.run(given | {"steps": 3}, progress=False).attrs["status"] == "complete"


@pytest.mark.parametrize("rule", ["springs", "distance-weighted", "elastic"])
@pytest.mark.parametrize("a", [2.0**-40, 2.0**60])
def test_step_is_linearised_equally_in_all_units(rule, a):
    """Lengths are all of the lattice: the matrices are the same, to rounding, and what broken
    bonds push is as much longer as lengths are."""

    def operator(a):
        cracks = [[[2.5 * a, -a], [2.5 * a, 1.5 * a]]]
        fracture = {"type": "threshold", "thresholds": [1.7 * a]}
        if rule == "distance-weighted":  # lost bonds of calibrated rules push nowhere
            fracture["placement"] = 1.5
        given = sheet(
            columns=6,
            rows=5,
            lattice={"type": "square", "a": a},
            neighbours={"type": "chebyshev", "shells": 1},
            rule={"type": rule} | ({"poisson_ratio": 0.3} if rule == "elastic" else {}),
            frame={"type": "none"},
            fracture=fracture | {"cracks": cracks},
        )
        return step_operator(build_scene(pbdkit.Experiment(**given)))

    one, other = operator(1.0), operator(a)
    for name in ("current", "leader"):
        matrix, scaled = getattr(one, name).toarray(), getattr(other, name).toarray()
        np.testing.assert_allclose(scaled, matrix, rtol=1e-14, atol=1e-15, err_msg=name)
    np.testing.assert_allclose(other.source / a, one.source, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("memory", [1.5, -1.5])
def test_unstable_rule_has_no_relaxation_bound(memory):
    given = sheet(solver={"type": "stepping", "memory": memory})
    analysis = pbdkit.analyse(given)
    assert analysis.stable is False
    assert analysis.largest_stable_relaxation is None
    assert any("no relaxation makes it stable" in w for w in analysis.warnings())


def test_delayed_frames_use_the_spectrum():
    scene = build_scene(pbdkit.Experiment(**sheet(frame={"type": "mean", "lag": 1})))
    assert wave_bound(scene) is None
    assert Analysis(scene).stable


def test_without_followers_there_is_nothing_to_analyse():
    leaders = [{"select": {"box": [-1, -1, 99, 99]}, "motion": {"type": "hold"}}]
    analysis = pbdkit.analyse(sheet(leaders=leaders))
    assert analysis.stable
    assert len(analysis.operator.followers) == 0
    assert analysis.warnings() == []


def test_isolated_particle_stays_at_any_momentum():
    """It has the eigenvalue 1 of the rule's own step, and no other."""
    body = {
        "type": "union",
        "of": [
            {"type": "grid", "columns": 6, "rows": 5},
            {"type": "rectangle", "width": 0.5, "height": 0.5, "origin": [19.8, 1.8]},
        ],
    }
    parts = {"rule": {"type": "mean-displacement"}, "frame": {"type": "none"}, "body": body}
    solver = {"type": "stepping", "relaxation": 0.4, "memory": 0.5}
    leaders = [{"select": {"box": [-1, -1, 0.5, 9]}, "motion": {"type": "hold"}}]
    plain = pbdkit.analyse(sheet(leaders=leaders, **parts))
    remembering = pbdkit.analyse(sheet(leaders=leaders, solver=solver, **parts))
    assert remembering.smallest_eigenvalue == pytest.approx(plain.smallest_eigenvalue, abs=1e-12)
    assert remembering.spectral_radius == pytest.approx(1.0, abs=1e-12)
    assert remembering.parts_without_leader == plain.parts_without_leader


def test_mirror_frame_fixes_a_body_without_leaders():
    loose = pbdkit.analyse(sheet(leaders=[], frame={"type": "mean"}))
    assert any(w.startswith("leaders: a part of") for w in loose.warnings())
    mirrored = pbdkit.analyse(sheet(leaders=[], frame={"type": "mirror"}))
    assert mirrored.spectral_radius < 1.0 - 1e-6
    assert mirrored.warnings() == []


@pytest.mark.parametrize(
    ("parts", "exact"),
    [
        ({}, True),
        ({"rule": {"type": "mixed-coordinate", "K": -0.002}}, True),
        ({"rule": {"type": "distance-weighted"}}, False),
        ({"fracture": {"type": "threshold", "thresholds": [1.5]}}, False),
        ({"neighbours": {"type": "euclidean", "radius": 1.2, "reevaluate": True}}, False),
    ],
)
def test_predictions_are_exact_for_a_linear_rule_with_fixed_neighbours(parts, exact):
    assert pbdkit.analyse(sheet(**parts)).exact is exact
