"""What can be run and may not be what was meant is warned of: points beside the body, radians."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

import pbdkit
from pbdkit.experiment.shipped import shipped_names
from pbdkit.scene.doubts import round_in_radians
from pbdkit.scene.scene import build_scene

HOLD = {"type": "hold"}


def warnings_of(**parts: Any) -> list[str]:
    whole = {
        "name": "doubtful",
        "lattice": {"type": "square", "a": 0.5},
        "body": {"type": "rectangle", "width": 4.0, "height": 2.0},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [{"select": {"edge": "left"}, "motion": HOLD}],
        "steps": 5,
    }
    return [*build_scene(pbdkit.Experiment(**whole | parts)).warnings]


def test_a_point_far_from_the_body_is_named_with_group_particle_and_distance() -> None:
    nearest = {"nearest": [[4.0, 2.0], [7.0, 6.0]]}
    select = [{"select": nearest, "motion": HOLD}]
    # The corner (4, 2) is a 3-4-5 triangle away, and the last of 9 columns of 5.
    assert warnings_of(leaders=select) == [
        "leaders.0.select.nearest: (7, 6) lies 5 away from the body; the particle nearest to it is "
        "45, at (4, 2)"
    ]
    load = {"select": {"nearest": [[-3.0, 0.0]]}, "force": [1.0, 0.0]}
    assert warnings_of(loads=[load]) == [
        "loads.0.select.nearest: (-3, 0) lies 3 away from the body; the particle nearest to it is "
        "1, at (0, 0)"
    ]


@pytest.mark.parametrize(("spacings", "warned"), [(0.0, 0), (1.0, 0), (1.9, 0), (2.1, 1), (9.0, 1)])
def test_two_spacings_are_near(spacings: float, warned: int) -> None:
    select = {"nearest": [[4.0 + 0.5 * spacings, 1.0]]}
    assert len(warnings_of(leaders=[{"select": select, "motion": HOLD}])) == warned


def test_few_of_many_points_are_named() -> None:
    select = {"nearest": [[50.0 + n, 0.0] for n in range(20)]}
    assert len(warnings_of(leaders=[{"select": select, "motion": HOLD}])) == 5


def turned(angle: float, steps: int = 10) -> list[str]:
    motion = {"type": "rotation", "centre": [0.0, 0.0], "angle": angle, "steps": steps}
    return warnings_of(leaders=[{"select": {"edge": "left"}, "motion": motion}])


def test_an_angle_in_radians_is_warned_of_with_its_degrees() -> None:
    assert turned(0.7854) == [
        "leaders.0.motion.angle: 0.7854 degrees look like radians, which would be 45.0001 degrees; "
        "angles are in degrees"
    ]
    assert len(turned(-math.pi / 6)) == 1
    (whole,) = turned(0.015708, 100)  # a right angle in all
    assert "0.015708 degrees look like radians, which would be 0.900002 degrees" in whole
    oblique = {"type": "oblique", "a": 0.5, "b": 0.5, "angle": 1.0472}
    spring = {"rule": {"type": "barycentre"}, "frame": {"type": "mean"}}
    assert any(
        w.startswith("lattice.angle: 1.0472 degrees look like radians, which would be 60.0001")
        for w in warnings_of(lattice=oblique, **spring)
    )


def test_the_motion_of_an_obstacle_is_looked_at_too() -> None:
    motion = {"type": "rotation", "centre": [9.0, 9.0], "angle": 1.5708, "steps": 1}
    disc = {"type": "disc", "radius": 1.0, "centre": [9.0, 9.0]}
    (warning,) = warnings_of(obstacles=[{"shape": disc, "motion": motion}])
    assert warning.startswith("obstacles.0.motion.angle: 1.5708 degrees look like radians")


@pytest.mark.parametrize("multiple", range(1, 25))
def test_every_multiple_of_15_degrees_is_known_in_radians(multiple: int) -> None:
    degrees = 15.0 * multiple
    assert round_in_radians(round(math.radians(degrees), 4))
    assert round_in_radians(-math.radians(degrees))
    assert not round_in_radians(degrees)


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.1, 0.225, 0.5, 1.0, 1.5, 2.88, 4.45, 5.76, 9.0])
def test_small_and_plain_degrees_are_degrees(angle: float) -> None:
    assert not round_in_radians(angle)


@pytest.mark.parametrize("name", shipped_names())
def test_no_shipped_experiment_is_doubted_so(name: str) -> None:
    if name.startswith(("paper", "modelling")):
        warnings = build_scene(pbdkit.load(name)).warnings
        assert not [w for w in warnings if "radians" in w or ".nearest: " in w]


def cloth(soft: float, *, turned: bool = False) -> dict[str, Any]:
    """Fibres 1/soft as stiff as their shear, along the diagonals or, `turned`, along the axes."""
    if turned:
        ratios = {"poisson_ratio": 0.0, "modulus_ratio": 1.0, "shear_ratio": soft}
    else:
        across = (0.5 - soft) / (0.5 + soft)
        modulus = (0.5 + soft) * (1.0 - across**2)
        ratios = {"poisson_ratio": across, "modulus_ratio": 1.0, "shear_ratio": 0.5 / modulus}
    return {"type": "orthotropic"} | ratios


def pulled_cloth(columns: int, rows: int, soft: float) -> dict[str, Any]:
    return {
        "name": "cloth",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns + 1, "rows": rows + 1},
        "neighbours": {"type": "chebyshev"},
        "rule": cloth(soft),
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": HOLD},
            {
                "select": {"edge": "right"},
                "motion": {"type": "displace", "displacement": [0.01 * columns, 0.0]},
            },
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-6},
        "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0}],
    }


def test_cells_of_cloth_along_the_diagonals_lock_and_the_cure_is_named() -> None:
    """What is foretold is the order of what comes out, against a lattice four times as fine."""

    def force(rows: int) -> float:
        ds = pbdkit.run(pulled_cloth(3 * rows, rows, 0.005), progress=False)
        return float(ds.reaction.values[-1, 1, 0]) / rows

    with pytest.warns(pbdkit.PbdkitWarning, match="cells lock") as caught:
        coarse, fine = force(12), force(48)
    told = re.search(r"too stiff by some (\S+) %; turn the body onto", str(caught[0].message))
    assert told
    assert 0.6 < (coarse / fine - 1.0) / (float(told[1]) / 100.0) < 1.7


@pytest.mark.parametrize(
    "rule",
    [
        cloth(0.005, turned=True),
        cloth(0.2),
        {"type": "elastic", "poisson_ratio": 0.499},
        {"type": "elastic", "poisson_ratio": 0.48, "plane": "strain"},
        {"type": "elastic", "poisson_ratio": -0.9},
        {"type": "orthotropic", "poisson_ratio": 0.3, "modulus_ratio": 0.05, "shear_ratio": 0.4},
    ],
)
def test_other_materials_are_not_said_to_lock(rule: dict[str, Any]) -> None:
    assert not [text for text in warnings_of(rule=rule) if "lock" in text]
