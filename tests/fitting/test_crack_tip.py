"""The position of a crack tip in a measured field, and stress intensity factors there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.components.stress_intensity import Frame, IsotropicPlane, auxiliary
from pbdkit.fitting.observations import TipFields

NU, CELLS, MIDDLE = 0.3, 25, 12.5
MATERIAL = IsotropicPlane(1 / (2 * (1 + NU)), (3 - NU) / (1 + NU))
K_I, K_II, T = 4e-3, 1e-3, 2e-4
NOISE = 2e-4
UNITS = {"length": "0.5 mm", "youngs_modulus": "3300 MPa"}


def plate(file, cut, *, vertical=False, **parts):
    """A square with a cut to its middle along x, or along y, and measured edges."""
    d, end = 0.25, CELLS - 0.25
    boxes = [
        [-d, -d, end, d],
        [d, end + d / 2, CELLS + d, CELLS + d],
        [CELLS - d, -d, CELLS + d, end],
    ]
    boxes += [[-d, d, d, MIDDLE], [-d, MIDDLE, d, CELLS + d]]
    boxes = [[b[1], b[0], b[3], b[2]] for b in boxes] if vertical else boxes
    motion = {"type": "measured", "file": str(file), "outside": "nearest"}
    return {
        "name": "tip",
        "units": UNITS,
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": CELLS + 1, "rows": CELLS + 1},
        "neighbours": {"type": "chebyshev"},
        "rule": {"type": "elastic", "poisson_ratio": NU},
        "frame": {"type": "natural"},
        "cuts": [cut],
        "leaders": [{"select": {"box": box}, "motion": motion} for box in boxes],
        "steps": 1,
        "solver": {"type": "equilibrium"},
        "diagnostics": [{"type": "stress-intensity"}],
    } | parts


def williams(points, tip):
    """Displacements of modes I and II and a T-stress about a tip, for a Young's modulus of 1."""
    x = points - tip
    singular = np.tensordot([K_I, K_II], auxiliary(x, MATERIAL)[0][:2], 1)
    return singular + T * x * [1.0, -NU]


def write_field(file, tip, *, vertical=False, noise=NOISE):
    """Writes the field at points of half a cell's distance, none of them near the crack."""
    n = np.arange(0.4, CELLS, 0.8)
    points = np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2)
    points = points[(abs(points[:, 1] - MIDDLE) > 0.8) | (points[:, 0] > tip + 1.0)]
    u = williams(points, [tip, MIDDLE])
    u += noise * np.random.default_rng(1).normal(size=u.shape)
    columns = np.hstack([points, u])
    columns = columns[:, [1, 0, 3, 2]] if vertical else columns
    np.savetxt(file, columns, "%.9g", ",", header="x,y,ux,uy", comments="")


def description(file, cut, **parts):
    return {
        "experiment": plate(file, cut),
        "unknown": {},
        "measured": {"file": str(file), "noise": NOISE},
        "modes": 6,
        "derived": ["K_I", "K_II", "T_stress"],
        "crack_tip": {"within": 6.0},
    } | parts


def shipped_field():
    """The data of the shipped fit `crack-field`, (point, column), as its head describes them."""
    E, nu, length, tip, noise = 3300.0, 0.35, 0.01, [171.3, 164.0], 0.015
    material = IsotropicPlane(1 / (2 * (1 + nu)), (3 - nu) / (1 + nu))
    n = np.arange(4.0, 320.0, 8.0)
    points = np.stack(np.meshgrid(n, n, indexing="ij"), axis=-1).reshape(-1, 2)
    x = points - tip
    points, x = (part[(abs(x[:, 1]) >= 8.0) | (x[:, 0] > 8.0)] for part in (points, x))
    K = np.array([25.0, 5.0]) / E / math.sqrt(length)
    u = np.tensordot(K, auxiliary(x, material)[0][:2], 1) - 2.0 / E * x * [1.0, -nu]
    u += [0.4, -0.2] + 3e-4 * x[:, ::-1] * [-1.0, 1.0]
    return np.hstack([points, u + noise * np.random.default_rng(19).normal(size=u.shape)])


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    file = tmp_path_factory.mktemp("tip") / "field.csv"
    write_field(file, MIDDLE + 0.3)
    return pbdkit.fit(description(file, {"from": [-1.0, MIDDLE], "to": [10.0, MIDDLE]}))


def test_tip_is_located_between_the_places_of_the_lattice(fitted):
    tip = fitted.crack_tip
    assert tip.position[1] == MIDDLE
    assert tip.position[0] == pytest.approx(MIDDLE + 0.3, abs=0.25)
    assert tip.extension.value == pytest.approx(0.5 * (tip.position[0] - 10.0))
    assert tip.extension.unit == "mm"
    # The square lattice with diagonals ends a crack at each half of a cell.
    assert tip.of_lattice == pytest.approx(0.5 * 0.5 / math.sqrt(12.0))
    assert 0.0 < tip.of_data < tip.extension.error < 0.2
    assert tip.cut_end[0] == pytest.approx(tip.position[0], abs=0.75)
    assert fitted.misfits[0].ratio == pytest.approx(1.0, abs=0.1)


def test_intensities_are_those_of_the_field(fitted):
    scale = 3300.0 * math.sqrt(0.5)
    for name, true in (("K_I", K_I), ("K_II", K_II)):
        derived = fitted.derived[name]
        assert derived.estimate.unit == "MPa*mm^0.5"
        assert 0.002 < derived.of_data / (scale * K_I) < 0.02
        assert derived.estimate.error == pytest.approx(
            math.hypot(derived.of_data, derived.of_diagnostic)
        )
        assert abs(derived.estimate.value - scale * true) < 2.5 * derived.estimate.error
    stress = fitted.derived["T_stress"].estimate
    assert stress.unit == "MPa"
    assert abs(stress.value - 3300.0 * T) < 2.5 * stress.error


def test_settings_of_the_measurement_move_the_cut(fitted, tmp_path):
    file = tmp_path / "field.csv"
    write_field(file, MIDDLE + 0.3)
    measured = {"file": str(file), "noise": NOISE, "settings": {"cuts.0.to": [10.0, MIDDLE]}}
    cut = {"from": [-1.0, MIDDLE], "to": [3.0, MIDDLE]}
    moved = pbdkit.fit(description(file, cut, measured=measured))
    assert moved.crack_tip == fitted.crack_tip
    assert moved.experiment.cuts == fitted.experiment.cuts


def test_fitted_experiment_has_the_crack_that_was_found(fitted):
    assert fitted.experiment.cuts[0].to == fitted.crack_tip.cut_end
    end = fitted.dataset.isel(time=-1)
    assert end.K_I.item() == pytest.approx(fitted.derived["K_I"].estimate.value, rel=1e-9)
    content = json.loads(json.dumps(fitted.as_dict()))["crack_tip"]
    assert content["position"] == [*fitted.crack_tip.position]
    assert f"crack tip: {fitted.crack_tip}" in str(fitted)


def test_reflected_field_has_the_reflected_tip(fitted, tmp_path):
    # The reflection exchanges x and y and the ends of the cut, and changes the sign of K_II.
    file = tmp_path / "field.csv"
    write_field(file, MIDDLE + 0.3, vertical=True)
    cut = {"to": [MIDDLE, -1.0], "from": [MIDDLE, 12.0]}
    reflected = pbdkit.fit(
        description(
            file,
            cut,
            experiment=plate(file, cut, vertical=True),
            crack_tip={"end": "from", "within": 6.0},
        )
    )
    np.testing.assert_allclose(reflected.crack_tip.position[::-1], fitted.crack_tip.position, 1e-6)
    for name, sign in (("K_I", 1), ("K_II", -1), ("T_stress", 1)):
        one, other = (f.derived[name].estimate for f in (fitted, reflected))
        assert other.value == pytest.approx(sign * one.value, rel=1e-4)
        assert other.error == pytest.approx(one.error, rel=1e-2)


def test_shipped_field_is_that_of_its_description():
    file = Path(pbdkit.__file__).parent / "fits" / "crack-field.csv"
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows, shipped_field(), atol=5.1e-5)


def test_terms_are_derivatives_along_the_crack():
    axes = np.array([[0.6, 0.8], [-0.8, 0.6]])
    frame = Frame(np.array([2.0, 1.0]), axes[0])
    points = np.random.default_rng(0).normal([5.0, 1.0], 1.0, (20, 2))

    def displacement(shift):
        moved = Frame(frame.origin + shift * axes[0], frame.direction)
        return auxiliary(moved.of(points), MATERIAL)[0][:2] @ axes

    expected = (displacement(-1e-5) - displacement(1e-5)) / 2e-5
    terms = TipFields(frame, MATERIAL).at(points)
    np.testing.assert_allclose(terms, expected.transpose(2, 1, 0).reshape(-1, 2), atol=1e-8)


@pytest.mark.parametrize(
    ("parts", "error", "message"),
    [
        ({"crack_tip": {"cut": 2, "within": 6.0}}, pbdkit.ExperimentError, "there is no cut 2"),
        ({"crack_tip": {"within": 0.2}}, pbdkit.ExperimentError, "no three places"),
        ({"crack_tip": {"within": 1.0}}, pbdkit.DivergedError, "ahead of the end of the cut"),
        (
            {"profile": ["rule.poisson_ratio"], "unknown": {"rule.poisson_ratio": [0.1, 0.4]}},
            pbdkit.ExperimentError,
            "`profile` is not available with `crack_tip`",
        ),
        ({"crack_tip": None, "derived": []}, pbdkit.ExperimentError, "nothing to fit"),
    ],
)  # fmt: skip
def test_faulty_descriptions_are_reported(parts, error, message, tmp_path):
    file = tmp_path / "field.csv"
    write_field(file, MIDDLE + 0.3)
    cut = {"from": [-1.0, MIDDLE], "to": [10.0, MIDDLE]}
    with pytest.raises(error, match=message):
        pbdkit.fit(description(file, cut, **parts))


def test_anisotropic_materials_are_refused(tmp_path):
    file = tmp_path / "field.csv"
    write_field(file, MIDDLE + 0.3)
    cut = {"from": [-1.0, MIDDLE], "to": [10.0, MIDDLE]}
    rule = {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.6, "shear_ratio": 0.3}
    with pytest.raises(pbdkit.ExperimentError, match="isotropic materials only"):
        pbdkit.fit(description(file, cut, experiment=plate(file, cut, rule=rule), derived=["J"]))
