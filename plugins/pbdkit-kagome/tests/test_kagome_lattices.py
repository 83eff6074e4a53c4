"""Kagome and honeycomb: coordination, area, what is known of equilibrium and of waves on them."""

import math

import numpy as np
import pytest
from pbdkit_kagome import BondSteps, Honeycomb, Kagome

import pbdkit
from pbdkit.plugin import length

COMPONENTS = [Kagome, Honeycomb, BondSteps]
BOTH = pytest.mark.parametrize("lattice", [Kagome, Honeycomb])
SEQUENCE = {"kagome": [4, 8, 14, 18, 22, 28, 30, 38], "honeycomb": [3, 6, 9, 12, 15, 18, 21, 24]}
GRADIENT = np.array([[0.2, -0.05], [0.1, -0.1]])


def experiment(lattice, **parts):
    held = [
        {"select": {"edge": edge}, "motion": {"type": "hold"}}
        for edge in ("left", "right", "bottom", "top")
    ]
    base = {
        "name": "basis",
        "lattice": lattice,
        "body": {"type": "grid", "columns": 18, "rows": 16},
        "rule": {"type": "barycentre"},
        "leaders": held,
        "steps": 1,
        "diagnostics": [{"type": "displacement"}],
    }
    return base | parts


def displacements(lattice, **parts):
    """Reference positions and last displacements of the body, (particle, axis)."""
    ds = pbdkit.run(experiment(lattice, **parts), components=COMPONENTS, progress=False)
    body = ds.isel(time=-1, particle=(ds.kind.isel(time=-1) < 2).values)
    return body.reference.values, body.u.values


@BOTH
@pytest.mark.parametrize("a", [1.0, 0.7, 13.0])
def test_coordination_number_and_bond_length_of_each_site(lattice, a):
    cell = lattice(a=a).cell()
    for sublattice in range(len(cell.sites)):
        near = cell.offsets(sublattice, 1.7 * a)
        assert len(near) == SEQUENCE[lattice.type_name()][0]
        np.testing.assert_allclose([offset.length for offset in near], a, rtol=1e-13)


@pytest.mark.parametrize(
    ("lattice", "area"), [(Kagome, 2 / math.sqrt(3)), (Honeycomb, 3 * math.sqrt(3) / 4)]
)
def test_area_of_a_site(lattice, area):
    cell = lattice(a=1.7).cell()
    one, other = cell.vectors
    whole = one.x * other.y - one.y * other.x
    assert whole / len(cell.sites) == pytest.approx(area * 1.7**2, rel=1e-13)


@BOTH
def test_sites_match_the_hexagonal_lattice_at_equal_index(lattice):
    whole = pbdkit.run(experiment({"type": "hexagonal", "a": 0.7}), progress=False)
    place = dict(zip(map(tuple, whole.site.values), whole.reference.values, strict=True))
    ours = pbdkit.run(experiment(lattice(a=0.7)), components=COMPONENTS, progress=False)
    body = (ours.kind.isel(time=-1) < 2).values
    share = body.sum() / (18 * 16)
    assert share == {"kagome": 3 / 4, "honeycomb": 2 / 3}[lattice.type_name()]
    expected = [place[tuple(site)] for site in ours.site.values[body]]
    np.testing.assert_allclose(ours.reference.values[body], expected, atol=1e-12)


@BOTH
def test_shells_of_bond_steps_are_the_coordination_sequence(lattice):
    """Known for the nets 3.6.3.6 and 6.6.6: from every site alike."""
    cell, expected = lattice().cell(), SEQUENCE[lattice.type_name()]
    for sublattice in range(len(cell.sites)):
        shells = BondSteps(shells=8).shells_around(cell, sublattice)
        assert [len(shell) for shell in shells] == expected


def test_bond_steps_separate_equal_distances_on_the_kagome_lattice():
    near, beyond, far = BondSteps(shells=3).shells_around(Kagome().cell(), 0)
    lengths = [sorted(round(o.length, 9) for o in shell) for shell in (near, beyond, far)]
    assert lengths[0] == [1.0] * 4
    assert lengths[1] == [round(math.sqrt(3), 9)] * 4 + [2.0] * 4
    assert lengths[2].count(2.0) == 2  # across a hexagon
    coordination = pbdkit.Experiment(
        **experiment(Kagome(), neighbours={"type": "coordination", "shells": 3})
    ).neighbours.shells_around(Kagome().cell(), 0)
    assert [len(shell) for shell in coordination] == [4, 4, 6]


def test_on_the_hexagonal_lattice_bond_steps_are_rings():
    of_hexagonal = pbdkit.load("paper/f1").lattice.cell()
    shells = BondSteps(shells=4).shells_around(of_hexagonal, 0)
    assert [len(shell) for shell in shells] == [6, 12, 18, 24]


@BOTH
def test_asymmetric_neighbourhoods_are_refused(lattice):
    """Index distance means nothing to a lattice without centres of inversion."""
    asked = experiment(lattice(), neighbours={"type": "chebyshev", "shells": 2})
    if lattice is Kagome:
        pbdkit.run(asked, components=COMPONENTS, progress=False)
        return
    with pytest.raises(pbdkit.ExperimentError, match="'chebyshev' is unbalanced on this lattice"):
        pbdkit.run(asked, components=COMPONENTS, progress=False)


@BOTH
@pytest.mark.parametrize("shells", [1, 2])
def test_homogeneous_deformations_are_equilibria_of_the_barycentre(lattice, shells):
    """The neighbours of every site have their barycentre in it, and the barycentre is affine."""
    parts = {
        "neighbours": {"type": "bond-steps", "shells": shells},
        "initial": {"type": "affine", "gradient": GRADIENT.tolist()},
        "steps": 50,
    }
    inner = {"type": "none"}
    X, u = displacements(lattice(), frame=inner, leaders=led_all_round(shells), **parts)
    np.testing.assert_allclose(u, X @ GRADIENT.T, atol=1e-12)


def led_all_round(depth, columns=18, rows=16):
    """Holds a rim wide enough that no follower lacks a neighbour."""
    rim, width, height = 1.05 * depth, columns - 0.5, (rows - 1) * math.sqrt(3) / 2
    boxes = [
        [-1, -1, rim, height + 1],
        [width - rim, -1, width + 1, height + 1],
        [-1, -1, width + 1, rim],
        [-1, height - rim, width + 1, height + 1],
    ]
    return [{"select": {"box": box}, "motion": {"type": "hold"}} for box in boxes]


def test_on_the_kagome_lattice_they_are_equilibria_of_every_rule():
    """Its sites are centres of inversion: what opposite neighbours do cancels."""
    X, u = displacements(
        Kagome(),
        rule={"type": "distance-weighted"},
        frame={"type": "none"},
        leaders=led_all_round(1),
        initial={"type": "affine", "gradient": GRADIENT.tolist()},
        solver={"type": "stepping", "relaxation": 0.5},
        steps=50,
    )
    np.testing.assert_allclose(u, X @ GRADIENT.T, atol=1e-12)


def test_honeycomb_sublattices_shift_relative_to_each_other():
    """Under strain E the distance-weighted mean vanishes where sublattice B has shifted against A.

    To first order Σ (n·E n) n + Σ ((n·s) n + s) = 0 over the three bonds n of A, so that
    s = -(a/6) (E_xx - E_yy, -2 E_xy).
    """
    strain = 1e-5
    E = strain * np.array([[1.0, 0.3], [0.3, -0.5]])
    X, u = displacements(
        Honeycomb(),
        body={"type": "grid", "columns": 36, "rows": 40},
        rule={"type": "distance-weighted"},
        frame={"type": "none"},
        leaders=led_all_round(1, 36, 40),
        initial={"type": "affine", "gradient": E.tolist()},
        solver={"type": "stepping", "relaxation": 0.5},
        steps=800,
    )
    middle = np.abs(X - X.mean(axis=0)).max(axis=1) < 8.0
    third = np.mod(np.round(2 * X[middle, 0]), 3)  # columns of A lie 3/2 apart, and of B
    is_b = third == 2
    assert set(third) == {0, 2}
    # The held rim does not shift, so that the middle is strained a little less: fitted, not given.
    terms = np.column_stack([X[middle], np.ones(middle.sum()), is_b])
    gradient, _, s = np.split(np.linalg.lstsq(terms, u[middle])[0], [2, 3])
    (xx, yx), (xy, yy) = gradient
    assert xx == pytest.approx(E[0, 0], rel=0.05)
    np.testing.assert_allclose(s[0], [-(xx - yy) / 6, (xy + yx) / 6], rtol=2e-3, atol=0)


@BOTH
@pytest.mark.parametrize("shells", [1, 2])
def test_barycentre_diffusivity_is_a_quarter_of_the_mean_squared_bond(lattice, shells):
    """Steps to neighbours with their barycentre at the site are those of an unbiased walk."""
    neighbours = {"type": "bond-steps", "shells": shells}
    around = BondSteps(shells=shells).shells_around(lattice(a=2.0).cell(), 0)
    squares = [offset.length**2 / 4.0 for shell in around for offset in shell]
    asked = experiment(lattice(a=2.0), neighbours=neighbours)
    found = pbdkit.identify(asked, components=COMPONENTS)
    assert found.kind == "diffusion"
    expected = np.eye(2) * np.mean(squares) / 4  # in units of the bond, which is 2 long
    np.testing.assert_allclose(found.long.diffusivity, expected, atol=1e-12)


def test_the_flat_band_of_the_kagome_lattice_bounds_its_spectrum():
    """Alternating moves round a hexagon have no effect outside: P = -1/2, so w < 4/3."""
    asked = experiment(Kagome())
    found = pbdkit.identify(asked, components=COMPONENTS).spectrum
    assert found.smallest == pytest.approx(-0.5, abs=1e-12)
    assert found.largest_stable_relaxation == pytest.approx(4 / 3, abs=1e-12)
    # One hexagon alone has such a mode: a finite body has the same bound, to the last digits.
    assert pbdkit.analyse(asked, components=COMPONENTS).smallest_eigenvalue == pytest.approx(
        -0.5, abs=1e-12
    )


def test_bipartite_honeycomb_has_a_symmetric_spectrum():
    asked = experiment(Honeycomb())
    found = pbdkit.identify(asked, components=COMPONENTS).spectrum
    assert (found.smallest, found.largest) == pytest.approx((-1.0, 1.0), abs=1e-9)
    own = pbdkit.analyse(asked, components=COMPONENTS)
    assert own.smallest_eigenvalue == pytest.approx(-own.spectral_radius, abs=1e-9)


def test_each_side_gives_an_exact_triangle():
    """The bonds of the honeycomb add up to zero exactly, and have one length."""
    for a in np.random.default_rng(1).lognormal(0.0, 5.0, 500):
        rests = [offset.rest for offset in Honeycomb(a=a).cell().offsets(0, 1.1 * a)]
        assert (sum(r.x for r in rests), sum(r.y for r in rests)) == (0.0, 0.0)
        assert len({float(length(r)) for r in rests}) == 1
        assert rests[0].x == pytest.approx(a, rel=1e-13) or rests[-1].x == pytest.approx(a)
