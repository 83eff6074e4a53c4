"""Distance of a body from its equilibrium: against the closed form, and against runs."""

import json
import math

import numpy as np
import pytest
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    LATTICES,
    NEIGHBOURS,
    all_pairs,
    body_of,
    experiment,
    pull_right,
    scene_of,
)
from scene_strategies import in_turn

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state


def pulled(columns, rows, x, y=0.0, steps=10, **parts):
    """A sheet with a right end that moves by (x, y) in each of its steps."""
    leaders = [HOLD_LEFT, pull_right(x, y, steps)]
    return {"columns": columns, "rows": rows, "leaders": leaders, "steps": steps} | parts


def measured_distance(**parts):
    """Return the distance of a run from the equilibrium of its last step."""
    scene = scene_of(**parts)
    stepped = Stepper(scene).advance(initial_state(scene), scene.experiment.steps)
    straight = scene_of(**parts | {"solver": {"type": "equilibrium", "tolerance": 1e-9}})
    settled, _ = equilibrium_state(straight)
    return float(np.hypot(*(body_of(scene, settled) - body_of(scene, stepped)).T).max())


def closed_form(speed, length):
    """4 v l² / (9 √3 h²), h = 1."""
    return 4 * speed * length**2 / (9 * math.sqrt(3))


@pytest.mark.parametrize(("columns", "rows"), [(20, 20), (30, 8), (41, 5)])
def test_distance_matches_the_closed_form(columns, rows):
    analysis = pbdkit.analyse(experiment(**pulled(columns, rows, 0.0035)))
    assert analysis.distance == pytest.approx(closed_form(0.0035, columns - 1), rel=0.02)


def test_distance_matches_a_run():
    """Case a's sheet, long enough on its way for the lag to become steady."""
    parts = pulled(20, 20, 0.0035, steps=2200)
    measured, distance = (
        measured_distance(**parts),
        pbdkit.analyse(experiment(**parts)).leader_distance,
    )
    assert measured == pytest.approx(0.322, abs=5e-4)
    assert distance.reached == pytest.approx(measured, rel=1e-9)
    assert distance.steady == pytest.approx(measured, rel=1e-5)
    assert closed_form(0.0035, 19) == pytest.approx(0.3242, abs=1e-4)


@pytest.mark.parametrize(
    ("lattice", "neighbours", "frame"),
    all_pairs(LATTICES, NEIGHBOURS, ["mean", "first", "lag", "wide", {"type": "none"}]),
)
def test_reached_stretch_matches_runs_on_every_lattice(lattice, neighbours, frame):
    """Frame points that follow leaders are late, in every neighbourhood and frame its own way."""
    parts = pulled(
        7, 6, 0.2, -0.1, steps=6, lattice=lattice, neighbours=neighbours, frame=frame,
        rule="mean-displacement",
    )  # fmt: skip
    distance = pbdkit.analyse(experiment(**parts)).leader_distance
    if (lattice, neighbours) == ("oblique", "coordination-1"):
        assert (
            distance is None
        )  # neighbours lie along the columns: no particle depends on the leaders
        return
    assert (distance.first, distance.last) == (1, 6)
    assert distance.speed == pytest.approx(math.hypot(0.2, 0.1))
    assert distance.reached == pytest.approx(measured_distance(**parts), rel=1e-7)


@pytest.mark.parametrize(
    ("rule", "weights", "frame"),
    in_turn(
        all_pairs(
            ["barycentre", "mixed-coordinate"],
            [(0.7, 0.0), (1.0, 0.9), (0.5, -0.4)],
            ["mean", "lag"],
        ),
        3,
    ),
)
def test_relaxation_and_momentum_affect_the_distance(rule, weights, frame):
    relaxation, memory = weights
    solver = {"type": "stepping", "relaxation": relaxation, "memory": memory}
    for steps in (2, 9, 2000):
        parts = pulled(7, 6, 2e-3, 1e-3, steps=steps, rule=rule, frame=frame, solver=solver)
        distance = pbdkit.analyse(experiment(**parts)).leader_distance
        measured = measured_distance(**parts)
        assert distance.reached == pytest.approx(measured, rel=1e-6)
    assert distance.steady == pytest.approx(measured, rel=1e-6)


def test_large_sheets_use_sparse_matrices():
    parts = pulled(50, 12, 0.01, steps=40, neighbours="chebyshev-1")
    assert pbdkit.analyse(experiment(**parts)).leader_distance.reached == pytest.approx(
        measured_distance(**parts), rel=1e-7
    )


def test_the_fastest_steps_of_all_leaders_count():
    path = {"type": "path", "steps": [4, 9, 10], "displacements": [[0.4, 0], [1.9, 0], [9.0, 0]]}
    later = {"select": {"edge": "right"}, "motion": path, "from": 3}
    drift = {"type": "velocity", "velocity": [0.0, 0.4], "steps": 99}
    other = {"select": {"edge": "left"}, "motion": drift, "until": 2}
    distance = pbdkit.analyse(experiment(8, 5, leaders=[other, later], steps=40)).leader_distance
    # The way from 1.9 to 9 is a jump of one step: it has no speed.
    assert (distance.first, distance.last) == (1, 2)
    assert distance.speed == pytest.approx(0.4)
    distance = pbdkit.analyse(
        experiment(8, 5, leaders=[later, HOLD_LEFT], steps=40)
    ).leader_distance
    assert (distance.first, distance.last) == (7, 11)
    assert distance.speed == pytest.approx(0.3)


@pytest.mark.parametrize(
    "parts",
    [
        {"leaders": []},
        {"leaders": BOTH_ENDS_HELD},
        {"leaders": [HOLD_LEFT, pull_right(1.0, 0.0, steps=1)]},
        {"leaders": [pull_right(0.1, 0.0)], "solver": {"type": "stepping", "relaxation": 1.3}},
        {"leaders": [HOLD_LEFT, pull_right(0.1, 0.0)], "solver": {"type": "equilibrium"}},
        {
            "leaders": [pull_right(0.1, 0.0)],
            "neighbours": {"type": "euclidean", "radius": 1.1, "reevaluate": True},
        },
    ],
    ids=["nobody", "still", "jump", "unstable", "straight", "found anew"],
)
def test_without_steady_motion_and_stable_steps_there_is_no_distance(parts):
    analysis = pbdkit.analyse(experiment(**parts))
    assert analysis.distance is analysis.leader_distance is None
    assert not any("from equilibrium, more than" in w for w in analysis.warnings())


def test_long_motion_is_estimated():
    distance = pbdkit.analyse(experiment(**pulled(60, 60, 1e-4, steps=100_000))).leader_distance
    assert distance.reached == pytest.approx(distance.steady, rel=1e-6)
    assert distance.size == pytest.approx(closed_form(1e-4, 59), rel=0.02)


@pytest.mark.parametrize("steps", [3, 60, 400, 3000])
def test_reached_stretch_is_estimated_within_10_percent(steps, monkeypatch):
    parts = pulled(40, 12, 0.01, steps=steps)
    followed = pbdkit.analyse(experiment(**parts)).leader_distance
    monkeypatch.setattr("pbdkit.stability.distance.MAX_PRODUCTS", 0.0)
    estimated = pbdkit.analyse(experiment(**parts)).leader_distance
    assert estimated.steady == followed.steady
    assert estimated.reached == pytest.approx(followed.reached, rel=0.1)


def test_reached_stretch_is_not_estimated_with_momentum(monkeypatch):
    monkeypatch.setattr("pbdkit.stability.distance.MAX_PRODUCTS", 0.0)
    solver = {"type": "stepping", "memory": 0.5}
    distance = pbdkit.analyse(experiment(**pulled(8, 6, 0.01, solver=solver))).leader_distance
    assert distance.reached is None
    assert distance.size == distance.steady


FAST, SLOW = "0.35", "0.04"


@pytest.mark.parametrize(("speed", "warned"), [(FAST, True), (SLOW, False)])
def test_check_prints_the_distance_and_warns_if_it_is_large(call, speed, warned):
    arguments = ["check", "paper/a", "--set", f"leaders.1.motion.velocity=[{speed}, 0.0]"]
    figures = json.loads(call(*arguments, "--json").out)
    steady, reached = (float(speed) / 0.35 * x for x in (7.0648, 2.0426))
    assert figures["lag"] == pytest.approx(steady, rel=1e-4)
    assert figures["lag_reached"] == pytest.approx(reached, rel=1e-4)
    said = call(*arguments, "--verbose").out
    assert (
        f"distance   {steady:.4g} lattice units from equilibrium if the leaders continue at their "
        f"fastest, and {reached:.4g} at the end of these steps"
    ) in said
    expected = (
        "leaders: in steps 1 to 10 the fastest moves by 0.35 per step, which brings the body 2.04 "
        "from equilibrium, more than a bond (1): the strain of bonds depends on this speed; "
        "move by less than 0.05 per step, or use solver: {type: equilibrium}"
    )
    assert (expected in figures["warnings"]) == warned
    assert (expected in said) == warned


def test_recommended_speed_keeps_the_distance_below_a_bond():
    fast = pbdkit.analyse("paper/a").leader_distance
    slow = fast.speed / fast.steady
    distance = pbdkit.analyse(experiment(**pulled(10, 10, slow, steps=4000))).leader_distance
    assert distance.reached == pytest.approx(1.0, rel=1e-6)


def test_check_prints_no_distance_where_there_is_none(call):
    figures = json.loads(call("check", "stability/oscillation", "--json").out)
    assert figures["lag"] is figures["lag_reached"] is None
    assert "units from equilibrium" not in call("check", "stability/oscillation", "--verbose").out


def test_case_22_bonds_of_a_fast_test_stretch_nine_times_the_equilibrium():
    parts = pulled(20, 20, 0.35, steps=10)
    scene = scene_of(**parts)
    u = body_of(scene, Stepper(scene).advance(initial_state(scene), 10)).reshape(20, 20, 2)
    assert np.diff(u[:, 10, 0]).max() == pytest.approx(1.66, abs=0.005)
    assert pytest.approx(0.18, abs=0.005) == 3.5 / 19
    (warning,) = pbdkit.analyse(experiment(**parts)).warnings()
    assert (
        f"brings the body {measured_distance(**parts):.3g} from equilibrium, more than" in warning
    )
