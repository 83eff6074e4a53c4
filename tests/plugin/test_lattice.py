"""The number of axes is defined once, by the lattice: a simple cubic lattice steps like the
others."""

from itertools import product
from typing import Literal

import numpy as np
import plain_space
import pytest

import pbdkit
from pbdkit.model.bodies import Body, Box
from pbdkit.model.motions import Velocity
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import choose, make_engine
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

SIZES, STEPS = (3, 6, 7), 12
PULL, TURN = (0.11, 0.02, -0.03), (-0.02, 0.05, 0.04)


class Cubic(pbdkit.Lattice):
    """Sites at the whole numbers of space."""

    type: Literal["cubic"] = "cubic"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def cell(self):
        return pbdkit.plugin.Cell(tuple(map(pbdkit.plugin.SpaceVector, *np.eye(3).tolist())))


class Brick(Body):
    """A box of sites."""

    type: Literal["brick"] = "brick"

    def boxes(self):
        return [Box((0, 0, 0), tuple(n - 1 for n in SIZES), in_sites=True)]

    def distance(self, at):
        beyond = [np.maximum(-i, i - (n - 1)) for i, n in zip(at.index, SIZES, strict=True)]
        return np.maximum.reduce(beyond).astype(float)


INTACT = {"type": "none"}


def faces():
    """The sites of both ends, and of the whole window in the order of the numbers."""
    window = list(product(*(range(-1, n + 1) for n in SIZES)))
    body = list(product(*map(range, SIZES)))
    return [s for s in body if s[0] == 0], [s for s in body if s[0] == SIZES[0] - 1], window


def scene(engine, fracture, *, moves=True):
    """Return the block, with its ends moved apart. The experiment file has bodies and motions of
    the plane only: those of space are put in."""
    left, right, window = faces()
    plane = pbdkit.Experiment(
        version=1,
        name="block",
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": 3, "rows": 3},
        neighbours={"type": "coordination", "shells": 1},
        rule={"type": "barycentre"},
        fracture=fracture,
        leaders=[
            {"select": {"numbers": [window.index(s) + 1 for s in face]}, "motion": {"type": "hold"}}
            for face in (left, right)
        ],
        steps=STEPS,
        solver={"type": "stepping", "engine": engine},
    )
    motions = [Velocity.model_construct(velocity=v, steps=4) for v in (TURN, PULL)]
    groups = [
        group.model_copy(update={"motion": motion})
        for group, motion in zip(plane.leaders, motions, strict=True)
    ]
    space = {"lattice": Cubic(), "body": Brick()} | ({"leaders": tuple(groups)} if moves else {})
    experiment = plane.model_copy(update=space)
    experiment._validated = dict(experiment.__dict__)  # files have no lattice of three axes yet
    return build_scene(experiment)


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize("threshold", [None, 1.2])
def test_cubic_lattice_steps_like_plain_loops(engine, threshold, request):
    if threshold is not None:
        request.getfixturevalue("compiled_at_length")
    torn = {"type": "threshold", "thresholds": [threshold]}
    block = scene(engine, INTACT if threshold is None else torn)
    left, right, _ = faces()
    history, broken = plain_space.simulate(
        SIZES, [(left, TURN, 4), (right, PULL, 4)], STEPS, threshold
    )
    assert (threshold is None) == (not broken)
    stepper, _ = make_engine(block, choose(block))
    state = initial_state(block)
    for expected in history:
        state = stepper.advance(state)
        np.testing.assert_array_equal(block.raster.table(state.u), expected)
    if broken:
        assert np.count_nonzero(state.broken_step >= 0) == len(broken)
        assert np.unique(state.broken_step).tolist() == [-1, *sorted(set(broken.values()))]


def test_bonds_in_space_soften_as_by_numpy(interpreted):
    block = scene("compiled", {"type": "damage", "onset": 0.05, "failure": 0.3})
    state, known = initial_state(block), initial_state(block)
    state = make_engine(block, choose(block))[0].advance(state, 4)
    known = Stepper(block).advance(known, 4)
    assert np.count_nonzero(known.broken_step >= 0)
    for mine, others in zip(state.arrays(), known.arrays(), strict=True):
        np.testing.assert_array_equal(mine, others)


def test_dataset_has_three_axes():
    block = scene("numpy", INTACT, moves=False)
    ds = pbdkit.run(block.experiment, progress=False)
    assert ds.axis.values.tolist() == ["x", "y", "z"]
    assert ds.position.shape == (STEPS + 1, block.raster.count, 3)
    assert ds.site.values.tolist() == [list(site) for site in faces()[2]]
    assert (ds.site.values == np.stack([ds.i, ds.j, ds.k], axis=1)).all()


def test_spectrum_matches_the_closed_form():
    # Ends held, copying frame: λ = (cos a + cos b + cos c) / 3, a = pπ/(n - 1), b, c = qπ/n.
    ends = (SIZES[0] - 1, SIZES[0] - 1), (SIZES[1], SIZES[1]), (SIZES[2], SIZES[2])
    a, b, c = (np.pi * np.arange(count) / parts for count, parts in ends)
    grid = np.cos(a[1:, None, None]) + np.cos(b[:, None]) + np.cos(c)
    analysis = pbdkit.analyse(scene("numpy", INTACT).experiment)
    assert analysis.spectral_radius == pytest.approx(np.abs(grid / 3).max(), abs=1e-12)
    assert analysis.smallest_eigenvalue == pytest.approx((grid / 3).min(), abs=1e-12)
