"""Several steps in one pass over the memory give the numbers of one after the other, to the bit."""

from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from interpreted_kernels import interpreting
from property_cases import HOLD_LEFT, pull_right
from remembering_parts import Vanes
from scene_strategies import (
    AT_LENGTH,
    calibrated_experiments,
    experiments,
    in_turn,
    pulled_apart,
    samples,
)

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping import engine_choice as choice
from pbdkit.stepping.engine_choice import choose
from pbdkit.stepping.numba_engine import plan as bands, time_skewing as passes
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numba_engine.time_skewing import Skew, single_steps
from pbdkit.stepping.step import Reach
from tests.stepping.numba_engine.test_engine import (
    ANEW,
    COMPONENTS,
    DAMAGE,
    ELASTIC,
    MANY,
    TWICE,
    assert_bitwise_equal,
    sheet,
)


@contextmanager
def small_passes(deep=4, band=3, tile=5, order=range):
    """Nothing counts as small enough for the cache, there are several bands and tiles, up to three
    threads, and their pieces come in some order."""
    sizes = {"DEEP": deep, "BAND": band, "SHORTEST": tile, "ROW": 0, "CACHE": 0}
    with interpreting(), pytest.MonkeyPatch.context() as patch:
        for name, size in sizes.items():
            patch.setattr(bands, name, size)
        patch.setattr(passes, "CACHE", 0)
        patch.setattr("numba.prange", order)
        patch.setattr("numba.config.NUMBA_NUM_THREADS", 3)
        patch.setattr("numba.set_num_threads", lambda threads: None)
        yield


def backwards(count):
    return reversed(range(count))


def scene_of(**parts):
    return build_scene(pbdkit.Experiment(**sheet(**parts)))


IN_ONE_PASS = {
    name: parts
    for name, parts in COMPONENTS.items()
    if not single_steps(build_scene(pbdkit.Experiment(**sheet(**parts))))
}


def test_most_components_support_several_steps_per_pass():
    assert len(IN_ONE_PASS) >= 35
    assert {"fracture", "damage", "relaxed, with memory", "frame lag"} <= set(IN_ONE_PASS)


@pytest.mark.parametrize("name", in_turn(IN_ONE_PASS, 3))
def test_every_component(name):
    with small_passes():
        scene = scene_of(**IN_ONE_PASS[name])
        assert_bitwise_equal(scene, CompiledStepper(scene))


NOISE = {"type": "noise", "amplitude": 0.1}
HOLD = {"type": "hold"}
MIDDLE = {
    "select": {"box": [19.5, -0.5, 24.5, 1.5]},
    "motion": {"type": "velocity", "velocity": [0.1, 0.07], "steps": 20},
}
LONG = {
    "body": {"type": "grid", "columns": 44, "rows": 4},
    "initial": NOISE,
    "leaders": [HOLD_LEFT, MIDDLE, pull_right(0.3, 0.1) | {"until": 9}],
}
"""Leaders move where pieces meet."""
VANES = {"rule": Vanes(), "frame": {"type": "none"}}
TURNED = {
    "select": {"edge": "right"},
    "motion": {"type": "rotation", "centre": [40.0, 1.0], "angle": 10.0, "steps": 3},
    "from": 2,
    "until": 6,
    "clamped": True,
}
ROLLERS = [
    {"select": {"edge": "left"}, "motion": HOLD, "axes": ["x"]},
    {"select": {"edge": "bottom"}, "motion": HOLD, "axes": ["y"]},
    pull_right(0.1, 0.0) | {"axes": ["x"]},
]
OBSTACLES = [
    {
        "shape": {"type": "disc", "radius": 6.0, "centre": [22.0, 9.02]},
        "motion": {"type": "velocity", "velocity": [0.2, -0.05], "steps": 20},
    },
    {
        "shape": {"half_plane": {"point": [-1.01, 0.0], "normal": [1.0, 0.0]}},
        "motion": {"type": "velocity", "velocity": [0.03, 0.0], "steps": 5},
    },
]
SOLID = {key: TWICE[key] for key in ("neighbours", "frame")} | {"rule": ELASTIC}
SWUNG = {"type": "stepping", "relaxation": 0.7, "memory": 0.2}
WITH_MORE = {
    "rollers": SOLID | {"leaders": ROLLERS},
    "rollers that stand": SOLID | {"leaders": ROLLERS[:2]},
    "rollers, memory": {"leaders": [ROLLERS[0], MIDDLE | {"axes": ["y"]}], "solver": SWUNG},
    "rollers, damage": {"leaders": [ROLLERS[0], MIDDLE], "fracture": DAMAGE},
    "obstacles": SOLID | {"leaders": [HOLD_LEFT], "obstacles": OBSTACLES},
    "obstacles, from rest": {"obstacles": OBSTACLES, "initial": {"type": "reference"}},
    "obstacles, damage": {"obstacles": OBSTACLES, "fracture": DAMAGE},
    "directions": VANES,
    "directions, clamped": VANES | {"leaders": [HOLD_LEFT | {"clamped": True}, MIDDLE, TURNED]},
    "lag": {"frame": {"type": "first", "lag": 1, "layers": 2}, "fracture": DAMAGE},
    "moves of another": TWICE | {"body": {"type": "grid", "columns": 110, "rows": 3}},
    "moves of another, on rollers": TWICE
    | {
        "body": {"type": "grid", "columns": 80, "rows": 3},
        "frame": {"type": "mean"},
        "leaders": [ROLLERS[0], MIDDLE],
    },
    "damage, two sublattices": {
        "lattice": {"type": "hexagonal", "a": 1.0},
        "body": {"type": "rectangle", "width": 43.0, "height": 4.0},
        "fracture": DAMAGE,
    },
}


EVENTS = [(name, pieces) for name in WITH_MORE for pieces in ((1, 3) if AT_LENGTH else (3,))]


@pytest.mark.parametrize(("name", "pieces"), in_turn(EVENTS, 3))
def test_further_events_during_steps(name, pieces):
    with small_passes(order=backwards):
        scene = scene_of(**LONG | WITH_MORE[name])
        engine = CompiledStepper(scene, pieces)
        assert_bitwise_equal(scene, engine, calls=(1, 13, 2))


WITHOUT_LEADERS = [name for name, parts in IN_ONE_PASS.items() if "leaders" not in parts]


@pytest.mark.parametrize("name", in_turn(WITHOUT_LEADERS, 4))
def test_every_component_in_pieces(name):
    with small_passes(deep=9):
        scene = scene_of(**LONG | IN_ONE_PASS[name])
        assert_bitwise_equal(scene, CompiledStepper(scene, 2), calls=(1, 11))


ORDERS = st.sampled_from([range, backwards])
SIZES = st.tuples(st.integers(2, 7), st.integers(1, 4), st.integers(1, 6), ORDERS)
CALLS = st.lists(st.integers(1, 9), min_size=1, max_size=4)
PIECES = st.integers(1, 3)


@samples(15)
@given(experiments(), CALLS, PIECES, SIZES)
def test_random_scenes(experiment, calls, pieces, sizes):
    compare(experiment, calls, pieces, sizes)


@samples(15)
@given(experiments(leaders=pulled_apart(), fracturing=st.just(True)), CALLS, PIECES, SIZES)
def test_broken_scenes(experiment, calls, pieces, sizes):
    compare(experiment, calls, pieces, sizes)


@samples(15)
@given(calibrated_experiments(), CALLS, PIECES, SIZES)
def test_calibrated_scenes(experiment, calls, pieces, sizes):
    compare(experiment, calls, pieces, sizes)


def compare(experiment, calls, pieces, sizes):
    if experiment["body"]["type"] == "grid":  # long enough for several pieces
        experiment = experiment | {"body": experiment["body"] | {"columns": 16 * pieces}}
    try:
        scene = build_scene(pbdkit.Experiment(**experiment | {"steps": sum(calls)}))
        assume(not single_steps(scene))
        with small_passes(*sizes):
            assert_bitwise_equal(scene, CompiledStepper(scene, pieces), calls=calls)
    except pbdkit.ExperimentError:  # leaders that contradict each other, perhaps on the way
        assume(False)


@pytest.mark.parametrize("pieces", [1, 2])
def test_insufficient_step_distance_gives_wrong_results(pieces, monkeypatch):
    monkeypatch.setattr(Reach, "step", 1)
    with small_passes(order=backwards):
        scene = scene_of(**LONG | {"neighbours": {"type": "chebyshev", "shells": 2}})
        engine = CompiledStepper(scene, pieces)
        with pytest.raises(AssertionError, match="not equal"):
            assert_bitwise_equal(scene, engine, calls=(1, 9))


def test_leader_positions_are_known_for_many_steps(monkeypatch):
    """One call of the kernel makes them, and stops where a group is released."""
    scene = scene_of(steps=40)
    with small_passes():
        engine = CompiledStepper(scene)
        run, counts = engine._run, []
        engine._run = lambda *given: (counts.append(given[2]), run(*given))
        assert_bitwise_equal(scene, engine, calls=(40,))
    assert counts == [9, 31]


def test_compiled_in_the_measured_sizes(monkeypatch):
    for module in (bands, passes):
        monkeypatch.setattr(module, "CACHE", 2**20)
    experiment = sheet(
        body={"type": "grid", "columns": 301, "rows": 257},
        leaders=[HOLD_LEFT, pull_right(0.3, 0.1, steps=50) | {"until": 45}],
        initial=NOISE,
        solver=SWUNG,
    )
    scene = build_scene(pbdkit.Experiment(**experiment))
    engine = CompiledStepper(scene, 2)
    assert engine._arrays["sizes"][0] == bands.DEEP
    assert_bitwise_equal(scene, engine, calls=(1, 2, 37, 16))


ONE_STEP = {
    "found anew": ({"neighbours": ANEW}, "neighbours are re-evaluated"),
    "many": ({"neighbours": MANY}, "there are many neighbours"),
}


@pytest.mark.parametrize(("parts", "why"), ONE_STEP.values(), ids=ONE_STEP)
def test_single_step_passes_have_a_reason(parts, why, monkeypatch):
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    solver = {"type": "stepping", "threads": 1} | parts.get("solver", {})
    scene = scene_of(**parts | {"solver": solver})
    assert single_steps(scene) == why
    assert "a pass" not in choose(scene).reason  # it stays in the cache anyway
    monkeypatch.setattr(passes, "CACHE", 0)
    assert choose(scene).reason.endswith(f"; one step per pass over the memory: {why}")


@pytest.mark.parametrize("threads", [1, 2])
def test_passes_of_several_steps_give_no_message(threads, monkeypatch):
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    monkeypatch.setattr(passes, "CACHE", 0)
    solver = {"type": "stepping", "threads": threads}
    assert "a pass" not in choose(scene_of(solver=solver)).reason


def test_frame_with_distant_particles_uses_one_step_per_pass(monkeypatch):
    monkeypatch.setattr(passes, "FARTHEST", 1)
    assert single_steps(scene_of()) == "frame points follow particles far away"
    near = Skew(scene_of(frame={"type": "none"}))
    assert near.along == (1, 1)
    assert np.all(np.array(Skew(scene_of()).along) > 1)
