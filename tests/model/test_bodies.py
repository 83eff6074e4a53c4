"""Bodies, category changes, and what is refused about them; their numbers are compared with the
plain loops on random scenes."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

import pbdkit
from pbdkit.model.bodies import Sites
from pbdkit.plugin import Vector
from pbdkit.scene.scene import build_scene

HOLD = {"motion": {"type": "hold"}}


def scene(**parts):
    given = {
        "name": "body",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 6, "rows": 5},
        "rule": {"type": "barycentre"},
        "steps": 20,
    }
    return given | parts


def body_sites(body, **parts):
    raster = build_scene(pbdkit.Experiment(**scene(body=body, **parts))).raster
    return {tuple(site) for site in raster.site_of(raster.body_rows).tolist()}


def test_sites_on_an_outline_belong_to_the_body():
    for shift in (0.0, 5e-10, -5e-10):
        assert len(body_sites({"type": "disc", "radius": 2.0 + shift, "centre": [0, 0]})) == 13
    assert len(body_sites({"type": "disc", "radius": 2.0 - 1e-8, "centre": [0, 0]})) == 9
    assert len(body_sites({"type": "rectangle", "width": 3.0, "height": 2.0})) == 12
    triangle = {"type": "polygon", "vertices": [[0, 0], [4, 0], [0, 4]]}
    assert len(body_sites(triangle)) == 15


def test_outline_of_a_cutout_stays_in_the_body():
    disc = {"type": "disc", "radius": 2.0, "centre": [5.0, 5.0]}
    whole = {"type": "rectangle", "width": 10.0, "height": 10.0}
    cut = body_sites({"type": "difference", "of": [whole, disc]})
    assert len(cut) == 121 - 9
    assert (7, 5) in cut
    both = body_sites({"type": "intersection", "of": [whole, disc]})
    assert both & cut == {(3, 5), (7, 5), (5, 3), (5, 7)}
    assert both | cut == body_sites({"type": "union", "of": [whole, disc]})


def test_a_far_body_is_the_same_body():
    far = {"type": "disc", "radius": 2.0, "centre": [1e6, -1e6]}
    origin = {"type": "square", "a": 1.0, "origin": [1e6, -1e6]}
    near = body_sites({"type": "disc", "radius": 2.0, "centre": [0, 0]})
    assert body_sites(far, lattice=origin) == near


PARTS = {
    "rectangle": {"width": 4.0, "height": 3.0, "origin": [0.5, 1.0]},
    "disc": {"radius": 2.0, "centre": [3.0, 2.5]},
    "ring": {"inner": 1.0, "outer": 2.0, "centre": [3.0, 2.5]},
    "polygon": {"vertices": [[0.0, 0.0], [5.0, 1.0], [3.0, 4.0]]},
    "dogbone": {
        "length": 6.0, "width": 5.0, "gauge_length": 2.0, "gauge_width": 1.0, "radius": 1.0
    },
    "dogbone with flat fillets": {
        "length": 6.0, "width": 3.0, "gauge_length": 1.0, "gauge_width": 1.5, "radius": 3.0
    },
}  # fmt: skip
OUTLINES = [{"type": name.split()[0], **part} for name, part in PARTS.items()]
COMPOSED = [
    {"type": name, "of": [OUTLINES[0], OUTLINES[1], OUTLINES[3]]}
    for name in ("union", "intersection", "difference")
]


@pytest.mark.parametrize("body", OUTLINES + COMPOSED, ids=lambda body: body["type"])
def test_area_is_where_the_distance_is_negative(body):
    body = pbdkit.Experiment(**scene(body=body)).body
    at = Vector(*np.random.default_rng(1).uniform(-0.5, 6.5, (2, 4000)))
    away = body.distance(Sites((np.zeros(4000, int),) * 2, at))
    clear = np.abs(away) > 1e-3
    assert clear.sum() > 3900
    inside = shapely.contains_xy(body.area(), *at)
    np.testing.assert_array_equal(inside[clear], away[clear] < 0.0)
    assert 0 < inside.sum() < 4000


def test_body_with_a_grid_has_no_area():
    grid = {"type": "difference", "of": [GRID, PARTS["disc"] | {"type": "disc"}]}
    assert pbdkit.Experiment(**scene(body=grid)).body.area() is None


GRID = {"type": "grid", "columns": 5, "rows": 4}


@pytest.mark.parametrize("frame", ["natural", "none"])
@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
@pytest.mark.parametrize("made", ["grid", "difference", "union", "intersection"])
def test_grid_is_the_same_body_in_all_units_and_positions(made, lattice, frame):
    def sites(a, origin):
        x, y = (n * a + shift for n, shift in zip((1.5, 1.5), origin, strict=True))
        disc = {"type": "disc", "radius": 0.9 * a, "centre": [x, y]}
        body = GRID if made == "grid" else {"type": made, "of": [GRID, disc]}
        return body_sites(
            body,
            lattice={"type": lattice, "a": a, "origin": origin},
            neighbours={"type": "chebyshev" if lattice == "square" else "coordination"},
            rule={"type": "elastic", "poisson_ratio": 0.3},
            frame={"type": frame},
        )

    expected = sites(1.0, [0.0, 0.0])
    for a in (2.0**-40, 2.0**10, 2.0**30, 2.0**40):
        assert sites(a, [0.0, 0.0]) == expected
    if made == "grid":
        assert len(expected) == 20
        assert sites(1e3, [3e16, -2e16]) == expected


def test_a_dogbone_is_narrow_in_the_middle():
    bone = {
        "type": "dogbone",
        "length": 30.0,
        "width": 10.0,
        "gauge_length": 8.0,
        "gauge_width": 4.0,
        "radius": 5.0,
    }
    sites = body_sites(bone)
    heights = [sum(i == column for i, _ in sites) for column in range(31)]
    assert heights == heights[::-1]
    assert heights[0] == 11
    assert heights[15] == 5
    assert heights[:16] == sorted(heights[:16], reverse=True)


@pytest.mark.parametrize(("gap", "narrow"), [(1.0, True), (2.0, True), (3.0, False)])
def test_slot_too_narrow_for_the_frame_gives_a_warning(gap, narrow):
    """One frame layer wants three empty sites between two faces."""
    left = {"type": "rectangle", "width": 4.0, "height": 8.0}
    right = left | {"origin": [5.0 + gap, 0.0]}
    joint = {"type": "rectangle", "width": 9.0, "height": 2.0}
    body = {"type": "union", "of": [left, right, joint]}
    warnings = build_scene(pbdkit.Experiment(**scene(body=body))).warnings
    assert any("narrower than 3 sites" in warning for warning in warnings) == narrow


REFUSED = {
    "empty body": (
        {"body": {"type": "disc", "radius": 0.1, "centre": [0.5, 0.5]}},
        "contains no site of the lattice; enlarge it, or move it$",
    ),
    "hole larger than the body": (
        {
            "body": {
                "type": "difference",
                "of": [
                    {"type": "grid", "columns": 4, "rows": 4},
                    {"type": "disc", "radius": 9.0, "centre": [0, 0]},
                ],
            }
        },
        "contains no site of the lattice; make the parts that are subtracted smaller, or the first",
    ),
    "ring inside out": (
        {"body": {"type": "ring", "inner": 3.0, "outer": 2.0, "centre": [0, 0]}},
        r"inner \(3\) must be below outer",
    ),
    "crossed polygon": (
        {"body": {"type": "polygon", "vertices": [[0, 0], [2, 2], [2, 0], [0, 2]]}},
        "not simple: Self-intersection",
    ),
    "fillets too long": (
        {
            "body": {
                "type": "dogbone",
                "length": 10.0,
                "width": 8.0,
                "gauge_length": 6.0,
                "gauge_width": 2.0,
                "radius": 4.0,
            }
        },
        "increase the length, or decrease the radius",
    ),
    "mirror on hexagonal": (
        {"frame": {"type": "mirror"}, "lattice": {"type": "hexagonal", "a": 1.0}},
        "requires a square or rectangular lattice",
    ),
    "mirror of a disc": (
        {"frame": {"type": "mirror"}, "body": {"type": "disc", "radius": 3.0, "centre": [0, 0]}},
        "requires a rectangular body",
    ),
    "mirror wider than the body": (
        {"frame": {"type": "mirror", "layers": 5}},
        "of more rows and columns than the frame",
    ),
    "lattice neighbours re-evaluated": (
        {"neighbours": {"type": "chebyshev", "reevaluate": True}},
        "use {type: euclidean}",
    ),
    "fracture with re-evaluated neighbours": (
        {
            "neighbours": {"type": "euclidean", "radius": 1.2, "reevaluate": True},
            "fracture": {"type": "threshold", "thresholds": [2.0]},
        },
        "bonds are not permanent",
    ),
    "radius below every distance": (
        {"neighbours": {"type": "euclidean", "radius": 0.5}},
        "some sites have no neighbour",
    ),
    "recorded in two ways": (
        {"record": {"every": 2, "at": [4]}},
        "`every` and `at` exclude each other",
    ),
    "recorded beyond the end": (
        {"record": {"at": [4, 21]}},
        "step 21 exceeds the number of steps, 20",
    ),
    "recorded out of order": ({"record": {"at": [4, 3]}}, "must increase"),
    "path out of order": (
        {
            "leaders": [
                {
                    "select": {"edge": "left"},
                    "motion": {"type": "path", "steps": [4, 2], "displacements": [[1, 0], [2, 0]]},
                }
            ]
        },
        "steps must increase",
    ),
}


@pytest.mark.parametrize(("parts", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_bodies_are_refused_with_the_reason(parts, message):
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(scene(**parts), progress=False)


def test_roles_change_in_every_order():
    """Leads, follows, leads again from where it then is, and follows."""
    pull = {"type": "velocity", "velocity": [0.2, 0.0], "steps": 3}
    leaders = [
        {"select": {"edge": "left"}} | HOLD,
        {"select": {"edge": "right"}, "motion": pull, "until": 4},
        {"select": {"edge": "right"}, "motion": pull, "from": 8, "until": 12},
    ]
    ds = pbdkit.run(scene(leaders=leaders), progress=False)
    right = ds.site[:, 0].values == 5
    kinds = ds.kind.values[:, right & (ds.kind[1] == 0).values]
    leads = [0, 1, 2, 3, 4, 8, 9, 10, 11, 12]
    assert [t for t in range(21) if (kinds[t] == 0).all()] == leads
    assert (kinds[[5, 6, 7, 13, 20]] == 1).all()
    x = ds.position.values[:, right & (ds.kind[1] == 0).values, 0]
    np.testing.assert_allclose(x[4] - x[0], 0.6, atol=1e-15)
    np.testing.assert_allclose(np.diff(x[7:11], axis=0), 0.2, atol=1e-15)
    assert (x[7] < x[4]).all()
    assert (x[20] < x[12]).all()


def test_a_released_leader_keeps_its_broken_bonds():
    far = {"type": "displace", "displacement": [3.0, 0.0]}
    leaders = [{"select": {"edge": "left"}} | HOLD]
    leaders += [{"select": {"edge": "right"}, "motion": far, "until": 3}]
    fracture = {"type": "threshold", "thresholds": [2.5], "frame_bonds": False}
    diagnostics = [{"type": "broken"}]
    given = scene(leaders=leaders, fracture=fracture, diagnostics=diagnostics, steps=60)
    ds = pbdkit.run(given, progress=False)
    assert ds.broken_bonds.values[1] == 5
    assert (ds.broken_bonds.values[1:] == 5).all()
    right = (ds.site[:, 0] == 5).values & (ds.kind[0] == 0).values
    # Cut off and free, with nothing that pulls it back: it stays where it was let go.
    np.testing.assert_allclose(ds.position.values[-1, right, 0], 8.0, atol=1e-12)


def test_consistent_groups_may_overlap():
    leaders = [{"select": {"edge": e}} | HOLD for e in ("left", "bottom", "right", "top")]
    ds = pbdkit.run(scene(leaders=leaders), progress=False)
    assert (ds.kind[-1] == 0).sum() == 2 * 6 + 2 * 3


def test_overlaps_are_found_after_groups_are_replaced():
    """Overlaps are also found if the groups are replaced, as in interactive sessions."""
    held = build_scene(pbdkit.load("paper/a"))
    assert not held.leaders_overlap
    assert replace(held, leading=(*held.leading, held.leading[0])).leaders_overlap
