"""The cells between the sites of a lattice: they tile the plane, and show what is inside out."""

import json
from typing import Literal

import numpy as np
import pytest
from property_cases import BOTH_ENDS_HELD, LATTICES, displace, experiment, scene_of, state_with

import pbdkit
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.cells import _is_simple, tiling_of
from pbdkit.plugin import BasisSite, Cell, Vector
from pbdkit.plugin.lattice import CellPolygon, Offset, area_share
from pbdkit.stepping.state import initial_state

every_lattice = pytest.mark.parametrize("lattice", LATTICES)
ROOT3 = 3.0**0.5
HONEYCOMB = Cell(
    (Vector(1.5, ROOT3 / 2), Vector(0.0, ROOT3)),
    (BasisSite(), BasisSite(Vector(1.0, 0.0), (1, 0), (1, 0))),
    (2, 1),
    ((2, 0), (0, 1)),
)
KAGOME = Cell(
    (Vector(2.0, 0.0), Vector(1.0, ROOT3)),
    (
        BasisSite(),
        BasisSite(Vector(1.0, 0.0), (1, 0), (1, 0)),
        BasisSite(Vector(0.5, ROOT3 / 2), (0, 1), (0, 1)),
    ),
    (2, 2),
    ((2, 0), (0, 2)),
)


def area_of(polygon):
    (x, y), (to_x, to_y) = np.transpose(polygon), np.roll(polygon, -1, axis=0).T
    return float((x * to_y - y * to_x).sum()) / 2


def cell_of(lattice):
    return scene_of(lattice=lattice).raster.cell


@pytest.mark.parametrize(
    ("cell", "corners"),
    [
        *((cell_of(name), [4] if "rect" in name[:4] or name == "square" else None)
          for name in LATTICES),
        (HONEYCOMB, [6]),
        (KAGOME, [3, 3, 6]),
        (Cell((Vector(1.0, 0.0), Vector(0.996, 0.087))), [3, 3]),
        (Cell((Vector(1.0, 0.0), Vector(7.0, 1.0))), [4]),
    ],
)  # fmt: skip
def test_the_cells_of_a_lattice_tile_the_plane(cell, corners):
    slots = ((),) * len(cell.sites)
    polygons = [found.rest for found in tiling_of(cell, slots).polygons]
    a, b = cell.vectors
    areas = [area_of(polygon) for polygon in polygons]
    assert min(areas) > 0
    assert sum(areas) == pytest.approx(abs(a.x * b.y - a.y * b.x), rel=1e-12)
    assert sorted(map(len, polygons)) == (corners or [3] * 2 * len(cell.sites))


def measured(scene, u, *, intact_only=False):
    """Return the shares of all cells of a body with displacements u, (body particle, axis)."""
    moment = StateMoment(state_with(scene, u), Tables(scene))
    return moment.cells.over(area_share, intact_only=intact_only)


@every_lattice
def test_cell_areas_of_an_affine_deformation_scale_with_its_determinant(lattice):
    scene = scene_of(5, 4, lattice=lattice)
    X = scene.raster.reference(scene.raster.body_rows)
    assert (measured(scene, 0 * X) == 1.0).all()
    for gradient in (
        [[0.3, -0.2], [0.5, 0.1]],
        [[-2.0, 0.0], [0.0, 0.0]],
        [[0.0, 0.0], [1.0, -3.0]],
    ):
        shares = measured(scene, X @ np.array(gradient).T)
        determinant = np.linalg.det(np.eye(2) + gradient)
        np.testing.assert_allclose(shares, determinant, rtol=0, atol=1e-13)


def test_square_folded_over_its_diagonal_is_concave_and_not_inverted():
    """A square with a corner at (.4, .4) has .4 of its area, though the triangle there -.2."""
    scene = scene_of(2, 2)
    u = np.zeros((4, 2))
    u[3] = -0.6
    assert area_of([(0, 0), (1, 0), (0.4, 0.4), (0, 1)]) == pytest.approx(0.4)
    np.testing.assert_allclose(measured(scene, u), [0.4], rtol=0, atol=1e-15)
    warning = StateMoment(state_with(scene, u), Tables(scene)).cells.inside_out()
    assert warning.startswith(
        "the last state is folded: 1 of 1 cells have an inverted corner; the worst, at "
        "particle 6, has -0.2 times its area at rest; "
    )


@every_lattice
def test_cells_with_a_broken_bond_count_on_request(lattice):
    crack = {"type": "threshold", "thresholds": [9.0], "cracks": [[[1.75, -9.0], [1.75, 9.0]]]}
    scene = scene_of(6, 5, lattice=lattice, fracture=crack)
    moment = StateMoment(initial_state(scene), Tables(scene))
    low = scene.raster.reference(scene.raster.body_rows).min(axis=0)
    high = scene.raster.reference(scene.raster.body_rows).max(axis=0)
    assert low[0] < 1.75 < high[0]
    every, intact = (moment.cells.over(area_share, intact_only=k) for k in (False, True))
    assert 0 < len(intact) < len(every)
    if lattice == "square":
        assert (len(intact), len(every)) == (16, 20)  # the crack runs through a column of four


def test_parts_of_a_broken_body_may_overlap():
    """Both halves as they were, the right one moved to the other side of the left one."""
    crack = {"type": "threshold", "thresholds": [9.0], "cracks": [[[2.5, -9.0], [2.5, 9.0]]]}
    scene = scene_of(6, 5, fracture=crack)
    u = np.zeros((30, 2))
    u[15:, 0] = -4.0
    broken = StateMoment(state_with(scene, u), Tables(scene))
    assert broken.cells.inside_out() is None
    whole = scene_of(6, 5)
    warning = StateMoment(state_with(whole, u), Tables(whole)).cells.inside_out()
    assert warning == (
        "the last state has inverted cells: 4 of 20 cells are inverted; the worst, at particle 23, "
        "has -3 times its area at rest; reduce the displacement of the leaders, or the coupling of "
        "x and y in the rule"
    )


def test_the_warning_is_printed_by_run_and_silenced_by_quiet(call, tmp_path):
    (tmp_path / "e.json").write_text(json.dumps(experiment(leaders=[displace([9], 4.0, 0.0)])))
    said = call("run", str(tmp_path / "e.json"), "-o", "a.nc")
    assert said.code == 0
    assert said.err.startswith("warning: the last state has inverted cells: ")
    quiet = call("run", str(tmp_path / "e.json"), "-o", "b.nc", "--quiet")
    assert quiet.err == ""


@pytest.mark.parametrize(("columns", "rows"), [(1, 5), (6, 1), (1, 1)])
@pytest.mark.filterwarnings("ignore:leaders. all particles are leaders")
def test_diagnostic_refuses_a_body_without_cells(columns, rows):
    given = experiment(columns, rows, leaders=BOTH_ENDS_HELD[:1])
    asked = given | {"diagnostics": [{"type": "smallest-cell-area"}]}
    message = "diagnostics.0.*requires cells, but no cell has all its corners in the body"
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(asked, progress=False)
    assert pbdkit.run(given, progress=False).status == "complete"


class Areas(pbdkit.Diagnostic):
    """The sum of the areas of all cells now: a third party's use of them."""

    type: Literal["areas"] = "areas"

    def variables(self):
        return (pbdkit.plugin.Variable("areas", (), "area", "1"),)

    def measure(self, now):
        def area(d, r):
            x = [Vector(a.x + b.x, a.y + b.y) for a, b in zip(d, r, strict=True)]
            return sum(x[k - 1].x * x[k].y - x[k - 1].y * x[k].x for k in range(len(x))) / 2

        return (now.cells.over(area).sum(),)


@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_custom_diagnostic_gets_the_cells():
    given = experiment(6, 5, initial={"type": "affine", "gradient": [[0.5, 0.0], [0.0, 0.0]]})
    ds = pbdkit.run(given | {"diagnostics": [Areas()]}, components=[Areas], progress=False)
    assert ds.areas[0] == pytest.approx(1.5 * 20)


@pytest.mark.parametrize("sliver", [0.025, 0.05, 0.09, 0.5])
def test_cells_above_the_sliver_limit_belong_to_the_body(sliver):
    """Its area is that of the outline; below a fiftieth slivers are left out."""
    rules = {"rule": {"type": "elastic", "poisson_ratio": 0.3}, "frame": {"type": "natural"}}
    neighbours = {"type": "chebyshev", "shells": 1}

    def area(sliver):
        body = {"type": "rectangle", "width": 4.0 + sliver, "height": 3.0}
        return scene_of(body=body, neighbours=neighbours, **rules).cells.share.sum()

    assert area(sliver) == pytest.approx(12.0 + 3.0 * sliver, abs=0.15 * sliver)
    assert area(0.015) == pytest.approx(12.0, rel=1e-12)


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        ([(0.0, 0.0), (1.0, 0.0), (0.3, 0.8)], True),
        ([(0.0, 0.0), (1.0, 0.2), (1.3, 1.0), (0.3, 0.8)], True),
        ([(0.0, 0.0), (1.0, 0.0), (0.8, 0.5), (0.2, 0.5)], False),
        ([(0.0, 0.0), (1.0, 0.0), (1.4, 0.6), (0.5, 1.2), (-0.4, 0.6)], False),
    ],
    ids=["triangle", "parallelogram", "trapezium", "pentagon"],
)
def test_only_triangles_and_parallelograms_are_simple(corners, expected):
    here = (0, 0)
    offsets = (Offset(0, here, here, here, Vector(x, y)) for x, y in corners)
    assert _is_simple(CellPolygon(0, 0, tuple(offsets))) == expected
