"""Every engine gives the numbers of the numpy engine, to the last bit."""

import time
from typing import Literal

import numba
import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from interpreted_kernels import interpreting
from property_cases import FRAMES, LATTICES, NEIGHBOURS, RULES, pull_right
from remembering_parts import Tiring, Weakest
from scene_strategies import (
    AT_LENGTH,
    calibrated_experiments,
    experiments,
    in_turn,
    pulled_apart,
    samples,
)
from turning_frame import Turning

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping import engine_choice as choice
from pbdkit.stepping.engine_choice import choose, make_engine
from pbdkit.stepping.numba_engine import arrays as stretches, engine as compiled_stepper
from pbdkit.stepping.numba_engine.cache import load_kernel, source_key
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

TORN = {
    "type": "threshold",
    "thresholds": [1.4371],
    "placement": 0.9,
    "cracks": [[[2.31, -1.7], [2.37, 1.2]]],
}


def sheet(**parts):
    experiment = {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 9, "rows": 7},
        "rule": {"type": "barycentre"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            pull_right(0.3, 0.1) | {"until": 9},
        ],
        "steps": 40,
    }
    return experiment | parts


def assert_bitwise_equal(scene, *engines, calls=(1, 2, 7, 1, 12)):
    """Assert that results depend neither on the number of steps in one call nor on the engine of
    earlier steps."""
    reference, oracle = initial_state(scene), Stepper(scene)
    states = [initial_state(scene) for _ in engines]
    for steps in calls:
        reference = oracle.advance(reference, steps)
        for n, engine in enumerate(engines):
            states[n] = engine.advance(states[n], steps)
            for name in ("u", "previous", "broken_step", "broken_length"):
                np.testing.assert_array_equal(getattr(states[n], name), getattr(reference, name))
            for name in ("bond_values", "particle_values"):
                for one, other in zip(
                    getattr(states[n], name), getattr(reference, name), strict=True
                ):
                    assert one.dtype == other.dtype
                    np.testing.assert_array_equal(one, other)
            assert states[n].step == reference.step
    return reference


@samples(20)
@given(experiments())
def test_kernel_logic_on_random_scenes(experiment):
    compare_interpreted(experiment)


@samples(20)
@given(experiments(leaders=pulled_apart(), fracturing=st.just(True)))
def test_kernel_logic_on_broken_scenes(experiment):
    compare_interpreted(experiment)


@samples(20)
@given(calibrated_experiments())
def test_kernel_logic_on_calibrated_scenes(experiment):
    compare_interpreted(experiment)


def compare_interpreted(experiment):
    try:
        scene = build_scene(pbdkit.Experiment(**experiment | {"steps": 10}))
        with interpreting():
            assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1, 2, 3, 4))
    except pbdkit.ExperimentError:  # leaders that contradict each other, perhaps on the way
        assume(False)


ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
CUT = {
    lattice: {
        "lattice": {"type": lattice, "a": 1.0},
        "neighbours": {"type": kind, "shells": 1},
        "rule": ELASTIC,
        "frame": {"type": "natural"},
        "body": {"type": "disc", "radius": 4.0, "centre": [3.0, 3.0]},
        "initial": {"type": "noise", "amplitude": 0.1},
        "leaders": [],
    }
    for lattice, kind in (("square", "chebyshev"), ("hexagonal", "coordination"))
}
SCATTERED = {"type": "strain", "failure": 0.25, "scatter": 0.2}
DAMAGE = {"type": "damage", "onset": 0.05, "failure": 0.35}
MANY = {"type": "chebyshev", "shells": 3}
ANEW = {"type": "euclidean", "radius": 1.5, "reevaluate": True}
TWICE = {
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "strain-gradient", "length": 0.5, "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "solver": {"type": "stepping", "relaxation": 0.05},
}
COMPONENTS = {
    **{f"rule {name}": {"rule": rule} for name, rule in RULES.items()},
    **{f"lattice {name}": {"lattice": part} for name, part in LATTICES.items()},
    **{f"neighbours {name}": {"neighbours": part} for name, part in NEIGHBOURS.items()},
    **{f"frame {name}": {"frame": part} for name, part in FRAMES.items()},
    "mirror frame": {"frame": {"type": "mirror"}},
    "euclidean": {"neighbours": {"type": "euclidean", "radius": 1.5, "weights": [1.0, 1.2]}},
    "fracture": {"fracture": TORN},
    "fracture, frame spared": {"fracture": TORN | {"frame_bonds": False}},
    "fracture, reference": {"fracture": TORN | {"fictitious": "reference"}},
    "fracture, no frame": {"fracture": TORN, "frame": {"type": "none"}},
    "relaxed, with memory": {"solver": {"type": "stepping", "relaxation": 0.7, "memory": 0.2}},
    "released where it would not rest": {
        "frame": {"type": "none"},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}, "until": 2}],
    },
    "noise": {"initial": {"type": "noise", "amplitude": 0.1}},
    **{f"natural frame, {name}": parts for name, parts in CUT.items()},
    "strength by bond in cut cells": CUT["square"]
    | {"fracture": SCATTERED, "initial": {"type": "noise", "amplitude": 0.3}},
    "disc": {"body": {"type": "disc", "radius": 4.0, "centre": [3.0, 3.0]}, "leaders": []},
    "strength by bond": {"fracture": SCATTERED},
    "strength by bond, no frame": {"fracture": SCATTERED, "frame": {"type": "none"}},
    "damage": {"fracture": DAMAGE},
    "damage by bond, frame spared": {"fracture": DAMAGE | {"scatter": 0.3, "frame_bonds": False}},
    "numbers of bonds, drawn and counted": {"fracture": Weakest(spread=0.3, weak=0.7)},
    "numbers of particles": {"rule": Tiring(spread=0.1)},
    "48 neighbours": {"neighbours": MANY},
    "48 neighbours, torn": {"neighbours": MANY, "fracture": SCATTERED, "frame": {"type": "none"}},
    "48 neighbours, numbers of particles": {"neighbours": MANY, "rule": Tiring()},
    "found anew": {"neighbours": ANEW},
    "found anew, by place": {"neighbours": ANEW, "rule": RULES["mixed-coordinate"]},
    "found anew, numbers of particles": {"neighbours": ANEW, "rule": Tiring(spread=0.1)},
    "moves of another": TWICE,
    "moves of another, with a frame": TWICE | {"frame": {"type": "mean"}},
    "moves of another, cut": TWICE | {"body": CUT["square"]["body"], "leaders": []},
}


@pytest.mark.parametrize("name", in_turn(COMPONENTS, 2))
def test_kernel_logic_for_every_component(name, interpreted, monkeypatch):
    scene = build_scene(pbdkit.Experiment(**sheet(**COMPONENTS[name])))
    assert_bitwise_equal(scene, CompiledStepper(scene))
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    assert choose(scene).engine == "compiled"


TOGETHER = {
    "frame": Turning(),
    "fracture": {
        "type": "strain",
        "failure": {"steps": [3, 20], "values": [0.6, 0.3]},
        "cracks": TORN["cracks"],
    },
    "cuts": [{"from": [5.5, 7.0], "to": [5.5, 4.6], "at": 6}],
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}, "axes": ["x"]},
        pull_right(0.3, 0.1) | {"until": 9},
    ],
    "obstacles": [
        {
            "shape": {"half_plane": {"point": [0.0, -0.3], "normal": [0.1, 1.0]}},
            "motion": {"type": "velocity", "velocity": [0.0, 0.1], "steps": 8},
        }
    ],
    "solver": {
        "type": "stepping",
        "relaxation": {"steps": [2, 9], "values": [0.8, 0.6]},
        "memory": 0.2,
    },
}
"""Matrices of a frame, and all that tears, guides and changes."""
COMPILED = {
    "two sublattices, by place, lag and memory": {
        "lattice": LATTICES["hexagonal"],
        "rule": RULES["mixed-coordinate-y"],
        "frame": FRAMES["lag"],
        "initial": {"type": "noise", "amplitude": 0.1},
        "solver": {"type": "stepping", "relaxation": 0.7, "memory": 0.2},
    },
    "48 neighbours that soften, drawn and counted": {
        "neighbours": MANY,
        "rule": Tiring(spread=0.1),
        "fracture": Weakest(spread=0.3, weak=0.7),
    },
    "found anew on a slanted lattice, numbers of particles": {
        "lattice": LATTICES["oblique"],
        "neighbours": ANEW,
        "rule": Tiring(spread=0.1),
    },
}
"""Each kind of code that kernels are made of, several together in each; those above are compiled
for threads, below, single precision in `components/test_fracture`, and the built-in functions, a
rule that moves by another and cells that soften too, in `testing/test_conformance`. The profile
`long` compiles every component above as well."""
if AT_LENGTH:
    COMPILED |= COMPONENTS | {"together": TOGETHER}


@pytest.mark.parametrize("parts", COMPILED.values(), ids=COMPILED)
def test_compiled_equals_numpy(parts):
    scene = build_scene(pbdkit.Experiment(**sheet(**parts)))
    reference = assert_bitwise_equal(scene, CompiledStepper(scene))
    assert not scene.has_fracture or (reference.broken_step > 0).any()
    assert reference.u.any()


THREADED = {
    "torn": {"fracture": TORN},
    "damaged, numbers of particles, frame spared": {
        "rule": Tiring(spread=0.1),
        "fracture": DAMAGE | {"scatter": 0.3, "frame_bonds": False},
    },
    "found anew": {"neighbours": ANEW},
    "moves of another": TWICE | {"frame": {"type": "mean"}},
}


@pytest.fixture
def banded(monkeypatch):
    """A scene large enough for several bands of rows."""
    monkeypatch.setattr(compiled_stepper, "BAND", 50)
    body = {"type": "grid", "columns": 24, "rows": 20}
    return lambda parts: build_scene(pbdkit.Experiment(**sheet(body=body, **parts)))


@pytest.mark.parametrize("parts", THREADED.values(), ids=THREADED)
def test_kernel_logic_on_any_number_of_threads(parts, banded, interpreted):
    scene = banded(parts)
    assert_bitwise_equal(scene, CompiledStepper(scene), CompiledStepper(scene, 2), calls=(1, 5))


def test_band_contains_at_least_one_row(interpreted, monkeypatch):
    monkeypatch.setattr(compiled_stepper, "BAND", 1)
    scene = build_scene(pbdkit.Experiment(**sheet(fracture=DAMAGE)))
    assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1,))


@pytest.mark.parametrize("parts", [TOGETHER, *(THREADED.values() if AT_LENGTH else ())])
def test_any_number_of_threads_gives_the_same(parts, banded):
    scene = banded(parts)
    reference = assert_bitwise_equal(scene, CompiledStepper(scene, 2))
    assert not scene.has_fracture or (reference.broken_step > 0).any()


@pytest.mark.parametrize("kind", ["whole", "torn"])
def test_different_stiffness_in_every_cell(kind, interpreted):
    parts = TWICE | {"rule": ELASTIC, "initial": {"type": "noise", "amplitude": 0.1}}
    if kind == "torn":
        parts |= {"fracture": SCATTERED}
    scene = build_scene(pbdkit.Experiment(**sheet(**parts)))
    share = scene.cells.share
    share *= np.random.default_rng(0).uniform(0.02, 1.0, share.shape)
    reference = assert_bitwise_equal(scene, CompiledStepper(scene))
    assert kind == "whole" or (reference.broken_step > 0).any()


@pytest.mark.parametrize("parts", [{"fracture": TORN}, CUT["hexagonal"]], ids=["torn", "cut"])
def test_row_kinds_affect_only_speed(parts, interpreted, monkeypatch):
    """Everything in the loop over slots, or as much as can be without."""
    scene = build_scene(pbdkit.Experiment(**sheet(**parts)))
    for short in (0, 100):
        monkeypatch.setattr(stretches, "SHORT", short)
        assert_bitwise_equal(scene, CompiledStepper(scene))


def test_a_thousand_neighbours_compile_in_seconds():
    scene = build_scene(pbdkit.Experiment(**sheet(neighbours=MANY | {"shells": 16})))
    assert max(map(len, scene.neighbourhood.slots)) == 1088
    began = time.process_time()
    engine = CompiledStepper(scene)
    assert time.process_time() - began < 10.0
    assert_bitwise_equal(scene, engine, calls=(1, 1))


@pytest.mark.parametrize("name", ["paper/d2", "paper/f2"])
def test_a_whole_run_is_the_same(name, interpreted):
    experiment = pbdkit.load(name, settings=["steps=40", "record.every=7"])
    compiled = pbdkit.load(name, settings=["steps=40", "record.every=7", "solver.engine=compiled"])
    one, other = pbdkit.run(experiment, progress=False), pbdkit.run(compiled, progress=False)
    for variable in one.variables:
        np.testing.assert_array_equal(one[variable], other[variable])


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_single_precision_stays_close(engine, interpreted):
    solver = {"type": "stepping", "engine": engine, "precision": "float32"}
    exact = pbdkit.run(sheet(steps=200), progress=False)
    single = pbdkit.run(sheet(steps=200, solver=solver), progress=False)
    error = abs(single.position - exact.position).max()
    assert 0.0 < error < 5e-6


class Halfway(pbdkit.FollowerRule):
    type: str = "halfway"

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return SHARE * total[0] / total[1]


SHARE = 0.5


APPLIED = """
@njit(cache=CACHED)
def run(out):
    out[0] = apply((2.0, 3.0), 0, 0)
"""


def test_an_edited_rule_never_runs_an_old_kernel(monkeypatch):
    out = np.empty(1)
    for share in (0.5, 0.25):
        monkeypatch.setitem(globals(), "SHARE", share)
        load_kernel(APPLIED, {"apply": Halfway.apply}, (out,))(out)
        assert out == Halfway.apply((2.0, 3.0), 0, 0)


class Uncompilable(Halfway):
    type: str = "uncompilable"

    @staticmethod
    def apply(total, here, p):
        return globals()["SHARE"] * total[0]


def test_uncompilable_rule_runs_slower_with_a_message(monkeypatch):
    monkeypatch.setattr(choice, "PATIENCE_S", 0.0)
    scene = build_scene(pbdkit.Experiment(**sheet(rule=Uncompilable(type="uncompilable"))))
    engine, made = make_engine(scene, choose(scene))
    assert engine.name == made.engine == "numpy"
    assert "the compiled engine is not available: FollowerRule 'uncompilable' failed" in made.reason


def test_small_scenes_are_not_compiled():
    scene = build_scene(pbdkit.load("paper/a"))
    assert choose(scene).engine == "numpy"


def test_large_scenes_are_compiled_unless_prevented(monkeypatch):
    experiment = sheet(body={"type": "grid", "columns": 400, "rows": 400}, steps=5000)
    scene = build_scene(pbdkit.Experiment(**experiment))
    assert choose(scene).engine == "compiled"
    monkeypatch.setattr(choice, "find_spec", lambda name: None)
    assert choose(scene).engine == "numpy"
    assert "pip install 'pbdkit[fast]'" in choose(scene).reason
    asked = experiment | {"solver": {"type": "stepping", "engine": "compiled"}}
    with pytest.raises(pbdkit.ExperimentError, match=r"solver.engine: .* numba is not installed"):
        choose(build_scene(pbdkit.Experiment(**asked)))


class Wedged(pbdkit.plugin.StartsCracked, pbdkit.FractureModel):
    """Never breaks a bond, and opens the initial crack."""

    type: Literal["wedged"] = "wedged"

    def segments(self):
        return [((6.5, 2.5), (6.5, 9.0))]

    def constants(self, slot):
        return {}

    @staticmethod
    def breaks(d, r, c, p):
        return d.x > 1e9

    @staticmethod
    def fictitious(u, r, p):
        return -0.1 * r


def test_initial_crack_that_opens_moves_the_body_from_the_first_step(interpreted):
    leaders = [{"select": {"edge": "left"}, "motion": {"type": "hold"}}]
    scene = build_scene(pbdkit.Experiment(**sheet(fracture=Wedged(), leaders=leaders)))
    assert assert_bitwise_equal(scene, CompiledStepper(scene)).u.any()


def test_particles_beyond_the_reach_of_leaders_are_untouched():
    body = {"type": "grid", "columns": 80, "rows": 30}
    leaders = [{"select": {"edge": "left"}, "motion": {"type": "displace", "displacement": [1, 0]}}]
    scene = build_scene(pbdkit.Experiment(**sheet(body=body, leaders=leaders)))
    engine, state = CompiledStepper(scene), initial_state(scene)
    state = engine.advance(state, 20)
    marked = np.nan
    state.u[:, :, 50:, :] = marked  # reading there spoils the result
    state.previous[:, :, 50:, :] = marked
    state = engine.advance(state, 15)
    assert np.isfinite(state.u[:, :, :40, :]).all()
    assert (state.u[0, 0, 2:36, 5] > 0).all()


def test_motion_propagates_through_frame_points_of_distant_particles(interpreted):
    """Frame points follow the particle in the middle, so that the edge moves one step after it."""
    pushed = {"type": "displace", "displacement": [0.1, 0.05]}
    leaders = [{"select": {"nearest": [[4.0, 3.0]]}, "motion": pushed}]
    scene = build_scene(pbdkit.Experiment(**sheet(frame=Turning(), leaders=leaders)))
    state = assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1, 1))
    block = scene.raster.body_block(0)
    assert block.of(state.u[0])[0].all()


FACTORS = np.array([0.5, 1.0])
WHOLE = np.int64(1)


@numba.njit
def halved(x):
    return SHARE * x


class Reads(Halfway):
    """Reads what can change in ways that are easily overlooked."""

    @staticmethod
    def apply(total, here, p, s=SHARE):
        def inner(x):
            return SHARE * x

        d, n = total
        return pbdkit.plugin.Vector(halved(inner(FACTORS[0] * d.x)) / (n + WHOLE), s * d.y / n)


@pytest.mark.parametrize(
    ("name", "value"), [("SHARE", 0.3), ("FACTORS", np.array([0.2, 1.0])), ("WHOLE", np.int64(3))]
)
def test_names_read_by_a_rule_are_part_of_its_kernel_key(monkeypatch, name, value):
    before = source_key(Reads.gather, Reads.apply)
    assert before == source_key(Reads.gather, Reads.apply)
    monkeypatch.setitem(globals(), name, value)
    assert source_key(Reads.gather, Reads.apply) != before


def test_indistinguishable_values_give_a_new_key_every_time(monkeypatch):
    monkeypatch.setitem(globals(), "FACTORS", [object()])
    assert source_key(Reads.apply) != source_key(Reads.apply)


def test_equal_functions_in_two_modules_have_separate_kernels():
    """A kernel that is kept finds its functions by their modules, which may be gone."""
    source = "def gather(d, r, w, p):\n    return d, 1.0\n"
    one, other, again = {"__name__": "one"}, {"__name__": "other"}, {"__name__": "one"}
    for names in (one, other, again):
        exec(source, names)
    assert source_key(one["gather"]) == source_key(again["gather"])
    assert source_key(one["gather"]) != source_key(other["gather"])
