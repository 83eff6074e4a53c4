"""Strain, rotation and stress: exact where they are known, and at second order elsewhere."""

import math

import numpy as np
import pytest
from property_cases import LATTICES, experiment, scene_of, state_with

import pbdkit
from pbdkit.io.snapshot import StateCells, StateMoment, Tables
from pbdkit.lattice.raster import FRAME
from pbdkit.scene.scene import build_scene
from tests.components.test_elasticity import (
    CASES,
    GRID,
    HEXAGONAL,
    NATURAL,
    RECTANGULAR,
    SQUARE,
    STRESS,
    bending,
    held_as,
    rotation,
    tension,
)

# Fields are given by the start of a run: no leaders are needed.
pytestmark = [
    pytest.mark.filterwarnings("ignore:leaders. the experiment has neither"),
    pytest.mark.filterwarnings("ignore:neighbours. all lie along one line"),
]

E = 7.0
FIELDS = [{"type": "strain"}, {"type": "rotation"}, {"type": "stress", "youngs_modulus": E}]
FINITE = [
    {"type": "strain", "measure": "green-lagrange"},
    {"type": "stress", "youngs_modulus": E, "measure": "green-lagrange"},
]


DISC = {"type": "disc", "radius": 1.0, "centre": [0.0, 0.0]}


def last(dataset, name):
    """The last values of the body particles: (particle,), or (particle, 3) of a tensor."""
    body = (dataset.kind[-1] != FRAME).values
    if name in dataset:
        return dataset[name].values[-1, body]
    return np.stack([last(dataset, f"{name}_{part}") for part in ("xx", "yy", "xy")], axis=1)


def close(found, expected, atol=1e-12):
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=0, atol=atol)


# Linear triangles, the hexagonal lattice's cells, do not bend exactly, in any theory.
@pytest.mark.parametrize(
    ("name", "field"),
    [
        (name, field)
        for name in CASES
        for field in (rotation, tension, bending)
        if field is not bending or "hexagonal" not in name
    ],
)
def test_solutions_have_strain_rotation_and_stress_everywhere(name, field):
    """Small rotation, free tension and pure bending: at edges and leaders too."""
    given, _ = held_as(field, CASES[name], width=0.3)
    ds = pbdkit.run(given | {"diagnostics": FIELDS}, progress=False)
    c = build_scene(pbdkit.Experiment(**given)).experiment.rule.elasticity()
    contraction, modulus = c.xy / c.yy, E * (c.xx - c.xy**2 / c.yy)
    y = ds.reference.values[(ds.kind[-1] != FRAME).values, 1]
    x = ds.reference.values[(ds.kind[-1] != FRAME).values, 0]
    stretch = {rotation: 0 * y, tension: 0.1 + 0 * y, bending: 0.1 * y}[field]
    turn = {rotation: 0.2 + 0 * y, tension: 0 * y, bending: -0.2 * x}[field]
    close(last(ds, "strain"), stretch[:, None] * [1.0, -contraction, 0.0])
    close(last(ds, "stress"), modulus * stretch[:, None] * [1.0, 0.0, 0.0])
    close(last(ds, "rotation"), np.arctan2(turn, 2 + stretch * (1 - contraction)))


@pytest.mark.parametrize("lattice", LATTICES)
def test_affine_deformations_are_exact_on_every_lattice_for_every_rule(lattice):
    """A turn by 30° after a stretch, F = R U, from step 0; the frame does not matter."""
    turn, U = math.radians(30.0), np.array([[1.3, 0.2], [0.2, 0.8]])
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    H = R @ U - np.eye(2)
    given = experiment(
        lattice=lattice,
        initial={"type": "affine", "gradient": H.tolist(), "shift": [4.0, 5.0]},
        steps=1,
        diagnostics=[*FIELDS[:2], FINITE[0]],
    )
    ds = pbdkit.run(given, progress=False).isel(time=slice(0, 1))
    small, finite = (H + H.T) / 2, (U @ U - np.eye(2)) / 2
    close(last(ds, "rotation"), turn)
    close(last(ds, "strain"), [small[0, 0], small[1, 1], small[0, 1]])
    close(last(ds, "green_lagrange"), [finite[0, 0], finite[1, 1], finite[0, 1]])
    frame = (ds.kind[0] == FRAME).values
    assert frame.any()
    assert np.isnan(ds.strain_xx.values[0, frame]).all()
    assert np.isnan(ds.rotation.values[0, frame]).all()


def isotropic(nu, plane="stress"):
    """Hooke's law of plane strains (xx, yy, xy) written out, as (xx, yy, zz, xy) over E."""
    if plane == "strain":
        lame, shear = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))

        def stress(xx, yy, xy):
            volume = lame * (xx + yy)
            return volume + 2 * shear * xx, volume + 2 * shear * yy, volume, 2 * shear * xy

        return stress
    return lambda xx, yy, xy: (
        (xx + nu * yy) / (1 - nu**2), (yy + nu * xx) / (1 - nu**2), 0.0, xy / (1 + nu)
    )  # fmt: skip


def orthotropic(xx, yy, xy):
    """With E_y = E/2, ν_xy = .2 and G = .3 E."""
    compliance = np.array([[1.0, -0.2], [-0.2, 2.0]])
    return *np.linalg.solve(compliance, [xx, yy]), 0.0, 2 * 0.3 * xy


STRAINED = STRESS | {"plane": "strain"}
SHEARED = {
    "elastic": (STRESS | {"poisson_ratio": 0.3, "stiffness": 2.0}, isotropic(0.3), 2.0),
    "plane strain": (STRAINED | {"poisson_ratio": 0.4}, isotropic(0.4, "strain"), 1.0),
    "of cells": (
        STRAINED | {"poisson_ratio": {"otherwise": 0.4, "none": 0.1}},
        isotropic(0.4, "strain"),
        1.0,
    ),
    "orthotropic": (
        {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.5, "shear_ratio": 0.3},
        orthotropic,
        1.0,
    ),
    "springs": ({"type": "springs"}, isotropic(1 / 3), 1.0),
}  # fmt: skip
GRADIENTS = {
    "pure shear": [[0.0, 0.01], [0.01, 0.0]],
    "simple shear": [[0.0, 0.01], [0.0, 0.0]],
    "all": [[0.012, 0.02], [-0.005, -0.004]],
    "tiny": [[1.2e-170, 2e-170], [-5e-171, -4e-171]],
}


@pytest.mark.parametrize("gradient", GRADIENTS.values(), ids=GRADIENTS)
@pytest.mark.parametrize("name", SHEARED)
def test_stress_of_affine_deformations_follows_hookes_law(name, gradient):
    """Test all components, von Mises of the tensor in space, and principal values in the plane."""
    rule, law, stiffness = SHEARED[name]
    given = experiment(initial={"type": "affine", "gradient": gradient}) | SQUARE | {
        "body": DISC | {"radius": 3.2}, "rule": rule, "frame": NATURAL, "diagnostics": FIELDS,
        "regions": {"none": DISC | {"centre": [90.0, 0.0]}}, "steps": 1, "leaders": [],
    }  # fmt: skip
    with pytest.warns(pbdkit.PbdkitWarning):
        ds = pbdkit.run(given, progress=False).isel(time=0)
    small = (np.array(gradient) + np.transpose(gradient)) / 2
    xx, yy, zz, xy = (E * stiffness * value for value in law(small[0, 0], small[1, 1], small[0, 1]))
    within = ds.isel(particle=ds.inside.values)
    scale = max(abs(value) for value in (xx, yy, xy))
    for part, value in {"xx": xx, "yy": yy, "xy": xy}.items():
        close(within[f"stress_{part}"].values / scale, value / scale)
    stress = np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]])
    strain = np.pad(small, (0, 1)) + np.diag([0.0, 0.0, -np.trace(small)])
    for name, tensor, factor in (("stress", stress, 3 / 2), ("strain", strain, 2 / 3)):
        unit = np.abs(tensor).max()
        tensor = tensor / unit
        part = tensor - np.eye(3) * np.trace(tensor) / 3
        close(within[f"{name}_von_mises"].values / unit, np.sqrt(factor * (part**2).sum()))
        values = np.linalg.eigvalsh(tensor[:2, :2])[::-1]
        close(within[f"{name}_principal"].values / unit, values)


@pytest.mark.parametrize(
    ("body", "beyond"),
    [
        (DISC | {"radius": 3.2}, lambda x, y: np.hypot(x, y) > 3.2),
        (
            {"type": "rectangle", "width": 3.0, "height": 2.6},
            lambda x, y: np.maximum(np.abs(x - 1.5) - 1.5, np.abs(y - 1.3) - 1.3) > 1e-9,
        ),
        (GRID, lambda x, y: x < -1e9),
        ({"type": "difference", "of": [GRID, DISC]}, lambda x, y: x < -1e9),
    ],
    ids=["disc", "rectangle", "grid", "grid less a disc"],
)
@pytest.mark.parametrize("frame", ["natural", "mean"])
@pytest.mark.parametrize("lattice", [SQUARE, HEXAGONAL], ids=["square", "hexagonal"])
def test_stress_is_undefined_outside_the_outline(body, beyond, frame, lattice):
    """Corners of cut cells lie beyond it; sites on it do not."""
    lattice = lattice | {"lattice": lattice["lattice"] | {"a": 1.0}}
    given = experiment(steps=1, leaders=[], frame={"type": frame}) | lattice | {
        "body": body, "rule": STRESS, "diagnostics": [*FIELDS, {"type": "displacement"}],
        "initial": {"type": "affine", "gradient": [[0.1, 0.02], [0.0, 0.0]]},
    }  # fmt: skip
    ds = pbdkit.run(given, progress=False)
    of_body = (ds.role == 0).values
    expected = of_body & ~beyond(*ds.reference.values.T)
    assert ds.inside.dtype == bool
    np.testing.assert_array_equal(ds.inside, expected)
    assert expected.any()
    for name in ("stress_xx", "stress_von_mises", "strain_xy", "strain_principal", "rotation"):
        values = ds[name].values[-1].reshape(len(expected), -1)
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), expected)
        assert np.isnan(values[~expected]).all()
    assert np.isfinite(ds.u.values[-1, of_body]).all()


@pytest.mark.parametrize("angle", [30.0, 135.0, -90.0])
def test_finite_rotation_has_zero_strain(angle):
    turn = math.radians(angle)
    H = [[math.cos(turn) - 1, -math.sin(turn)], [math.sin(turn), math.cos(turn) - 1]]
    energy = {"type": "strain-energy", "youngs_modulus": E}
    given = SQUARE | {
        "name": "turned",
        "body": GRID,
        "rule": {"type": "springs"},
        "frame": NATURAL,
        "initial": {"type": "affine", "gradient": H},
        "steps": 1,
        "diagnostics": [FIELDS[1], *FINITE, energy],
    }
    ds = pbdkit.run(given, progress=False)
    close(last(ds, "rotation"), turn)
    close(last(ds, "green_lagrange"), 0.0)
    close(last(ds, "piola_kirchhoff"), 0.0)
    assert abs(float(ds.strain_energy[-1])) < 1e-24


HOLE = {
    "type": "difference",
    "of": [{"type": "rectangle", "width": 2.0, "height": 2.0}, DISC | {"radius": 0.5}],
}


def gradient_of(field, lattice, body, a):
    """The gradient that a displacement has at the particles of a natural body, and their X."""
    parts = {"square": SQUARE, "rectangular": RECTANGULAR, "hexagonal": HEXAGONAL}[lattice]
    sides = {"a": a, "b": 1.6 * a} if lattice == "rectangular" else {"a": a}
    scene = scene_of(**parts | {"lattice": {"type": lattice} | sides}, body=body, rule=STRESS,
                     frame=NATURAL)  # fmt: skip
    X = scene.raster.reference(scene.raster.body_rows)
    return StateMoment(state_with(scene, field(*X.T)), Tables(scene)).cells.gradient(), X


@pytest.mark.parametrize("body", [DISC, HOLE], ids=["disc", "quarter of a hole"])
@pytest.mark.parametrize("lattice", ["square", "rectangular"])
def test_quadratic_displacements_are_exact_on_curved_edges(lattice, body):
    found, X = gradient_of(
        lambda x, y: np.stack([x * x + x * y, y * y - x * x / 2], axis=1), lattice, body, 0.1
    )
    x, y = X.T
    close(found.reshape(-1, 4), np.stack([2 * x + y, x, -x, 2 * y], axis=1))


@pytest.mark.parametrize(("lattice", "order"), [("square", 2), ("hexagonal", 1)])
def test_maximum_error_of_a_smooth_field_decreases_with_spacing(lattice, order):
    """Four times at half the spacing, edges included; on triangles twice, by their edges."""
    errors = []
    for n in (2, 4):
        body = {"type": "grid", "columns": 9 * n + 1, "rows": 6 * n + 1}
        found, X = gradient_of(
            lambda x, y: np.stack([np.sin(2 * x), np.exp(x) * y], axis=1), lattice, body, 0.2 / n
        )
        x, y = X.T
        exact = np.stack([2 * np.cos(2 * x), 0 * x, np.exp(x) * y, np.exp(x)], axis=1)
        errors.append(np.abs(found.reshape(-1, 4) - exact).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


CALIBRATED = {"rule": STRESS, "frame": NATURAL}


@pytest.mark.parametrize(
    "parts",
    [{}, {"lattice": "hexagonal"}, SQUARE | CALIBRATED, HEXAGONAL | CALIBRATED],
    ids=["square, mean", "hexagonal, mean", "square, natural", "hexagonal, natural"],
)
def test_cells_with_a_broken_bond_are_excluded(parts):
    """Two halves, cracked apart, of which one has moved away."""
    X = scene_of(**parts).raster.reference()
    middle = X[:, 0].mean() + 0.01
    ends = [[middle, -9.0], [middle, 9.0]]
    crack = {"type": "threshold", "thresholds": [9.0], "cracks": [ends]}
    for fracture, strained in ((crack, False), ({"type": "none"}, True)):
        scene = scene_of(**parts | {"fracture": fracture})
        X = scene.raster.reference(scene.raster.body_rows)
        u = np.where(X[:, :1] > middle, [3.0, 1.0], [0.0, 0.0])
        H = StateMoment(state_with(scene, u), Tables(scene)).cells.gradient()
        H = H[scene.raster.body_rows]
        assert (np.abs(H) > 0.1).any() == strained
        assert strained or (H == 0).all()


def test_gradient_is_computed_once_and_only_if_required(monkeypatch):
    made = []
    of = StateCells._gradient.func

    def counted(cells):
        made.append(cells._state.step)
        return of(cells)

    monkeypatch.setattr(StateCells._gradient, "func", counted)
    given = experiment(steps=1) | SQUARE | {"rule": STRESS, "frame": NATURAL}
    pbdkit.run(given, progress=False)
    assert made == []
    ds = pbdkit.run(given | {"diagnostics": FIELDS}, progress=False)
    assert made == [0, 1]
    assert not {"green_lagrange_xx", "piola_kirchhoff_xx", "leader_group"} & set(ds.variables)


@pytest.mark.parametrize("rule", [{"type": "barycentre"}, STRESS | {"poisson_ratio": -1.0}])
def test_stress_of_a_rule_without_a_material_is_refused(rule):
    given = experiment(steps=1, diagnostics=FIELDS) | SQUARE | {"rule": rule}
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.run(given, progress=False)
    assert str(caught.value) == (
        "diagnostics.2: 'stress' requires a rule that is calibrated to a material ('elastic', "
        f"'orthotropic', 'springs', 'strain-gradient'); '{rule['type']}' with these parameters is "
        "not; use one of those, or remove the diagnostic"
    )


def test_strain_of_a_body_without_cells_is_refused():
    with pytest.raises(pbdkit.ExperimentError, match=r"^diagnostics\.0: 'strain' requires cells"):
        pbdkit.run(experiment(6, 1, diagnostics=FIELDS[:1]), progress=False)
