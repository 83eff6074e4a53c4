"""Cases in which the load path matters: rules that are not linear, bonds that break, events."""

import json
from itertools import pairwise

import numpy as np
import pytest
from changed_axes import Change, changed
from hypothesis import given, strategies as st
from scene_strategies import in_turn, samples

import pbdkit
from pbdkit.equilibrium.error_bound import (
    DisplacementScale,
    EquilibriumPredictor,
    UnconvergedError,
)
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.load_stepping import (
    _in_parts,
    equilibrate,
    events,
    finder_of,
    moments,
)
from pbdkit.equilibrium.newton import follow_contact
from pbdkit.equilibrium.system import Moves
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.state import initial_state

HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
STRAIGHT = {"type": "equilibrium"}


def moving(**motion):
    return {"select": {"edge": "right"}, "motion": motion}


def springs(displacement, columns=12, rows=4, **parts):
    return {
        "version": 1,
        "name": "springs",
        "lattice": {"type": "hexagonal", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "neighbours": {"type": "coordination", "shells": 1},
        "rule": {"type": "springs"},
        "frame": {"type": "natural"},
        "leaders": [HOLD, moving(type="displace", displacement=displacement)],
        "steps": 1,
        "diagnostics": [{"type": "displacement"}, {"type": "smallest-cell-area"}],
        "solver": STRAIGHT,
    } | parts


def sheet(leaders, **parts):
    return {
        "version": 1,
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 6, "rows": 5},
        "rule": {"type": "barycentre"},
        "leaders": leaders,
        "diagnostics": [{"type": "displacement"}],
        "solver": STRAIGHT,
    } | parts


def run(experiment):
    return pbdkit.run(experiment, progress=False)


@pytest.mark.parametrize(
    "displacement", in_turn([[0.5, 4.0], [0, 1.2], [0, 2.0], [3.0, 0]], 4), ids=str
)
def test_springs_follow_slow_loading_without_folding(displacement):
    small = {"columns": 8, "rows": 3}
    found = run(springs(displacement, **small))
    steps = 200
    velocity = [along / steps for along in displacement]
    slow = springs(
        None,
        **small,
        leaders=[HOLD, moving(type="velocity", velocity=velocity, steps=steps)],
        steps=20_000,
        record={"every": 20_000},
        solver={"type": "stepping", "settle": {"tolerance": 1e-7}},
    )
    assert np.abs(found.u[-1] - run(slow).u[-1]).max() < 1e-6 * np.hypot(*displacement) + 1e-6
    assert found.smallest_cell_area[-1] > 0.0
    assert json.loads(found.attrs["certificate"])["distance"] <= 1e-8 * np.hypot(*displacement)


def test_buckled_body_is_no_equilibrium(monkeypatch):
    """A strip that is pressed along its axis can buckle to either side."""
    monkeypatch.setattr("pbdkit.equilibrium.load_stepping.MAX_ROUNDS", 2)
    with pytest.raises(pbdkit.DivergedError, match="branches into several equilibria"):
        run(springs([-2.0, 0.0]))


@samples(12)
@given(
    st.integers(4, 7),
    st.integers(3, 6),
    st.floats(1.2, 2.0),
    st.tuples(st.floats(-4, 4), st.floats(-1, 1)),
    st.integers(5, 40),
)
def test_the_same_load_in_the_same_parts_breaks_the_same_bonds(
    columns, rows, threshold, way, parts
):
    """At once and cut into increments, or slowly, one step an increment."""
    more = {
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "fracture": {"type": "threshold", "thresholds": [threshold]},
        "solver": STRAIGHT | {"increments": parts},
    }
    velocity = [along / parts for along in way]
    at_once = sheet([HOLD, moving(type="displace", displacement=way)], steps=1, **more)
    slowly = [HOLD, moving(type="velocity", velocity=velocity, steps=parts)]
    ends = [run(at_once), run(sheet(slowly, steps=parts, **more))]
    broken = [(ds.broken_step.values >= 0).tolist() for ds in ends]
    assert broken[0] == broken[1]
    assert np.abs(ends[0].u[-1] - ends[1].u[-1]).max() < 1e-6


def path_of(*leaders, steps=60):
    return build_scene(pbdkit.Experiment(**sheet(list(leaders), steps=steps, version=1)))


def test_increments_are_equal_parts_ended_by_events():
    there_and_back = moving(type="path", steps=[10, 20], displacements=[[2.0, 0.0], [0.0, 0.0]])
    late = {"select": {"edge": "top"}, "motion": {"type": "hold"}, "from": 41, "until": 50}
    scene = path_of(HOLD, there_and_back, late)
    assert events(scene) == [0, 10, 20, 40, 50, 51]
    found = moments(scene, 40)
    assert set(events(scene)[1:]) <= set(found)
    assert len([moment for moment in found if moment <= 20]) == 40
    assert set(range(1, 21)) <= set(found)
    parts = {round(b - a, 9) for a, b in pairwise([0.0, *found]) if b <= 20}
    assert parts == {0.5}


def test_a_motion_between_two_increments_is_not_skipped():
    """Once there and back within a step's reach of one increment: bonds break all the same."""
    pulled = moving(type="path", steps=[1, 2], displacements=[[9.0, 0.0], [0.0, 0.0]])
    fracture = {"type": "threshold", "thresholds": [1.5]}
    solver = STRAIGHT | {"increments": 1}
    torn = run(sheet([HOLD, pulled], steps=60, fracture=fracture, solver=solver))
    assert (torn.broken_step.values >= 0).any()


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_bond_changes_are_within_tolerance_at_the_end_of_the_path(tolerance):
    cohesive = {"type": "cohesive", "energy": 6e-4, "onset": 0.01}
    scene = build_scene(
        pbdkit.Experiment(
            **springs([0.07, 0.02], 7, 3)
            | {
                "lattice": {"type": "square", "a": 1.0},
                "neighbours": {"type": "chebyshev"},
                "rule": {"type": "elastic", "poisson_ratio": 0.3},
                "fracture": cohesive,
                "solver": {"type": "equilibrium", "tolerance": tolerance, "increments": 3},
            }
        )
    )
    state = initial_state(scene)
    equilibrate(scene, state)
    before = [value.copy() for value in state.bond_values]
    assert max(float(value.max()) for value in before) > 0.1
    Fracturing.of(scene).break_bonds(state.u, state, 1)
    for old, new in zip(before, state.bond_values, strict=True):
        assert np.abs(new - old).max() <= tolerance


def test_first_order_bounds_are_doubled():
    """Test springs, by the search and by a state on the path."""
    scene = build_scene(pbdkit.Experiment(**springs([0.5, 1.0])))
    state = initial_state(scene)
    error_bound = equilibrate(scene, state)
    moves = Moves(scene)
    system = linearised(scene, state, 1, "auto", Watch(), moves)
    rounding = system.amplification * moves.rounding(state.u)
    once = system.distance(moves.at(state, 1), rounding)
    assert error_bound.linearised
    assert error_bound.distance == pytest.approx(2.0 * once, rel=0.1)
    state.u[...] += moves.at(state, 1) + 1e-4 * np.sin(state.u)  # off by a little
    found = EquilibriumPredictor(scene, DisplacementScale.of(1.0, "1"), Watch()).predict(state)
    system = linearised(scene, state, 1, "auto", Watch())
    correction = found.u - state.u
    left = system.distance(moves.at(type(state)(**vars(state) | {"u": found.u}), 1),
                           moves.rounding(found.u))  # fmt: skip
    way = float(np.hypot(*correction).max())
    assert found.error_bound.distance == pytest.approx(way + 2.0 * left, rel=1e-9)
    assert 2.0 * left > 1e-6 * way


@pytest.mark.parametrize(
    ("count", "lengths", "exact"),
    [(6, [1.0, 2.0, 0.0], [2.0, 4.0, 0.0]), (6, [0.0, 0.0], [1.0, 1.0]), (1, [3.0], [1.0])],
)
def test_increments_are_proportional_to_the_path_of_the_leaders(count, lengths, exact) -> None:
    assert _in_parts(count, lengths) == exact


@pytest.mark.parametrize(("columns", "rise"), [(4, 1.2), (6, 1.0)])
def test_an_active_set_that_recurs_ends_the_search(columns, rise):
    """Particles that alternately touch and leave the obstacle would do so until the limit of 60
    changes of the set, in each part of an increment."""
    plane = {"half_plane": {"point": [0.0, 0.0], "normal": [0.0, 1.0]}}
    motion = {"type": "displace", "displacement": [0.0, rise]}
    experiment = springs(
        [0.0, 0.0],
        *(columns, 2),
        lattice={"type": "square", "a": 1.0},
        neighbours={"type": "chebyshev", "shells": 1},
        leaders=[HOLD],
        obstacles=[{"shape": plane, "motion": motion}],
    )
    scene = build_scene(pbdkit.Experiment(**experiment))
    state = initial_state(scene)
    with pytest.raises(UnconvergedError) as failed:
        follow_contact(finder_of(scene, state), state, 1.0)
    assert failed.value.error_bound.iterations < 30


TURNED = {
    "half_plane": {"half_plane": {"point": [1.0, -1.0], "normal": [0.6, 0.8]}},
    "rectangle": {"type": "rectangle", "width": 20.0, "height": 2.0, "origin": [-1.0, -3.0]},
    "disc": {"type": "disc", "radius": 2.0, "centre": [3.0, -4.0]},
}


@pytest.mark.parametrize("shape", TURNED)
def test_the_tolerance_of_a_turning_obstacle_has_the_unit_of_lengths(shape):
    turn = {"type": "rotation", "centre": [1.0, -1.0], "angle": 4.0, "steps": 4}
    experiment = springs([0.0, 0.0], leaders=[HOLD])
    experiment["obstacles"] = [{"shape": TURNED[shape], "motion": turn}]
    written = pbdkit.Experiment(**experiment).model_dump(mode="json", by_alias=True)
    tolerances = []
    for unit in (1.0, 2.0**-40, 2.0**20):
        scene = build_scene(pbdkit.Experiment(**changed(written, Change(unit))))
        tolerances.append(finder_of(scene, initial_state(scene)).tolerance / unit)
    assert tolerances[0] > 0.0
    assert tolerances == pytest.approx([tolerances[0]] * 3, rel=1e-9)
