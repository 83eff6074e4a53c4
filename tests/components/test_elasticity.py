"""Rules calibrated to a material: exact where elasticity is, at second order elsewhere."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scene_strategies import samples

import pbdkit
from pbdkit.components.elasticity import Elastic
from pbdkit.lattice.raster import FRAME, LEADER
from pbdkit.scene.scene import build_scene

SQUARE = {
    "lattice": {"type": "square", "a": 0.5},
    "neighbours": {"type": "chebyshev", "shells": 1},
}
RECTANGULAR = SQUARE | {"lattice": {"type": "rectangular", "a": 0.5, "b": 0.8}}
HEXAGONAL = {
    "lattice": {"type": "hexagonal", "a": 0.5},
    "neighbours": {"type": "coordination", "shells": 1},
}
STRESS = {"type": "elastic", "poisson_ratio": 0.3}
AUXETIC = {"type": "elastic", "poisson_ratio": -0.6}
STRAIN = {"type": "elastic", "poisson_ratio": 0.3, "plane": "strain"}
ORTHOTROPIC = {
    "type": "orthotropic",
    "poisson_ratio": 0.4,
    "modulus_ratio": 0.3,
    "shear_ratio": 0.2,
}
NATURAL = {"type": "natural"}
MATERIALS = {"stress": STRESS, "auxetic": AUXETIC, "strain": STRAIN, "orthotropic": ORTHOTROPIC}
GRID = {"type": "grid", "columns": 8, "rows": 6}
CASES = {
    f"{name}, {lattice}, natural": parts | {"rule": rule, "frame": NATURAL, "body": GRID}
    for name, rule in MATERIALS.items()
    for lattice, parts in {"square": SQUARE, "rectangular": RECTANGULAR}.items()
} | {
    f"{name}, hexagonal, natural": HEXAGONAL | {"rule": rule, "frame": NATURAL, "body": GRID}
    for name, rule in MATERIALS.items()
    if name != "orthotropic"
}


def rotation(x, y, contraction):
    return -0.1 * y, 0.1 * x


def tension(x, y, contraction):
    return 0.1 * x, -0.1 * contraction * y


def bending(x, y, contraction):
    return 0.1 * x * y, -0.05 * (x * x + contraction * y * y)


def held_as(field, parts, width):
    """The experiment in which columns at both ends, so wide, stand where an exact solution has
    them, and the solution at all particles."""
    base = {"name": "patch", "leaders": [], "steps": 1, "solver": {"type": "equilibrium"}} | parts
    scene = build_scene(pbdkit.Experiment(**base))
    stiffness = scene.experiment.rule.elasticity()
    X = scene.raster.reference(scene.raster.body_rows)
    exact = np.stack(field(*X.T, stiffness.xy / stiffness.yy), axis=1)
    ends = (X[:, 0] < X[:, 0].min() + width) | (X[:, 0] > X[:, 0].max() - width)
    leaders = [
        {
            "select": {"numbers": [int(scene.raster.body_rows[n]) + 1]},
            "motion": {"type": "displace", "displacement": exact[n].tolist()},
        }
        for n in np.flatnonzero(ends)
    ]
    return base | {"leaders": leaders}, exact


def body_displacements(dataset):
    u = (dataset.position[-1] - dataset.reference).values
    return u[(dataset.kind[-1] != FRAME).values]


PATCHES = [
    pytest.param(name, field, id=f"{name}, {field.__name__}")
    for name in CASES
    # Linear triangles do not bend exactly, in any theory.
    for field in ((rotation, tension) if "hexagonal" in name else (rotation, tension, bending))
]


@pytest.mark.parametrize(("name", "field"), PATCHES)
def test_patch_test(name, field):
    """Small rotation, free uniaxial tension and pure bending between two held ends."""
    experiment, exact = held_as(field, CASES[name], width=0.3)
    found = body_displacements(pbdkit.run(experiment, progress=False))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)


def steps_of(rule, frame="mean", neighbours=SQUARE["neighbours"]):
    experiment = SQUARE | {
        "neighbours": neighbours,
        "name": "steps",
        "body": GRID,
        "rule": rule,
        "frame": {"type": frame},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.2, 0.1], "steps": 9},
            },
        ],
        "steps": 40,
        "diagnostics": [{"type": "displacement"}],
    }
    return pbdkit.run(experiment, progress=False).u.values


def test_poisson_ratio_of_minus_one_gives_the_barycentre():
    """That of the four nearest: nothing is left on the diagonals."""
    elastic = steps_of({"type": "elastic", "poisson_ratio": -1.0})
    four = steps_of({"type": "barycentre"}, neighbours={"type": "coordination", "shells": 1})
    np.testing.assert_allclose(elastic, four, rtol=0, atol=1e-14)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.3, 0.45])
def test_stiffness_follows_from_the_law_of_hooke_in_space(nu):
    """The strain across the plane is zero in plane strain, and the stress in plane stress."""
    compliance = np.diag([1.0, 1.0, 1.0, 2 * (1 + nu)])  # of xx, yy, zz and xy
    compliance[:3, :3] -= nu * (1.0 - np.eye(3))
    in_plane = np.ix_([0, 1, 3], [0, 1, 3])
    exact = {
        "strain": np.linalg.inv(compliance)[in_plane],
        "stress": np.linalg.inv(compliance[in_plane]),
    }
    for plane, matrix in exact.items():
        c = Elastic(poisson_ratio=nu, plane=plane).elasticity()
        found = [[c.xx, c.xy, 0.0], [c.xy, c.yy, 0.0], [0.0, 0.0, c.shear]]
        np.testing.assert_allclose(found, matrix, rtol=1e-12)


def test_orthotropic_with_the_ratios_of_an_isotropic_material_is_elastic():
    nu = 0.3
    same = {"type": "orthotropic", "poisson_ratio": nu, "modulus_ratio": 1.0}
    same["shear_ratio"] = 1 / (2 * (1 + nu))
    elastic = steps_of({"type": "elastic", "poisson_ratio": nu}, "natural")
    np.testing.assert_allclose(steps_of(same, "natural"), elastic, rtol=0, atol=1e-14)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.3, 0.45])
def test_hexagonal_elastic_equals_linear_triangles(nu):
    """Against the stiffness that scikit-fem assembles on the same triangles."""
    skfem = pytest.importorskip("skfem")
    from skfem.models.elasticity import linear_elasticity

    rule = {"type": "elastic", "poisson_ratio": nu}
    experiment, _ = held_as(
        bending, HEXAGONAL | {"rule": rule, "frame": NATURAL, "body": GRID}, width=0.3
    )
    dataset = pbdkit.run(experiment, progress=False)
    X, u = dataset.reference.values, body_displacements(dataset)
    mesh = skfem.MeshTri(X.T, small_triangles(X, 0.5))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP1()))
    # Plane stress: Lamé's λ replaced by 2λμ/(λ + 2μ) = ν/(1 - ν²), with E = 1.
    K = linear_elasticity(nu / (1 - nu * nu), 1 / (2 * (1 + nu))).assemble(basis)
    nodes = np.flatnonzero(dataset.kind[-1] == LEADER)
    led = np.concatenate([basis.nodal_dofs[:, n] for n in nodes])
    x = np.zeros(K.shape[0])
    x[basis.nodal_dofs] = u.T
    known = np.zeros_like(x)
    known[led] = x[led]
    solved = skfem.solve(*skfem.condense(K, np.zeros_like(x), x=known, D=led))
    np.testing.assert_allclose(solved, x, rtol=0, atol=1e-12)


def small_triangles(X, side):
    """(corner, triangle): all triples of points at one distance from each other."""
    near = np.abs(np.linalg.norm(X[:, None] - X[None], axis=2) - side) < 1e-9
    return np.array(
        [
            (i, j, k)
            for i in range(len(X))
            for j in np.flatnonzero(near[i])
            for k in np.flatnonzero(near[i] & near[j])
            if i < j < k
        ]
    ).T


SPRINGS = {"square": SQUARE, "hexagonal": HEXAGONAL}
SMALL_GRID = {"type": "grid", "columns": 6, "rows": 5}


@pytest.mark.parametrize("parts", SPRINGS.values(), ids=SPRINGS)
def test_springs_rotate_exactly_with_their_leaders(parts):
    """A quarter turn of both ends about the origin, in 60 steps; the body follows."""

    def turn(edge):
        motion = {"type": "rotation", "centre": [0.0, 0.0], "angle": 1.5, "steps": 60}
        return {"select": {"edge": edge}, "motion": motion}

    experiment = parts | {
        "name": "turn",
        "body": {"type": "grid", "columns": 7, "rows": 5},
        "rule": {"type": "springs"},
        "frame": NATURAL,
        "leaders": [turn("left"), turn("right")],
        "solver": {"type": "stepping", "memory": 0.8},
        "steps": 900,
        "record": {"every": 900},
    }
    dataset = pbdkit.run(experiment, progress=False)
    x, y = dataset.reference.values.T
    turned = dataset.position[-1].values
    np.testing.assert_allclose(turned, np.stack([-y, x], axis=1), rtol=0, atol=1e-12)


@samples(30)
@given(seed=st.integers(0, 2**31), lattice=st.sampled_from(list(SPRINGS)))
def test_energy_of_springs_never_increases(seed, lattice):
    """From scrambled starts, up to two spacings from rest, with relaxation 1."""
    experiment = SPRINGS[lattice] | {
        "name": "scrambled",
        "seed": seed,
        "body": SMALL_GRID,
        "rule": {"type": "springs"},
        "frame": NATURAL,
        "initial": {"type": "noise", "amplitude": 1.0},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "steps": 60,
    }
    dataset = pbdkit.run(experiment, progress=False)
    i, j, k, rest = springs_of(lattice)
    x = dataset.position.values
    energy = (0.5 * k * (np.linalg.norm(x[:, i] - x[:, j], axis=2) - rest) ** 2).sum(axis=1)
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    assert energy[-1] < energy[0]


@functools.cache
def springs_of(lattice):
    """(i, j, stiffness, rest length) of a 6 × 5 body from the springs' definition: stiffness ¾ on
    edges and ⅜ on diagonals of squares, √¾ on triangles, half where one cell is missing."""
    scene = {"name": "springs", "body": SMALL_GRID, "rule": {"type": "springs"}, "frame": NATURAL}
    X = build_scene(pbdkit.Experiment(**SPRINGS[lattice], **scene, steps=1)).raster.reference()
    rest, found = np.linalg.norm(X[:, None] - X[None], axis=2), []
    for i, j in zip(*np.nonzero(np.triu(rest)), strict=True):
        if rest[i, j] < 0.51:
            k = 0.75 if lattice == "square" else math.sqrt(0.75)
            found.append((i, j, k * cells_beside(X, i, j, lattice == "square") / 2, rest[i, j]))
        elif rest[i, j] < 0.75:
            found.append((i, j, 0.375, rest[i, j]))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def cells_beside(X, i, j, is_square):
    """Return the number of cells that share an edge: on each side the corners that complete one
    must exist."""
    cells, (x, y) = 0, X[j] - X[i]
    for side in (1, -1):
        across = side * np.array([-y, x])
        wanted = [X[i] + across, X[j] + across]
        if not is_square:
            wanted = [X[i] + (X[j] - X[i]) / 2 + math.sqrt(0.75) * across]
        cells += all((np.linalg.norm(X - w, axis=1) < 1e-9).any() for w in wanted)
    return cells


@pytest.mark.parametrize("parts", SPRINGS.values(), ids=SPRINGS)
def test_springs_are_elastic_for_small_strain(parts):
    """Their answer to a small pull differs from that of ν = 1/3 at second order of the pull."""

    def pulled(rule, pull):
        experiment = parts | {
            "name": "pull",
            "body": GRID,
            "rule": rule,
            "frame": NATURAL,
            "leaders": [
                {"select": {"edge": "left"}, "motion": {"type": "hold"}},
                {
                    "select": {"edge": "right"},
                    "motion": {"type": "displace", "displacement": [pull, pull / 2]},
                },
            ],
            "steps": 1,
            "solver": {"type": "equilibrium"},
        }
        return body_displacements(pbdkit.run(experiment, progress=False))

    far = []
    for pull in (1e-3, 1e-4):
        elastic = pulled({"type": "elastic", "poisson_ratio": 1 / 3}, pull)
        far.append(np.abs(pulled({"type": "springs"}, pull) - elastic).max() / pull)
    assert far[0] < 5e-3
    assert far[1] == pytest.approx(far[0] / 10, rel=0.1)
