"""The shipped experiments of a material, and the statements of docs/materials.md."""

import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from finite_elements.errors import load, relative_l2
from scene_strategies import AT_LENGTH
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import pbdkit
from pbdkit.errors import DivergedError
from pbdkit.lattice.raster import FRAME, LEADER
from pbdkit.model.reading import read_text

PAGE = Path(__file__).parents[2] / "docs" / "materials.md"


@functools.cache
def run(name, *settings):
    experiment = pbdkit.load(f"material/{name}", settings=list(settings))
    return pbdkit.run(experiment, progress=False)


def on_sites(ds, shape):
    """Displacements of the body, (axis, i, j); 0 at sites beside it."""
    u, body = np.zeros((2, *shape)), ds.kind[-1].values != FRAME
    i, j = (ds.site.values[body] - ds.site.values[body].min(axis=0)).T
    u[:, i, j] = (ds.position[-1] - ds.reference).values[body].T
    return u


@pytest.mark.parametrize(
    ("name", "pulled", "within", "reaction"),
    [("bar", 0, 5.2e-4, 5.3e-4), ("cantilever", 1, 2.3e-4, 4.5e-3), ("hole", 0, 1.7e-3, 9e-4)],
)
def test_bodies_match_finite_elements(name, pulled, within, reaction):
    reference, ds = load(name, 20), run(name)
    assert relative_l2(on_sites(ds, reference.x.shape), reference) < within
    assert float(ds.reaction[-1, 1, pulled]) == pytest.approx(reference.reaction, rel=reaction)


@pytest.mark.parametrize(("name", "off"), [("bar", 0.067), ("cantilever", 0.145)])
def test_copying_frame_gives_another_solution(name, off):
    for cells in (10, 20):
        reference = load(name, cells)
        columns, rows = reference.x.shape
        body = f"body={{type: grid, columns: {columns}, rows: {rows}}}"
        ds = run(name, body, f"lattice.a={1 / cells}", "frame={type: mean}", "diagnostics=[]")
        error = relative_l2(on_sites(ds, (columns, rows)), reference)
        assert error == pytest.approx(off, abs=0.002)


def test_worked_example_recovers_the_modulus():
    """On the finest lattice in the profile `long`."""
    (given,) = re.findall(r"^```yaml\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    experiment = pbdkit.Experiment.build(read_text(given, PAGE.name))
    ds = pbdkit.run(experiment, progress=False)
    strain, stress = ds.nominal_strain.values, ds.nominal_stress.values
    assert np.polyfit(strain[5:], stress[5:], 1)[0] == pytest.approx(209880, abs=20)
    assert stress[-1] == pytest.approx(191.4, abs=0.1)
    assert strain[-1] == pytest.approx(9.19e-4, abs=1e-6)
    assert float(ds.reaction[-1, 1, 0]) == pytest.approx(4595, abs=1)
    straight = experiment.model_dump() | {"solver": {"type": "equilibrium"}}
    for a, modulus in ((4.0, 209927), (2.0, 209883), (1.0, 209895))[: 3 if AT_LENGTH else 2]:
        straight["lattice"] = {"type": "square", "a": a}
        ds = pbdkit.run(straight, progress=False)
        found = float(ds.nominal_stress[-1] / ds.nominal_strain[-1])
        assert found == pytest.approx(modulus, abs=2)


def layers(x, length):
    """A + Bx + C exp(-x/l) + D exp((x - 1)/l) with u = u' = 0 at 0, u = 1 and u' = 0 at 1."""
    small = math.exp(-1 / length)
    conditions = [
        [1, 0, 1, small],
        [0, length, -1, small],
        [1, 1, small, 1],
        [0, length, -small, 1],
    ]
    A, B, C, D = np.linalg.solve(conditions, [0, 0, 1, 0])
    return A + B * x + C * np.exp(-x / length) + D * np.exp((x - 1) / length)


def test_gradient_layer_matches_the_exact_solution():
    errors = []
    for a in (0.05, 0.025):
        ds = run("gradient-layer", f"lattice.a={a}")
        exact = layers(ds.reference.values[:, 0], 0.1)
        errors.append(np.abs(ds.u[-1, :, 0].values - exact).max())
    assert errors[0] < 3e-3
    assert errors[1] < errors[0] / 3.5


def test_error_bound_of_a_fine_gradient_layer_is_near_rounding():
    known = (
        r"rounding errors limit the relative distance to .*; set solver.tolerance: (\S+); the "
        r"state is within"
    )
    with pytest.raises(DivergedError, match=known) as caught:
        run("gradient-layer", "lattice.a=0.00625", "solver.tolerance=1.0e-12")
    (remedy,) = re.findall(known, str(caught.value))
    assert float(remedy) < 1e-6
    ds = run("gradient-layer", "lattice.a=0.00625", f"solver.tolerance={remedy}")
    exact = layers(ds.reference.values[:, 0], 0.1)
    assert np.abs(ds.u[-1, :, 0].values - exact).max() < 6e-5


def test_specimen_without_nick_has_youngs_modulus():
    settings = ["fracture={type: none}", "solver={type: equilibrium}"]
    ds = run("dogbone", *settings, "rule={type: elastic, poisson_ratio: 0.35}")
    slope = float(ds.nominal_stress[-1] / ds.nominal_strain[-1])
    assert slope == pytest.approx(3300.0, rel=6e-3)


def new_cracks(ds):
    """Steps and midpoints of the bonds that broke, not of those broken from the start."""
    new = ds.crack_step.values > 0
    return ds.crack_step.values[new], ds.crack_midpoint.values[new]


def pieces(ds):
    """The label of the piece that each particle is in, by the bonds that hold."""
    i, j = ds.bond_ends.values[ds.broken_step.values < 0].T - 1
    size = ds.sizes["particle"]
    return connected_components(coo_array((np.ones(len(i)), (i, j)), (size, size)), False)


def test_dogbone_curve_is_linear_until_fracture_and_ends_at_zero():
    ds = run("dogbone")
    strain, stress = ds.nominal_strain.values, ds.nominal_stress.values
    steps, _ = new_cracks(ds)
    whole = (ds.time.values > 0) & (ds.time.values < steps[0])
    slope, start = np.polyfit(strain[whole], stress[whole], 1)
    assert slope / 3300 == pytest.approx(0.947, abs=0.003)
    assert np.abs(slope * strain[whole] + start - stress[whole]).max() < 0.02 * stress.max()
    assert stress[whole][-1] == pytest.approx(31.9, abs=0.1)
    assert stress.max() == pytest.approx(34.7, abs=0.1)
    assert abs(stress[-1]) < 1e-3 * stress.max()


def test_the_dogbone_breaks_within_its_gauge_from_the_nick():
    ds = run("dogbone")
    _, middle = new_cracks(ds)
    np.testing.assert_allclose(middle[0], [12.25, 2.5])
    beside = np.abs(middle[:, 0] - 12.25) > 0.6
    np.testing.assert_allclose(middle[beside], [[17.25, 7.75], [6.75, 7.75]])  # in slivers
    count, label = pieces(ds)
    assert count == 2
    x, leads = ds.reference.values[:, 0], ds.kind[-1].values == LEADER
    assert set(label[leads & (x < 12)]) != set(label[leads & (x > 12)])


def test_notch_crack_starts_at_its_tip_and_is_mirror_symmetric():
    ds = run("notch")
    steps, middle = new_cracks(ds)
    np.testing.assert_allclose(middle[0], [3.5, 4.75])
    ahead = middle[middle[:, 1] == 4.75]
    assert (np.diff(ahead[:, 0]) >= 0).all()
    assert ahead[-1, 0] == 10.0

    broken = set(zip(steps, *middle.T, strict=True))
    assert {(step, x, 9.5 - y) for step, x, y in broken} == broken
    u = (ds.position - ds.reference).values.reshape(-1, 21, 20, 2)
    np.testing.assert_allclose(u[:, :, ::-1], u * [1.0, -1.0], rtol=0, atol=1e-12)
    assert pieces(ds)[0] == 2
    stress = ds.nominal_stress.values
    assert stress[ds.time.values < steps[0]][-1] == pytest.approx(22.5, abs=0.1)
    assert abs(stress[-1]) < 1e-4 * stress.max()


def strength(a, notched):
    """The stress at which the first bond of a plate 10 by 10 (and a half spacing) breaks at a
    strain of 2 %, in equilibrium: at the notch tip, or in the middle where there is none."""
    cells = round(10 / a) + 1
    height = cells * a
    cracks = [[[-1.0, height / 2], [3 + a / 2, height / 2]]] if notched else []
    settings = [
        f"lattice.a={a}",
        f"body={{type: grid, columns: {cells}, rows: {cells + 1}}}",
        "rule={type: elastic, poisson_ratio: 0.3333333333333333}",
        f"fracture={{type: strain, failure: 1000.0, cracks: {cracks}}}",
        "solver={type: equilibrium, increments: 1}",
        "diagnostics.1={type: displacement}",
        "steps=1",  # all is linear
    ]
    ds = run("notch", *settings)
    lower, upper = ds.bond_ends.values[ds.broken_step.values < 0].T - 1
    X, u = ds.reference.values, ds.u.values[-1]
    r, d = X[upper] - X[lower], u[upper] - u[lower]
    strain = (d * r).sum(axis=1) / (r * r).sum(axis=1)
    place = [3 + a, height / 2] if notched else [5.0, height / 2]
    middle = np.abs((X[lower] + X[upper]) / 2 - place).max(axis=1) < 1e-9
    assert middle.sum() == 1
    return 0.02 * float(ds.nominal_stress[-1]) / float(strain[middle][0])


def test_only_a_notched_plate_weakens_on_a_finer_lattice():
    """Strain at a crack's tip grows as 1/√h: the strength falls as √h, the fracture energy as h."""
    spacings = (0.5, 0.25, 0.125) if AT_LENGTH else (0.5, 0.25)
    whole = [strength(a, notched=False) for a in spacings[:2]]
    np.testing.assert_allclose(whole, 63.48, rtol=1e-3)
    torn = [strength(a, notched=True) for a in spacings]
    np.testing.assert_allclose(torn, [21.6, 16.3, 12.0][: len(torn)], atol=0.05)
    scaled = np.array(torn) / np.sqrt(spacings)
    assert 1.0 < scaled[1] / scaled[0] < 1.08
    if AT_LENGTH:
        assert 1.0 < scaled[2] / scaled[1] < scaled[1] / scaled[0]


def affine(lattice, rule, gradient, a=0.5, **more):
    """PE1 of the particle in the middle, and the dataset."""
    given = {
        "name": "affine",
        "lattice": {"type": lattice, "a": a},
        "body": {"type": "grid", "columns": 9, "rows": 9},
        "rule": {"type": rule},
        "initial": {"type": "affine", "gradient": gradient.tolist()},
        "steps": 1,
        "diagnostics": [{"type": "pe1"}],
    }
    ds = pbdkit.run(given | more, progress=False)
    from_middle = ((ds.reference - ds.reference.mean("particle")) ** 2).sum("axis")
    return float(ds.pe1[0, from_middle.values.argmin()]), ds


@pytest.mark.parametrize("seed", range(5))
def test_pe1_is_strain_energy_only_on_the_hexagonal_lattice(seed):
    """4 h² W/E at ν = 1/3; on the square lattice it does not see shear."""
    gradient = 1e-5 * np.random.default_rng(seed).uniform(-1, 1, (2, 2))
    strain, nu, a = (gradient + gradient.T) / 2, 1 / 3, 0.5
    (xx, xy), (_, yy) = strain
    energy = 0.5 / (1 - nu * nu) * (xx**2 + yy**2 + 2 * nu * xx * yy + 2 * (1 - nu) * xy**2)
    hexagonal, _ = affine("hexagonal", "barycentre", gradient)
    assert hexagonal == pytest.approx(4 * a * a * energy, rel=1e-4)
    square, _ = affine("square", "barycentre", gradient)
    assert square == pytest.approx(2 * a * a * (xx**2 + yy**2), rel=1e-4)


def test_pe1_is_the_energy_of_springs_at_any_strain():
    gradient, a = np.array([[0.3, 0.2], [-0.4, 0.5]]), 0.5
    asked = [{"type": "pe1"}, {"type": "strain-energy", "youngs_modulus": 1.0}]
    natural = {"frame": {"type": "natural"}, "diagnostics": asked}
    pe1, ds = affine("hexagonal", "springs", gradient, **natural)
    triangles = 2 * 8 * 8
    area = triangles * math.sqrt(3) / 4 * a * a
    assert pe1 == pytest.approx(4 * a * a * float(ds.strain_energy[0]) / area, rel=1e-12)
