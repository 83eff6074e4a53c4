"""Numbers that change with the steps: their values, and features that they can be combined with."""

import json
import math
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from scene_strategies import in_turn
from thread_ranks import on_ranks

import pbdkit
from pbdkit.components.elasticity import Elastic, StrainGradient
from pbdkit.equilibrium.load_stepping import moments
from pbdkit.errors import NotSharedError
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import RestingScene, scene_like
from pbdkit.io.explain import BondRecords
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.plugin import FollowerRule, FractureModel
from pbdkit.plugin.registry import Registry
from pbdkit.plugin.schedule import TimeDependent
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.forecast import forecast
from pbdkit.stepping.engine_choice import choose, kernel_obstacle
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.program import last_event
from pbdkit.stepping.state import initial_state
from pbdkit.web.session import Session
from tests.components.test_elasticity import NATURAL

pytestmark = pytest.mark.filterwarnings("ignore:frame. under 'mean'")


def time_dependent(steps, values):
    return {"steps": steps, "values": values}


HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
PULLED = {
    "select": {"edge": "right"},
    "motion": {"type": "velocity", "velocity": [0.05, 0.0], "steps": 12},
}
SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 9, "rows": 6},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "springs"},
    "leaders": [HELD, PULLED],
    "steps": 30,
    "record": {"every": 3},
}
FORCE = [{"select": {"edge": "top"}, "force": [0.0, time_dependent([2, 20], [0.0, 0.02])]}]
BREAKING = {"type": "strain", "failure": time_dependent([3, 25], [0.3, 0.02])}
CHANGING = {
    "relaxation": {"solver": {"relaxation": time_dependent([4, 20], [0.3, 1.0])}},
    "memory": {"solver": {"memory": time_dependent([0, 9, 20], [0.5, 0.9, 0.0])}},
    "limits": {"fracture": BREAKING},
    "thresholds": {
        "fracture": {"type": "threshold", "thresholds": [time_dependent([3, 25], [1.6, 1.43])]},
    },
    "both": {"fracture": BREAKING, "solver": {"relaxation": time_dependent([9, 10], [1.0, 0.4])}},
    "parameter": {"rule": {"type": "mixed-coordinate", "K": time_dependent([1, 9], [0.0, 0.01])}},
    "weights": {
        "rule": {"type": "elastic", "poisson_ratio": time_dependent([2, 15], [0.1, 0.4])},
        "solver": {"relaxation": 0.5},
    },
    "moves of another": {
        "rule": {"type": "strain-gradient", "poisson_ratio": 0.2,
                 "length": time_dependent([2, 15], [0.1, 0.6])},
        "solver": {"relaxation": 0.2},
    },
    "force": {"loads": FORCE, "frame": NATURAL},
    "with a field": {
        "regions": {"soft": {"type": "rectangle", "width": 4.0, "height": 9.0}},
        "rule": {"type": "elastic", "poisson_ratio": time_dependent([2, 15], [0.1, 0.4]),
                 "stiffness": {"otherwise": 1.0, "soft": 0.3}},
        "solver": {"relaxation": 0.5},
        "frame": NATURAL,
    },
}  # fmt: skip
COMPILED = (
    "relaxation", "memory", "limits", "thresholds", "both", "parameter", "force",
    "moves of another",
)  # fmt: skip


def sheet(*, engine="numpy", precision="float64", threads=1, **parts):
    solver = {"type": "stepping", "engine": engine, "precision": precision, "threads": threads}
    found = SHEET | parts
    if engine:
        found["solver"] = solver | parts.get("solver", {})
    return found


def same(one, other):
    return all(np.array_equal(one[n], other[n], equal_nan=True) for n in one.data_vars)


def now(part, step):
    """Parts of an experiment with numbers in place of schedules: by hand, as documented."""
    if isinstance(part, list):
        return [now(each, step) for each in part]
    if not isinstance(part, dict):
        return part
    if part.keys() == {"steps", "values"}:
        return float(np.interp(step, part["steps"], part["values"]))
    return {key: now(each, step) for key, each in part.items()}


knots = st.lists(
    st.tuples(st.integers(0, 60), st.floats(-5, 5)),
    min_size=1,
    max_size=6,
    unique_by=lambda k: k[0],
).map(sorted)


@given(knots)
def test_schedule_is_linear_between_steps_and_constant_beyond(known):
    steps, values = zip(*known, strict=True)
    time_dependent = TimeDependent[float](steps=steps, values=values)
    assert [time_dependent.at(step) for step in steps] == list(values)
    assert time_dependent.at(0) == values[0] or steps[0] == 0
    assert time_dependent.at(1000) == time_dependent.last == values[-1]
    for a, b in pairwise(steps):
        middle = (time_dependent.at(a) + time_dependent.at(b)) / 2
        assert time_dependent.at((a + b) / 2) == pytest.approx(middle, abs=1e-12)


@given(knots, st.integers(0, 70))
def test_the_next_change_is_the_next_step_with_another_value(known, step):
    steps, values = zip(*known, strict=True)
    time_dependent = TimeDependent[float](steps=steps, values=values)
    later = [n for n in range(step + 1, 100) if time_dependent.at(n) != time_dependent.at(step)]
    assert time_dependent.next_change(step) <= (later[0] if later else math.inf)
    if time_dependent.next_change(step) < math.inf and later:
        stays = [time_dependent.at(n) for n in range(step, int(time_dependent.next_change(step)))]
        assert set(stays) == {time_dependent.at(step)}
    assert max(time_dependent.breakpoints, default=0) >= max(
        (n for n in range(1, 100) if time_dependent.at(n) != time_dependent.at(n - 1)), default=0
    )


@pytest.mark.parametrize("name", CHANGING)
def test_each_step_equals_a_scene_with_the_values_at_its_end(name):
    parts = CHANGING[name]
    given_ = sheet(**parts)
    scene = build_scene(pbdkit.Experiment(**given_))
    stepper = Stepper(scene)
    state, plain = initial_state(scene), initial_state(scene)
    for step in range(1, 25):
        state = stepper.advance(state)
        plain = Stepper(build_scene(pbdkit.Experiment(**now(given_, step)))).advance(plain)
        np.testing.assert_array_equal(state.u, plain.u)
    assert state.broken_step is None or (state.broken_step > 0).any()


@pytest.mark.parametrize("name", in_turn(COMPILED, 2))
def test_kernels_follow_schedules_bit_for_bit(name, compiled_at_length):
    """`stepping/numba_engine/test_engine` compiles one that has several."""
    parts = CHANGING[name]
    one = pbdkit.run(sheet(**parts), progress=False)
    other = pbdkit.run(sheet(engine="compiled", **parts), progress=False)
    assert same(one, other)


@pytest.mark.parametrize("name", ["both", "memory"])
def test_kernels_follow_schedules_in_single_precision(name, compiled_at_length):
    """The agreement is approximate: kernels and numpy round differently there.
    `components/test_fracture` compiles kernels of single precision."""
    parts = CHANGING[name]
    one, other = (
        pbdkit.run(sheet(engine=engine, precision="float32", **parts), progress=False)
        for engine in ("numpy", "compiled")
    )
    np.testing.assert_allclose(other.position, one.position, rtol=0.0, atol=1e-6)
    double = pbdkit.run(sheet(**parts), progress=False)
    np.testing.assert_allclose(other.position, double.position, rtol=0.0, atol=1e-5)
    if "broken_step" in one:
        np.testing.assert_array_equal(other.broken_step, one.broken_step)


@pytest.mark.parametrize("name", sorted(set(CHANGING) - set(COMPILED)))
def test_numpy_replaces_kernels_with_a_reason(name):
    given_ = sheet(engine="auto", **CHANGING[name]) | {"steps": 10**9}
    choice = choose(build_scene(pbdkit.Experiment(**given_)))
    assert choice.engine == "numpy"
    assert "are time-dependent" in choice.reason
    with pytest.raises(pbdkit.ExperimentError, match=r"^solver\.engine: the compiled"):
        pbdkit.run(sheet(engine="compiled", **CHANGING[name]), progress=False)


@pytest.mark.parametrize("name", CHANGING)
def test_results_are_reproducible_from_the_dataset_alone(name, tmp_path):
    ds = pbdkit.run(sheet(**CHANGING[name]), progress=False)
    ds.to_netcdf(tmp_path / "out.nc")
    with xr.open_dataset(tmp_path / "out.nc") as kept:
        assert same(ds, pbdkit.rerun(kept.load(), progress=False))


@pytest.mark.parametrize("name", ["both", "force", "weights"])
def test_resumed_runs_equal_uninterrupted_ones(name, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file, steps in (("half", 14), ("whole", 30)):
        (tmp_path / f"{file}.yaml").write_text(
            json.dumps(sheet(**CHANGING[name]) | {"steps": steps})
        )
        assert call("run", f"{file}.yaml", "-o", f"{file}.nc").code == 0
    assert call("resume", "half.nc", "--steps", "30").code == 0
    with pbdkit.open("half.nc") as half, pbdkit.open("whole.nc") as whole:
        np.testing.assert_array_equal(half.position[-1], whole.position[-1])


FASTER = [
    "steps=100",
    "fracture.failure={steps: [10, 100], values: [0.2, 0.02]}",
    "record.every=1",
    "body.columns=11",
]
AGEING = pbdkit.load("modelling/ageing", settings=FASTER)
"""The shipped bar that ages, in a tenth of the steps and half as long."""


@pytest.fixture(scope="module")
def aged():
    return pbdkit.run(AGEING, progress=False)


def test_bar_that_ages_breaks_when_its_strength_equals_its_strain(aged):
    """Held at a strain of 4.05 %, while the strain at failure falls from 20 % to 2 %."""
    experiment = json.loads(aged.experiment)
    falls = experiment["fracture"]["failure"]
    at = np.interp(0.0405, falls["values"][::-1], falls["steps"][::-1])
    first = aged.broken_step.values[aged.broken_step.values > 0].min()
    assert first == math.floor(at) + 1


def test_equilibria_use_the_last_numbers():
    bar = SHEET | {
        "rule": {"type": "elastic", "poisson_ratio": 0.0,
                 "stiffness": time_dependent([0, 20], [1.0, 0.5])},
        "frame": NATURAL,
        "leaders": [HELD],
        "loads": [{"select": {"edge": "right"}, "force": [time_dependent([0, 30], [0, 0.1]), 0]}],
        "solver": {"type": "equilibrium", "tolerance": 1e-11},
        "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0}],
    }  # fmt: skip
    ds = pbdkit.run(bar, progress=False)
    u = ds.position[-1, -1, 0] - ds.reference[-1, 0]
    assert float(u) == pytest.approx(0.1 * 8.0 / (0.5 * 5.0), abs=1e-11)
    assert ds.reaction.values[-1, 0] == pytest.approx([-0.1, 0.0], abs=1e-11)


def test_increments_of_an_equilibrium_follow_schedules():
    """Bonds that age under a steady strain break within the increment in which the strength is
    reached, in step 90; then nothing holds the parts, and the last equilibrium is that before."""
    given_ = pbdkit.load("modelling/ageing", settings=[*FASTER, "solver={type: equilibrium}"])
    with pytest.raises(pbdkit.DivergedError, match="between step 89 and step 90") as error:
        pbdkit.run(given_, progress=False)
    kept = error.value.dataset
    assert kept.status == "separated"
    assert kept.time.values[-1] < 90
    assert (kept.broken_step.values < 0).all()
    assert {10, 100} <= set(moments(build_scene(given_), 1))


def test_increasing_loads_follow_their_path():
    """Springs under a pull that comes in one go and over the steps end where one way leads."""
    given_ = SHEET | {"frame": NATURAL, "leaders": [HELD], "solver": {"type": "equilibrium"}}
    ends = [
        pbdkit.run(
            given_ | {"loads": [{"select": {"edge": "right"}, "force": [force, 0.01]}]},
            progress=False,
        )
        for force in (0.4, time_dependent([0, 10, 20], [0.0, 0.1, 0.4]))
    ]
    np.testing.assert_allclose(ends[0].position[-1], ends[1].position[-1], atol=1e-7)


def test_measurements_of_a_step_use_its_values():
    """The force of the same displacements is half as large once the stiffness has come down to
    half."""
    stretched = SHEET | {
        "rule": {"type": "elastic", "poisson_ratio": 0.0,
                 "stiffness": time_dependent([0, 30], [1.0, 0.5])},
        "frame": NATURAL,
        "leaders": [HELD, {"select": {"edge": "right"}, "motion": {"type": "hold"}}],
        "initial": {"type": "affine", "gradient": [[0.01, 0.0], [0.0, 0.0]]},
        "diagnostics": [{"type": "stress", "youngs_modulus": 1.0},
                        {"type": "strain-energy", "youngs_modulus": 1.0}],
    }  # fmt: skip
    ds = pbdkit.run(stretched, progress=False)
    share = 1.0 - 0.5 * ds.time.values / 30
    np.testing.assert_allclose(ds.stress_xx.mean("particle"), 0.01 * share, atol=1e-12)
    energy = ds.strain_energy.values
    np.testing.assert_allclose(energy, energy[0] * share, rtol=1e-9)


def test_mass_is_accelerated_by_the_force_of_each_step():
    """So heavy that what neighbours exert counts for nothing: u = Σ Σ F / m."""
    force = time_dependent([1, 9], [0.0, 0.8])
    mass = {"type": "newton", "mass": 1e9, "force": [force, 0.0]}
    moved = {"select": {"edge": "right"}, "motion": mass}
    ds = pbdkit.run(SHEET | {"frame": NATURAL, "leaders": [HELD, moved]}, progress=False)
    pushes = np.interp(np.arange(1, 31), force["steps"], force["values"]) / 1e9
    u = (ds.position[-1] - ds.reference).values[-6:, 0]
    assert u.sum() == pytest.approx(np.cumsum(np.cumsum(pushes))[-1], rel=1e-6)


def test_check_warns_of_values_that_diverge_during_the_run(call, tmp_path):
    bad = SHEET | {
        "solver": {
            "type": "stepping",
            "relaxation": time_dependent([0, 10, 20], [1.0, 5.0, 1.0]),
        }
    }
    (tmp_path / "bad.yaml").write_text(json.dumps(bad))
    said = json.loads(call("check", str(tmp_path / "bad.yaml"), "--json").out)
    assert said["stable"]
    assert any("at step 10 steps diverge, with solver.relaxation 5" in w for w in said["warnings"])


def test_runs_do_not_converge_before_the_last_change():
    settling = {"type": "stepping", "settle": {"tolerance": 1e-3}}
    late = {"select": {"edge": "right"}, "force": [time_dependent([0, 400], [0, 0.1]), 0]}
    given_ = SHEET | {"frame": NATURAL, "leaders": [HELD], "loads": [late], "solver": settling}
    scene = build_scene(pbdkit.Experiment(**(given_ | {"steps": 5000})))
    assert last_event(scene) == 400
    ds = pbdkit.run(given_ | {"steps": 5000}, progress=False)
    assert ds.status == "settled"
    assert ds.time[-1] > 400


def test_members_of_a_sweep_are_distinguished_by_their_schedules():
    rises = [time_dependent([0, 10], [0.5, last]) for last in (0.8, 0.9)]
    vary = {"solver.relaxation": rises}
    found = pbdkit.sweep(sheet(solver={"relaxation": 1.0}), vary=vary, workers=1, progress=False)
    ends = [found.position.isel(relaxation=n, time=-1) for n in (0, 1)]
    assert abs(ends[0] - ends[1]).max() > 0


WRONG = {
    "order": ({"fracture": {"type": "strain", "failure": time_dependent([5, 5], [1, 2])}},
              r"fracture\.failure: steps should increase, but 5 follows 5"),
    "count": ({"fracture": {"type": "strain", "failure": time_dependent([5], [1, 2])}},
              r"fracture\.failure: 1 steps have 2 values"),
    "value": ({"fracture": {"type": "strain", "failure": time_dependent([1, 5], [1, -2])}},
              r"fracture\.failure: the last value: should be greater than 0, got -2"),
    "text": ({"fracture": {"type": "strain", "failure": time_dependent([1, 5], [1, "x"])}},
             r"fracture\.failure: values: 1: should be a valid number"),
    "no values": ({"fracture": {"type": "strain", "failure": {"steps": [1, 5]}}},
                  r"fracture\.failure: values: is missing"),
    "drawn": ({"fracture": BREAKING | {"scatter": 0.1}}, r"fracture\.failure: 'strain' draws"),
    "relaxation": ({"solver": {"type": "stepping", "relaxation": time_dependent([1, 2], [1, 0])}},
                   r"solver\.relaxation\.values\.1: should be greater than 0"),
    "in a field": ({"regions": {"a": {"type": "disc", "radius": 1.0, "centre": [0.0, 0.0]}},
                    "rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness":
                             {"otherwise": 1.0, "a": {"steps": [1], "values": [2.0]}}}},
                   r"rule\.stiffness: 'a' should be a number: values by region cannot vary"),
    "auto": ({"solver": {"type": "stepping", "relaxation": "auto",
                         "memory": time_dependent([1, 2], [0.1, 0.2])}},
             r"'auto' requires constant parameters"),
    "force": ({"loads": [{"select": {"edge": "top"}, "force": [0, time_dependent([1, 2], [0])]}],
               "frame": NATURAL}, r"loads\.0\.force\.1: 2 steps have 1 values"),
    "a motion": ({"leaders": [{"select": {"edge": "left"}, "motion":
                               {"type": "rotation", "angle": time_dependent([0], [1]),
                                "centre": [0, 0], "steps": 5}}]}, r"leaders\.0\.motion\.angle"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_invalid_schedules_are_refused_with_their_place(name):
    parts, said = WRONG[name]
    with pytest.raises(pbdkit.ExperimentError, match=said):
        pbdkit.run(SHEET | parts, progress=False)


def test_explain_gives_the_limit_at_the_step_of_breaking(aged):
    found = BondRecords(aged, build_scene(AGEING))
    broken = found.steps > 0
    limits = np.interp(found.steps[broken], [10, 100], [0.2, 0.02])
    np.testing.assert_allclose(found.limits[broken], limits, rtol=1e-12)


def test_schedule_without_effect_gives_a_warning():
    far = {"type": "disc", "radius": 1.0, "centre": [50.0, 50.0]}
    soft = {"type": "elastic", "stiffness": {"otherwise": 1.0, "far": 2.0}, "poisson_ratio": 0.3}
    scene = build_scene(
        pbdkit.Experiment(
            **SHEET | {"regions": {"far": far, "idle": far}, "rule": soft, "frame": NATURAL}
            | {"fracture": {"type": "strain", "failure": time_dependent([0, 99], [1.0, 0.5])}}
            | {"solver": {"type": "equilibrium"}}
        )
    )  # fmt: skip
    for said in (
        "regions.far: lies outside the body",
        "regions.idle: not referenced",
        "fracture.failure: changes until step 99, but the run ends with step 30",
    ):
        assert sum(warning.startswith(said) for warning in scene.warnings) == 1


def test_check_warns_of_loads_without_time_to_converge(call, tmp_path):
    given_ = SHEET | {"leaders": [HELD], "loads": FORCE, "frame": NATURAL}
    (tmp_path / "hasty.yaml").write_text(json.dumps(given_))
    said = json.loads(call("check", str(tmp_path / "hasty.yaml"), "--json").out)["warnings"]
    assert any(w.startswith("steps: under its loads the body converges in") for w in said)


class Leaning(pbdkit.FramePolicy):
    """Frame points follow the nearest particle and the body's lowest corner, by a number of the
    rule."""

    type: Literal["leaning"] = "leaning"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        points, first = np.unique(frame.nearest()[0], return_index=True)
        nearest = frame.nearest()[1][first]
        corner = frame.body_at(np.array([frame.low], np.int32))[0]
        share = getattr(frame.rule, "K", 0.0) + getattr(frame.rule, "poisson_ratio", 0.0)
        body = np.stack([nearest, np.full(len(points), corner)], axis=1).ravel()
        weight = np.tile([1.0 - share, share], len(points))
        return pbdkit.plugin.FrameMap(np.repeat(points, 2), body, weight)


FOLLOWING = {
    "parameter": {"rule": {"type": "mixed-coordinate", "K": time_dependent([1, 9], [0.0, 0.05])}},
    "weights": {
        "rule": {"type": "elastic", "poisson_ratio": time_dependent([2, 15], [0.1, 0.4])},
        "solver": {"relaxation": 0.5},
    },
    "limits": CHANGING["limits"]
    | {"rule": {"type": "elastic", "poisson_ratio": time_dependent([2, 15], [0.1, 0.4])}},
}
"""Time-dependent parameters under a frame that reads the rule."""


def leaning(**parts):
    """The sheet under a frame that reads the rule, as an experiment."""
    given_ = sheet(frame={"type": "leaning"}, **parts)
    return Experiment.build(Source(data=given_), [Leaning])


@pytest.mark.parametrize("name", FOLLOWING)
def test_frame_that_depends_on_the_rule_follows_its_schedule(name):
    parts = FOLLOWING[name]
    scene = build_scene(leaning(**parts))
    stepper = Stepper(scene)
    state, plain = initial_state(scene), initial_state(scene)
    for step in range(1, 25):
        state = stepper.advance(state)
        plain = Stepper(build_scene(leaning(**now(parts, step)))).advance(plain)
        np.testing.assert_array_equal(state.u, plain.u)


def test_independent_frame_is_built_once(monkeypatch):
    scene = build_scene(pbdkit.Experiment(**sheet(**CHANGING["weights"])))
    assert scene.at(3).frame is scene.frame
    scene = build_scene(leaning(**FOLLOWING["weights"]))
    assert scene.at(3).frame is not scene.frame


def test_kernels_leave_scheduled_frames_to_numpy():
    scene = build_scene(leaning(engine="auto", **FOLLOWING["parameter"]))
    assert "the weights of the frame are time-dependent" in kernel_obstacle(scene)


class Behind(StrainGradient):
    """Applies a rule to the moves of another, with weights that alone depend on the length."""

    type: Literal["behind"] = "behind"

    def inner(self):
        return Elastic(poisson_ratio=self.length, plane=self.plane)


def test_kernels_leave_inner_rules_with_scheduled_weights_to_numpy():
    rule = Behind(poisson_ratio=0.2, length=time_dependent([2, 15], [0.1, 0.4]))
    scene = build_scene(pbdkit.Experiment(**sheet(rule=rule)))
    assert kernel_obstacle(scene) == "constants of kernels are time-dependent"


def test_spectrum_during_the_run_uses_the_current_frame():
    parts = FOLLOWING["weights"]
    on_the_way = Analysis(build_scene(leaning(**parts)).at(5))
    anew = Analysis(build_scene(leaning(**now(parts, 5))))
    assert on_the_way.spectral_radius == anew.spectral_radius


@pytest.mark.parametrize("fracture", ["none", "strain"])
def test_equilibrium_uses_the_final_frame(fracture):
    """Numbers still change when the run ends, in increments where bonds can break."""
    parts = {
        "rule": {"type": "elastic", "poisson_ratio": time_dependent([0, 60], [0.1, 0.4])},
        "solver": {"type": "equilibrium", "tolerance": 1e-12},
        "fracture": {"type": "none"} if fracture == "none" else BREAKING | {"failure": 9.0},
    }
    ends = []
    for given_ in (parts, now(parts, 30)):
        given_ = SHEET | {"frame": {"type": "leaning"}} | given_
        ds = pbdkit.run(given_, components=[Leaning], progress=False)
        ends.append(ds.position.values[-1])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-11)


def test_changes_in_a_live_session_update_the_frame(tmp_path):
    session = Session(leaning(**now(FOLLOWING["weights"], 0)), tmp_path / "live.yaml")
    session.advance(5)
    session.turn("rule.poisson_ratio", 0.4)
    session.advance(5)
    run = Simulation.of_scene(build_scene(pbdkit.load(session.save().path, components=[Leaning])))
    for state in run:
        last = state.u.copy()
    np.testing.assert_array_equal(session.state.u, last)


def test_several_processes_leave_scheduled_frames_to_one():
    def begun(ranks):
        scene = ranks.scene(leaning(**FOLLOWING["parameter"]))
        with pytest.raises(NotSharedError, match=r"^frame: a frame that depends on time-dependent"):
            ranks.run(scene, Watch())
        return True

    assert all(on_ranks(2, begun))


def test_parameters_update_the_frame():
    one = leaning(**now(FOLLOWING["weights"], 30))
    other = Parameter("rule.poisson_ratio").put(one, 0.2)
    found, anew = scene_like(build_scene(one), other), build_scene(other)
    np.testing.assert_array_equal(found.frame.map.weight, anew.frame.map.weight)


@pytest.mark.parametrize("frame", ["natural", "mean"])
def test_sensitivities_use_the_values_of_the_last_step(frame):
    """The body responds to leaders that continue to move, with numbers that still change when the
    run ends."""
    moved = {"type": "displace", "displacement": [0.1, 0.2]}
    sheet_ = SHEET | {
        "rule": {"type": "elastic", "poisson_ratio": time_dependent([1, 9], [0.1, 0.45])},
        "frame": {"type": frame},
        "leaders": [HELD, {"select": {"edge": "right"}, "motion": moved}],
        "steps": 4,
        "solver": {"type": "equilibrium", "tolerance": 1e-12},
    }
    resting = RestingScene.of(pbdkit.Experiment(**sheet_))
    led = np.zeros_like(resting.state.u)
    led.reshape(2, -1)[0, resting.scene.leading[1].place] = 1.0
    expected = resting.change(Parameter("leaders.1.motion.displacement.0"))
    np.testing.assert_allclose(resting.answer(led), expected, rtol=0, atol=1e-11)


def test_parameters_of_selections_update_the_selection():
    boxed = {"select": {"box": [7.5, -1.0, 9.0, 9.0]}, "motion": PULLED["motion"]}
    one = pbdkit.Experiment(**sheet(leaders=[HELD, boxed]))
    other = Parameter("leaders.1.select.box.0").put(one, 6.5)
    found = scene_like(build_scene(one), other)
    assert found.leading[1].rows.tolist() == build_scene(other).leading[1].rows.tolist()


def experiment_of(parts):
    return pbdkit.Experiment(**sheet(**parts))


def test_check_evaluates_no_time_after_the_run():
    late = {"solver": {"relaxation": time_dependent([0, 20, 60, 80], [0.5, 0.8, 5.0, 0.5])}}
    assert not any("diverge" in w for w in forecast(build_scene(experiment_of(late))).warnings)
    late["solver"]["relaxation"] = time_dependent([0, 60], [5.0, 0.5])
    told = forecast(build_scene(experiment_of(late))).warnings
    assert any("at step 30 steps diverge, with solver.relaxation 2.75" in w for w in told)


SHIPPED = {
    "mixed-coordinate": ["K"],
    "springs": ["stiffness"],
    "elastic": ["poisson_ratio", "stiffness"],
    "orthotropic": ["poisson_ratio", "modulus_ratio", "shear_ratio", "stiffness"],
    "strain-gradient": ["poisson_ratio", "length", "stiffness"],
    "threshold": ["placement"],
    "strain": ["failure", "placement"],
    "damage": ["onset", "failure", "placement"],
    "cohesive": ["energy", "onset"],
}
"""The numbers of each shipped component that may change."""
GIVEN = {
    "orthotropic": {"poisson_ratio": 0.2, "modulus_ratio": 0.5, "shear_ratio": 0.3},
    "elastic": {"poisson_ratio": 0.3},
    "strain-gradient": {"poisson_ratio": 0.2, "length": 0.4},
    "mixed-coordinate": {"K": 0.01},
    "threshold": {"thresholds": [1.5]},
    "strain": {"failure": 0.03},
    "damage": {"onset": 0.02, "failure": 0.05},
    "cohesive": {"energy": 1e-3, "onset": 0.01},
}
MEASURED = [
    {"type": "stress", "youngs_modulus": 1.0},
    {"type": "strain-energy", "youngs_modulus": 1.0},
    {"type": "reaction", "youngs_modulus": 1.0},
]


def test_every_shipped_scheduled_parameter_is_compared():
    kinds = (FollowerRule, FractureModel)
    components = [c for kind in kinds for c in Registry().spellings(kind, installed=False)]
    known = {c.type_name(): sorted(c.numbers() - {"scatter"}) for c in components}
    known["cohesive"].remove("placement")  # lost bonds of a material exert nothing
    assert {name: sorted(numbers) for name, numbers in SHIPPED.items()} == {
        name: numbers for name, numbers in known.items() if numbers
    }


@pytest.mark.parametrize(
    ("kind", "number"),
    in_turn(((kind, number) for kind, own in SHIPPED.items() for number in own), 2),
)
def test_states_and_measurements_of_each_step_use_its_values(kind, number):
    """Compare every number that ships, with masses, guides and an obstacle, with a scene built
    again for each step."""
    part = {"type": kind} | GIVEN.get(kind, {})
    begins = part.get(number, 1.0)
    part[number] = time_dependent([1, 4], [begins, 1.2 * begins])
    rules = Registry().spellings(FollowerRule, installed=False)
    field = "rule" if kind in {rule.type_name() for rule in rules} else "fracture"
    calibrated = number != "placement" and kind != "mixed-coordinate"
    push = {"type": "newton", "mass": 5.0, "force": [0.02, 0.005]}
    wall = {"half_plane": {"point": [0.0, -0.02], "normal": [0.0, 1.0]}}
    given_ = {
        "body": {"type": "grid", "columns": 6, "rows": 4},
        "rule": {"type": "springs" if calibrated else "barycentre"},
        "frame": NATURAL if calibrated else {"type": "mean"},
        "leaders": [
            HELD,
            {"select": {"edge": "right"}, "motion": push} if calibrated else PULLED,
            {"select": {"box": [1.5, 2.5, 3.5, 3.5]}, "motion": HELD["motion"], "axes": ["y"]},
        ],
        "diagnostics": MEASURED if calibrated else [],
        "solver": {"relaxation": 0.2},
        field: part,
    }
    if kind != "strain-gradient":
        rises = {"type": "displace", "displacement": [0.0, 0.05]}
        given_["obstacles"] = [{"shape": wall, "motion": rises}]
    scene = build_scene(experiment_of(given_))
    stepper, tables = Stepper(scene), Tables(scene)
    state, plain = initial_state(scene), initial_state(scene)
    for step in range(1, 6):
        state = stepper.advance(state)
        anew = build_scene(experiment_of(now(given_, step)))
        plain = Stepper(anew).advance(plain)
        np.testing.assert_array_equal(state.u, plain.u)
        moments_ = StateMoment(state, tables), StateMoment(plain, Tables(anew))
        for diagnostic in scene.experiment.diagnostics:
            for one, other in zip(*map(diagnostic.measure, moments_), strict=True):
                np.testing.assert_array_equal(one, other)
