"""Contact without friction: bodies rest on obstacles as in mechanics, by any path."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.equilibrium import load_stepping as increments
from pbdkit.equilibrium.contact_system import NO_FACE, hold
from pbdkit.scene.obstacles import Walls, contact_correction, outlines_at
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state
from tests.scene.test_obstacles import CASES, HEXAGONAL, SHAPES, block, moving, plane, run
from tests.stepping.numba_engine.test_engine import assert_bitwise_equal

SQUARE = {"neighbours": {"type": "chebyshev", "shells": 1}, "lattice": {"type": "square", "a": 1.0}}
TRIANGLES = {
    "neighbours": {"type": "coordination", "shells": 1},
    "lattice": {"type": "hexagonal", "a": 1.0},
}
ELASTIC, SPRINGS = {"type": "elastic", "poisson_ratio": 0.3}, {"type": "springs"}
THIRD = {"type": "elastic", "poisson_ratio": 1.0 / 3.0}
EQUILIBRIUM = {"type": "equilibrium"}
BOUND_KINDS = ["equilibrium", "stepping"]
FORCES = [{"type": name, "youngs_modulus": 1.0} for name in ("contact", "reaction")]


def stepping(relaxation: float, memory: float = 0.0, steps: int = 1500) -> dict[str, Any]:
    """Return a solver for a number of steps, of which the last is recorded."""
    solver = {"type": "stepping", "engine": "numpy", "relaxation": relaxation, "memory": memory}
    return {"solver": solver, "steps": steps, "record": {"at": [0]}}


def at_rest(**parts: Any) -> Any:
    """The last state of a run with its forces."""
    parts = {"solver": EQUILIBRIUM, "steps": 1, "diagnostics": FORCES} | parts
    return run(block(**SQUARE) | parts).isel(time=-1)


def moved(ds: Any) -> Any:
    return (ds.position - ds.reference).values


def imbalance(ds: Any) -> float:
    """|Σ reactions + Σ contact + Σ loads| over the largest of them."""
    parts = [ds.reaction.values, ds.contact_force.values]
    parts += [ds.load_resultant.values] if "load_resultant" in ds else []
    parts = np.concatenate(parts)
    return float(np.abs(parts.sum(axis=0)).max() / np.abs(parts).max())


def displaced(x: float, y: float) -> dict[str, Any]:
    return {"motion": {"type": "displace", "displacement": [x, y]}}


@pytest.mark.parametrize(
    ("kind", "solver"),
    [(SQUARE, stepping(0.9, 0.8, 250)), (TRIANGLES, {"solver": EQUILIBRIUM})],
    ids=["square, stepping", "hexagonal, equilibrium"],
)
def test_springs_between_plates_are_compressed_uniformly(kind: Any, solver: Any) -> None:
    """The result is that of elasticity with ν = 1/3 at small strain, corners and cut cells
    included."""
    found = []
    for rule in (SPRINGS, THIRD):
        height = 4.0 if kind is SQUARE else 4.0 * math.sqrt(0.75)
        plates = [
            plane([0.0, 0.0], [0.0, 1.0], **displaced(0.0, 1e-4 * height)),
            plane([0.0, height], [0.0, -1.0], **displaced(0.0, -1e-4 * height)),
        ]
        ds = at_rest(
            **kind, rule=rule, body={"type": "rectangle", "width": 4.0, "height": height},
            leaders=[{"select": {"nearest": [[2.0, height / 2]]}, "motion": {"type": "hold"}}],
            obstacles=plates, **solver,
        )  # fmt: skip
        X = np.c_[ds.reference.values, np.ones(len(ds.reference))]
        gradient = np.linalg.lstsq(X, moved(ds), rcond=None)[0]
        assert np.abs(X @ gradient - moved(ds)).max() < 1e-9
        assert imbalance(ds) < 1e-9
        found.append([*gradient[:2].ravel(), *np.abs(ds.contact_force.values[:, 1])])
    np.testing.assert_allclose(found[0][3], -2e-4, rtol=1e-9)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("kind", [SQUARE, TRIANGLES], ids=["square", "hexagonal"])
def test_inclined_plate_pushes_along_its_normal(kind: Any) -> None:
    """The obstacle is on a corner, where springs and elastic bodies deform equally."""
    corner, found = [9.0, 4.0] if kind is SQUARE else [9.5, 5.0 * math.sqrt(0.75)], []
    for rule in (SPRINGS, THIRD):
        ds = at_rest(
            **kind, rule=rule, body={"type": "rectangle", "width": 9.0, "height": 4.0},
            leaders=[{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
            obstacles=[plane(corner, [-0.1, -1.0], **displaced(0.0, -1e-4))],
        )  # fmt: skip
        force = ds.contact_force.values[0]
        assert force @ [1.0, -0.1] == pytest.approx(0.0, abs=1e-12)
        assert imbalance(ds) < 1e-10
        found.append([*force, *moved(ds)[np.abs(ds.contact.values).max(axis=1).argmax()]])
    np.testing.assert_allclose(found[0], found[1], rtol=2e-3)


def mirrored(given: Any) -> Any:
    """In x = 7, the middle of the block."""
    if isinstance(given, dict):
        of = {"centre", "point", "origin"}
        found = {k: [14.0 - v[0], v[1]] if k in of else mirrored(v) for k, v in given.items()}
        turned = {"normal", "displacement"} & {*given}
        found |= {k: [-given[k][0], given[k][1]] for k in turned}
        if given.get("type") == "rectangle":  # of which the origin is the left end
            found["origin"] = [14.0 - given["origin"][0] - given["width"], given["origin"][1]]
        return found
    return [mirrored(each) for each in given] if isinstance(given, list) else given


@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
@pytest.mark.parametrize(
    "solver", [{"solver": EQUILIBRIUM}, stepping(0.9, 0.0, 60)], ids=BOUND_KINDS
)
def test_mirrored_scenes_agree(rule: Any, solver: Any) -> None:
    given = {
        "rule": rule,
        "body": {"type": "rectangle", "width": 12.0, "height": 5.3, "origin": [1.0, 0.0]},
        "leaders": [{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
        "obstacles": [
            {
                "shape": {"type": "disc", "radius": 3.0, "centre": [4.3, 9.1]},
                **displaced(0.1, -0.4),
            },
            plane([13.0, 6.1], [-0.5, -1.0], **displaced(-0.1, -0.2)),
        ],
    }
    one, other = at_rest(**given, **solver), at_rest(**mirrored(given), **solver)
    back = np.lexsort((other.reference[:, 1], (14.0 - other.reference[:, 0]).round(9)))
    same = np.lexsort((one.reference[:, 1], one.reference[:, 0].round(9)))
    np.testing.assert_allclose(
        moved(one)[same], moved(other)[back] * [-1.0, 1.0], atol=1e-12 * 0.3, rtol=0
    )


INTO_A_CORNER = {
    "body": {"type": "grid", "columns": 7, "rows": 7},
    "leaders": [{"select": {"box": [4.5, 4.5, 6.5, 6.5]}, **displaced(-0.03, -0.03)}],
}


@pytest.mark.parametrize(
    ("rule", "slant"), in_turn([(SPRINGS, 0.0), (SPRINGS, 0.5), (ELASTIC, 0.5), (ELASTIC, 0.2)], 2)
)
def test_corner_between_obstacles_constrains_both_normals(rule: Any, slant: float) -> None:
    """A symmetric block that is pushed into it, whatever their order and however it gets there."""
    normals = [[1.0, slant], [slant, 1.0]]
    found = []
    for order in ((0, 1), (1, 0)):
        given = {"rule": rule, "obstacles": [plane([0.0, 0.0], normals[n]) for n in order]}
        found_by = [{"solver": EQUILIBRIUM | {"tolerance": 1e-10}}, stepping(0.9, 0.85, 350)]
        for solver in found_by if order == (0, 1) else found_by[:1]:
            ds = at_rest(**INTO_A_CORNER, **given, **solver)
            np.testing.assert_allclose(moved(ds)[0], 0.0, atol=1e-12)
            depth = -(ds.position.values[ds.kind.values == 1] @ np.array(normals).T)
            assert depth.max() < 1e-12
            assert imbalance(ds) < 1e-9
            force = ds.contact_force.values[list(order)]
            np.testing.assert_allclose(force[0], force[1][::-1], atol=1e-9)
            across = force[:, 0] * np.array(normals)[:, 1] - force[:, 1] * np.array(normals)[:, 0]
            np.testing.assert_allclose(across, 0.0, atol=1e-12)
            assert force[0, 0] > 1e-3
            found.append(moved(ds))
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-9)


@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
def test_groove_of_one_obstacle_acts_like_two_obstacles(rule: Any) -> None:
    """A particle in the corner of a polygon that is not convex touches both sides of it."""
    groove = [[0.0, 0.0], [-2.0, 10.0], [-9.0, 10.0], [-9.0, -9.0], [10.0, -9.0], [10.0, -2.0]]
    one = [{"shape": {"type": "polygon", "vertices": groove}}]
    two = [plane([0.0, 0.0], [1.0, 0.2]), plane([0.0, 0.0], [0.2, 1.0])]
    found = [at_rest(**INTO_A_CORNER, rule=rule, obstacles=each) for each in (one, two)]
    np.testing.assert_allclose(moved(found[0]), moved(found[1]), atol=1e-12)
    forces = [ds.contact_force.values.sum(axis=0) for ds in found]
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-12)
    assert max(map(imbalance, found)) < 1e-10


def test_duplicate_obstacle_has_no_effect() -> None:
    once = [plane([0.0, 0.0], [1.0, 0.2]), plane([0.0, 0.0], [0.2, 1.0])]
    one, two = (at_rest(**INTO_A_CORNER, obstacles=each) for each in (once, [*once, once[0]]))
    np.testing.assert_allclose(moved(one), moved(two), atol=1e-13)
    forces = [ds.contact_force.values for ds in (one, two)]
    np.testing.assert_allclose(forces[0][0], forces[1][[0, 2]].sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(forces[0][1], forces[1][1], atol=1e-12)


def on_rollers(half: bool, **parts: Any) -> Any:
    """A block, or its right half on rollers along the plane of symmetry, under a disc."""
    left = 0.0 if half else -7.0
    middle = {"box": [-0.1, -1.0, 0.1, 9.0]} if half else {"nearest": [[0.0, 0.0]]}
    return at_rest(
        body={"type": "rectangle", "width": 7.0 - left, "height": 4.0, "origin": [left, 0.0]},
        leaders=[
            {"select": {"edge": "bottom"}, "motion": {"type": "hold"}, "axes": ["y"]},
            {"select": middle, "motion": {"type": "hold"}, "axes": ["x"]},
        ],
        obstacles=[
            {"shape": {"type": "disc", "radius": 6.0, "centre": [0.0, 10.01]}, **displaced(0, -0.3)}
        ],
        **parts,
    )


@pytest.mark.parametrize(
    ("rule", "solver"),
    [(SPRINGS, {"solver": EQUILIBRIUM}), (ELASTIC, stepping(0.9, 0.6, 300))],
    ids=["springs, equilibrium", "elastic, stepping"],
)
def test_half_a_body_on_rollers_equals_the_whole(rule: Any, solver: Any) -> None:
    whole, half = (on_rollers(half, rule=rule, **solver) for half in (False, True))
    some = whole.reference.values[:, 0] > -0.1
    np.testing.assert_allclose(moved(whole)[some], moved(half), atol=1e-12)
    force = whole.contact_force.values[0, 1]
    assert 2.0 * half.contact_force.values[0, 1] == pytest.approx(force, rel=1e-9)
    if solver["solver"] is EQUILIBRIUM:
        assert max(imbalance(whole), imbalance(half)) < 1e-9


def test_run_on_rollers_converges_at_obstacles() -> None:
    solver = stepping(0.9, 0.6)["solver"] | {"settle": {"tolerance": 1e-6}}
    settled = on_rollers(True, solver=solver, steps=500, record={"at": [0]})
    assert settled.status == "settled"
    rest = on_rollers(True)
    np.testing.assert_allclose(moved(settled), moved(rest), atol=0.3e-6)


@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
def test_particle_guided_under_an_inclined_plate_slides_along_it(rule: Any) -> None:
    """Wherever steps come from, in the profile `long` also by another relaxation; what the plate
    exerts across the guide is a reaction of it."""
    corner = {"select": {"nearest": [[6.0, 4.0]]}, **displaced(0.0, 0.4), "axes": ["y"]}
    given = {
        "rule": rule, "body": {"type": "grid", "columns": 7, "rows": 5},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}, corner],
        "obstacles": [plane([6.0, 4.1], [-1.0, -1.0])],
    }  # fmt: skip
    steps = [stepping(0.8, 0.85, 300), stepping(0.4, 0.9, 400)]
    solvers = [{"solver": EQUILIBRIUM}, *in_turn(steps, 2)]
    found = [at_rest(**given, **solver) for solver in solvers]
    for ds in found:
        assert ds.position.values[-1] == pytest.approx([5.7, 4.4], abs=1e-12)
        np.testing.assert_allclose(moved(ds), moved(found[0]), atol=1e-6)
        assert ds.contact_force.values[0] == pytest.approx(ds.contact.values[-1], abs=1e-12)
        assert ds.contact_force.values[0, 0] == pytest.approx(ds.contact_force.values[0, 1])
        assert imbalance(ds) < 1e-5
    assert imbalance(found[0]) < 1e-10


def test_blocked_guided_particles_give_a_warning() -> None:
    """A plate across the axis along which they are led; one beneath which they can go is none."""
    right = {"select": {"edge": "right"}, **displaced(0.5, 0.0), "axes": ["x"]}
    hold = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
    for normal, count in (([-1.0, 0.0], 1), ([-1.0, -1.0], 0)):
        given = block(leaders=[hold, right], obstacles=[plane([14.2, 8.0], normal)])
        warnings = build_scene(pbdkit.Experiment(**given)).warnings
        assert sum("leaders.1: moves particle" in each for each in warnings) == count


CURVED = {
    "disc": {"type": "disc", "radius": 2.5, "centre": [5.2, 7.7]},
    "ring": {"type": "ring", "inner": 6.3, "outer": 9.0, "centre": [4.0, 0.0]},
}
PRESSING = {"disc": displaced(0.2, -1.4), "ring": displaced(-0.1, -0.15)}


@pytest.mark.parametrize("shape", CURVED)
def test_contact_at_round_outlines_is_path_independent(shape: str) -> None:
    """Cells are cut, so that the compliance of particles depends on the direction. Steps of another
    size are made in the profile `long`."""
    given = {
        **TRIANGLES, "rule": ELASTIC,
        "body": {"type": "rectangle", "width": 8.0, "height": 4.0},
        "leaders": [{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
        "obstacles": [{"shape": CURVED[shape], **PRESSING[shape], "from": 2}],
    }  # fmt: skip
    ways = [stepping(1.0, 0.7, 250), stepping(0.6, 0.8, 250)]
    ways = [{"solver": EQUILIBRIUM, "steps": 3}, *in_turn(ways, 2)]
    found = [at_rest(**given | way) for way in ways]
    assert np.count_nonzero(np.abs(found[0].contact.values).max(axis=1) > 0.0) > 0
    for ds in found:
        assert imbalance(ds) < 1e-7
        np.testing.assert_allclose(moved(ds), moved(found[0]), atol=1e-7)


@pytest.mark.parametrize("shape", ["disc", "ring", "polygon"])
def test_projection_is_linearised_exactly(shape: str) -> None:
    """Compare T with differences of the final positions of particles, which do not move along the
    normal."""
    parts = HEXAGONAL | {"obstacles": [{"shape": SHAPES[shape]}], "leaders": []}
    scene = build_scene(pbdkit.Experiment(**block(**parts, neighbours=TRIANGLES["neighbours"])))
    contact, place = Contact(scene), scene.raster.place_of(scene.raster.body_rows)
    assert contact.compliance is not None
    ((_, outline),) = outlines_at(scene.barriers, 1)
    u = np.zeros((2, *scene.raster.shape))
    gap, *normal = outline.facing(*contact.positions(u, place))
    depth = np.random.default_rng(0).uniform(0.1, 0.6, len(place))
    # Those that rest nearest are put inside, the nearest deepest.
    goes = gap < np.sort(gap)[9]
    u.reshape(2, -1)[:, place[goes]] -= (np.stack(normal) * (gap + depth))[:, goes]
    faces, turned = hold(contact, scene, u, place, 1)
    assert (faces[:, 0] != NO_FACE).any()

    def there(axis: int, by: float) -> Any:
        put = u.copy()
        put[axis] += by
        return contact.positions(put, place) + contact.corrections(put, place, 1)

    size = 1e-5
    columns = [(there(axis, size) - there(axis, -size)) / (2.0 * size) for axis in range(2)]
    np.testing.assert_allclose(turned, np.stack(columns).transpose(2, 1, 0), atol=1e-8)


def test_contact_of_a_disc_converges_quadratically() -> None:
    """Few sets are tried, since each is that of an exact linearisation."""
    disc = {"shape": {"type": "disc", "radius": 2.0, "centre": [7.0, 10.0]}, **displaced(0, -0.8)}
    held = [{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}]
    ds = run(block(leaders=held, obstacles=[disc], solver={"type": "equilibrium"}, steps=1))
    assert json.loads(ds.attrs["certificate"])["iterations"] <= 8


def test_a_body_that_loses_contact_is_not_pulled_back() -> None:
    """Lifted from a floor on which it rests, it does not hang on it."""
    up = {"select": {"edge": "top"}, **moving([0.0, 0.02])}
    given = {"leaders": [up], "obstacles": [plane([0.0, 0.0], [0.0, 1.0])], "steps": 25}
    ds = run(block(**given, rule=ELASTIC, diagnostics=FORCES[:1], record={"every": 1}))
    assert np.array_equal(ds.contact_force.values[:, 0], 0.0 * ds.contact_force.values[:, 0])


def test_body_pressed_by_obstacles_may_buckle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip before a plate has a straight equilibrium, which is not stable."""
    monkeypatch.setattr(increments, "MAX_ROUNDS", 2)
    ends = [{"select": {"edge": "left"}, "motion": {"type": "hold"}}]
    given = {
        "body": {"type": "grid", "columns": 17, "rows": 3}, "rule": SPRINGS, "leaders": ends,
        "obstacles": [plane([16.0, 0.0], [-1.0, 0.0], **displaced(-1.9, 0.0))],
    }  # fmt: skip
    with pytest.raises(pbdkit.DivergedError, match="branches into several equilibria"):
        at_rest(**given)


@pytest.mark.parametrize("rule", [SPRINGS, ELASTIC], ids=["springs", "elastic"])
@pytest.mark.parametrize("select", [{"edge": "bottom"}, {"nearest": [[14.0, 0.0]]}], ids=str)
def test_loads_on_a_just_touching_floor(rule: Any, select: Any) -> None:
    """Nothing moves, and the floor bears all that leaders do not."""
    loads = [*FORCES, {"type": "load-displacement", "youngs_modulus": 1.0}]
    ds = at_rest(
        rule=rule, loads=[{"select": select, "force": [0.0, -0.01]}], diagnostics=loads,
        obstacles=[plane([0.0, 0.0], [0.0, 1.0])],
    )  # fmt: skip
    np.testing.assert_allclose(moved(ds), 0.0, atol=1e-12)
    assert imbalance(ds) < 1e-12
    led = 1.0 / 15 if "edge" in select else 0.0
    assert ds.contact_force.values[0, 1] == pytest.approx(0.01 * (1.0 - led), rel=0.1)


BALANCED = {
    "between": ({"obstacles": CASES["between obstacles"]["obstacles"][:4]}, 10),
    "between, springs": (
        {"obstacles": CASES["between obstacles"]["obstacles"][:4], "rule": SPRINGS}, 10,
    ),
    "in a groove": (
        {k: CASES["in a groove"][k] for k in ("body", "obstacles")}
        | {"leaders": [{"select": {"box": [-1, -1, 2.1, 9]}, "motion": {"type": "hold"}}]}, 13,
    ),
    "hexagonal": (
        HEXAGONAL | {"neighbours": TRIANGLES["neighbours"]}
        | {"obstacles": [plane([14.0, 7.6], [-0.3, -1.0], **moving([0.0, -0.05]))]}, 10,
    ),
    "orthotropic": (
        {"rule": {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.4,
                  "shear_ratio": 0.3},
         "obstacles": [plane([14.0, 8.1], [-0.3, -1.0], **moving([0.0, -0.05]))]}, 10,
    ),
    "strain-gradient": (
        {"rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.5},
         "obstacles": [plane([14.0, 8.1], [-0.3, -1.0], **moving([0.0, -0.05]))]}, 10,
    ),
    "regions": (
        {"regions": {"soft": {"type": "disc", "radius": 3.3, "centre": [11.0, 7.0]}},
         "rule": {"type": "elastic", "poisson_ratio": 0.3,
                  "stiffness": {"otherwise": 1.0, "soft": 0.1}},
         "obstacles": [{"shape": SHAPES["disc"], **moving([0.02, -0.05])},
                       plane([14.0, 8.0], [-1.0, -0.6], **moving([-0.02, -0.02]))]}, 10,
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "loaded"), [(case, n % 2 == 1) for n, case in enumerate(in_turn(BALANCED, 3))]
)
def test_forces_balance_in_every_equilibrium(case: str, loaded: bool) -> None:
    """Nothing is inside an obstacle, either."""
    parts, steps = BALANCED[case]
    if loaded:
        load = {"select": {"box": [6.5, 2.5, 9.5, 5.5]}, "force": [0.01, 0.02]}
        parts = parts | {"loads": [load]}
    loads = [{"type": "load-displacement", "youngs_modulus": 1.0}] if loaded else []
    given = {"diagnostics": [*FORCES, *loads], "steps": steps, "solver": EQUILIBRIUM}
    ds = run(block(**SQUARE) | parts | given).isel(time=-1)
    assert imbalance(ds) < 1e-8
    scene = build_scene(pbdkit.Experiment(**block(**SQUARE) | parts | given))
    origin = np.array(scene.raster.lattice.origin)
    for _, outline in outlines_at(scene.barriers, steps):
        at = (ds.position.values[ds.kind.values == 1] - origin).T
        assert outline.facing(*at)[0].min() > -1e-12
    assert np.abs(ds.contact_force.values).max() > 1e-4


def masses(**parts: Any) -> dict[str, Any]:
    """Return a block with a right edge that flies to the right."""
    fly = {"type": "newton", "mass": 50.0, "velocity": [0.05, 0.01]}
    given = {
        "body": {"type": "grid", "columns": 6, "rows": 4}, "rule": ELASTIC,
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}},
                    {"select": {"edge": "right"}, "motion": fly}],
        "obstacles": [plane([5.1, 0.0], [-1.0, 0.0])], "steps": 30,
    }  # fmt: skip
    return block(**given | parts)


def test_masses_are_stopped_by_obstacles() -> None:
    """They lose what they have of velocity along the normal, and fly on along the obstacle."""
    ds = run(masses())
    x, y = ds.position.values[:, -4:].transpose(2, 0, 1)
    at_wall = np.abs(x - 5.1) < 1e-12
    assert x.max() < 5.1 + 1e-12
    first = int(at_wall.all(axis=1).argmax())
    assert first == 3
    # The remainder is the pull of neighbours in a step, not a reflected velocity of .05.
    assert np.abs(np.diff(x[first : first + 9], axis=0)).max() < 0.005
    assert (np.diff(y[:5], axis=0) > 0.0).all()


def test_obstacle_pushes_masses() -> None:
    """A plate that comes has them go with it; one that appears where they are flings none away."""
    plate = plane([5.2, 0.0], [-1.0, 0.0], **moving([-0.02, 0.0], 10))
    ds = run(masses(obstacles=[plate], steps=10))
    x, wall = ds.position.values[:, -1, 0], 5.2 - 0.02 * ds.time.values
    assert (x <= wall + 1e-12).all()
    assert np.count_nonzero(np.abs(x - wall) < 1e-12) >= 2
    assert np.diff(x)[5:].max() < -0.02  # with the plate, then pulled back
    late = run(masses(obstacles=[plane([4.5, 0.0], [-1.0, 0.0], **{"from": 5})], steps=8))
    assert np.diff(late.position.values[:, -1, 0])[-1] == pytest.approx(0.0, abs=0.02)
    assert late.position.values[5:, -1, 0].max() <= 4.5 + 1e-12


def test_kernels_step_masses_at_obstacles_identically() -> None:
    from interpreted_kernels import interpreting

    scene = build_scene(pbdkit.Experiment(**masses()))
    with interpreting():
        state = assert_bitwise_equal(scene, CompiledStepper(scene))
    assert np.abs(state.u).max() > 0.05


def test_colliding_plates_leave_particles_at_least_depth() -> None:
    """If no place is free there is no other result, and no particle flies off."""
    plates = [plane([0.0, 8.0 - d], [0.0, -n]) for n, d in ((1.0, 0.1), (-1.0, 0.0))]
    plates = [plates[0] | {"from": 2}, plane([0.0, 8.0], [0.0, 1.0], **{"from": 2})]
    scene = build_scene(pbdkit.Experiment(**block(obstacles=plates)))
    state = Stepper(scene).advance(initial_state(scene), 3)
    assert np.isfinite(state.u).all()
    assert np.abs(state.u).max() < 9.0


@pytest.mark.parametrize(
    "lattice",
    [
        {"type": "square", "a": 1.0},
        {"type": "rectangular", "a": 1.0, "b": 2.3},
        {"type": "hexagonal", "a": 1.0},
    ],
    ids=lambda lattice: lattice["type"],
)
def test_exactly_the_particles_inside_an_obstacle_are_pushed(lattice: Any) -> None:
    """Whichever part of the body the obstacle covers, for every displacement of the body. The
    displacements are those of the function for single particles, to the last bit."""
    normals = ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.3, -1.0], [-1.0, 0.2])
    shapes = [{"half_plane": {"point": [4.4, 3.3], "normal": normal}} for normal in normals]
    shapes += [{"type": "disc", "radius": 2.7, "centre": at} for at in ([0.3, 0.2], [8.8, 6.9])]
    for shape in shapes:
        given = block(
            lattice=lattice,
            neighbours=(TRIANGLES if lattice["type"] == "hexagonal" else SQUARE)["neighbours"],
            body={"type": "rectangle", "width": 9.2, "height": 7.1},
            rule=ELASTIC, leaders=[], steps=3,
            obstacles=[{"shape": shape, "from": 2}],
        )  # fmt: skip
        scene = build_scene(pbdkit.Experiment(**given))
        contact, raster = Contact(scene), scene.raster
        place = raster.place_of(raster.body_rows)
        ((_, outline),) = outlines_at(scene.barriers, 2)
        walls = Walls.of([outline])
        along = np.indices(raster.shape).sum(axis=0) / sum(raster.shape)
        for shift in (0.0 * along, 2.0 * along - 1.1):
            u = np.stack([shift, shift])
            at = contact.positions(u, place)
            inside = outline.facing(*at)[0] < 0.0
            assert 0 < inside.sum() < len(place)
            contact.push_out(u, 2)
            w = u.reshape(2, -1)[:, place] - shift.ravel()[place]
            np.testing.assert_array_equal((w != 0.0).any(axis=0), inside)
            one = int(np.flatnonzero(inside)[-1])
            C = contact.compliance_at(place[[one]])[:, 0]
            exact = contact_correction(*at[:, one], *C, 0, *walls)
            shifted = np.array(exact) + shift.ravel()[place[one]]
            np.testing.assert_array_equal(u.reshape(2, -1)[:, place[one]], shifted)


@pytest.mark.parametrize("axes", [["x"], ["y"]])
def test_guided_particles_are_pushed_along_their_free_axis_only(axes: Any) -> None:
    guided = {"select": {"edge": "right"}, **displaced(0.0, 0.0), "axes": axes}
    hold = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
    shape = {"half_plane": {"point": [13.5, 0.0], "normal": [-1.0, 0.6]}}
    given = block(leaders=[hold, guided], obstacles=[{"shape": shape, "from": 2}], steps=3)
    scene = build_scene(pbdkit.Experiment(**given))
    place = scene.leading[1].place
    w = Contact(scene).corrections(np.zeros((2, *scene.raster.shape)), place, 2)
    for axis, name in enumerate("xy"):
        assert w[axis].any() == (name not in axes)


@pytest.mark.parametrize("is_guided", [False, True])
def test_particles_slide_along_a_face_parallel_to_their_guide(is_guided: bool) -> None:
    guided = {"select": {"edge": "bottom"}, **displaced(0.0, 0.0), "axes": ["y"]}
    floor = plane([0.0, 0.0], [0.0, 1.0])
    given = block(leaders=[guided] if is_guided else [], obstacles=[floor])
    scene = build_scene(pbdkit.Experiment(**given))
    u = np.zeros((2, *scene.raster.shape))
    place = scene.raster.place_of(scene.raster.body_rows)
    place = place[Contact(scene).positions(u, place)[1] == 0.0]
    faces, turned = hold(Contact(scene), scene, u, place, 1.0)
    assert (turned[:, :, 0] == [1.0, 0.0]).all()
    assert (turned[:, 1] == 0.0).all()
    assert (faces[:, 0] == (NO_FACE if is_guided else 0)).all()
    assert len(faces) == 15
