"""Particles with directions: neighbours that see what is remembered, and clamped leaders."""

import math

import numpy as np
import pytest
from interpreted_kernels import interpreting
from property_cases import HOLD_LEFT, experiment
from remembering_parts import Tiring, Vanes, Weakest

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

NOISE = {"type": "noise", "amplitude": 0.2}
NONE = {"type": "none"}
TURNED = {
    "select": {"edge": "right"},
    "motion": {"type": "rotation", "centre": [2.0, 1.0], "angle": 10.0, "steps": 3},
    "from": 2,
    "until": 6,
    "clamped": True,
}


def vanes(**parts):
    given = {"rule": Vanes(), "frame": NONE, "initial": NOISE, "steps": 8, "diagnostics": []}
    return experiment(5, 4, **given | parts)


def run(**parts):
    return pbdkit.run(vanes(**parts), components=[Vanes, Weakest], progress=False)


def states(scene, stepper, steps):
    state = initial_state(scene)
    for count in steps:
        state = stepper.advance(state, count)
        yield state.copy()


def by_hand(ds, steps):
    """The rule in plain loops, on particles by their place."""
    place = {tuple(map(round, X)): n for n, X in enumerate(ds.reference.values.tolist())}
    x = ds.position.values[0].tolist()
    e = [(1.0, 0.0) for _ in x]
    for _ in range(steps):
        new_x, new_e = [], []
        for (i, j), n in place.items():
            near = [
                place[k] for k in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if k in place
            ]
            weight = move_x = move_y = 0.0
            c, s = e[n]
            for k in near:
                w = 1.5 + 0.5 * (e[n][0] * e[k][0] + e[n][1] * e[k][1])
                v = x[k][0] - x[n][0], x[k][1] - x[n][1]
                turned = (e[n][0] * v[0] + e[n][1] * v[1]) * 0.1
                X, Y = ds.reference.values[k] - ds.reference.values[n]
                weight += w
                move_x += w * (v[0] - X)
                move_y += w * (v[1] - Y)
                c, s = c + e[k][0] - turned * v[1], s + e[k][1] + turned * v[0]
            size = math.hypot(c, s) + 1e-9
            new_e.append((n, (c / size, s / size)))
            at = x[n][0] + 0.5 * move_x / weight, x[n][1] + 0.5 * move_y / weight
            new_x.append((n, at))
        x, e = ([value for _, value in sorted(new)] for new in (new_x, new_e))
    return np.array(x), np.array(e)


def test_neighbours_see_the_state_before_the_step():
    ds = run(solver={"type": "stepping", "engine": "numpy"})
    x, e = by_hand(ds, 8)
    np.testing.assert_allclose(ds.position.values[-1], x, atol=1e-13)
    np.testing.assert_allclose(ds.vane_cos.values[-1], e[:, 0], atol=1e-13)
    np.testing.assert_allclose(ds.vane_sin.values[-1], e[:, 1], atol=1e-13)
    assert np.ptp(ds.vane_sin.values[-1]) > 0.01


DISC = {"type": "disc", "radius": 1.2, "centre": [4.0, 3.0]}
HOLE = {"type": "difference", "of": [{"type": "rectangle", "width": 8.0, "height": 6.0}, DISC]}
CASES = {
    "clamped": {"leaders": [HOLD_LEFT | {"clamped": True}, TURNED]},
    "hole": {"body": HOLE, "leaders": [TURNED], "solver": {"type": "stepping", "memory": 0.3}},
    "single": {"solver": {"type": "stepping", "precision": "float32"}, "leaders": [TURNED]},
    "far": {"neighbours": {"type": "chebyshev", "shells": 3}, "leaders": [TURNED]},
    "anew": {"neighbours": {"type": "euclidean", "radius": 1.3, "reevaluate": True}},
}


@pytest.mark.parametrize("case", CASES)
def test_kernels_agree_bit_for_bit(case):
    scene = build_scene(pbdkit.Experiment(**vanes(**CASES[case])))
    with interpreting():
        found = list(states(scene, CompiledStepper(scene), (1, 2, 5)))
    for one, other in zip(found, states(scene, Stepper(scene), (1, 2, 5)), strict=True):
        for values, expected in zip(one.arrays(), other.arrays(), strict=True):
            np.testing.assert_array_equal(values, expected)


def test_clamped_leaders_rotate_with_their_motion_and_others_freely():
    free = HOLD_LEFT | {"clamped": False}
    ds = run(leaders=[free, TURNED], solver={"type": "stepping", "engine": "numpy"})
    angle = np.degrees(np.arctan2(ds.vane_sin, ds.vane_cos)).values
    right = ds.reference.values[:, 0] == 4.0
    # The motion begins at step 2, from the direction that was reached, and ends at step 4.
    start = angle[1, right]
    for step, turned in ((2, 10.0), (3, 20.0), (4, 30.0), (6, 30.0)):
        np.testing.assert_allclose(angle[step, right], start + turned, atol=1e-9)
    assert (np.abs(angle[7, right] - angle[6, right]) > 1e-3).all()
    left = ds.reference.values[:, 0] == 0.0
    assert (np.abs(np.diff(angle[:, left], axis=0)) > 0.0).all()


def test_clamped_run_continues_from_a_copy_of_its_state():
    scene = build_scene(pbdkit.Experiment(**vanes(leaders=[TURNED])))
    *_, half, _ = states(scene, Stepper(scene), (3, 5))
    *_, whole = states(scene, Stepper(scene), (8,))
    gone_on = Stepper(scene).advance(half, 5)
    for values, expected in zip(gone_on.arrays(), whole.arrays(), strict=True):
        np.testing.assert_array_equal(values, expected)


class Misnamed(Vanes):
    type: str = "misnamed"

    def rotations(self):
        return (("vane_cos", "lift"),)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"frame": {"type": "mean"}}, "frame points do not have; use frame: {type: none}"),
        (
            {"fracture": Weakest()},
            "fictitious points of broken bonds do not have; use fracture",
        ),
        (
            {"rule": {"type": "barycentre"}, "leaders": [TURNED]},
            r"leaders\.0\.clamped: with 'barycentre' particles have no directions that can be",
        ),
        ({"rule": Tiring(), "leaders": [TURNED]}, "with 'tiring' particles have no directions"),
        (
            {"rule": Misnamed(), "leaders": [TURNED]},
            "has 'lift' in `rotations`, but `remembered` declares no",
        ),
    ],
)
def test_incompatible_parts_are_refused(parts, told):
    with pytest.raises(pbdkit.PbdkitError, match=told):
        build_scene(pbdkit.Experiment(**vanes(**parts)))


class Unaware(Vanes):
    type: str = "unaware"

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0, 0.0, 0.0


def test_gather_without_its_declared_inputs_is_named():
    with pytest.raises(pbdkit.ExperimentError, match=r"declare gather\(d, r, w, p, own, there\)"):
        pbdkit.run(vanes(rule={"type": "unaware"}), components=[Unaware], progress=False)
