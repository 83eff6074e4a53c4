"""Breaking of bonds near a state."""

from typing import Literal

import pytest

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.state import initial_state


class Between(pbdkit.FractureModel):
    """Bonds break between two lengths of the difference of displacements."""

    type: Literal["between"] = "between"
    low: float
    high: float

    def constants(self, slot):
        return {}

    @staticmethod
    def breaks(d, r, c, p):
        square = d.x * d.x + d.y * d.y
        return (square >= p.low * p.low) & (square <= p.high * p.high)

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 0.01, True), (0.09, 0.11, True), (0.05, 0.06, False), (0.12, 9.0, False)],
)
def test_bonds_may_break_at_a_state_or_at_a_distance_from_it(low, high, expected):
    """The displacements are zero. At the corners of an octagon around a circle of radius 0.1 their
    difference is 0.1 / cos(π/8) = 0.108."""
    experiment = pbdkit.Experiment(
        name="between",
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": 3, "rows": 2},
        rule={"type": "barycentre"},
        fracture=Between(low=low, high=high),
        leaders=[],
        steps=1,
    )
    scene = build_scene(experiment)
    state = initial_state(scene)
    assert Fracturing.of(scene).may_break(state.u, state, 0.1) == expected
