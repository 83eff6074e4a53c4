"""One run: states follow one after the other, and the caller may keep them."""

from __future__ import annotations

import ast
import copy
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium.error_bound import Pace
from pbdkit.io.sinks import MemorySink
from pbdkit.model.solver import Equilibrium, Solver
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import DRIVERS, Simulation, SteppingDriver, record
from pbdkit.stepping.divergence import Guard
from pbdkit.stepping.state import State

SOLVERS = {
    "stepping": {"type": "stepping"},
    "memory": {"type": "stepping", "memory": 0.5},
    "compiled": {"type": "stepping", "engine": "compiled"},
    "settle": {"type": "stepping", "settle": {"tolerance": 1e-4}},
    "equilibrium": {"type": "equilibrium"},
}


def scene_of(given: dict[str, Any], **parts: Any) -> Scene:
    return build_scene(pbdkit.Experiment(**given | parts))


def test_every_solver_has_a_driver_and_only_its_parameters() -> None:
    assert set(DRIVERS) == set(Solver.__subclasses__())
    assert set(Equilibrium.model_fields) == {"type", "method", "tolerance", "increments", "control"}
    assert not hasattr(Equilibrium(), "relaxation")


def test_no_code_tests_the_class_of_a_solver() -> None:
    asked = []
    for path in Path(pbdkit.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
                names = {getattr(n, "id", "") for n in ast.walk(node.args[1])}
                asked += [path.name] if names & {"Stepping", "Equilibrium"} else []
    assert asked == []


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_states_of_a_run_are_the_recorded_ones(
    tensile: dict[str, Any], solver: dict[str, Any]
) -> None:
    given = tensile | {"solver": solver, "steps": 500, "record": {"every": 7}}
    run = Simulation.of_scene(scene_of(given))
    assert run.outcome is None
    places = {state.step: run.scene.raster.table(state.u).copy() for state in run}
    assert run.outcome is not None
    ds = pbdkit.run(given, progress=False)
    assert run.outcome.status == ds.attrs["status"]
    assert run.outcome.stop_reason == ds.attrs["stop_reason"]
    assert set(ds.time.values) <= set(places)
    for step in ds.time.values:
        there = ds.position.sel(time=step) - ds.reference
        np.testing.assert_allclose(there, places[step], atol=1e-14)
    assert max(places) == ds.time[-1] == run.outcome.steps


def test_run_can_be_observed_between_records_and_changed(tensile: dict[str, Any]) -> None:
    given = tensile | {"leaders": tensile["leaders"][:1], "record": {"at": [0]}}
    run = Simulation.of_scene(scene_of(given, diagnostics=[{"type": "track", "numbers": [13]}]))
    steps, moved = [], 0.0
    for state in run:
        steps.append(state.step)
        if state.step == 4:
            state.u[0] += 1.0
        if state.step == 5:
            moved = float(state.u[0].max())
    assert steps == list(range(11))
    assert 0.5 < moved <= 1.0


@pytest.mark.parametrize("solver", ["stepping", "memory", "compiled"])
def test_run_continues_from_a_state(tensile: dict[str, Any], solver: str) -> None:
    given = tensile | {"solver": SOLVERS[solver], "steps": 60}
    kept: State | None = None
    whole = Simulation.of_scene(scene_of(given))
    for state in whole:
        if state.step == 23:
            kept = state.copy()
    rest = Simulation.of_scene(scene_of(given), start=kept)
    assert [state.step for state in rest] == list(range(23, 61))
    assert np.array_equal(rest.driver.state.u, whole.driver.state.u)
    assert rest.outcome == whole.outcome


def test_convergence_depends_only_on_data(
    tensile: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is stopped, and continued from its state, guard and pace, has the same end."""
    # Calls are not cut short where the machine is busy.
    monkeypatch.setattr("pbdkit.simulation.MAX_CALL_S", 1e6)
    given = tensile | {"solver": SOLVERS["settle"], "steps": 5000, "record": {"at": [0]}}
    whole, left = Simulation.of_scene(scene_of(given)), Simulation.of_scene(scene_of(given))
    steps = [state.step for state in whole]
    middle = steps[len(steps) // 2]
    for state in left:
        if state.step == middle:
            break
    driver, state = left.driver, left.driver.state.copy()
    assert isinstance(driver, SteppingDriver)
    assert driver.monitor is not None
    rest = Simulation.of_scene(scene_of(given), start=state)
    assert isinstance(rest.driver, SteppingDriver)
    assert rest.driver.monitor is not None
    rest.driver.guard = Guard(**vars(copy.deepcopy(driver.guard)))
    rest.driver.monitor.pace = Pace(**dataclasses.asdict(driver.monitor.pace))
    assert [state.step for state in rest] == steps[steps.index(middle) :]
    assert rest.outcome is not None
    assert whole.outcome is not None
    assert (rest.outcome.status, rest.outcome.steps) == ("settled", whole.outcome.steps)


@pytest.mark.parametrize("solver", ["stepping", "equilibrium"])
def test_observer_can_stop_a_run(tensile: dict[str, Any], solver: str) -> None:
    given = tensile | {"solver": SOLVERS[solver], "record": {"at": [0]}, "steps": 10**6}
    told: list[str] = []
    watch = Watch(lambda: len(told) > 2, lambda what, share: told.append(what))
    sink, run = MemorySink(), Simulation.of_scene(scene_of(given), watch=watch)
    report = record(run, sink)
    assert report.outcome.status == "interrupted"
    assert told[0] == {"stepping": "step 0 of 1000000", "equilibrium": "assembling"}[solver]
    assert sink.dataset().time[-1] == report.outcome.steps < 10**6


def test_equilibrium_before_the_first_step_is_found_again(tensile: dict[str, Any]) -> None:
    """Leaders hold their particles at time 0, too, where the rule would move these."""
    simulation = Simulation(tensile | {"frame": {"type": "none"}, "fracture": {"type": "none"}})
    simulation.equilibrate()
    first = simulation.driver.state.u.copy()
    assert simulation.equilibrate().residual < 1e-12
    np.testing.assert_allclose(simulation.driver.state.u, first, atol=1e-12)


def test_python_and_command_give_the_same_warnings(call: Any, tensile: dict[str, Any]) -> None:
    doubtful = tensile | {"leaders": [], "solver": {"type": "stepping", "relaxation": 1.5}}
    Path("doubtful.json").write_text(json.dumps(doubtful))
    lines = call("run", "doubtful.json").err.splitlines()
    said = [line.removeprefix("warning: ") for line in lines]
    with pytest.warns(pbdkit.PbdkitWarning) as told:
        pbdkit.run(doubtful, progress=False)
    texts = [str(warning.message) for warning in told]
    assert texts == said[: len(texts)]
    # Warnings that need an analysis are in its result.
    assert {*said[len(texts) :]} <= {*pbdkit.analyse(doubtful).warnings()}
    assert {warning.filename for warning in told} == {__file__}
    assert any("nothing moves" in text for text in said)
    assert any("can diverge" in text for text in said)


def test_an_unbounded_relaxation_is_refused(tensile: dict[str, Any]) -> None:
    with pytest.raises(pbdkit.ExperimentError, match=r"solver.relaxation: .*1e\+?06|1000000"):
        pbdkit.Experiment(**tensile | {"solver": {"type": "stepping", "relaxation": 1e300}})


@pytest.mark.parametrize("relaxation", [1e6, 1e-300])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_overflow_gives_no_numpy_warning(tensile: dict[str, Any], relaxation: float) -> None:
    solver = {"type": "stepping", "relaxation": relaxation, "memory": 1e6}
    with (
        pytest.warns(pbdkit.PbdkitWarning, match="can diverge"),
        pytest.raises(pbdkit.DivergedError),
    ):
        pbdkit.run(tensile | {"solver": solver, "steps": 200}, progress=False)


def test_reason_for_an_engine_is_correct_for_a_large_body(tensile: dict[str, Any]) -> None:
    body = {"type": "grid", "columns": 300, "rows": 300}
    run = Simulation.of_scene(scene_of(tensile, body=body, steps=1))
    assert run.choice.engine == "numpy"
    assert "small" not in run.choice.reason
    assert run.choice.reason.endswith("s in total; compiling would take longer")


def test_rerun_warns_of_other_versions(tensile: dict[str, Any], install: Any) -> None:
    source = (
        "import pbdkit\nfrom typing import Literal\n"
        "class Same(pbdkit.FollowerRule):\n"
        "    type: Literal['same'] = 'same'\n"
        "    @staticmethod\n"
        "    def gather(d, r, w, p): return d, 1.0\n"
        "    @staticmethod\n"
        "    def apply(total, here, p): return total[0] / total[1]\n"
        "@pbdkit.hookimpl\ndef pbdkit_components(): return [Same]\n"
    )
    install("pbdkit-same", source, "0.3")
    ds = pbdkit.run(tensile | {"rule": {"type": "same"}}, progress=False)
    again = pbdkit.rerun(ds, progress=False)
    assert np.array_equal(again.position, ds.position)
    made_by = json.loads(ds.attrs["plugins"])
    ds.attrs["plugins"] = json.dumps(made_by | {"pbdkit-same": "9.9"})
    with pytest.warns(pbdkit.PbdkitWarning, match=r"made by pbdkit-same 9\.9, run again by 0\.3"):
        pbdkit.rerun(ds, progress=False)


def test_rerun_warns_of_another_pbdkit(tensile: dict[str, Any]) -> None:
    ds = pbdkit.run(tensile, progress=False)
    ds.attrs["plugins"] = json.dumps({"pbdkit": "9.9"})
    here = re.escape(pbdkit.__version__)
    with pytest.warns(pbdkit.PbdkitWarning, match=rf"made by pbdkit 9\.9, run again by {here}"):
        pbdkit.rerun(ds, progress=False)


@pytest.mark.parametrize("name", ["experiment", "plugins"])
@pytest.mark.parametrize("value", ["{", "[1]", 3])
def test_damaged_attribute_is_reported(tensile: dict[str, Any], name: str, value: Any) -> None:
    ds = pbdkit.run(tensile, progress=False)
    ds.attrs[name] = value
    with pytest.raises(pbdkit.StorageError, match=f"attribute '{name}' is damaged"):
        pbdkit.rerun(ds, progress=False)


STEPPED = {
    "numpy": {"type": "stepping", "engine": "numpy", "memory": 0.5},
    "compiled": {"type": "stepping", "engine": "compiled"},
    "settle": {"type": "stepping", "settle": {"tolerance": 1e-4}},
}
TRACK = {"type": "track", "numbers": [13]}


def same_values(one: Any, other: Any) -> None:
    """Assert that all variables of two datasets are equal, except time and reason of their end."""
    assert {*one.variables} == {*other.variables}
    for name, variable in one.variables.items():
        np.testing.assert_array_equal(variable, other.variables[name])


@pytest.mark.parametrize("solver", STEPPED.values(), ids=STEPPED)
def test_manual_steps_equal_those_of_a_run(tensile: dict[str, Any], solver: dict[str, Any]) -> None:
    given = tensile | {"solver": solver, "steps": 500, "diagnostics": [TRACK]}
    whole = pbdkit.run(given, progress=False)
    simulation = pbdkit.Simulation(given)
    with simulation.record() as recording:
        for n in (0, 1, 2, 57, 340):
            simulation.step(n)
            if simulation.outcome is None:
                now = whole.sel(time=simulation.time)
                np.testing.assert_array_equal(simulation.state.position, now.position)
        simulation.run()
    same_values(recording.dataset, whole)
    assert recording.dataset.status == whole.status == simulation.outcome.status
    assert simulation.time == whole.time[-1]


def test_state_has_the_labels_of_a_run_and_is_unchanged(tensile: dict[str, Any]) -> None:
    given = tensile | {"steps": 20, "fracture": {"type": "threshold", "thresholds": [1.02]}}
    given |= {"diagnostics": [{"type": "displacement"}]}
    whole, simulation = pbdkit.run(given, progress=False), pbdkit.Simulation(given)
    simulation.step(12)
    state, then = simulation.state, whole.sel(time=12)
    before = state.position.copy()
    simulation.step(8)
    np.testing.assert_array_equal(state.position, before)
    assert not state.u.values.flags.writeable
    for name in ("position", "kind", "u", *state.coords):
        assert then[name].dims == state[name].dims
        np.testing.assert_array_equal(then[name], state[name])
        assert then[name].attrs.keys() == state[name].attrs.keys()
    broke = np.where(whole.broken_step <= 12, whole.broken_step, -1)
    np.testing.assert_array_equal(state.broken_step, broke)
    assert (state.broken_step >= 0).any()
    assert state.pbd.experiment() == pbdkit.Experiment(**given)


def test_partial_recording_begins_and_ends_with_the_current_state(
    tensile: dict[str, Any], tmp_path: Path
) -> None:
    given = tensile | {"steps": 40, "record": {"every": 5}}
    whole, simulation = pbdkit.run(given, progress=False), pbdkit.Simulation(given)
    simulation.step(12)
    with simulation.record(tmp_path / "part.nc") as recording:
        simulation.step(11)
        with pytest.raises(pbdkit.ExperimentError, match="record: recording has not ended"):
            _ = recording.dataset
    simulation.step(1)
    with pbdkit.open(tmp_path / "part.nc") as part:
        assert part.time.values.tolist() == [12, 15, 20, 23]
        assert (part.status, part.stop_reason) == ("interrupted", "stopped after step 23")
        at = part.position.sel(time=[15, 20])
        np.testing.assert_array_equal(at, whole.position.sel(time=[15, 20]))
    with pytest.raises(pbdkit.ExperimentError, match=r"part\.nc.* exists"):
        simulation.record(tmp_path / "part.nc")
    with pbdkit.resume(tmp_path / "part.nc", steps=40, progress=False) as longer:
        np.testing.assert_array_equal(longer.position[-1], whole.position[-1])


def test_simulation_recorded_to_its_end_is_complete(
    tensile: dict[str, Any], tmp_path: Path
) -> None:
    given = tensile | {"steps": 30}
    simulation = pbdkit.Simulation(given)
    with simulation.record(tmp_path / "out.nc"), simulation.record() as other:
        simulation.step(30)
    with pbdkit.open(tmp_path / "out.nc") as ds:
        assert ds.status == "complete"
        same_values(ds, pbdkit.run(given, progress=False))
        same_values(ds, other.dataset)
    for refused in (simulation.step, simulation.record):
        with pytest.raises(pbdkit.ExperimentError, match="has ended: completed all steps"):
            refused()


def test_intermediate_equilibrium_is_recorded_and_continued(tensile: dict[str, Any]) -> None:
    simulation = pbdkit.Simulation(tensile | {"steps": 40})
    with simulation.record() as recording:
        simulation.step(20)
        error_bound = simulation.equilibrate()
        rest = simulation.state
        simulation.step(1)
    straight = tensile | {"steps": 20, "solver": {"type": "equilibrium"}}
    expected = pbdkit.run(straight, progress=False).position[-1]
    np.testing.assert_allclose(rest.position, expected, rtol=0, atol=1e-9)
    assert error_bound.share < 1e-8
    assert simulation.time == 21
    ds = recording.dataset
    assert ds.time.values.tolist() == list(range(22))
    np.testing.assert_array_equal(ds.position.sel(time=20), rest.position)
    # Leaders rest from step 10 on: what is at rest stays.
    np.testing.assert_allclose(ds.position[-1], rest.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_recording_begins_with_the_equilibrium_at_its_first_step(
    tensile: dict[str, Any], steps: int
) -> None:
    simulation = pbdkit.Simulation(tensile | {"steps": 12, "record": {"every": 5}})
    simulation.step(7)
    before = simulation.state
    with simulation.record() as recording:
        simulation.equilibrate()
        rest = simulation.state
        simulation.step(steps)
    ds = recording.dataset
    assert ds.time.values.tolist() == sorted({7, 7 + steps})
    assert not np.array_equal(rest.position, before.position)
    np.testing.assert_array_equal(ds.position.sel(time=7), rest.position)


def test_equilibrium_of_the_solver_equals_that_of_a_run(tensile: dict[str, Any]) -> None:
    given = tensile | {"solver": {"type": "equilibrium"}}
    simulation = pbdkit.Simulation(given)
    with pytest.raises(pbdkit.ExperimentError, match=r"solver: .* call run\(\) or equilibrate\(\)"):
        simulation.step()
    assert str(simulation.equilibrate()).startswith("within ")
    whole = pbdkit.run(given, progress=False)
    np.testing.assert_array_equal(simulation.state.position, whole.position[-1])


def test_a_simulation_starts_from_the_state_of_another(tensile: dict[str, Any]) -> None:
    given = tensile | {"steps": 40}
    whole, first = pbdkit.run(given, progress=False), pbdkit.Simulation(given)
    first.step(15)
    second = pbdkit.Simulation(given, start=first)
    third = pbdkit.Simulation(given, settings={"solver.relaxation": 0.5}, start=first)
    first.run()
    for simulation in (second, third):
        assert simulation.time == 15
        simulation.run()
    np.testing.assert_array_equal(second.state.position, whole.position[-1])
    assert not np.array_equal(third.state.position, whole.position[-1])
    wider = given | {"body": {"type": "grid", "columns": 11, "rows": 10}}
    with pytest.raises(pbdkit.ExperimentError, match="start: its state belongs to another body"):
        pbdkit.Simulation(wider, start=first)
    with pytest.raises(pbdkit.ExperimentError, match="start: its state is that of step 40"):
        pbdkit.Simulation(given | {"steps": 20}, start=first)


def test_steps_beyond_the_experiment_are_refused(tensile: dict[str, Any]) -> None:
    simulation = pbdkit.Simulation(tensile | {"steps": 30})
    simulation.step(10)
    message = r"step: 25 more steps exceed the 30 .* 10 are made; .*{'steps': 35}"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        simulation.step(25)
    for n in (-1, 1.0, True):
        with pytest.raises(pbdkit.ExperimentError, match="step: expected a number of steps"):
            simulation.step(n)
    assert simulation.time == 10


def test_diverging_simulation_raises_and_its_recording_is_kept(
    tensile: dict[str, Any],
) -> None:
    given = tensile | {"steps": 4000, "solver": {"type": "stepping", "relaxation": 2.5}}
    with pytest.warns(pbdkit.errors.StabilityWarning, match="can diverge"):
        simulation = pbdkit.Simulation(given)
    with (
        pytest.raises(pbdkit.DivergedError, match=" diverged under rule "),
        simulation.record() as kept,
    ):
        simulation.step(4000)
    assert kept.dataset.status == "diverged"
    assert simulation.outcome.status == "diverged"


def test_error_in_the_block_keeps_the_records(tensile: dict[str, Any]) -> None:
    simulation = pbdkit.Simulation(tensile | {"steps": 30})

    def fail() -> None:
        with simulation.record() as recording:
            kept.append(recording)
            simulation.step(3)
            raise KeyError

    kept: list[Any] = []
    with pytest.raises(KeyError):
        fail()
    assert kept[0].dataset.time.values.tolist() == [0, 1, 2, 3]
