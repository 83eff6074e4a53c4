"""Operations that components bring along are stepped by every engine as the built-in ones are."""

import json
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np
import particle_operations
import pytest
from interpreted_kernels import interpreting
from particle_operations import Drag, Wind
from property_cases import HOLD_LEFT, pull_right
from thread_ranks import on_ranks

import pbdkit
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record
from pbdkit.stepping.engine_choice import gpu_obstacle
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numba_engine.time_skewing import single_steps
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state
from tests.mpi.test_distributed_run import assert_same, written
from tests.stepping.numba_engine.test_engine import TORN, assert_bitwise_equal, sheet
from tests.stepping.numba_engine.test_time_skewing import small_passes
from tests.test_restart import assert_same as assert_same_file, run_in_parts

MIDDLE = {"box": [2.5, 1.5, 6.5, 5.5]}
CASES = {
    "drag": {"operations": [Drag(select=MIDDLE)]},
    "drag on all, torn": {
        "operations": [Drag(select={"box": [0.0, 0.0, 9.0, 9.0]}, factor=0.5)],
        "fracture": TORN | {"thresholds": [1.2]},
        "solver": {"type": "stepping", "relaxation": 0.7, "memory": 0.2},
    },
    "wind, and drag of what it does": {
        "operations": [Wind(select={"edge": "top"}), Drag(select={"edge": "top"})],
        "frame": {"type": "mean", "lag": 1},
    },
    "on rollers": {
        "operations": [Drag(select={"edge": "right"})],
        "leaders": [HOLD_LEFT, pull_right(0.2, 0.0) | {"axes": ["x"]}],
    },
}
EVERY = pytest.mark.parametrize("parts", CASES.values(), ids=CASES)


def scene_of(**parts):
    return build_scene(pbdkit.Experiment(**sheet(**parts)))


def test_drag_reduces_each_step_by_its_fraction():
    free, dragged = scene_of(), scene_of(**CASES["drag"])
    state, other = (Stepper(s).advance(initial_state(s), 3) for s in (free, dragged))
    before = other.copy()
    state = Stepper(free).advance(other.copy())
    other = Stepper(dragged).advance(other)
    place = dragged.operations[0].place
    u, new, found = (each.u.reshape(2, -1) for each in (before, state, other))
    assert len(place) == 16
    np.testing.assert_allclose(found[:, place], 0.75 * new[:, place] + 0.25 * u[:, place])
    rest = np.setdiff1d(free.raster.place_of(free.raster.body_rows), place)
    np.testing.assert_array_equal(found[:, rest], new[:, rest])


@EVERY
def test_kernels_agree_to_the_last_bit(parts):
    with interpreting():
        scene = scene_of(**parts)
        assert_bitwise_equal(scene, CompiledStepper(scene), CompiledStepper(scene, 2))


@EVERY
def test_several_steps_per_pass_are_possible(parts):
    with small_passes():
        scene = scene_of(**{"body": {"type": "grid", "columns": 36, "rows": 7}} | parts)
        assert single_steps(scene) == ""
        assert_bitwise_equal(scene, CompiledStepper(scene), CompiledStepper(scene, 3))


def test_operation_compiles():
    scene = scene_of(**CASES["drag"])
    assert_bitwise_equal(scene, CompiledStepper(scene))
    assert gpu_obstacle(scene) == ""


def test_operation_is_distributed_over_ranks(tmp_path):
    parts = sheet(**CASES["drag on all, torn"]) | {"steps": 12}
    written(parts, tmp_path / "one.nc")
    on_ranks(3, lambda ranks: written(parts, tmp_path / "three.nc", ranks))
    assert_same(tmp_path / "one.nc", tmp_path / "three.nc")


def test_run_in_parts_equals_the_whole_run(install, tensile, tmp_path):
    install("pbdkit-drag", Path(particle_operations.__file__).read_text())
    where = {"select": {"box": [1.0, 0.0, 2.0, 2.0]}}
    given = tensile | {"operations": [{"type": "drag", "factor": 0.3} | where]}
    whole, parts = tmp_path / "whole.nc", tmp_path / "parts.nc"
    scene = build_scene(pbdkit.Experiment(**given))
    assert [len(operated.place) for operated in scene.operations] == [6]
    record(Simulation.of_scene(scene), NetcdfSink(whole))
    assert run_in_parts(given, parts, count(2)) > 0
    assert_same_file(whole, parts)


def test_equilibrium_is_unchanged():
    dragged = CASES["drag on all, torn"]["operations"]
    at_rest = {"solver": {"type": "equilibrium", "tolerance": 1e-9}}
    alone, with_drag = (
        pbdkit.run(pbdkit.Experiment(**sheet(**at_rest, **parts)))
        for parts in ({}, {"operations": dragged})
    )
    np.testing.assert_array_equal(alone.position, with_drag.position)
    settle = {"solver": {"type": "stepping", "settle": {"tolerance": 1e-6}}, "steps": 5000}
    stepped = pbdkit.run(pbdkit.Experiment(**sheet(**settle, operations=dragged)))
    np.testing.assert_allclose(stepped.position[-1], alone.position[-1], atol=1e-5)
    assert 10 < stepped.time[-1] < 5000


@pytest.mark.parametrize("solver", [{"type": "equilibrium"}, {"type": "stepping", "settle": {}}])
def test_operation_that_moves_at_rest_has_no_equilibrium(solver):
    with pytest.raises(pbdkit.ExperimentError, match="solver: 'wind' can move particles"):
        pbdkit.Experiment(**sheet(operations=[Wind(select={"edge": "top"})], solver=solver))


def test_analysis_omits_it_with_a_warning():
    experiment = pbdkit.Experiment(**sheet(**CASES["drag"]))
    analysis = pbdkit.analyse(experiment)
    assert not analysis.exact
    assert any("'drag'" in line for line in analysis.warnings())
    assert analysis.spectral_radius == pbdkit.analyse(pbdkit.Experiment(**sheet())).spectral_radius


def test_empty_selection_is_refused():
    nobody = Drag(select={"box": [90.0, 90.0, 91.0, 91.0]})
    with pytest.raises(pbdkit.ExperimentError, match=r"operations.0.select: selects no particle"):
        scene_of(operations=[nobody])


def test_operation_must_return_a_vector():
    class Odd(Drag):
        type: Literal["odd"] = "odd"

        @staticmethod
        def displacement(u, new, p):
            return 0.0

    scene = scene_of(operations=[Odd(select=MIDDLE)])
    with pytest.raises(pbdkit.PluginError, match="`displacement` returned"):
        Stepper(scene).advance(initial_state(scene))


def test_file_names_it_and_round_trips(tmp_path):
    (tmp_path / "e.json").write_text(
        json.dumps(sheet(operations=[{"type": "drag", "select": {"edge": "top"}, "factor": 0.5}]))
    )
    experiment = pbdkit.load(tmp_path / "e.json", components=[Drag])
    assert experiment.operations == (Drag(select={"edge": "top"}, factor=0.5),)
    written_ = experiment.model_dump(mode="json", by_alias=True)["operations"]
    assert written_ == [{"type": "drag", "select": {"edge": "top"}, "factor": 0.5}]
    assert "operations" not in pbdkit.Experiment(**sheet()).model_dump(mode="json")
