"""Voids narrower than two cells: cells that would connect both of their sides are left out."""

import math
from itertools import product

import numpy as np
import pytest
from scene_strategies import in_turn
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import pbdkit
from pbdkit.lattice.raster import FRAME
from pbdkit.scene.scene import build_scene
from tests.mpi.test_partition import assert_built_as_cut

LATTICES = {
    "square": {"type": "square", "a": 1.0},
    "rectangular": {"type": "rectangular", "a": 1.0, "b": 0.7},
    "hexagonal": {"type": "hexagonal", "a": 1.0},
}
PLATE = {"type": "rectangle", "width": 10.0, "height": 10.0}


def document(lattice, body, **parts):
    neighbours = {"type": "chebyshev", "shells": 1}
    if lattice["type"] == "hexagonal":
        neighbours = {"type": "coordination", "shells": 1}
    return {
        "name": "void",
        "lattice": lattice,
        "body": body,
        "neighbours": neighbours,
        "rule": {"type": "elastic", "poisson_ratio": 0.2},
        "frame": {"type": "natural"},
        "leaders": [],
        "steps": 1,
        **parts,
    }


def scene_of(lattice, body):
    return build_scene(pbdkit.Experiment(**document(lattice, body)))


def less(*voids, of=PLATE):
    return {"type": "difference", "of": [of, *voids]}


def slot(width, angle, middle, length=40.0):
    along = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    across = np.array([-along[1], along[0]])
    ends = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [middle + s * along * length / 2 + t * across * width / 2 for s, t in ends]
    return {"type": "polygon", "vertices": [corner.tolist() for corner in corners]}


def pieces(scene):
    """(X, piece) of the particles of a body, connected by cells with a share."""
    raster = scene.raster
    body = raster.body_rows
    start, end = [], []
    for patch in scene.patches:
        share = np.where(patch.whole, scene.cells.of(patch), 0.0)
        for place in np.flatnonzero(share):
            first, *others = patch.rows(raster, place).tolist()
            start += [first] * len(others)
            end += others
    graph = coo_array((np.ones(len(start)), (start, end)), shape=(raster.count,) * 2)
    _, label = connected_components(graph, directed=False)
    return raster.reference(body), label[body]


def left_out(scene):
    return [warning for warning in scene.warnings if "omitted" in warning]


@pytest.mark.parametrize("name", in_turn(LATTICES, 2))
@pytest.mark.parametrize("angle", [0.0, 90.0, 33.0])
@pytest.mark.parametrize("width", [0.1, 0.3, 0.9, 1.5])
@pytest.mark.parametrize("middle", [(5.0, 4.9), (5.3, 5.2)])
def test_slot_through_a_body_separates_it(name, angle, width, middle):
    scene = scene_of(LATTICES[name], less(slot(width, angle, np.array(middle))))
    X, piece = pieces(scene)
    assert len(set(piece.tolist())) == 2
    x, y = (X - middle).T
    height = y * math.cos(math.radians(angle)) - x * math.sin(math.radians(angle))
    inner = (X >= 0.0).all(axis=1) & (X <= 10.0).all(axis=1)
    over, under = (set(piece[inner & (s * height > width / 2)].tolist()) for s in (1, -1))
    assert len(over) == len(under) == 1
    assert over != under


@pytest.mark.parametrize(
    ("left", "right", "area"), [(4.9, 5.2, 89.0), (4.8, 5.1, 89.0), (4.85, 5.15, 80.0)]
)
def test_only_the_larger_cells_beside_a_slot_remain(left, right, area):
    """The slot contains a column of particles at x = 5. Of the two columns of cells beside it, that
    with the larger area remains, and none if both areas are equal."""
    cut = slot(right - left, 90.0, np.array([(left + right) / 2, 5.0]))
    scene = scene_of(LATTICES["square"], less(cut))
    assert scene.cells.share.sum() == pytest.approx(area, rel=1e-4)


@pytest.mark.parametrize("name", LATTICES)
def test_mirror_images_stay_mirror_images(name):
    b = {"square": 1.0, "rectangular": 0.7, "hexagonal": 3**0.5}[name]
    for middle in (6.0 * b, 6.2 * b):
        shares = []
        for sign in (1.0, -1.0):
            body = {
                "type": "rectangle",
                "width": 10.0,
                "height": 12.0 * b,
                "origin": [0.0, -6.0 * b],
            }
            cut = slot(0.4, 12.0 * sign, np.array([5.0, sign * (middle - 6.0 * b)]))
            scene = scene_of(LATTICES[name], less(cut, of=body))
            X, _ = pieces(scene)
            shares.append((scene.cells.share.sum(), sorted((X * [1.0, sign]).round(6).tolist())))
        assert shares[0][0] == pytest.approx(shares[1][0], rel=1e-9)
        np.testing.assert_allclose(shares[0][1], shares[1][1])


@pytest.mark.parametrize("name", LATTICES)
@pytest.mark.parametrize(
    "body",
    [
        less({"type": "disc", "radius": 3.0, "centre": [5.0, 5.0]}),
        less({"type": "disc", "radius": 2.3, "centre": [5.2, 4.9]}),
        less({"type": "rectangle", "width": 6.0, "height": 5.5, "origin": [5.0, 5.2]}),
        {"type": "union", "of": [PLATE, PLATE | {"height": 6.2, "origin": [10.0, 0.0]}]},
        {"type": "polygon", "vertices": [[0.0, 0.0], [12.0, 0.0], [0.0, 5.0]]},
    ],
)
def test_bodies_without_narrow_voids_keep_all_cells(name, body):
    scene = scene_of(LATTICES[name], body)
    assert left_out(scene) == []
    assert len(set(pieces(scene)[1].tolist())) == 1


@pytest.mark.parametrize("name", LATTICES)
@pytest.mark.parametrize("tip", [5.0, 5.3])
def test_a_notch_keeps_its_body_connected(name, tip):
    notch = {"type": "polygon", "vertices": [[3.5, -1.0], [6.7, -1.0], [5.1, tip]]}
    assert len(set(pieces(scene_of(LATTICES[name], less(notch)))[1].tolist())) == 1


def test_a_thin_strip_stays_connected():
    strip = {"type": "rectangle", "width": 12.0, "height": 0.3, "origin": [0.0, 4.35]}
    scene = scene_of(LATTICES["square"], strip)
    assert left_out(scene) == []
    assert len(set(pieces(scene)[1].tolist())) == 1


def test_the_warning_names_cells_place_and_remedy():
    vertical = {"type": "rectangle", "width": 0.4, "height": 5.0, "origin": [4.3, -1.0]}
    assert left_out(scene_of(LATTICES["square"], less(vertical))) == [
        "body: 4 cells are omitted, the first near (4, 0), where a void is less than two cells "
        "wide: they would connect its two sides; use a finer lattice, with two cells across the "
        "void, or `cuts` for a crack of zero width"
    ]


A = 2.5
BEAM = {"type": "rectangle", "width": 40 * A, "height": 20 * A}


def stiffness(lattice, body, **parts):
    """The force at the middle of a beam in bending on two supports."""
    prescribed = [(0.0, 0.0, "y"), (40 * A, 0.0, "y"), (20 * A, 20 * A, None)]
    leaders = []
    for x, y, axis in prescribed:
        hold = {"motion": {"type": "hold"}, "axes": ["y"]}
        pushed = {"motion": {"type": "displace", "displacement": [0.0, -0.01]}}
        leaders.append({"select": {"nearest": [[x, y]]}} | (hold if axis else pushed))
    diagnostics = [{"type": "reaction", "youngs_modulus": 1.0, "thickness": 1.0}]
    solver = {"type": "equilibrium"}
    found = document(
        lattice, body, leaders=leaders, diagnostics=diagnostics, solver=solver, **parts
    )
    return -float(pbdkit.run(found, progress=False).reaction.values[-1, -1, 1])


@pytest.mark.filterwarnings("ignore:body")
def test_beam_with_a_narrow_slot_has_the_stiffness_of_one_with_a_cut():
    lattice, x, depth = {"type": "square", "a": A}, 20.4 * A, 10 * A
    cut = stiffness(lattice, BEAM, cuts=[{"from": [x, -1.0], "to": [x, depth]}])
    assert stiffness(lattice, BEAM) > 1.5 * cut
    for width in (0.1, 0.3, 0.7):
        void = {"type": "rectangle", "width": width * A, "height": depth + 1.0}
        void["origin"] = [x - width * A / 2, -1.0]
        assert stiffness(lattice, less(void, of=BEAM)) == pytest.approx(cut, rel=0.12)


@pytest.mark.parametrize(
    ("middle", "size"), in_turn(product([(5.0, 5.0), (0.5, 5.0), (5.3, 5.2)], [2, 3]), 2)
)
def test_every_process_excludes_the_same_cells(size, middle):
    lattice = {"type": "square", "a": 0.5}
    body = less(slot(0.2, 80.0, np.array(middle)))
    solver = {"type": "equilibrium"}
    hold = [{"select": {"edge": "left"}, "motion": {"type": "hold"}}]
    assert_built_as_cut(document(lattice, body, solver=solver, leaders=hold), size)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
def test_particles_are_the_sites_inside_the_outline_wherever_it_lies(lattice):
    centre, origin = np.array([7.3, -11.2]), np.array([-60.2, 30.7])
    body = {"type": "disc", "radius": 4.1, "centre": (origin + centre).tolist()}
    parts = {"rule": {"type": "barycentre"}, "frame": {"type": "none"}}
    given = document(lattice | {"origin": origin.tolist()}, body, **parts)
    raster = build_scene(pbdkit.Experiment(**given)).raster
    cells = np.stack(np.meshgrid(*[np.arange(-40, 41)] * 2), axis=-1).reshape(-1, 1, 2)
    sites = (cells @ np.array(raster.cell.vectors) + raster.cell.basis).reshape(-1, 2)
    inside = sites[np.linalg.norm(sites - centre, axis=1) <= body["radius"]]
    found = raster.reference(raster.body_rows) - origin
    order, back = (np.lexsort(each.round(6).T) for each in (found, inside))
    np.testing.assert_allclose(found[order], inside[back], atol=1e-9)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
def test_frame_consists_of_the_sites_within_its_layers(lattice):
    body = {"type": "disc", "radius": 3.3, "centre": [0.2, 0.1]}
    rule, frame = {"type": "barycentre"}, {"type": "mean", "layers": 2}
    given = document(lattice, body, rule=rule, frame=frame)
    raster = build_scene(pbdkit.Experiment(**given)).raster
    inside = set(map(tuple, raster.site_of(raster.body_rows).tolist()))
    points = raster.site_of(np.flatnonzero(raster.table_kind == FRAME))
    steps = list(product(range(-2, 3), repeat=2))
    expected = {(i + a, j + b) for i, j in inside for a, b in steps} - inside
    assert set(map(tuple, points.tolist())) == expected
