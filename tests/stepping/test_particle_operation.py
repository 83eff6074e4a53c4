"""Operations that components bring along are stepped by every engine as the built-in ones are."""

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
from interpreted_kernels import interpreting
from property_cases import HOLD_LEFT, pull_right
from thread_ranks import on_ranks

import pbdkit
from pbdkit.plugin import ParticleOperation, Vector
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import what_gpus_lack
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numba_engine.time_skewing import single_steps
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state
from tests.mpi.test_run import assert_same, written
from tests.stepping.numba_engine.test_engine import TORN, assert_bitwise_equal, sheet
from tests.stepping.numba_engine.test_time_skewing import small_passes


class Drag(ParticleOperation):
    """Particles keep a share of their old place."""

    type: Literal["drag"] = "drag"
    factor: float = 0.25

    rests: ClassVar[bool] = True

    @staticmethod
    def displacement(u, new, p):
        return new - p.factor * (new - u)


class Wind(ParticleOperation):
    """Particles go on by so much in every step."""

    type: Literal["wind"] = "wind"
    speed: float = 0.01

    @staticmethod
    def displacement(u, new, p):
        return Vector(new.x + p.speed, new.y)


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


def test_a_drag_takes_its_share_of_each_step():
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
def test_several_steps_go_in_a_pass(parts):
    with small_passes():
        scene = scene_of(**{"body": {"type": "grid", "columns": 36, "rows": 7}} | parts)
        assert single_steps(scene) == ""
        assert_bitwise_equal(scene, CompiledStepper(scene), CompiledStepper(scene, 3))


def test_it_compiles():
    scene = scene_of(**CASES["drag"])
    assert_bitwise_equal(scene, CompiledStepper(scene))
    assert what_gpus_lack(scene) == ""


def test_ranks_share_it(tmp_path):
    parts = sheet(**CASES["drag on all, torn"]) | {"steps": 12}
    written(parts, tmp_path / "one.nc")
    on_ranks(3, lambda ranks: written(parts, tmp_path / "three.nc", ranks))
    assert_same(tmp_path / "one.nc", tmp_path / "three.nc")
