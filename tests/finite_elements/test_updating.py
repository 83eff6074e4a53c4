"""Finite-element updating of the shipped specimen, which pbdkit's fit is held against."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

pytest.importorskip("skfem", reason="the rival is scikit-fem, of the group test")
from finite_elements import ends, specimen, updating

import pbdkit

N = 6


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """The mesh of `ends` is as coarse as the one that it is compared with."""
    monkeypatch.setattr(ends, "ELEMENTS", N)


@pytest.fixture(scope="module")
def elements():
    return updating.alike(N, plain=False)


def test_uniformly_pulled_bar_is_exact():
    """Without its hole it would be: so the boundary of the hole is pulled along, too."""
    plate = specimen.Plate(4)
    x, y = plate.basis.doflocs
    u = np.where(plate.along_x, 2e-3 * x, -0.3 * 2e-3 * (y - 10.0))
    points = specimen.read().inside(0.1).points
    seen = plate.shows(points) @ u
    right = np.concatenate([2e-3 * points[:, 0], -0.3 * 2e-3 * (points[:, 1] - 10.0)])
    np.testing.assert_allclose(seen, right, atol=1e-12)
    around = np.hypot(x - 40.0, y - 10.0) < specimen.RADIUS + 1e-9
    held = around | np.isin(np.arange(len(u)), plate.led)
    forces = plate.stiffness(specimen.lame(0.3)) @ u
    assert np.abs(forces[~held]).max() < 1e-12
    assert forces[plate.pulled].sum() == pytest.approx(2e-3 * specimen.HEIGHT)
    area = specimen.LENGTH * specimen.HEIGHT - np.pi * specimen.RADIUS**2
    assert plate.basis.dx.sum() == pytest.approx(area, rel=1e-5)


def test_derivatives_match_finite_differences():
    data = specimen.read().inside(0.5)
    model = updating.Model(2, data)
    modes = model.plate.modes(2)
    weights = np.random.default_rng(0).normal(size=modes.shape[1])
    found = model.answers(0.3, modes, weights)
    above, below = (model.answers(0.3 + h, modes, weights) for h in (1e-5, -1e-5))
    slope = (above.seen - below.seen) @ weights / 2e-5
    np.testing.assert_allclose(found.seen_slope, slope, atol=1e-6 * np.abs(slope).max())
    change = (above.carried - below.carried) @ weights / 2e-5
    assert found.carried_slope == pytest.approx(change, rel=1e-6)
    shown = model.shows @ model.state(0.3, modes @ weights)
    np.testing.assert_allclose(found.seen @ weights, shown, atol=1e-10)


def test_plain_and_optimised_updating_agree():
    plain, well = (updating.usual(4, plain=plain, inset=2.0) for plain in (True, False))
    assert plain.poisson.value == pytest.approx(well.poisson.value, abs=1e-4)
    assert plain.young.value == pytest.approx(well.young.value, rel=1e-6)
    assert plain.young.error == pytest.approx(well.young.error, rel=1e-3)


def test_pbdkit_matches_finite_element_updating(elements):
    """Poisson's ratio within its error; both errors are those of the same noise. Young's modulus
    within what the meshes leave to be desired, 0.05 %."""
    fit = yaml.safe_load(specimen.FILE.with_suffix(".yaml").read_text("utf-8"))
    fit["experiment"]["lattice"]["a"] = 0.4
    fit["experiment"]["solver"] = {"type": "equilibrium", "method": "lu"}  # compiles nothing
    for reader in (fit["measured"], *(one["motion"] for one in fit["experiment"]["leaders"])):
        reader["file"] = str(specimen.FILE)
    found = pbdkit.fit(fit)
    own = found.values["rule.poisson_ratio"]
    assert abs(own.value - elements.poisson.value) < own.error
    assert own.error / own.growth == pytest.approx(elements.poisson.error, rel=0.03)
    assert found.youngs_modulus.value == pytest.approx(elements.young.value, rel=1e-3)
    young = found.youngs_modulus
    assert young.error / young.growth == pytest.approx(elements.young.error, rel=0.03)
    assert found.ratio == pytest.approx(elements.ratio, rel=0.01)


def test_both_ends_show_the_same_decreasing_strain():
    found, apart = ends.fall(), ends.ends()
    assert apart["left"].modulus.value < 0.9 * apart["right"].modulus.value
    spread = np.hypot(found.left.error, found.right.error)
    assert abs(found.left.value - found.right.value) < 2.0 * spread
    assert found.whole.value > 20.0 * found.whole.error
    assert abs(found.between.value - found.whole.value) < 2.0 * found.between.error
    straight = ends.straightened(found.found.strengths[0].value)
    moduli = [end.modulus for end in straight.values()]
    assert abs(moduli[0].value - moduli[1].value) < 2.0 * np.hypot(*(m.error for m in moduli))


def test_clamping_a_moving_end_biases_the_modulus(elements):
    held, free = ends.clamped(), ends.clamped(rigid=True)
    assert held.young.value < 0.65 * elements.young.value
    assert free.young.value == pytest.approx(elements.young.value, rel=5e-3)
    assert free.left < 0.1 * held.left
    assert ends.moved()[0].value > 0.25 * ends.moved()[1].value
