"""Results of `pbdkit identify` for the built-in rules, against exact values."""

import math

import numpy as np
import pytest
from identity_cases import (
    BARYCENTRE,
    CENTRED,
    EIGHT,
    FOUR,
    HEXAGONAL,
    NEAREST,
    RECTANGULAR,
    SQUARE,
    THIRD_PARTY,
    WEIGHTED,
    experiment,
    identity,
    oblique,
    shells,
)
from property_cases import LATTICES, NEIGHBOURS, advanced, body_sites
from scene_strategies import in_turn

import pbdkit
from pbdkit.identification.waves import operator, slow_waves
from pbdkit.linear.spectrum import modes
from pbdkit.model.reading import Source
from pbdkit.model.shipped import shipped_names
from pbdkit.scene.scene import build_scene

AVERAGING = {
    "square 4": (SQUARE, NEAREST, 1 / 4, -1.0, 1e-12),
    "chebyshev 8": (SQUARE, EIGHT, 3 / 8, -1 / 2, 1e-12),
    "chebyshev 24": (SQUARE, shells(2, "chebyshev"), 25 / 24, -29 / 96, 1e-11),
    "hexagonal 6": (HEXAGONAL, NEAREST, 1 / 4, -1 / 2, 1e-12),
    "hexagonal 18": (HEXAGONAL, shells(3), 2 / 3, -0.2449, 1e-4),
}
"""lattice, neighbours, D in spacing² a step, λ_min, and how well that is known."""
POISSON_RATIOS = [-0.9, -0.5, 0.0, 0.2, 1 / 3, 0.45, 0.5]


def elastic(poisson_ratio, **more):
    return {"type": "elastic", "poisson_ratio": poisson_ratio, **more}


@pytest.mark.parametrize("rule", ["barycentre", "mean-displacement"])
@pytest.mark.parametrize("case", AVERAGING)
def test_averaging_is_isotropic_diffusion(case, rule):
    lattice, neighbours, diffusivity, smallest, within = AVERAGING[case]
    found = identity(lattice, neighbours, rule)
    assert (found.kind, found.symmetry, found.reasons) == ("diffusion", "isotropic", ())
    assert found.diffusivity == pytest.approx(diffusivity, rel=1e-12)
    assert found.spectrum.smallest == pytest.approx(smallest, abs=within)
    bound = 2 / (1 - found.spectrum.smallest)
    assert found.spectrum.largest_stable_relaxation == pytest.approx(bound, rel=1e-12)
    assert found.poisson_ratio == pytest.approx(-1.0, abs=1e-12)
    assert (found.linear, found.symmetric, found.turns) == (True, True, True)
    assert found.rests_at_edges == (rule == "mean-displacement")


def four_of(lattice):
    return FOUR[lattice["type"]]


@pytest.mark.parametrize("lattice", [RECTANGULAR, CENTRED, oblique(75.0)], ids=lambda x: x["type"])
def test_averaging_over_four_neighbours_elsewhere_is_anisotropic(lattice):
    found = identity(lattice, four_of(lattice), BARYCENTRE)
    assert (found.kind, found.symmetry, found.diffusivity) == ("diffusion", "anisotropic", None)
    assert (found.poisson_ratio, found.body) == (None, None)
    assert found.spectrum.smallest == pytest.approx(-1.0, abs=1e-12)
    assert found.spectrum.largest_stable_relaxation == pytest.approx(1.0, rel=1e-12)
    rest = found.stencil.rest
    tensor = np.einsum("ec,ed->cd", rest, rest) / len(rest) / 2
    np.testing.assert_allclose(found.long.diffusivity, tensor, atol=1e-13)
    ends = np.linalg.eigvalsh(tensor)
    assert (found.long.fast.smallest, found.long.fast.largest) == pytest.approx(tuple(ends))


@pytest.mark.parametrize(
    ("lattice", "neighbours", "smallest"),
    [
        (SQUARE, NEAREST, -2.0),
        (SQUARE, EIGHT, -1.586),
        (SQUARE, shells(2, "chebyshev"), -1.283),
        (HEXAGONAL, NEAREST, -1.344),
        (HEXAGONAL, shells(3), -1.104),
        (RECTANGULAR, FOUR["rectangular"], -2.333),
        (CENTRED, FOUR["centred-rectangular"], -2.6),
        (oblique(60.0), FOUR["oblique"], -2.5),
        (oblique(5.0), FOUR["oblique"], -2.996),
    ],
)
def test_distance_weighting_as_printed_diverges_on_every_lattice(lattice, neighbours, smallest):
    found = identity(lattice, neighbours, WEIGHTED)
    assert found.spectrum.smallest == pytest.approx(smallest, abs=6e-4)
    bound = found.spectrum.largest_stable_relaxation
    assert bound == pytest.approx(2 / (1 - smallest), abs=6e-4)
    assert f"relaxation 1 diverges; it is stable below {bound:.6g}" in found.notes
    assert (found.linear, found.turns, found.rests_at_edges) == (False, True, False)


def test_distance_weighting_over_four_neighbours_has_the_symmetry_of_a_square():
    """(1/8) Σ (1 + n nᵀ) n n: C11 = 1/2, C66 = 1/4, C12 = -C66."""
    found = identity(SQUARE, NEAREST, WEIGHTED)
    assert (found.kind, found.symmetry, found.body.axis) == ("elasticity", "square", 0.0)
    expected = [[1 / 2, -1 / 4, 0], [-1 / 4, 1 / 2, 0], [0, 0, 1 / 4]]
    np.testing.assert_allclose(found.body.stiffness, expected, atol=1e-9)
    ratios = [found.body.poisson_ratio(angle) for angle in (0.0, 90.0, 45.0)]
    assert ratios == pytest.approx([-1 / 2, -1 / 2, -1 / 3], abs=1e-8)


def test_distance_weighting_has_the_poisson_ratio_of_springs_without_rest_length():
    """(1/12) Σ (1 + n nᵀ) n n on the hexagonal lattice, where Σ n n = 3, Σ n_x⁴ = 9/4 and
    Σ n_x² n_y² = 3/4: C11 = (3 + 9/4)/12, C66 = (3 + 3/4)/12, C12 + C66 = 2 (3/4)/12."""
    found = identity(HEXAGONAL, NEAREST, WEIGHTED)
    assert (found.kind, found.symmetry) == ("elasticity", "isotropic")
    c11, c12, c66 = 21 / 48, -9 / 48, 15 / 48
    expected = [[c11, c12, 0], [c12, c11, 0], [0, 0, c66]]
    np.testing.assert_allclose(found.body.stiffness, expected, atol=1e-9)
    assert found.poisson_ratio == pytest.approx(-3 / 7, abs=1e-8)
    assert (
        "away from free edges the rule is elastic; at free edges it exerts an inward force"
    ) in found.notes


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_linear_elasticity_does_not_commute_with_finite_rotations(nu):
    """Strains of linear elasticity are not objective, unless the rule is diffusion: ν = -1."""
    found = identity(SQUARE, EIGHT, elastic(nu))
    assert (found.linear, found.turns) == (True, False)


@pytest.mark.parametrize("lattice", [SQUARE, RECTANGULAR], ids=["square", "rectangular"])
@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_elastic_on_rectangles_has_the_specified_material(lattice, nu):
    found = identity(lattice, EIGHT, elastic(nu))
    assert (found.kind, found.symmetry) == ("elasticity", "isotropic")
    assert found.poisson_ratio == pytest.approx(nu, abs=1e-12)
    if lattice is SQUARE:
        assert found.body.stiffness[0, 0] == pytest.approx(2 / (5 - 3 * nu))
        bound = (5 - 3 * nu) / 4 / (1.0 if nu >= 0.0 else 1 - nu)
        assert found.spectrum.largest_stable_relaxation == pytest.approx(bound, rel=1e-9)
        np.testing.assert_allclose(found.body.mobility, np.eye(2), atol=1e-12)


@pytest.mark.parametrize("nu", POISSON_RATIOS)
def test_elastic_on_triangles_has_the_specified_material(nu):
    found = identity(HEXAGONAL, NEAREST, elastic(nu))
    assert (found.kind, found.symmetry, found.symmetric) == ("elasticity", "isotropic", True)
    assert found.poisson_ratio == pytest.approx(nu, abs=1e-12)
    assert found.body.stiffness[0, 0] == pytest.approx(1 / (3 - nu))
    bound = 3 * (3 - nu) / 8
    if nu < -1 / 3:
        bound = (3 - nu) * (1 - 3 * nu) / (3 * (1 - nu) ** 2)
    assert found.spectrum.largest_stable_relaxation == pytest.approx(bound, rel=1e-9)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.3, 0.45])
@pytest.mark.parametrize(("lattice", "neighbours"), [(SQUARE, EIGHT), (HEXAGONAL, NEAREST)])
def test_plane_strain_has_the_ratio_of_another_plane_stress_material(lattice, neighbours, nu):
    found = identity(lattice, neighbours, elastic(nu, plane="strain"))
    assert found.poisson_ratio == pytest.approx(nu / (1 - nu), abs=1e-12)


@pytest.mark.parametrize(
    ("lattice", "neighbours", "alike"), [(SQUARE, EIGHT, NEAREST), (HEXAGONAL, NEAREST, NEAREST)]
)
def test_poisson_ratio_of_minus_one_is_the_barycentre(lattice, neighbours, alike):
    """With the four nearest neighbours on the square lattice the weights of the diagonals are (1 +
    ν)."""
    found, mean = identity(lattice, neighbours, elastic(-1.0)), identity(lattice, alike, BARYCENTRE)
    assert (found.kind, found.diffusivity) == ("diffusion", pytest.approx(mean.diffusivity))
    assert found.poisson_ratio == pytest.approx(-1.0, abs=1e-12)
    k = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 2))
    np.testing.assert_allclose(operator(found.stencil, k), operator(mean.stencil, k), atol=1e-13)


@pytest.mark.parametrize("lattice", [SQUARE, RECTANGULAR], ids=["square", "rectangular"])
@pytest.mark.parametrize(
    ("nu", "modulus", "shear"), [(0.3, 0.5, 0.2), (0.1, 3.0, 0.6), (0.0, 1.0, 0.1), (-0.4, 0.8, 1)]
)
def test_orthotropic_has_the_specified_material(lattice, nu, modulus, shear):
    rule = {
        "type": "orthotropic",
        "poisson_ratio": nu,
        "modulus_ratio": modulus,
        "shear_ratio": shear,
    }
    found = identity(lattice, EIGHT, rule)
    expected = "square" if modulus == 1.0 else "orthotropic"
    assert (found.kind, found.symmetry, found.body.axis) == ("elasticity", expected, 0.0)
    body, along = found.body, found.body.youngs_modulus(0.0)
    assert body.poisson_ratio(0.0) == pytest.approx(nu, abs=1e-12)
    assert body.poisson_ratio(90.0) == pytest.approx(nu * modulus, abs=1e-12)
    assert body.youngs_modulus(90.0) / along == pytest.approx(modulus)
    assert body.stiffness[2, 2] / along == pytest.approx(shear)
    # A bar along the diagonal: 1/E = (S11 + S22 + 2 S12 + S66) / 4.
    diagonal = (1 + 1 / modulus - 2 * nu + 1 / shear) / 4
    assert body.youngs_modulus(45.0) / along == pytest.approx(1 / diagonal)


@pytest.mark.parametrize(("lattice", "neighbours"), [(SQUARE, EIGHT), (HEXAGONAL, NEAREST)])
def test_springs_have_a_poisson_ratio_of_one_third(lattice, neighbours):
    found = identity(lattice, neighbours, "springs")
    assert (found.kind, found.symmetry) == ("elasticity", "isotropic")
    assert found.poisson_ratio == pytest.approx(1 / 3, abs=1e-12)
    assert (found.linear, found.turns, found.rests_at_edges) == (False, True, True)
    assert found.spectrum.smallest == pytest.approx(0.0, abs=1e-12)
    assert found.spectrum.largest_stable_relaxation == pytest.approx(2.0)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_parameter_of_mixed_coordinates_is_no_poisson_ratio(axis):
    rule = {"type": "mixed-coordinate", "K": -0.001, "axis": axis}
    found = identity(SQUARE, NEAREST, rule)
    assert (found.kind, found.poisson_ratio, found.body) == ("neither", None, None)
    across = "yx"["xy".index(axis)]
    assert found.reasons == (
        f"the rule depends on the position: under a translation by 1 along {axis}, the particle at "
        f"(0, 0) of the body moves 0.004 more along {across} per step than the one in the middle; "
        "a material constant has no such effect: K is not a Poisson ratio",
    )


@pytest.mark.parametrize(
    ("lattice", "neighbours", "least"),
    [
        (SQUARE, EIGHT, -1 / 12),
        (SQUARE, shells(3), -1 / 7),
        (SQUARE, shells(2, "chebyshev"), -7 / 20),
        (HEXAGONAL, shells(2), -3 / 32),
        (HEXAGONAL, shells(3), -9 / 64),
    ],
)
def test_positive_further_shells_are_no_gradient_elasticity(lattice, neighbours, least):
    """λ² = -Σ x⁴ / (12 Σ x²) along x, and so along every normal."""
    found = identity(lattice, neighbours, BARYCENTRE)
    assert min(l2 for g in found.long.gradients for l2 in g.material) == pytest.approx(least)
    for gradient in found.long.gradients:
        angle = np.radians(gradient.direction)
        x = found.stencil.rest @ [np.cos(angle), np.sin(angle)]
        assert gradient.total == pytest.approx((-(x**4).sum() / (x**2).sum() / 12,) * 2)
    assert max(l2 for g in found.long.gradients for l2 in g.material) < 1e-12
    assert any("which is not the sign of gradient elasticity" in note for note in found.notes)


def test_nearest_rows_have_the_fourth_order_of_the_lattice():
    found = identity(SQUARE, NEAREST, BARYCENTRE)
    assert [(g.direction, g.rows_apart) for g in found.long.gradients] == [
        (0.0, 1.0), (45.0, pytest.approx(math.sqrt(0.5))), (90.0, 1.0)
    ]  # fmt: skip
    for gradient in found.long.gradients:
        assert gradient.total == pytest.approx((-(gradient.rows_apart**2) / 12,) * 2)
        assert gradient.material == pytest.approx((0.0, 0.0), abs=1e-13)


@pytest.mark.parametrize("c", [0.01, 1.0])
def test_squared_operator_is_gradient_elasticity(c):
    """c (1 - P)²: l² = c D in every direction, stable below 2/(2 + 4c)."""
    neighbours = {"type": "euclidean", "radius": 2.0}
    found = identity(SQUARE, neighbours, {"type": "twice", "c": c})
    assert (found.kind, found.diffusivity) == ("diffusion", pytest.approx(0.25))
    for gradient in found.long.gradients:
        assert gradient.material == pytest.approx((c / 4, c / 4), abs=1e-13)
    assert found.spectrum.largest_stable_relaxation == pytest.approx(2 / (2 + 4 * c))
    length = math.sqrt(c / 4)
    assert f"the rule is gradient elasticity with a length of {length:.6g} h" in found.notes


@pytest.mark.parametrize(
    ("lattice", "neighbours", "rule"),
    [
        (SQUARE, shells(2, "chebyshev"), BARYCENTRE),
        (HEXAGONAL, shells(2), BARYCENTRE),
        (oblique(75.0), EIGHT, BARYCENTRE),
        (SQUARE, EIGHT, elastic(0.3)),
        (RECTANGULAR, EIGHT, elastic(0.2)),
        (HEXAGONAL, NEAREST, elastic(0.45)),
        (SQUARE, EIGHT, "slanted"),
        (SQUARE, EIGHT, "odd"),
    ],
)
def test_second_order_matches_a_step(lattice, neighbours, rule):
    """u_b = x·H_b·x / 2 moves the particle in the middle by Q_abcd H_bcd, whatever H."""
    source = Source(data=experiment(lattice, neighbours, rule))
    scene = build_scene(pbdkit.Experiment.build(source, THIRD_PARTY))
    found = identity(lattice, neighbours, rule)
    H = np.random.default_rng(1).uniform(-1, 1, (2, 2, 2))
    H += H.transpose(0, 2, 1)
    X = scene.raster.reference(scene.raster.body_rows)
    middle = (body_sites(scene) == 4).all(axis=1)
    X = X - X[middle]
    u = np.einsum("bcd,pc,pd->pb", H, X, X) / 2
    before, after = advanced(scene, u, 1)
    expected = np.einsum("abcd,bcd->a", found.long.second, H) * found.spacing**2
    np.testing.assert_allclose((after - before)[middle][0], expected, rtol=1e-11)


def test_waves_with_momentum_have_the_speed_of_the_steps():
    """ω² = c² k² less a constant, along x where λ = (1 + cos k)/2."""
    memory, k = 0.81, np.array([0.25, 0.26])
    found = identity(SQUARE, NEAREST, BARYCENTRE, solver={"type": "stepping", "memory": memory})
    speed = math.sqrt(found.relaxation * found.diffusivity / math.sqrt(found.memory))
    assert speed == pytest.approx(math.sqrt(0.25 / 0.9))
    frequency = np.angle(modes((1 + np.cos(k)) / 2 + 0j, 1.0, memory)[:2])
    assert np.diff(frequency**2) / np.diff(k**2) == pytest.approx(speed**2, rel=0.01)


def test_long_waves_match_their_series_to_fourth_order():
    found = identity({"type": "honeycomb"}, NEAREST, "central")
    waves = slow_waves(found.stencil)
    direction = np.array([np.cos(0.4), np.sin(0.4)])
    series = waves.series(direction)
    for k, within in ((0.1, 2e-8), (0.05, 2e-8 / 2**6)):
        expected = np.linalg.eigvals(sum(term * k**m for m, term in enumerate(series)))
        exact = np.linalg.eigvals(operator(found.stencil, k * direction[None])[0]).real
        np.testing.assert_allclose(np.sort(expected.real), np.sort(exact)[:2], atol=within)


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_averaging_spreads_by_half_the_mean_square_of_the_offsets(lattice, neighbours):
    found = identity(LATTICES[lattice], NEIGHBOURS[neighbours], BARYCENTRE)
    assert (found.kind, found.stencil.sites) == ("diffusion", 1)
    rest = found.stencil.rest
    tensor = rest.T @ rest / len(rest) / 2
    np.testing.assert_allclose(found.long.diffusivity, tensor, atol=1e-12)


@pytest.mark.parametrize("name", in_turn(shipped_names(), 3))
def test_every_shipped_experiment_has_an_identity(name):
    found = pbdkit.identify(name)
    assert (found.kind == "neither") == bool(found.reasons)
    assert (found.kind == "neither") == (found.rule == "mixed-coordinate")


def test_changing_neighbours_are_identified_at_rest():
    neighbours = {"type": "euclidean", "radius": 1.0, "reevaluate": True}
    found = identity(SQUARE, neighbours, BARYCENTRE)
    assert found.diffusivity == pytest.approx(0.25)
    assert (
        "neighbours are re-evaluated: the values hold while they are those at rest" in found.notes
    )
