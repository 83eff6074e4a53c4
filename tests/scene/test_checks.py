"""Valid experiments that may not be what the user meant have a warning: points beside the body,
radians."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

import pbdkit
from pbdkit.model.shipped import shipped_names
from pbdkit.scene.checks import round_in_radians
from pbdkit.scene.scene import build_scene
from pbdkit.stability.forecast import further_warnings, refuse_unheld_loads

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


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("material/hole", {}, []),
        ("material/hole", {"lattice.a": 0.1}, []),
        (
            "material/hole",
            {"lattice.a": 0.2},
            ["body: the disc of radius 0.5 lattice units has 2.5"],
        ),
        ("material/hole", {"lattice.a": 0.2, "diagnostics": [{"type": "displacement"}]}, []),
        (
            "modelling/composite-plate",
            {"lattice.a": "2 mm"},
            [
                "body: the disc of radius 6 mm has 3 ",
                "regions.steel: the disc of radius 8 mm has 4 ",
            ],
        ),
    ],
)
def test_hole_and_inclusion_of_few_cells_have_a_warning(
    name: str, settings: dict[str, Any], words: list[str]
) -> None:
    warnings = build_scene(pbdkit.load(name, settings=settings)).warnings
    coarse = [text for text in warnings if "in its radius; the stress at its rim" in text]
    assert len(coarse) == len(words)
    assert all(text.startswith(word) for text, word in zip(coarse, words, strict=True))


def test_fillets_and_rings_of_few_cells_have_a_warning() -> None:
    stress = [{"type": "stress", "youngs_modulus": 1.0}]
    ring = {"type": "ring", "inner": 1.0, "outer": 4.0, "centre": [4.0, 4.0]}
    (text,) = warnings_of(body=ring, diagnostics=stress)
    assert text.startswith("body: the inner circle of radius 1 lattice units has 2 lattice const")
    bone = {"type": "dogbone", "length": 24.0, "width": 9.0, "gauge_length": 10.0,
            "gauge_width": 6.0, "radius": 2.0}  # fmt: skip
    (text,) = warnings_of(body=bone, diagnostics=stress)
    assert text.startswith("body: the fillet of radius 2 lattice units has 4 lattice constants")


def test_distant_point_is_named_with_group_particle_and_distance() -> None:
    nearest = {"nearest": [[4.0, 2.0], [7.0, 6.0]]}
    select = [{"select": nearest, "motion": HOLD}]
    # The corner (4, 2) is a 3-4-5 triangle away, and the last of 9 columns of 5.
    assert warnings_of(leaders=select) == [
        "leaders.0.select.nearest: the distance of (7, 6) from the body is 5 lattice units; the "
        "nearest particle is 45, at (4, 2)"
    ]
    load = {"select": {"nearest": [[-3.0, 0.0]]}, "force": [1.0, 0.0]}
    assert warnings_of(loads=[load])[0] == (
        "loads.0.select.nearest: the distance of (-3, 0) from the body is 3 lattice units; the "
        "nearest particle is 1, at (0, 0)"
    )


@pytest.mark.parametrize(("spacings", "warned"), [(0.0, 0), (1.0, 0), (1.9, 0), (2.1, 1), (9.0, 1)])
def test_two_spacings_count_as_near(spacings: float, warned: int) -> None:
    select = {"nearest": [[4.0 + 0.5 * spacings, 1.0]]}
    assert len(warnings_of(leaders=[{"select": select, "motion": HOLD}])) == warned


GAUGE = {"type": "stress-strain", "youngs_modulus": 1.0, "width": 2.0, "group": 0}


def test_gauge_point_beside_the_body_is_named() -> None:
    near = GAUGE | {"points": [[0.0, 1.2], [4.3, 2.4]]}  # .5 from the corner: one spacing
    assert warnings_of(diagnostics=[near]) == []
    far = GAUGE | {"points": [[1.0, 1.0], [4.0, 2.6]]}
    words = "diagnostics.0.points: the distance of (4, 2.6) from the body is 0.6 lattice units; "
    assert warnings_of(diagnostics=[far]) == [f"{words}the nearest particle is 45, at (4, 2)"]
    far |= {"youngs_modulus": "1 MPa"}
    (text,) = warnings_of(diagnostics=[far], units={"length": "2 mm"})
    assert (
        "of (8, 5.2) mm from the body is 1.2 mm; the nearest particle is 45, at (8, 4) mm" in text
    )


def test_section_wider_than_the_body_has_a_warning() -> None:
    gauge = GAUGE | {"points": [[0.5, 1.0], [3.5, 1.0]]}
    assert warnings_of(diagnostics=[gauge | {"width": 3.0}]) == []
    (text,) = warnings_of(diagnostics=[gauge | {"width": 3.1}])
    assert text.startswith(
        "diagnostics.0.width: 3.1 lattice units, but the body extends over 2 lattice units along y"
    )
    assert warnings_of(diagnostics=[gauge | {"axis": "y", "width": 3.1}]) == []


def test_group_without_reaction_along_the_axis_has_a_warning() -> None:
    leaders = [
        {"select": {"edge": "left"}, "motion": HOLD, "axes": ["x"]},
        {"select": {"edge": "bottom"}, "motion": HOLD, "axes": ["y"]},
    ]
    gauge = GAUGE | {"points": [[0.5, 1.0], [3.5, 1.0]]}
    assert warnings_of(leaders=leaders, diagnostics=[gauge]) == []
    idle = {"leaders": leaders, "diagnostics": [gauge | {"group": 1}]}
    (text,) = warnings_of(**idle)
    assert text == (
        "diagnostics.0.group: leader group 1 does not prescribe the motion along x, so that it "
        "exerts no force along x and the nominal stress is 0; choose a group that prescribes it (0)"
    )
    ramp = {"select": {"edge": "right"}, "force": [{"steps": [0, 5], "values": [0.0, 0.01]}, 0.0]}
    (text,) = warnings_of(**idle, loads=[ramp])
    assert text.endswith("the body is loaded by loads.0: use `load-displacement`")


def test_only_some_of_many_points_are_named() -> None:
    select = {"nearest": [[50.0 + n, 0.0] for n in range(20)]}
    assert len(warnings_of(leaders=[{"select": select, "motion": HOLD}])) == 5


def turned(angle: float, steps: int = 10) -> list[str]:
    motion = {"type": "rotation", "centre": [0.0, 0.0], "angle": angle, "steps": steps}
    return warnings_of(leaders=[{"select": {"edge": "left"}, "motion": motion}])


def test_angle_in_radians_gives_a_warning_with_degrees() -> None:
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


def test_motion_of_an_obstacle_is_checked_too() -> None:
    motion = {"type": "rotation", "centre": [9.0, 9.0], "angle": 1.5708, "steps": 1}
    disc = {"type": "disc", "radius": 1.0, "centre": [9.0, 9.0]}
    (warning,) = warnings_of(obstacles=[{"shape": disc, "motion": motion}])
    assert warning.startswith("obstacles.0.motion.angle: 1.5708 degrees look like radians")


@pytest.mark.parametrize("multiple", range(1, 25))
def test_every_multiple_of_15_degrees_is_recognised_in_radians(multiple: int) -> None:
    degrees = 15.0 * multiple
    assert round_in_radians(round(math.radians(degrees), 4))
    assert round_in_radians(-math.radians(degrees))
    assert not round_in_radians(degrees)


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.1, 0.225, 0.5, 1.0, 1.5, 2.88, 4.45, 5.76, 9.0])
def test_small_and_round_degrees_are_degrees(angle: float) -> None:
    assert not round_in_radians(angle)


@pytest.mark.parametrize("name", shipped_names())
def test_no_shipped_experiment_gives_these_warnings(name: str) -> None:
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


def test_locking_of_diagonal_cloth_is_named_with_the_remedy() -> None:
    """The predicted order of accuracy is that of the result, against a lattice four times as
    fine."""

    def force(rows: int) -> float:
        ds = pbdkit.run(pulled_cloth(3 * rows, rows, 0.005), progress=False)
        return float(ds.reaction.values[-1, 1, 0]) / rows

    with pytest.warns(pbdkit.PbdkitWarning, match="cells lock") as caught:
        coarse, fine = force(12), force(48)
    told = re.search(r"too stiff by about (\S+) %; align the stiff", str(caught[0].message))
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
def test_other_materials_give_no_locking_warning(rule: dict[str, Any]) -> None:
    assert not [text for text in warnings_of(rule=rule) if "lock" in text]


def bar(**more: Any) -> dict[str, Any]:
    """A bar that is held on its left, and loaded on its right."""
    return {
        "name": "bar",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "rectangle", "width": 10.0, "height": 4.0, "origin": [2.0, 1.0]},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [{"select": {"edge": "left"}, "motion": HOLD}],
        "loads": [{"select": {"edge": "right"}, "force": [1e-3, 1e-3]}],
        "steps": 30,
    } | more


def scene_warnings(**more: Any) -> list[str]:
    return [*build_scene(pbdkit.Experiment(**bar(**more))).warnings]


def test_crack_that_crosses_no_bond_gives_a_warning() -> None:
    crack = {"type": "strain", "failure": 0.02, "cracks": [[[6.5, 0.0], [6.5, 2.5]]]}
    assert scene_warnings(fracture=crack) == []
    crack["cracks"] = [[[6.5, 0.0], [6.5, 2.5]], [[60.5, 0.0], [60.5, 2.5]]]
    (warning,) = scene_warnings(fracture=crack)
    assert warning.startswith("fracture.cracks.1: it crosses no bond of the body")


IN_PERCENT = [
    (
        {"type": "strain", "failure": 2.0},
        ["fracture.failure: 2 is a strain of 200 %; 2 % is written 0.02"],
    ),
    ({"type": "strain", "failure": 0.99}, []),
    (
        {"type": "damage", "onset": 1.0, "failure": 2.5},
        ["fracture.onset: 1 is", "fracture.failure: 2.5 is"],
    ),
    ({"type": "damage", "onset": 0.01, "failure": 0.1}, []),
]


@pytest.mark.parametrize(("fracture", "fields"), IN_PERCENT)
def test_strains_in_percent_give_a_warning(fracture: dict[str, Any], fields: list[str]) -> None:
    found = scene_warnings(fracture=fracture)
    assert len(found) == len(fields)
    assert all(w.startswith(field) for w, field in zip(found, fields, strict=True))


def test_load_on_leaders_alone_gives_a_warning() -> None:
    told = "loads.0: acts only on leaders, so that it has no effect on the body"
    on_the_left = [{"select": {"edge": "left"}, "force": [1e-3, 0.0]}]
    assert scene_warnings(loads=on_the_left) == [told]
    rollers = [{"select": {"edge": "left"}, "motion": HOLD, "axes": ["x"]}]
    assert scene_warnings(loads=on_the_left, leaders=rollers) == [told]
    upwards = [{"select": {"edge": "left"}, "force": [1e-3, 1e-3]}]
    assert scene_warnings(loads=upwards, leaders=rollers) == []
    for_a_time = [{"select": {"edge": "left"}, "motion": HOLD, "until": 10}]
    assert scene_warnings(loads=on_the_left, leaders=for_a_time) == []
    assert scene_warnings(loads=[{"select": {"edge": "bottom"}, "force": [1e-3, 0.0]}]) == []


PLACES = [(60.0, 0.0, True), (60.0, -2.0, False), (14.0, 0.0, False)]


@pytest.mark.parametrize(("x", "velocity", "far"), PLACES)
def test_obstacle_that_never_approaches_gives_a_warning(
    x: float, velocity: float, far: bool
) -> None:
    motion = {"type": "velocity", "velocity": [velocity, 0.0], "steps": 20}
    obstacle = {"shape": {"type": "disc", "radius": 1.0, "centre": [x, 3.0]}, "motion": motion}
    found = scene_warnings(obstacles=[obstacle], loads=[])
    assert [w.split(":")[0] for w in found] == ["obstacles.0"] * far


def supports(*given: tuple[dict[str, Any], list[str] | None]) -> list[dict[str, Any]]:
    return [{"select": s, "motion": HOLD} | ({"axes": a} if a else {}) for s, a in given]


LEFT, CORNER = {"edge": "left"}, {"nearest": [[2.0, 1.0]]}
HELD = {
    "clamped": (supports((LEFT, None)), [1e-3, 1e-3], True),
    "rollers and a corner": (supports((LEFT, ["x"]), (CORNER, ["y"])), [1e-3, 1e-3], True),
    "rollers, pulled along them": (supports((LEFT, ["x"])), [1e-3, 1e-3], False),
    "rollers, pulled across": (supports((LEFT, ["x"])), [1e-3, 0.0], True),
    "a hinge": (supports((CORNER, None)), [0.0, 1e-3], False),
    "a hinge, with a second roller": (
        supports((CORNER, None), ({"nearest": [[12.0, 1.0]]}, ["y"])), [1e-3, 1e-3], True,
    ),
    "free": ([], [1e-3, 0.0], False),
}  # fmt: skip


@pytest.mark.parametrize(("leaders", "force", "is_held"), HELD.values(), ids=HELD)
def test_check_and_run_refuse_scenes_without_equilibrium(
    call: Any, leaders: Any, force: list[float], is_held: bool
) -> None:
    loads = [{"select": {"edge": "right"}, "force": force}]
    given = bar(leaders=leaders, loads=loads, steps=1, solver={"type": "equilibrium"})
    Path("bar.json").write_text(json.dumps(given))
    checked, run = call("check", "bar.json"), call("run", "bar.json")
    assert (checked.code, run.code) == (0, 0) if is_held else (2, 2)
    if not is_held:
        assert "a part of 5" in checked.err
        assert checked.err == run.err
    steps = call("check", "bar.json", "--set", "solver={type: stepping}", "--set", "steps=90000")
    assert ("loads: a part of" in steps.out) == (not is_held)


def test_unsupported_one_of_two_bodies_is_named() -> None:
    apart = [{"type": "rectangle", "width": 4.0, "height": 4.0},
             {"type": "rectangle", "width": 4.0, "height": 4.0, "origin": [10.0, 0.0]}]  # fmt: skip
    given = bar(body={"type": "union", "of": apart}, solver={"type": "equilibrium"})
    with pytest.raises(pbdkit.ExperimentError, match=r"25 particles \(with number 26\)"):
        refuse_unheld_loads(build_scene(pbdkit.Experiment(**given)))


def test_run_and_check_warn_of_too_fast_leaders(call: Any) -> None:
    fast = {"type": "velocity", "velocity": [0.3, 0.0], "steps": 10}
    leaders = [*bar()["leaders"], {"select": {"edge": "right"}, "motion": fast}]
    Path("bar.json").write_text(json.dumps(bar(leaders=leaders, loads=[])))
    told = "leaders: in steps 1 to 10 the fastest moves by 0.3 per step, which brings the body"
    lines = [line for line in call("check", "bar.json").out.splitlines() if "warning" in line]
    run = call("run", "bar.json")
    assert run.err.splitlines() == lines
    assert told in run.err
    assert call("run", "bar.json", "--force", "--quiet").err == ""


def test_large_bodies_run_without_spectrum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = build_scene(pbdkit.load("paper/a"))
    assert further_warnings(scene)
    monkeypatch.setattr("pbdkit.stability.forecast.QUICK_PARTICLES", 100)
    assert further_warnings(scene) == []
