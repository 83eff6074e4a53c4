"""Search for equilibria: implicit steps, and distances that are computed once."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium.load_stepping import finder_of
from pbdkit.equilibrium.newton import Search
from pbdkit.equilibrium.system import random_displacements
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

HANGING = {
    "version": 1,
    "name": "bar",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 6, "rows": 2},
    "neighbours": {"type": "coordination", "shells": 2},
    "rule": {"type": "springs"},
    "frame": {"type": "natural"},
    "fracture": {"type": "none"},
    "cuts": [
        {"from": [2.5, -0.5], "to": [2.5, 0.6]},
        {"from": [1.4, 0.5], "to": [2.6, 0.5]},
        {"from": [1.5, -0.5], "to": [1.5, 0.2]},
    ],
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {"select": {"edge": "right"}, "motion": {"type": "hold"}},
    ],
    "steps": 2,
    "solver": {"type": "equilibrium", "tolerance": 1e-5},
}
"""Two bars of springs, of which the upper one is cut, so that its end hangs by one bond."""


@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_implicit_steps_relax_a_part_that_hangs_by_one_bond(size):
    """No force acts on it wherever it turns about its end."""
    scene = build_scene(pbdkit.Experiment(**HANGING))
    state = initial_state(scene)
    state.u += random_displacements(scene, size)
    finder = finder_of(scene, state, Watch())
    bound = finder.relax(state, 1)
    assert np.abs(finder.moves.at(state, 1)).max() < 1e-6
    assert bound.iterations < 40


def test_a_distance_is_that_by_the_current_system():
    """Each combination of system and residual is evaluated once."""
    count = []

    def by(distance):
        return SimpleNamespace(distance=lambda moves, rounding: count.append(moves) or distance)

    search = SimpleNamespace(
        _last_distance=(math.inf, None, None), _rounding=lambda: 0.0, _linear=True
    )
    for n, distance in enumerate((3.0, 2.0)):
        search._residual, search._system = np.zeros(1), by(distance)
        for _ in range(2):
            assert Search._distance(search) == distance
        search._system = by(distance / 4.0)
        assert Search._distance(search) == distance / 4.0
        assert len(count) == 2 * n + 2
