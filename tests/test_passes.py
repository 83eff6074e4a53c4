"""Several steps in one pass over the memory give the numbers of one after the other, to the bit."""

from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from interpreted_kernels import interpreting
from property_cases import HOLD_LEFT, pull_right
from scene_strategies import calibrated_experiments, experiments, pulled_apart, samples
from test_engines import ANEW, COMPONENTS, DAMAGE, MANY, TWICE, assert_bitwise_equal, sheet

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping import choice, passes
from pbdkit.stepping.choice import choose
from pbdkit.stepping.compiled import blocks
from pbdkit.stepping.compiled.compiled_stepper import CompiledStepper
from pbdkit.stepping.passes import Skew, single_steps


@contextmanager
def small_passes(deep=4, band=3, tile=5):
    """Nothing counts as small enough for the cache, and there are several bands and tiles."""
    sizes = {"DEEP": deep, "BAND": band, "SHORTEST": tile, "ROW": 0, "CACHE": 0}
    with interpreting(), pytest.MonkeyPatch.context() as patch:
        for name, size in sizes.items():
            patch.setattr(blocks, name, size)
        patch.setattr(passes, "CACHE", 0)
        yield


def scene_of(**parts):
    return build_scene(pbdkit.Experiment(**sheet(**parts)))


IN_ONE_PASS = {
    name: parts
    for name, parts in COMPONENTS.items()
    if not single_steps(build_scene(pbdkit.Experiment(**sheet(**parts))))
}


def test_most_components_can_go_several_steps_a_pass():
    assert len(IN_ONE_PASS) >= 30
    assert {"fracture", "relaxed, with memory", "natural frame, hexagonal"} <= set(IN_ONE_PASS)


@pytest.mark.parametrize("parts", IN_ONE_PASS.values(), ids=IN_ONE_PASS)
def test_every_component(parts):
    with small_passes():
        scene = scene_of(**parts)
        assert_bitwise_equal(scene, CompiledStepper(scene))


SIZES = (st.integers(2, 7), st.integers(1, 4), st.integers(1, 6))
CALLS = st.lists(st.integers(1, 9), min_size=1, max_size=4)


@samples(25)
@given(experiments(), CALLS, *SIZES)
def test_random_scenes(experiment, calls, deep, band, tile):
    compare(experiment, calls, deep, band, tile)


@samples(15)
@given(experiments(leaders=pulled_apart(), fracturing=st.just(True)), CALLS, *SIZES)
def test_torn_scenes(experiment, calls, deep, band, tile):
    compare(experiment, calls, deep, band, tile)


@samples(15)
@given(calibrated_experiments(), CALLS, *SIZES)
def test_calibrated_scenes(experiment, calls, deep, band, tile):
    compare(experiment, calls, deep, band, tile)


def compare(experiment, calls, *sizes):
    try:
        scene = build_scene(pbdkit.Experiment(**experiment | {"steps": sum(calls)}))
        assume(not single_steps(scene))
        with small_passes(*sizes):
            assert_bitwise_equal(scene, CompiledStepper(scene), calls=calls)
    except pbdkit.ExperimentError:  # leaders that contradict each other, perhaps on the way
        assume(False)


NOISE = {"type": "noise", "amplitude": 0.1}


def test_steps_too_near_each_other_would_spoil_the_numbers(monkeypatch):
    monkeypatch.setattr(Skew, "along", (0, 0))
    with small_passes():
        scene = scene_of(initial=NOISE)
        engine = CompiledStepper(scene)
        with pytest.raises(AssertionError, match="not equal"):
            assert_bitwise_equal(scene, engine, calls=(1, 9))


def test_where_moving_leaders_go_is_known_for_many_steps(monkeypatch):
    """One call of the kernel makes them, and stops where a group is released."""
    scene = scene_of(steps=40)
    with small_passes():
        engine = CompiledStepper(scene)
        run, counts = engine._run, []
        engine._run = lambda *given: (counts.append(given[2]), run(*given))
        assert_bitwise_equal(scene, engine, calls=(40,))
    assert counts == [9, 31]


def test_compiled_in_the_sizes_that_were_measured(monkeypatch):
    for module in (blocks, passes):
        monkeypatch.setattr(module, "CACHE", 2**20)
    experiment = sheet(
        body={"type": "grid", "columns": 301, "rows": 257},
        leaders=[HOLD_LEFT, pull_right(0.3, 0.1, steps=50) | {"until": 45}],
        initial=NOISE,
        solver={"type": "stepping", "relaxation": 0.7, "memory": 0.2},
    )
    scene = build_scene(pbdkit.Experiment(**experiment))
    engine = CompiledStepper(scene)
    assert engine._arrays["sizes"][0] == blocks.DEEP
    assert_bitwise_equal(scene, engine, calls=(1, 2, 37, 16))


ONE_STEP = {
    "found anew": ({"neighbours": ANEW}, "neighbours are found anew"),
    "moves of another": (TWICE, "the rule moves by another's moves"),
    "many": ({"neighbours": MANY}, "there are many neighbours"),
    "damage": ({"fracture": DAMAGE}, "bonds remember"),
    "lag": ({"frame": {"type": "mean", "lag": 1}}, "the frame lags"),
    "rollers": (
        {"leaders": [{"select": {"edge": "left"}, "axes": ["x"], "motion": {"type": "hold"}}]},
        "leaders lead along an axis",
    ),
}


@pytest.mark.parametrize(("parts", "why"), ONE_STEP.values(), ids=ONE_STEP)
def test_what_goes_one_step_a_pass_says_why(parts, why, monkeypatch):
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    solver = {"type": "stepping", "threads": 1} | parts.get("solver", {})
    scene = scene_of(**parts | {"solver": solver})
    assert single_steps(scene) == why
    assert "a pass" not in choose(scene).reason  # it stays in the cache anyway
    monkeypatch.setattr(passes, "CACHE", 0)
    assert choose(scene).reason.endswith(f"; one step a pass over the memory: {why}")


def test_what_goes_several_steps_a_pass_says_nothing_unless_there_are_threads(monkeypatch):
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    monkeypatch.setattr(passes, "CACHE", 0)
    for threads, said in ((1, ""), (2, "; one step a pass over the memory: there are several")):
        solver = {"type": "stepping", "threads": threads}
        reason = choose(scene_of(solver=solver)).reason
        assert (said in reason) if said else ("a pass" not in reason)


def test_a_frame_that_follows_from_afar_goes_one_step_a_pass(monkeypatch):
    monkeypatch.setattr(passes, "FARTHEST", 1)
    assert single_steps(scene_of()) == "frame points follow particles far away"
    near = Skew(scene_of(frame={"type": "none"}))
    assert near.along == near.reach == (1, 1)
    assert np.all(np.array(Skew(scene_of()).along) > 1)
