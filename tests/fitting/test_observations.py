"""Points of a measured field that count: their depth in a body, and the particles around them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial import KDTree

import pbdkit
from pbdkit.fitting.observations import Interpolation, boundaries, deeper, depths
from pbdkit.model.bodies import AnyBody, Sites
from pbdkit.plugin import Vector
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state
from tests.fitting.test_fit import plate

BODY = TypeAdapter(AnyBody)


NEXT = {
    "neighbours": {"type": "coordination", "shells": 1}, "frame": {"type": "none"},
    "rule": {"type": "barycentre"},
}  # fmt: skip
"""A scene of any lattice."""


def box(width, height, x=0.0, y=0.0):
    return {"type": "rectangle", "width": width, "height": height, "origin": [x, y]}


OUTLINES = {
    "rectangle": box(6.0, 4.0, 1.0, 0.5),
    "disc": {"type": "disc", "radius": 2.5, "centre": [4.0, 3.0]},
    "ring": {"type": "ring", "inner": 1.0, "outer": 2.5, "centre": [4.0, 3.0]},
    "polygon": {"type": "polygon", "vertices": [[1.0, 0.5], [7.0, 1.0], [6.0, 5.0], [3.5, 2.0]]},
    "dogbone": {"type": "dogbone", "length": 8.0, "width": 4.0, "gauge_length": 2.0,
                "gauge_width": 1.5, "radius": 1.5},
    "dogbone with steep fillets": {"type": "dogbone", "length": 8.0, "width": 4.0,
                                   "gauge_length": 2.0, "gauge_width": 1.5, "radius": 0.8},
    "parts side by side": {"type": "union", "of": [box(3.3, 4.0), box(3.0, 4.0, 3.3)]},
    "parts of one another": {"type": "union", "of": [box(7.0, 1.0, 0.0, 1.5), box(1.0, 5.0, 3.0)]},
    "a hole with corners": {"type": "difference", "of": [box(8.0, 6.0), box(2.0, 1.0, 3.0, 2.5)]},
    "a notch": {"type": "difference", "of": [
        box(8.0, 6.0), {"type": "disc", "radius": 1.5, "centre": [8.0, 3.0]}]},
    "what is common": {"type": "intersection", "of": [
        box(5.0, 3.0, 1.0, 1.0), {"type": "disc", "radius": 2.5, "centre": [4.0, 3.0]}]},
}  # fmt: skip


@pytest.mark.parametrize("name", OUTLINES)
def test_depth_of_a_point_is_the_distance_to_the_nearest_outside_point(name):
    """Compared with the signs of points all over, with distances as fine as they are."""
    body, fine = BODY.validate_python(OUTLINES[name]), 0.03
    x, y = (each.ravel() for each in np.meshgrid(*[np.arange(-1.0, 9.0, fine)] * 2))
    places = np.stack([x, y], axis=1)
    inside = body.distance(Sites((np.zeros(len(x), int),) * 2, Vector(x, y))) <= 0.0
    some = np.random.default_rng(0).choice(len(x), 400)
    found = depths(body, pbdkit.Experiment(**plate()).lattice, places[some])
    assert ((found >= 0.0) == inside[some])[np.abs(found) > 1e-9].all()
    for sign, others in ((1.0, ~inside), (-1.0, inside)):
        own = some[inside[some] == (sign > 0.0)]
        nearest, _ = KDTree(places[others]).query(places[own])
        depth = sign * found[inside[some] == (sign > 0.0)]
        assert (depth <= nearest + 1e-6).all()
        assert (depth >= nearest - 4.0 * fine).all()  # in tips


LATTICES = {
    "square": ({"type": "square", "a": 0.5, "origin": [3.0, -2.0]}, 0.5, 0.5),
    "rectangular": ({"type": "rectangular", "a": 1.0, "b": 0.7}, 1.0, 0.7),
}


def lattice(given):
    return pbdkit.Experiment(**plate(lattice=given)).lattice


@pytest.mark.parametrize("name", LATTICES)
def test_grid_has_the_depth_of_the_equal_rectangle(name):
    """The body alone, with a hole, beside another body, and cut out of another: the remaining part
    then ends at the particles next to it."""
    given, a, b = LATTICES[name]
    x, y = given.get("origin", [0.0, 0.0])
    grid, same = {"type": "grid", "columns": 7, "rows": 5}, box(6 * a, 4 * b, x, y)
    hole = {"type": "disc", "radius": 0.8 * a, "centre": [x + 3 * a, y + 2 * b]}
    beside = box(3 * a, 4 * b, x + 6 * a, y)
    around, wider = box(14 * a, 12 * b, x - 4 * a, y - 4 * b), box(8 * a, 6 * b, x - a, y - b)
    pairs = [
        (grid, same),
        *(
            ({"type": kind, "of": [grid, other]}, {"type": kind, "of": [same, other]})
            for kind, other in (("difference", hole), ("union", beside), ("intersection", hole))
        ),
        tuple({"type": "difference", "of": [around, cut]} for cut in (grid, wider)),
    ]
    points = np.random.default_rng(1).uniform(
        [x - 3 * a, y - 3 * b], [x + 9 * a, y + 7 * b], (200, 2)
    )
    for one, other in pairs:
        found = [
            depths(BODY.validate_python(each), lattice(given), points) for each in (one, other)
        ]
        np.testing.assert_allclose(*found, atol=1e-8 * a)


def test_triangular_grid_ends_at_its_sides():
    """The zigzag of its left and right sides is part of the outline."""
    grid = BODY.validate_python({"type": "grid", "columns": 6, "rows": 5})
    high = 3**0.5 / 2
    points = np.array([[0.25, high], [0.5, high], [1.0, high], [2.5, 2 * high], [2.5, 0.0]])
    found = depths(grid, lattice({"type": "hexagonal", "a": 1.0}), points)
    across = 0.25 * high
    np.testing.assert_allclose(found, [-across, 0.0, 0.5, 2 * high, 0.0], atol=1e-9)


def test_points_on_the_margin_count_in_any_unit():
    """A rectangle of 12 x 8 spacings, a grid of as many and the rectangle in millimetres."""
    inner = np.stack(np.meshgrid(np.arange(13.0), np.arange(9.0)), axis=-1).reshape(-1, 2)
    kept = ((inner >= 3.0) & (inner <= [9.0, 5.0])).all(axis=1)
    for a in (1.0, 0.1, 1e-6):
        given = lattice({"type": "square", "a": a})
        for body in (box(12 * a, 8 * a), {"type": "grid", "columns": 13, "rows": 9}):
            found = deeper(BODY.validate_python(body), given, a * inner, 3 * a)
            assert (found == kept).all()
    units = {"length": "0.5 mm"}
    made = plate(
        units=units, body=box("6 mm", "4 mm"), regions={}, leaders=[],
        lattice={"type": "square", "a": "0.5 mm"},
    )  # fmt: skip
    experiment = pbdkit.Experiment(**made)
    assert (deeper(experiment.body, experiment.lattice, inner, 3.0) == kept).all()


def test_margin_excludes_as_many_points_of_a_grid_as_of_a_rectangle(tmp_path):
    points = np.random.default_rng(2).uniform([0.0, 0.0], [12.0, 8.0], (300, 2))
    rows = np.c_[points, 0.01 * points[:, 0], -0.003 * points[:, 1]]
    np.savetxt(tmp_path / "field.csv", rows, delimiter=",", header="x,y,ux,uy", comments="")
    expected = ((points >= 1.5) & (points <= [10.5, 6.5])).all(axis=1).sum()
    drawn = {"type": "displace", "displacement": [0.12, 0.0]}
    for body in (box(12.0, 8.0), {"type": "grid", "columns": 13, "rows": 9}):
        made = plate(
            body=body, regions={}, lattice={"type": "square", "a": 1.0},
            leaders=[{"select": {"edge": "left"}, "motion": {"type": "hold"}},
                     {"select": {"edge": "right"}, "motion": drawn}],
        )  # fmt: skip
        given = {"file": str(tmp_path / "field.csv"), "noise": 1e-3, "margin": 1.5}
        found = pbdkit.fit(
            {"experiment": made, "unknown": {"rule.poisson_ratio": [0.0, 0.49]}, "measured": given}
        )
        assert found.misfits[0].numbers == 2 * expected
        assert found.misfits[0].left_out == 300 - expected
        assert "nearer to its outline than the margin" in found.misfits[0].left_out_because


@pytest.mark.parametrize("radius", [0.3, 1.6, 2.6])
@pytest.mark.parametrize("kind", ["hexagonal", "centred-rectangular"])
def test_points_in_a_hole_lie_between_no_particles(kind, radius):
    """Points in a hole have a corner of their triangle outside the body; elsewhere a linear field
    is reproduced."""
    high = 3**0.5 if kind == "hexagonal" else 1.3
    given = {"type": kind, "a": 1.0} | ({} if kind == "hexagonal" else {"b": high})
    centre = np.array([5.0, 2 * high])
    of = [{"type": "grid", "columns": 11, "rows": 9},
          {"type": "disc", "radius": radius, "centre": centre.tolist()}]  # fmt: skip
    body = {"type": "difference", "of": of}
    made = plate(lattice=given, body=body, regions={}, leaders=[]) | NEXT
    scene = build_scene(pbdkit.Experiment(**made))
    points = np.random.default_rng(3).uniform([0.6, 0.0], [9.9, 4 * high], (600, 2))
    found = Interpolation.at(scene, points)
    everything = build_scene(pbdkit.Experiment(**made | {"body": of[0]}))
    whole = Interpolation.at(everything, points)
    assert whole.inside.sum() > 550
    corners = everything.raster.reference(whole.rows.ravel()).reshape(-1, 3, 2)
    there = np.linalg.norm(corners - centre, axis=-1) >= radius
    expected = whole.inside.copy()
    expected[whole.inside] = (there | (whole.shares < 1e-12)).all(axis=1)
    assert (~expected & whole.inside).any()
    assert (found.inside == expected).all()
    u = np.zeros((2, *scene.raster.shape))
    rows = scene.raster.body_rows
    slopes = np.array([[0.1, 0.2], [-0.3, 0.4]])
    u.reshape(2, -1)[:, scene.raster.place_of(rows)] = (scene.raster.reference(rows) @ slopes.T).T
    np.testing.assert_allclose(found.of(u, scene), points[found.inside] @ slopes.T, atol=1e-12)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_points_in_initially_broken_cells_are_excluded(kind):
    """On both sides of a cut the field is another; no point is between."""
    cut = {"from": [-1.0, 2.6], "to": [5.3, 2.6]}
    made = plate(
        lattice={"type": kind, "a": 1.0}, body=box(10.0, 5.0), regions={}, leaders=[], cuts=[cut]
    ) | (NEXT if kind == "hexagonal" else {})
    scene = build_scene(pbdkit.Experiment(**made))
    points = np.random.default_rng(4).uniform([0.6, 0.0], [9.0, 4.3], (400, 2))
    found, uncut = (
        Interpolation.at(scene, points),
        Interpolation.at(build_scene(pbdkit.Experiment(**made | {"cuts": []})), points),
    )
    gone = points[uncut.inside & ~found.inside]
    assert 10 < len(gone) < 100
    assert (np.abs(gone[:, 1] - 2.6) < 1.0).all()
    assert (gone[:, 0] < 6.4).all()
    state = initial_state(scene)
    above = scene.raster.reference(scene.raster.body_rows)[:, 1] > 2.6
    u = state.u.reshape(2, -1)
    u[:, scene.raster.place_of(scene.raster.body_rows)] = above
    left = points[found.inside][:, 0] < 4.0
    jumps = found.of(state.u, scene)[left]
    assert np.isclose(jumps, 0.0).sum() + np.isclose(jumps, 1.0).sum() == jumps.size


def test_measured_boundaries_share_no_particle():
    """Each is estimated by itself, so that a corner would go two ways; a box leaves it out."""
    made = plate()
    ends = [group["motion"] for group in made["leaders"]]
    motion = {
        key: [each[key][0] for each in ends] for key in ("points", "displacements")
    }  # at the lower corners
    bottom = {"select": {"edge": "bottom"}, "motion": {"type": "measured", **motion}}
    made["leaders"].append(bottom)
    told = r"leader groups 0 and 2 share the particle at \(0, 0\).*`modes: 0`"
    with pytest.raises(pbdkit.ExperimentError, match=told):
        boundaries(build_scene(pbdkit.Experiment(**made)), 3)
    made["leaders"][2] = bottom | {"select": {"box": [0.5, -0.1, 19.5, 0.1]}}
    assert len(boundaries(build_scene(pbdkit.Experiment(**made)), 3)) == 3
    bottom = bottom | {"axes": ["y"]}
    across = [group | {"axes": ["x"]} for group in plate()["leaders"]]
    made["leaders"] = [*across, bottom]
    assert len(boundaries(build_scene(pbdkit.Experiment(**made)), 3)) == 3
