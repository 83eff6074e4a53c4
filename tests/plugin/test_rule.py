"""Rules that work on the moves of another, under every frame that goes with them."""

from typing import ClassVar, Literal

import numpy as np
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

FRAMES = [
    "{type: mean}",
    "{type: first}",
    "{type: mirror}",
    "{type: none}",
    "{type: mean, layers: 3}",
]
SMALL = ("diagnostics=[]", "body.columns=5", "body.rows=4", "leaders.1.motion.velocity=[0.02, 0.0]")
NESTED = "applies a rule to the moves of another"


class Membrane(pbdkit.FollowerRule):
    """u moves by (P - 1) u."""

    type: Literal["membrane"] = "membrane"
    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class Plate(pbdkit.plugin.AppliesTwice, Membrane):
    """u moves by -(1/2) (1 - P)² u."""

    type: Literal["plate"] = "plate"

    def inner(self):
        return Membrane()

    @staticmethod
    def apply(total, here, p):
        return -0.5 * total[0] / total[1]


def plate(frame, *settings):
    settings = ["rule={type: plate}", f"frame={frame}", "leaders.1.until=4000", *settings]
    return pbdkit.load("paper/a", components=[Plate], settings=settings)


@pytest.mark.parametrize("frame", FRAMES)
def test_step_equals_two_steps_of_the_inner_rule(frame):
    scene = build_scene(plate(frame, "initial={type: noise, amplitude: 0.1}", "steps=1"))
    state = initial_state(scene)
    u = scene.raster.table(state.u)
    z = membrane_moves(scene, u)
    expected = u - 0.5 * membrane_moves(scene, z)
    # Leaders are led, and frame points follow in the end; followers are what the rule moves.
    after = scene.raster.table(Stepper(scene).advance(initial_state(scene)).u)
    led = np.concatenate([group.rows for group in scene.leading])
    near = {neighbour for row in led for neighbour in neighbours(scene, row)}
    near |= set(led)
    free = [r for r in scene.raster.body_rows if not near & {r, *neighbours(scene, r)}]
    assert len(free) > 20
    np.testing.assert_allclose(after[free], expected[free], rtol=0, atol=1e-15)


def neighbours(scene, row):
    ends = scene.bonds.ends
    return [*ends[ends[:, 0] == row, 1], *ends[ends[:, 1] == row, 0]]


def membrane_moves(scene, u):
    """(P - 1) u of the body; frame points as the frame makes them."""
    moves = np.zeros_like(u)
    for row in scene.raster.body_rows:
        around = neighbours(scene, row)
        moves[row] = np.mean(u[around] - u[row], axis=0)
    if scene.frame:
        planes = np.zeros((2, scene.raster.kind.size))
        planes[:, scene.raster.place_of(np.arange(len(u)))] = moves.T
        scene.frame.follow(planes, planes)
        moves = planes[:, scene.raster.place_of(np.arange(len(u)))].T
    return moves


@pytest.mark.parametrize("frame", in_turn(FRAMES, 2))
def test_steps_converge_to_the_equilibrium(frame):
    stepped = pbdkit.run(
        plate(frame, *SMALL, "solver.memory=0.8", "steps=1200", "record.at=[0, 1200]"),
        progress=False,
    )
    straight = pbdkit.run(
        plate(frame, *SMALL, "steps=20", "solver={type: equilibrium}"), progress=False
    )
    assert straight.attrs["status"] == "complete"
    off = np.abs(stepped.position[-1].values - straight.position[-1].values).max()
    assert off < 1e-10


@pytest.mark.parametrize("frame", FRAMES)
def test_operator_equals_the_step(frame):
    experiment = plate(frame, "initial={type: noise, amplitude: 0.1}", "steps=1", "leaders=[]")
    scene, analysis = build_scene(experiment), pbdkit.analyse(experiment)
    start = initial_state(scene)
    rows = analysis.operator.followers
    u = scene.raster.table(start.u)[rows].ravel()
    after = scene.raster.table(Stepper(scene).advance(initial_state(scene)).u)[rows].ravel()
    predicted = analysis.operator.current @ u + analysis.operator.source
    np.testing.assert_allclose(after, predicted, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("setting", "remedy"),
    [
        ("frame={type: mean, lag: 1}", "use frame: lag: 0"),
        ("fracture={type: threshold, thresholds: [2.0]}", "use fracture: {type: none}"),
        (
            "neighbours={type: euclidean, radius: 1.2, reevaluate: true}",
            "use neighbours: reevaluate",
        ),
    ],
)
def test_incompatible_parts_are_refused_with_the_remedy(setting, remedy):
    with pytest.raises(pbdkit.ExperimentError, match=NESTED) as told:
        pbdkit.run(plate("{type: none}", setting, "steps=1"), progress=False)
    assert remedy in str(told.value)
