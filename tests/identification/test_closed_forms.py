"""Elastic constants, long waves and translations against closed forms."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pbdkit.identification.elastic_constants import Elasticity, elasticity
from pbdkit.identification.identity import _character, _range_text
from pbdkit.identification.waves import DirectionalRange, _shortest, fourth_order, gradients

VOIGT = np.array([[0, 2], [2, 1]])
"""Row of Voigt's notation of a pair of axes."""


def second_order(stiffness: Any, mobility: Any) -> Any:
    """Q_abcd of a step that moves each particle by mobility · div σ."""
    C = stiffness[VOIGT[:, :, None, None], VOIGT[None, None]]
    gamma = (np.einsum("acbd->abcd", C) + np.einsum("adbc->abcd", C)) / 2
    return np.einsum("ae,ebcd->abcd", mobility, gamma)


@pytest.mark.parametrize("seed", range(5))
def test_stiffness_and_mobility_of_a_general_body_are_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, skew = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
    stiffness, inverse = root @ root.T + 0.3 * np.eye(3), skew @ skew.T + 0.2 * np.eye(2)
    inverse *= 2.0 / np.trace(inverse)
    body = elasticity(second_order(stiffness, np.linalg.inv(inverse)))
    assert isinstance(body, Elasticity)
    np.testing.assert_allclose(body.stiffness, stiffness, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(body.mobility, np.linalg.inv(inverse), rtol=1e-9, atol=1e-9)


def test_axes_without_coupling_have_the_mobility_1() -> None:
    """Every diagonal mobility is possible; the one nearest to 1 is used."""
    body = elasticity(second_order(np.diag([2.0, 0.5, 0.0]), np.eye(2)))
    assert isinstance(body, Elasticity)
    np.testing.assert_allclose(body.mobility, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(body.stiffness, np.diag([2.0, 0.5, 0.0]), atol=1e-12)


@pytest.mark.parametrize(
    ("speeds", "coupled"),
    [((1.0, 0.4), False), ((0.4, 1.0), False), ((0.7, 0.7), False), ((1.0, 0.4), True)],
)
def test_fourth_order_lengths_are_those_of_the_eigenvalues(speeds: Any, coupled: bool) -> None:
    """z = d k² (1 + λ² k²) for the eigenvalues z of second k² + third k³ + fourth k⁴."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    second = turn @ np.diag(speeds) @ turn.T
    third = 0.3j * np.array([[0.0, 1.0], [-1.0, 0.0]]) * coupled
    fourth = turn @ np.diag([0.05, -0.2]) @ turn.T if not coupled else np.diag([0.05, -0.2])
    waves: Any = SimpleNamespace(series=lambda _: (None, None, second, third, fourth))
    k = 1e-2
    z = np.sort(np.linalg.eigvals(second * k**2 + third * k**3 + fourth * k**4).real)[::-1]
    exact = (z / (np.sort(speeds)[::-1] * k**2) - 1.0) / k**2
    np.testing.assert_allclose(fourth_order(waves, np.array([1.0, 0.0])), exact, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "basis",
    [[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.5, math.sqrt(0.75)]], [[1.0, 0.0], [0.3, 1.4]]],
)
def test_the_shortest_translations_are_found_in_any_description(basis: Any, seed: int) -> None:
    """The cell vectors and the shifts are arbitrary sums of the basis."""
    rng, exact = np.random.default_rng(seed), np.array(basis)
    m, n = rng.integers(-3, 4, 2)
    unimodular = np.array([[1, m], [0, 1]]) @ np.array([[1, 0], [n, 1]])
    vectors = np.array([[2, 0], [0, 1]]) @ unimodular @ exact
    a_half = unimodular[0] @ exact
    shifts = np.array([[0.0, 0.0], a_half + rng.integers(-9, 10, 2) @ vectors])
    found = _shortest(vectors, shifts)
    lengths = np.sort(np.linalg.norm(exact, axis=1))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), lengths, atol=1e-9)
    assert abs(np.linalg.det(found)) == pytest.approx(abs(np.linalg.det(exact)))


@pytest.mark.parametrize("turn", [0.0, 37.0, 120.0, 200.0, 299.7])
def test_gradients_are_normal_to_the_densest_rows_in_any_orientation(turn: float) -> None:
    """The rows of the triangular lattice; the lengths of isotropic waves have no direction."""
    angles = np.radians([turn, turn + 60.0])
    basis = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    terms = (None, None, np.eye(2), np.zeros((2, 2)), -0.1 * np.eye(2))
    waves: Any = SimpleNamespace(stencil=SimpleNamespace(basis=basis), series=lambda _: terms)
    found = gradients(waves)
    np.testing.assert_allclose(
        [gradient.direction for gradient in found],
        np.sort((turn + np.array([30.0, 90.0, 150.0])) % 180.0),
    )
    for gradient in found:
        assert gradient.rows_apart == pytest.approx(math.sqrt(0.75))
        np.testing.assert_allclose(gradient.total, -0.1)


def test_a_range_names_its_directions_unless_it_is_isotropic() -> None:
    """In the order of the fields of a range."""
    same = DirectionalRange(smallest=2.0, at_smallest=10.0, largest=2.0, at_largest=70.0)
    assert _range_text(same, "h²") == "2 h² in every direction"
    wide = DirectionalRange(smallest=1.0, at_smallest=10.0, largest=2.0, at_largest=70.0)
    assert _range_text(wide, "h²") == "2 h² along 70°, 1 along 10°"


@pytest.mark.parametrize("holds", [False, True])
def test_properties_are_reported_as_they_are(holds: bool) -> None:
    """Symmetry, linearity, invariance and rest."""
    spectrum = SimpleNamespace(smallest=0.0, largest=2.0, imaginary=0.3 * holds)
    identity: Any = SimpleNamespace(
        spectrum=spectrum, linear=holds, symmetric=holds, turns=holds, rests_at_edges=holds
    )
    rows = dict(_character(identity))
    assert rows.pop("eigenvalues") == "0 to 2" + ", imaginary parts up to 0.3" * holds
    assert len(rows) == 4
    assert all(text.startswith("yes" if holds else "no") for text in rows.values())
