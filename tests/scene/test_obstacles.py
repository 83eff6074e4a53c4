"""Obstacles: followers do not enter them, and rest against them as in contact mechanics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from interpreted_kernels import interpreting
from scene_strategies import in_turn

import pbdkit
from pbdkit.model.boundary_conditions import Obstacle
from pbdkit.scene.obstacles import Outline, outline_of
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine import emitter
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state
from tests.stepping.numba_engine.test_engine import assert_bitwise_equal
from tests.stepping.numba_engine.test_time_skewing import small_passes

ELASTIC = {
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "frame": {"type": "natural"},
}
MEAN = {
    "rule": {"type": "barycentre"},
    "neighbours": {"type": "coordination"},
    "frame": {"type": "mean"},
}
HEXAGONAL = {
    "lattice": {"type": "hexagonal", "a": 1.0, "origin": [0.3, 0.2]},
    "body": {"type": "rectangle", "width": 14.0, "height": 7.0, "origin": [0.2, 0.1]},
    "leaders": [{"select": {"box": [0.0, 0.0, 0.9, 9.0]}, "motion": {"type": "hold"}}],
}
SHAPES: dict[str, dict[str, Any]] = {
    "disc": {"type": "disc", "radius": 6.0, "centre": [7.0, 14.01]},
    "half-plane": {"half_plane": {"point": [0.0, -0.01], "normal": [0.0, 2.0]}},
    "polygon": {"type": "polygon", "vertices": [[15.01, 3.0], [22.0, 5.0], [22.0, 1.0]]},
    "ring": {"type": "ring", "inner": 16.5, "outer": 20.0, "centre": [7.0, 4.0]},
    "rectangle": {"type": "rectangle", "width": 4.0, "height": 5.0, "origin": [5.0, 8.01]},
}
COME = [
    {
        "shape": SHAPES["disc"],
        "motion": {"type": "velocity", "velocity": [0.02, -0.05], "steps": 15},
        "until": 18,
    },
    {
        "shape": SHAPES["half-plane"],
        "motion": {"type": "rotation", "centre": [0.0, 0.0], "angle": 0.2, "steps": 9},
    },
    {
        "shape": SHAPES["polygon"],
        "motion": {"type": "velocity", "velocity": [-0.1, 0.0], "steps": 8},
        "from": 4,
    },
    {"shape": SHAPES["ring"], "from": 3},
]


def block(**parts: Any) -> dict[str, Any]:
    """A block that is held at its left edge."""
    given = {
        "name": "block",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 15, "rows": 9},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "obstacles": COME,
        "steps": 30,
    }
    return given | ELASTIC | parts


def pressed(shape: str, by: float, **parts: Any) -> dict[str, Any]:
    """A block that stands on its held bottom edge while an obstacle comes down."""
    held = [{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}]
    down = {"type": "velocity", "velocity": [0.0, -by / 10], "steps": 10}
    contact = [{"type": "contact", "youngs_modulus": 2.0, "thickness": 3.0}]
    measured = [*contact, {"type": "reaction", "youngs_modulus": 2.0, "thickness": 3.0}]
    above = {"half_plane": {"point": [0.0, 8.0], "normal": [0.0, -1.0]}}
    tip = {"type": "polygon", "vertices": [[7.2, 8.0], [15.0, 12.0], [0.0, 12.0]]}
    disc = {"type": "disc", "radius": 6.0, "centre": [7.0, 14.0]}
    shapes = {"half-plane": above, "disc": disc, "wedge": tip}
    obstacles = [{"shape": shapes[shape], "motion": down}]
    return block(leaders=held, obstacles=obstacles, diagnostics=measured) | parts


def run(given: dict[str, Any]) -> Any:
    return pbdkit.run(pbdkit.Experiment(**given), progress=False)


def places(count: int = 4000) -> Any:
    return np.random.default_rng(3).uniform(-3.0, 23.0, (2, count))


def outline(name: str) -> Outline:
    return outline_of(Obstacle(shape=SHAPES[name]).shape)


@pytest.mark.parametrize("name", ["polygon", "rectangle", "star", "clockwise"])
def test_polygons_match_analytic_geometry(name: str) -> None:
    """Distance, side and nearest point of the boundary as shapely has them."""
    angles, radii = np.arange(10) * np.pi / 5, np.tile([9.0, 3.0], 5)
    star = (10.0 + radii * [np.cos(angles), np.sin(angles)]).T
    bodies = {
        "star": {"type": "polygon", "vertices": star.tolist()},
        "clockwise": {"type": "polygon", "vertices": star[::-1].tolist()},
    }
    own = outline_of(Obstacle(shape=(bodies | SHAPES)[name]).shape)
    gap, nx, ny = own.facing(*places())
    body, at = shapely.Polygon(own.points), shapely.points(*places())
    np.testing.assert_allclose(np.abs(gap), shapely.distance(body.boundary, at), atol=1e-12)
    assert ((gap < 0) == shapely.contains(body, at)).all()
    np.testing.assert_allclose(nx * nx + ny * ny, 1.0)
    nearest = shapely.points(*(places() - gap * np.stack([nx, ny])))
    np.testing.assert_allclose(shapely.distance(body.boundary, nearest), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["disc", "ring", "half-plane"])
def test_round_and_flat_outlines_match_their_formulas(name: str) -> None:
    x, y = places()
    gap, nx, ny = outline(name).facing(x, y)
    to_disc, r = np.hypot(x - 7.0, y - 14.01) - 6.0, np.hypot(x - 7.0, y - 4.0)
    known = {"disc": to_disc, "ring": np.maximum(r - 20.0, 16.5 - r), "half-plane": y + 0.01}
    np.testing.assert_allclose(gap, known[name], atol=1e-12)
    back = outline(name).facing(x - gap * nx, y - gap * ny)[0]
    np.testing.assert_allclose(back, 0.0, atol=1e-12)


def test_followers_do_not_penetrate_and_leaders_are_unaffected() -> None:
    ds = run(block())
    leads = ds.kind.values[-1] == 0
    assert np.array_equal(ds.position.values[-1, leads], ds.reference.values[leads])
    scene = build_scene(pbdkit.Experiment(**block()))
    for step in range(1, 31):
        x, y = ds.position.sel(time=step).values[ds.kind.values[step] == 1].T
        own = [b.at(step) for b in scene.barriers]
        # One obstacle comes after the other: the last has the last word.
        assert own[-1] is None or own[-1].facing(x, y)[0].min() > -1e-12
        assert (own[0] is None) == (step > 18)
    assert np.abs(ds.position.values[-1] - ds.reference.values).max() > 0.1


def plane(point: Any, normal: Any, **parts: Any) -> dict[str, Any]:
    """Return an obstacle with a straight edge."""
    return {"shape": {"half_plane": {"point": point, "normal": normal}}} | parts


def moving(velocity: Any, steps: int = 10) -> dict[str, Any]:
    """The motion of an obstacle."""
    return {"motion": {"type": "velocity", "velocity": velocity, "steps": steps}}


GROOVE = {
    "type": "polygon",
    "vertices": [[13.0, -6.0], [16.5, 4.0], [12.0, 14.0], [30.0, 14.0], [30.0, -6.0]],
}
BETWEEN = [
    plane([14.0, 8.0], [-1.0, -0.4], **moving([-0.03, -0.03])),
    plane([14.0, 8.0], [-0.3, -1.0], **moving([-0.02, -0.05])),
    {"shape": {"type": "disc", "radius": 2.0, "centre": [16.1, 0.3]}, **moving([-0.05, 0.02])},
    {"shape": {"type": "disc", "radius": 3.0, "centre": [13.0, -3.1]}, **moving([0.01, 0.04])},
    {"shape": SHAPES["ring"], "from": 8},
]
"""Obstacles that press particles against each other."""
ROLLERS = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}, "axes": ["x"]},
    {"select": {"edge": "bottom"}, "motion": {"type": "hold"}, "axes": ["y"]},
    {
        "select": {"edge": "right"},
        "motion": {"type": "velocity", "velocity": [0.03, 0.0], "steps": 9},
        "axes": ["x"],
        "until": 17,
    },
]
ON_ROLLERS = [
    plane([0.0, 8.1], [0.2, -1.0], **moving([0.0, -0.04])),
    {"shape": {"type": "disc", "radius": 5.0, "centre": [14.0, 13.0]}, **moving([-0.05, -0.04])},
    {"shape": {"type": "ring", "inner": 9.3, "outer": 14.0, "centre": [7.0, 4.0]}, "from": 5},
    {"shape": GROOVE, **moving([-0.15, 0.0])},
]

CASES = {
    "elastic": block(),
    "between obstacles": block(obstacles=BETWEEN),
    "between obstacles, springs": block(obstacles=BETWEEN, rule={"type": "springs"}),
    "in a groove": block(
        obstacles=[{"shape": GROOVE, **moving([-0.45, 0.0], 13)}],
        body={"type": "polygon", "vertices": [[0.0, 0.0], [12.0, 4.0], [0.0, 8.0]]},
    ),
    "on rollers": block(obstacles=ON_ROLLERS, leaders=ROLLERS),
    "on rollers, memory": block(
        obstacles=ON_ROLLERS[::-1],
        leaders=ROLLERS,
        rule={"type": "springs"},
        solver={"type": "stepping", "relaxation": 0.9, "memory": 0.3},
    ),
    "memory": block(**MEAN, solver={"type": "stepping", "relaxation": 0.9, "memory": 0.3}),
    "single precision": block(**MEAN, solver={"type": "stepping", "precision": "float32"}),
    "hexagonal, lag": block(**MEAN | {"frame": {"type": "first", "layers": 1, "lag": 1}},
                            **HEXAGONAL),
    "fracture": block(**MEAN, fracture={"type": "threshold", "thresholds": [1.1]}),
    "twice": block(rule={"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.4},
                   solver={"type": "stepping", "relaxation": 0.2}),
    "noise": block(initial={"type": "noise", "amplitude": 0.02}),
}  # fmt: skip


@pytest.mark.parametrize("case", in_turn(CASES, 2))
def test_both_engines_agree_to_the_last_bit(case: str) -> None:
    scene = build_scene(pbdkit.Experiment(**CASES[case]))
    with interpreting():
        state = assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1, 2, 7, 8))
    assert np.abs(state.u).max() > 0.05


@pytest.mark.parametrize("case", ["between obstacles, springs", "on rollers"])
def test_several_steps_per_pass_agree_bit_for_bit(case: str) -> None:
    scene = build_scene(pbdkit.Experiment(**CASES[case]))
    with small_passes():
        engines = CompiledStepper(scene), CompiledStepper(scene, 2)
        assert_bitwise_equal(scene, *engines, calls=(1, 2, 7, 8))


def test_threads_agree_bit_for_bit(compiled_at_length: None) -> None:
    scene = build_scene(pbdkit.Experiment(**CASES["memory"]))
    assert_bitwise_equal(scene, CompiledStepper(scene, 2))


def test_changing_neighbours_meet_obstacles_too() -> None:
    near = {"type": "euclidean", "radius": 1.5, "reevaluate": True}
    given = block(**MEAN | {"neighbours": near, "frame": {"type": "none"}})
    scene = build_scene(pbdkit.Experiment(**given))
    with interpreting():
        assert_bitwise_equal(scene, CompiledStepper(scene))


def test_scenes_without_obstacles_have_kernels_without_contact(monkeypatch: Any) -> None:
    sources = []
    write = emitter.write_module
    monkeypatch.setattr(
        emitter, "write_module", lambda *a: sources.append(write(*a)) or sources[-1]
    )
    for obstacles in ([], COME):
        with interpreting():
            CompiledStepper(build_scene(pbdkit.Experiment(**block(obstacles=obstacles))))
    (bare, _), (held, _) = sources
    assert "wall" not in bare
    assert "contact_correction" not in bare
    assert "contact_correction" in held


def test_distant_particles_stay_exactly_at_rest() -> None:
    """Whatever an obstacle does elsewhere; the compiled engine does not look there."""
    scene = build_scene(pbdkit.Experiment(**block(**MEAN, obstacles=COME[:1])))
    state = Stepper(scene).advance(initial_state(scene), 3)
    top = scene.raster.table(state.u).any(axis=1)
    assert top.any()
    assert scene.raster.reference(np.flatnonzero(top))[:, 1].min() > 4.0


@pytest.mark.parametrize("shape", ["half-plane", "disc", "wedge"])
def test_equilibrium_is_the_limit_of_the_steps(shape: str) -> None:
    straight = run(pressed(shape, 0.4, solver={"type": "equilibrium"}))
    settle = {"type": "stepping", "memory": 0.75, "settle": {"tolerance": 1e-6}}
    stepped = run(pressed(shape, 0.4, solver=settle, steps=5000, record={"at": [0]}))
    assert (straight.status, stepped.status) == ("complete", "settled")
    far = np.abs(straight.position[-1].values - stepped.position[-1].values).max()
    assert far <= 0.4 * 1e-6 + 1e-9
    force, reaction = (straight[name].values[-1, 0] for name in ("contact_force", "reaction"))
    np.testing.assert_allclose(force + reaction, 0.0, atol=1e-6)
    assert force[1] < -0.1


def test_nonlinear_rules_reach_equilibrium_on_obstacles() -> None:
    springs = {"rule": {"type": "springs"}, "body": {"type": "grid", "columns": 7, "rows": 7}}
    straight = run(pressed("wedge", 0.4, **springs, solver={"type": "equilibrium"}))
    stepping = {"solver": {"type": "stepping", "memory": 0.8}, "record": {"at": [0]}}
    stepped = run(pressed("wedge", 0.4, **springs, **stepping, steps=500))
    assert straight.status == "complete"
    far = np.abs(straight.position[-1].values - stepped.position[-1].values).max()
    assert far <= 1e-6


def test_a_block_between_two_plates_is_compressed_uniformly() -> None:
    """Without friction the solution is affine: ε_y = -d / H, ε_x = ν d / H, F = E t W d / H."""
    plates = [
        {
            "shape": {"half_plane": {"point": [0.0, y], "normal": [0.0, 1.0 if y == 0 else -1.0]}},
            "motion": {"type": "displace", "displacement": [0.0, 0.05 if y == 0 else -0.05]},
        }
        for y in (0.0, 8.0)
    ]
    middle = [{"select": {"nearest": [[7.0, 4.0]]}, "motion": {"type": "hold"}}]
    contact = [{"type": "contact", "youngs_modulus": 2.0, "thickness": 3.0}]
    parts = {"solver": {"type": "equilibrium"}, "diagnostics": contact}
    ds = run(block(obstacles=plates, leaders=middle, **parts))
    X, u = ds.reference.values - [7.0, 4.0], (ds.position[-1] - ds.reference).values
    np.testing.assert_allclose(u, X * [0.3 * 0.1 / 8.0, -0.1 / 8.0], atol=1e-8)
    force = 2.0 * 3.0 * 14.0 * 0.1 / 8.0
    np.testing.assert_allclose(ds.contact_force[-1], [[0, force], [0, -force]], atol=1e-6)
    np.testing.assert_allclose(ds.contact[-1].sum("particle"), 0.0, atol=1e-6)


def half_widths(cells: int) -> tuple[float, float]:
    """Return half-width and peak of the pressure, fitted and by Hertz for the same force, with
    about that number of particles across the contact: p² = p_0² (1 - x² / a²), a² = 4 F' R / (π
    E*)."""
    a = cells / 2
    wide, high, radius = int(4 * a) * 2, int(5 * a), 20 * a
    given = block(
        body={"type": "grid", "columns": wide + 1, "rows": high + 1},
        leaders=[{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
        obstacles=[{
            "shape": {"type": "disc", "radius": radius, "centre": [wide / 2, high + radius]},
            "motion": {"type": "displace", "displacement": [0.0, -1.1 * a * a / radius]},
        }],
        steps=1, solver={"type": "equilibrium"},
        diagnostics=[{"type": "contact", "youngs_modulus": 1.0}],
    )  # fmt: skip
    ds = run(given)
    pressure = -ds.contact.values[-1, :, 1]
    on = pressure > 0.0
    x = ds.position.values[-1, on, 0] - wide / 2
    fit = np.polynomial.polynomial.polyfit(x * x, pressure[on] ** 2, 1)
    hertz = np.sqrt(4 * -ds.contact_force.values[-1, 0, 1] * radius / np.pi)
    return float(np.sqrt(-fit[0] / fit[1])), float(hertz)


def test_disc_on_a_block_matches_hertz() -> None:
    """At 40 cells within 3 % (docs/validation/accuracy.md); here coarser, and quicker."""
    fitted, hertz = half_widths(14)
    assert fitted == pytest.approx(hertz, rel=0.06)


def bending() -> tuple[float, float, float]:
    """Deflection over force of the shipped beam, that of Timoshenko, and the share of shear."""
    ds = pbdkit.run(pbdkit.load("modelling/three-point-bending"), progress=False)
    X, L, H = ds.reference.values, 160.0, 16.0
    left, middle, right = (
        ds.u.values[-1, np.abs(X - [x, H / 2]).sum(axis=1).argmin(), 1] for x in (10.0, 90.0, 170.0)
    )
    force = ds.contact_force.values[-1, :, 1].sum()
    np.testing.assert_allclose(ds.reaction[-1].sum("leader_group"), [0.0, -force], atol=1e-9)
    shear = L / (4 * 5 / 6 / 2.6 * H)
    beam = L**3 / (48 * H**3 / 12) + shear
    return float(((left + right) / 2 - middle) / force), beam, shear / beam


def test_three_point_bending_matches_timoshenko() -> None:
    found, beam, _ = bending()
    assert found == pytest.approx(beam, rel=0.015)


def test_unsupported_body_moves_to_its_supports() -> None:
    """A beam that hangs at one particle, a little above two discs, has no equilibrium of its own
    before it lies on them."""
    nose = {"type": "displace", "displacement": [0.0, -0.2]}
    discs = [{"shape": {"type": "disc", "radius": 2.0, "centre": [x, -2.05]}} for x in (2.0, 22.0)]
    given = block(
        body={"type": "grid", "columns": 25, "rows": 5}, obstacles=discs,
        leaders=[{"select": {"nearest": [[12.0, 4.0]]}, "motion": nose}],
        solver={"type": "equilibrium"}, diagnostics=[{"type": "contact", "youngs_modulus": 1.0}],
    )  # fmt: skip
    force = run(given).contact_force.values[-1]
    assert force[0, 1] > 1e-4
    np.testing.assert_allclose(force[0], force[1] * [-1.0, 1.0], atol=1e-9)


def test_future_obstacle_may_lie_in_the_body() -> None:
    shape = {"type": "disc", "radius": 2.5, "centre": [7.0, 4.0]}
    ds = run(block(obstacles=[{"shape": shape, "from": 3, "until": 4}], steps=5))
    closest = np.hypot(*(ds.position.values - [7.0, 4.0]).transpose(2, 0, 1)).min(axis=1)
    assert (closest[:3] < 0.1).all()
    assert (closest[3:5] > 2.5 - 1e-12).all()
    assert closest[5] < 2.5


@pytest.mark.parametrize("normal", [(1.0, 0.0), (0.0, -1.0)])
def test_an_obstacle_farther_away_than_the_size_of_the_body_gives_a_warning(normal: Any) -> None:
    corners = np.array([[0.0, 0.0], [14.0, 8.0]])
    near = (corners @ normal).min() - np.hypot(14.0, 8.0)
    for distance, count in ((0.1, 1), (-0.1, 0)):
        at = (near - distance) * np.array(normal)
        scene = build_scene(pbdkit.Experiment(**block(obstacles=[plane(at.tolist(), normal)])))
        assert sum("remains farther from the body" in text for text in scene.warnings) == count


MESSAGES: dict[str, tuple[dict[str, Any], str]] = {
    "grid": (
        {"shape": {"type": "grid", "columns": 2, "rows": 2}},
        "obstacles.0.shape.type: a grid has no outline and cannot be an obstacle; use a rectangle",
    ),
    "union": (
        {"shape": {"type": "union", "of": []}},
        "obstacles.0.shape.type: a union cannot be an obstacle; use one obstacle for each part",
    ),
    "dogbone": ({"shape": {"type": "dogbone"}}, "a dogbone cannot be an obstacle; use a polygon"),
    "misspelt": ({"shape": {"type": "dics"}}, "unknown type 'dics'; did you mean 'disc'?"),
    "no normal": (
        {"shape": {"half_plane": {"point": [0.0, 0.0], "normal": [0.0, 0.0]}}},
        "obstacles.0.shape.half_plane: the normal has no direction; give a vector other than",
    ),
    "until": (
        {"shape": SHAPES["disc"], "from": 4, "until": 2},
        "obstacles.0: until (2) is before from (4)",
    ),
    "inside": (
        {"shape": {"type": "disc", "radius": 1.2, "centre": [7.1, 4.0]}},
        "obstacles.0.shape: particle 68 at (7, 4) starts at a depth of 1.1 lattice units inside "
        "it; start the obstacle outside the body and move it there, or start it at a later step",
    ),
    "infinite": (
        {
            "shape": SHAPES["disc"],
            "motion": {"type": "velocity", "velocity": [1e300, 0.0], "steps": 10**10},
        },
        "obstacles.0.motion: the displacement at step",
    ),
    "never rests": (
        {
            "shape": SHAPES["disc"],
            "motion": {"type": "oscillation", "amplitude": [0.0, 0.1], "period": 9.0},
        },
        "obstacles.0.motion: never comes to rest, so that there is no equilibrium",
    ),
}


@pytest.mark.parametrize("fault", MESSAGES)
def test_refusals_name_place_and_remedy(fault: str) -> None:
    obstacle, text = MESSAGES[fault]
    steps = 10**11 if fault == "infinite" else 30
    given = block(obstacles=[obstacle], solver={"type": "equilibrium"}, steps=steps)
    with pytest.raises(pbdkit.ExperimentError) as error:
        run(given)
    assert text in str(error.value)


def test_contact_diagnostic_requires_obstacles() -> None:
    contact = {"type": "contact", "youngs_modulus": 1.0}
    with pytest.raises(
        pbdkit.ExperimentError, match="'contact' requires obstacles; the experiment has none"
    ):
        build_scene(pbdkit.Experiment(**block(obstacles=[], diagnostics=[contact])))


def test_sliding_body_has_no_unique_equilibrium() -> None:
    """Two plates hold a block between them, and nothing holds it along them."""
    sides = ((0.0, 1.0), (8.0, -1.0))
    plates = [{"shape": {"half_plane": {"point": [0.0, y], "normal": [0.0, n]}},
               "motion": {"type": "displace", "displacement": [0.0, 0.05 * n]}}
              for y, n in sides]  # fmt: skip
    with pytest.raises(pbdkit.ExperimentError, match="obstacles: there is no unique equilibrium: "):
        run(block(obstacles=plates, leaders=[], solver={"type": "equilibrium"}))


def test_leaders_driven_into_an_obstacle_give_a_warning() -> None:
    into = {"type": "velocity", "velocity": [0.0, 0.5], "steps": 4}
    given = block(leaders=[{"select": {"edge": "top"}, "motion": into}])
    warnings = build_scene(pbdkit.Experiment(**given)).warnings
    known = "leaders.0: moves particle 72 into obstacles.0 by step 1; obstacles stop followers"
    assert any(known in warning for warning in warnings)


def test_leaders_inside_an_obstacle_at_the_turn_of_their_path_only_give_a_warning() -> None:
    """The obstacle is .5 above the top edge, and the path begins in step 3."""
    path = {"type": "path", "steps": [4, 8], "displacements": [[0.0, 0.6], [0.0, 0.0]]}
    lid = {"shape": {"half_plane": {"point": [0.0, 8.5], "normal": [0.0, -1.0]}}}
    given = block(leaders=[{"select": {"edge": "top"}, "motion": path, "from": 3}])
    scene = build_scene(pbdkit.Experiment(**given | {"obstacles": [lid], "steps": 20}))
    assert sum("into obstacles.0 by step 6;" in warning for warning in scene.warnings) == 1


@pytest.mark.parametrize("a", [1.0, 0.5])
def test_a_turning_plate_is_displaced_at_the_distance_of_a_lattice_constant(a: float) -> None:
    """It turns about its point, which stays. The chord of the other point is 2a sin(30° / 2)."""
    turn = {"type": "rotation", "centre": [1.0, -1.0], "angle": 7.5, "steps": 4}
    plate = {"shape": {"half_plane": {"point": [1.0, -1.0], "normal": [0.6, 0.8]}}, "motion": turn}
    given = block(lattice={"type": "square", "a": a}, obstacles=[plate])
    (barrier,) = build_scene(pbdkit.Experiment(**given)).barriers
    chords = np.hypot(*barrier.offset(4).T)
    np.testing.assert_allclose(chords, [0.0, 2.0 * a * np.sin(np.radians(15.0))], atol=1e-15)


def test_run_is_reproduced_from_the_dataset_alone() -> None:
    ds = run(pressed("wedge", 0.4))
    again = pbdkit.rerun(ds)
    assert again.drop_attrs().identical(ds.drop_attrs())


def test_indentation_recovers_to_rest() -> None:
    ds = pbdkit.run(pbdkit.load("modelling/indentation"), progress=False)
    force = -ds.contact_force.values[:, 0, 1]
    deepest = int(force.argmax())
    assert ds.time[deepest] in (400, 420)
    assert force[deepest] > 0.3
    assert (np.diff(force[: deepest + 1]) > 0.0).all()
    assert force[-1] == 0.0
    np.testing.assert_allclose(ds.position[-1], ds.reference, atol=2e-4)
