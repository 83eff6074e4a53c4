"""Bodies of several materials against their closed forms, and the same from every engine."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from finite_elements.inclusion import jumps, plate
from interpreted_kernels import interpreting
from scene_strategies import in_turn
from shapely import Polygon

import pbdkit
from pbdkit.lattice.fill import cut_by_border
from pbdkit.plugin import Cell, Vector
from pbdkit.scene.constants import signed_distance
from pbdkit.scene.materials import laminate, layered
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine import sweeps
from pbdkit.stepping.numba_engine.arrays import kinds_of
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from tests.stepping.numba_engine.test_engine import assert_bitwise_equal

PULL = 0.01


def bar(length: float, height: float, spacing: float = 1.0, **rule: Any) -> dict[str, Any]:
    """A bar along x, pulled by a hundredth of its length; ν = 0, so that nothing bars it
    sideways."""
    return {
        "name": "bar",
        "lattice": {"type": "square", "a": spacing},
        "body": {"type": "rectangle", "width": length, "height": height},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": 0.0} | rule,
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "displace", "displacement": [PULL * length, 0.0]},
            },
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-12},
        "diagnostics": [{"type": "displacement"}, {"type": "reaction", "youngs_modulus": 1.0}],
    }


@pytest.mark.parametrize("contrast", [10.0, 1000.0])
@pytest.mark.parametrize("border", [4.0, 4.5, 4.3, 4.01])
def test_two_phases_in_series(contrast, border):
    """On a line of cells, and across cells: the stress is one, and strains are as 1/E."""
    length, height = 8.0, 3.0
    stiff = {"type": "rectangle", "width": 9.0, "height": 5.0, "origin": [border, -1.0]}
    given = bar(length, height, stiffness={"otherwise": 1.0, "stiff": contrast})
    ds = pbdkit.run(given | {"regions": {"stiff": stiff}}, progress=False)
    stress = PULL * length / (border + (length - border) / contrast)
    x = ds["reference"].values[:, 0]
    u = stress * (np.minimum(x, border) + np.maximum(x - border, 0.0) / contrast)
    found = ds["u"].isel(time=-1).values
    assert np.abs(found[:, 0] - u).max() < 1e-10 * PULL * length
    assert np.abs(found[:, 1]).max() < 1e-10 * PULL * length
    pulled = ds["reaction"].isel(time=-1).values[1]
    np.testing.assert_allclose(pulled, [stress * height, 0.0], atol=1e-10 * stress * height)


def errors_of(modulus: Any, exact: Any) -> list[float]:
    """Compare graded bars of length 1 with 5, 10 and 20 cells, over the pull."""
    errors = []
    for n in (5, 10, 20):
        given = bar(1.0, 2.0 / n, 1.0 / n, stiffness=lambda x, y: modulus(x) + 0.0 * y)
        given["solver"] = {"type": "equilibrium", "tolerance": 1e-11}
        ds = pbdkit.run(given, progress=False)
        x, u = ds["reference"].values[:, 0], ds["u"].isel(time=-1).values[:, 0]
        errors.append(float(np.abs(u / PULL - exact(x)).max()))
    return errors


def test_an_exponentially_graded_bar_is_exact_at_its_particles():
    """E = exp(2x): the mean of 1/E over a cell is that at its middle times a constant."""
    errors = errors_of(
        lambda x: np.exp(2.0 * x), lambda x: (1.0 - np.exp(-2.0 * x)) / (1.0 - np.exp(-2.0))
    )
    assert max(errors) < 1e-10


def test_a_graded_bar_converges_at_second_order():
    """E = 1 + 3x: u = ln(1 + 3x) / ln 4 of the end's."""
    errors = errors_of(lambda x: 1.0 + 3.0 * x, lambda x: np.log(1.0 + 3.0 * x) / np.log(4.0))
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 1.9


def test_inclined_layers_are_layers():
    """Turned layers have the turned stiffness; equal layers are one material; and by themselves
    they have the harmonic mean across and the arithmetic one along."""
    one, other = (np.diag([e, e, e / 2])[None] for e in (1.0, 4.0))
    share, across = np.array([0.25]), np.array([[1.0, 0.0]])
    found = laminate(one, other, share, across)[0]
    np.testing.assert_allclose(np.diag(found), [1 / 0.8125, 1.75, 0.5 / 0.8125])
    np.testing.assert_allclose(laminate(other, other, share, across), other)
    up = laminate(one, other, share, np.array([[0.0, 1.0]]))[0]
    np.testing.assert_allclose(np.diag(up), np.diag(found)[[1, 0, 2]], atol=1e-14)
    angle = np.array([[np.cos(0.3), np.sin(0.3)]])
    turned = laminate(one, other, share, angle)[0]
    n, t = angle[0], np.array([-angle[0, 1], angle[0, 0]])
    strain = np.array([n[0] ** 2, n[1] ** 2, 2 * n[0] * n[1]])  # unit strain along the normal
    assert strain @ turned @ strain == pytest.approx(found[0, 0])
    strain = np.array([t[0] ** 2, t[1] ** 2, 2 * t[0] * t[1]])
    assert strain @ turned @ strain == pytest.approx(found[1, 1])


REGIONS = {
    "a": {"type": "disc", "radius": 2.3, "centre": [4.2, 3.1]},
    "b": {"type": "rectangle", "width": 3.3, "height": 9.0, "origin": [6.2, 1.4]},
}
SQUARE = {"lattice": {"type": "square", "a": 1.0}}
SQUARE_CELLS = SQUARE | {"neighbours": {"type": "chebyshev"}, "frame": {"type": "natural"}}
HEXAGONAL = {"lattice": {"type": "hexagonal", "a": 1.0}}


def by_region(otherwise: float, a: float, b: float) -> dict[str, float]:
    return {"otherwise": otherwise, "a": a, "b": b}


STIFF = by_region(1.0, 10.0, 0.1)
FIELDS: dict[str, dict[str, Any]] = {
    "stiffness": SQUARE_CELLS
    | {"rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": STIFF}},
    "poisson": SQUARE_CELLS
    | {"rule": {"type": "elastic", "poisson_ratio": by_region(0.3, 0.4, 0.0)}},
    "triangles": HEXAGONAL
    | {
        "frame": {"type": "natural"},
        "rule": {"type": "elastic", "poisson_ratio": by_region(0.3, 0.4, 0.0), "stiffness": STIFF},
    },
    "orthotropic": SQUARE_CELLS
    | {
        "rule": {
            "type": "orthotropic",
            "poisson_ratio": 0.2,
            "modulus_ratio": by_region(0.5, 1.0, 2.0),
            "shear_ratio": 0.3,
        }
    },
    "under a frame": SQUARE_CELLS
    | {
        "frame": {"type": "none"},
        "rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": STIFF},
    },
    "springs": HEXAGONAL
    | {"frame": {"type": "natural"}, "rule": {"type": "springs", "stiffness": STIFF}},
    "K": SQUARE | {"rule": {"type": "mixed-coordinate", "K": by_region(-0.002, 0.001, -0.004)}},
    "strain": HEXAGONAL
    | {
        "rule": {"type": "barycentre"},
        "fracture": {"type": "strain", "failure": by_region(0.1, 0.03, 0.2)},
    },
    "damage": HEXAGONAL
    | {
        "rule": {"type": "barycentre"},
        "fracture": {
            "type": "damage",
            "onset": by_region(0.02, 0.01, 0.05),
            "failure": {"x": [-2.0, 20.0], "y": [0.0], "values": [[0.1], [0.3]]},
        },
    },
    "torn composite": SQUARE_CELLS
    | {
        "rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": STIFF},
        "fracture": {"type": "strain", "failure": by_region(0.1, 0.03, 0.2)},
    },
}


@pytest.mark.parametrize("parts", in_turn(FIELDS.values(), 2), ids=in_turn(FIELDS, 2))
def test_engines_agree_and_the_dataset_is_complete(parts):
    given = {
        "name": "composite",
        "regions": REGIONS,
        "body": {"type": "rectangle", "width": 9.7, "height": 6.0},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.2, 0.03], "steps": 9},
            },
        ],
        "steps": 12,
        "solver": {"type": "stepping", "engine": "numpy", "relaxation": 0.5},
    } | parts
    scene = build_scene(pbdkit.Experiment(**given))
    with interpreting():
        assert_bitwise_equal(scene, CompiledStepper(scene), calls=(1, 2, 9))
    ds = pbdkit.run(given, progress=False)
    assert pbdkit.rerun(ds, progress=False)["position"].identical(ds["position"])
    uniform = given | {"regions": {}} | _uniform(given)
    other = pbdkit.run(uniform, progress=False)["position"].values
    assert not np.array_equal(other, ds["position"].values)


def _uniform(given: dict[str, Any]) -> dict[str, Any]:
    """Return the same with one number for all."""

    def one(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return value.get("otherwise", 0.1)

    return {
        part: {name: one(value) for name, value in given[part].items()}
        for part in ("rule", "fracture")
        if part in given
    }


EVERYWHERE = {"all": {"type": "disc", "radius": 40.0, "centre": [3.0, 2.0]}}


@pytest.mark.parametrize("parts", FIELDS.values(), ids=FIELDS)
def test_region_of_the_whole_body_equals_a_constant(parts):
    """Whatever stands for `otherwise`."""
    given: dict[str, Any] = {
        "name": "composite",
        "regions": EVERYWHERE,
        "body": {"type": "rectangle", "width": 6.0, "height": 4.0},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "steps": 3,
        "initial": {"type": "noise", "amplitude": 0.05},
        "solver": {"type": "stepping", "engine": "numpy", "relaxation": 0.5},
    } | parts
    uniform = given | _uniform(given)
    for field in ("rule", "fracture"):
        if field in parts:
            given[field] = {
                name: {"otherwise": value["otherwise"] * 1.1, "all": value["otherwise"]}
                if isinstance(value, dict) and "otherwise" in value
                else uniform[field][name]
                for name, value in parts[field].items()
            }
    found, expected = (pbdkit.run(one, progress=False)["position"] for one in (given, uniform))
    np.testing.assert_allclose(found.values, expected.values, rtol=0.0, atol=1e-12)


def test_crack_consumes_its_energy_in_any_material():
    """A cell n times as stiff is torn at an nth of the strain: its strength is n times as large."""
    rule = bar(8.0, 4.0)["rule"] | {
        "stiffness": {"x": [0.0, 8.0], "y": [0.0], "values": [[1.0], [3.0]]}
    }
    given = bar(8.0, 4.0) | {
        "rule": rule,
        "fracture": {"type": "cohesive", "energy": 1e-5, "onset": 1e-3},
        "diagnostics": [],
    }
    scene = build_scene(pbdkit.Experiment(**given))
    found = scene.constants.by_bond
    assert set(found) == {"release"}
    inside = found["release"][found["release"] > 0.0]
    assert inside.min() == pytest.approx(2e-2 / 3, rel=0.05)
    assert inside.max() == pytest.approx(2e-2, rel=0.05)


def test_circular_inclusion_matches_the_exact_solution():
    """Goodier's: the strain of the inclusion, and the stress of the plate beside its pole."""
    assert max(jumps()) < 1e-12
    rough, fine = plate(10), plate(20)
    assert fine.error < rough.error / 1.6 < 0.03
    assert abs(fine.stretch - 1.0) < 0.6 * abs(rough.stretch - 1.0) < 0.04
    for found, within in ((rough, 0.06), (fine, 0.03)):
        there, _, at_pole = found.pole
        assert max(abs(there - 1.0), abs(at_pole - 1.0)) < within


NU_BY_REGION = {"poisson_ratio": {"otherwise": 0.2, "right": 0.0}}
ORTHOTROPIC = {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.5}
MIXED_RULES = {
    "Poisson's ratio by region": NU_BY_REGION,
    "over a grid": {"poisson_ratio": {"x": [0.0, 9.0], "y": [0.0], "values": [[0.0], [0.4]]}},
    "by region, cut": {"poisson_ratio": {"otherwise": 0.2, "oblique": 0.45}},
    "plane strain": {"plane": "strain"} | NU_BY_REGION,
    "orthotropic": ORTHOTROPIC
    | {"shear_ratio": 0.3, "modulus_ratio": {"otherwise": 0.5, "right": 2.0}},
    "shear ratio": ORTHOTROPIC | {"shear_ratio": {"otherwise": 0.3, "oblique": 0.2}},
}


def loaded_sheet(rule: dict[str, Any], force: float) -> Any:
    """The displacements of a sheet that is held on the left and loaded on the right, at rest."""
    given = bar(8.0, 3.0) | {
        "rule": {"type": "elastic"} | rule,
        "regions": {
            "right": {"type": "rectangle", "width": 9.0, "height": 9.0, "origin": [3.5, -1.0]},
            "oblique": {"type": "polygon", "vertices": [[2.2, -1], [9, -1], [9, 4], [4.3, 4]]},
        },
        "loads": [{"select": {"edge": "right"}, "force": [force, 0.3 * force]}],
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "diagnostics": [{"type": "displacement"}],
        "solver": {"type": "equilibrium"},
    }
    return pbdkit.run(given, progress=False)["u"].isel(time=-1).values


def test_particles_without_cells_of_another_material_have_their_own_kernel():
    """Particles that have all neighbours, and only cells of the material of the rule, are computed
    without a loop over slots. The cells from 3 to 4 contain both materials."""
    right = {"type": "rectangle", "width": 9.0, "height": 9.0, "origin": [3.5, -1.0]}
    given = bar(8.0, 4.0) | {
        "rule": {"type": "elastic"} | NU_BY_REGION,
        "regions": {"right": right},
    }
    scene = build_scene(pbdkit.Experiment(**given))
    block = scene.raster.body_block(0)
    x, y = scene.raster.reference_planes(block)
    is_whole = (x > 0.5) & (x < 2.5) & (y > 0.5) & (y < 3.5)
    expected = np.where(is_whole, sweeps.PLAIN, sweeps.GENERAL)
    np.testing.assert_array_equal(kinds_of(scene, block, all_general=False), expected)


@pytest.mark.parametrize("stiffness", [4.0, "field", "course"])
@pytest.mark.parametrize("name", MIXED_RULES)
def test_stiffness_applies_to_every_cell_beside_other_variations(name, stiffness):
    """Four times the stiffness under a load is the stiffness under a quarter of it."""
    fourfold = {
        "field": {"otherwise": 4.0},
        "course": {"steps": [0, 1], "values": [1.0, 4.0]},
    }.get(stiffness, stiffness)
    expected = loaded_sheet(MIXED_RULES[name], 1e-3)
    found = loaded_sheet(MIXED_RULES[name] | {"stiffness": fourfold}, 4e-3)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def layer(middle: float, height: float, angle: float = 0.0) -> dict[str, Any]:
    """A long straight layer at y = `middle` above (4, 0), turned about (4, middle)."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    corners = [a * 20.0 * along + b * height / 2 * across
               for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]  # fmt: skip
    return {"type": "polygon", "vertices": [[4.0 + x, middle + y] for x, y in corners]}


def transposed(region: dict[str, Any]) -> dict[str, Any]:
    return region | {"vertices": [[y, x] for x, y in region["vertices"]]}


def pulled_along(axis: int, region: dict[str, Any]) -> Any:
    """The displacements of a block of 4 by 5, of which the short sides are along the axis, pulled
    by a stress of 1e-3 across a layer that is a thousandth as stiff, (component, x, y)."""
    low, high = (("left", "right"), ("bottom", "top"))[axis]
    sides = {"width": 4.0, "height": 5.0} if axis == 1 else {"width": 5.0, "height": 4.0}
    given = bar(1.0, 1.0, stiffness={"otherwise": 1.0, "layer": 1e-3}) | {
        "body": {"type": "rectangle"} | sides,
        "regions": {"layer": region},
        "leaders": [
            {"select": {"edge": low}, "axes": ["xy"[axis]], "motion": {"type": "hold"}},
            {"select": {"nearest": [[0.0, 0.0]]}, "motion": {"type": "hold"}},
        ],
        "solver": {"type": "equilibrium"},
        "loads": [{"select": {"edge": high}, "force": (4e-3 * np.eye(2)[axis]).tolist()}],
        "diagnostics": [{"type": "displacement"}],
    }
    u = pbdkit.run(given, progress=False)["u"].isel(time=-1).values
    return u.reshape(1 + int(sides["width"]), 1 + int(sides["height"]), 2).transpose(2, 0, 1)


@pytest.mark.parametrize("middle", [2.5, 2.53, 2.0])
@pytest.mark.parametrize("height", [0.8, 0.4, 0.02])
@pytest.mark.parametrize("axis", [0, 1])
def test_layer_thinner_than_a_cell_is_in_series_at_any_position(axis, height, middle):
    region = layer(middle, height)
    u = pulled_along(axis, region if axis == 1 else transposed(region))
    stretched = 5.0 - height + height * 1e3
    far = u[1, :, -1] if axis == 1 else u[0, -1, :]
    np.testing.assert_allclose(far, 1e-3 * stretched, rtol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 90.0])
def test_thin_layers_are_symmetric_under_exchange_of_axes(angle):
    region = layer(2.5, 0.3, np.radians(angle))
    across, along = pulled_along(1, region), pulled_along(0, transposed(region))
    np.testing.assert_allclose(
        along, across[::-1].swapaxes(1, 2), rtol=0, atol=1e-6 * np.abs(across).max()
    )


@pytest.mark.parametrize("height", [0.9, 0.3, 0.02])
@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0, 90.0, 160.0])
def test_volume_fraction_and_direction_of_a_layer_in_a_cell_are_exact(angle, height):
    """In all cells that it passes through wholly, side by side, with its middle anywhere."""
    body = pbdkit.Experiment(**bar(8.0, 3.0) | {"body": layer(0.3, height, np.radians(angle))}).body
    outline = Polygon(body.vertices)
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    cells = corners + np.stack(np.meshgrid(np.arange(2.0, 6.0), [-1.0, 0.0, 1.0]), -1).reshape(
        -1, 1, 2
    )
    x, y = cells.transpose(2, 1, 0)
    signed = partial(signed_distance, body, Cell((Vector(1.0, 0.0), Vector(0.0, 1.0))))
    share, facing = cut_by_border(signed, x, y)
    expected = [outline.intersection(Polygon(cell)).area for cell in cells]
    np.testing.assert_allclose(share, expected, atol=2e-3 * height)
    normal = np.array([-np.sin(np.radians(angle)), np.cos(np.radians(angle))])
    for each, part in zip(facing, share, strict=True):
        length = np.trace(each)
        assert (length > 0.0) == (part > 0.0)
        np.testing.assert_allclose(each, length * np.outer(normal, normal), atol=1e-3 * length)


def test_square_within_a_cell_has_equal_stiffness_along_both_axes():
    one, other = (np.diag([e, e, e / 2])[None] for e in (1.0, 100.0))
    found = layered(one, other, np.array([0.3]), np.eye(2)[None])[0]
    assert found[0, 0] == pytest.approx(found[1, 1], rel=1e-12)
    assert np.abs(found[:2, 2]).max() < 1e-12 * found[0, 0]
    assert 1.0 < found[0, 0] < 30.7
