"""The springs of a cell, which remain where it is torn, are no stiffer than the cell."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pbdkit.components.elasticity import bond_springs, mean_move, springs_in
from pbdkit.components.rules import Springs, spring_pull
from pbdkit.plugin import Vector
from pbdkit.plugin.rule import Stiffness

RNG = np.random.default_rng(11)


def rectangle(a: float, b: float) -> tuple[Any, Any, float]:
    """Cells, the springs of one of them as (rest offset, share of both sides), and its area."""
    cells = SimpleNamespace(regular=4, rectangle=(a, b), is_diagonal=lambda slot: all(slot.rest))
    bonds = [((a, 0.0), 1), ((a, 0.0), 1), ((0.0, b), 1), ((0.0, b), 1), ((a, b), 2), ((-a, b), 2)]
    return cells, bonds, a * b


def triangle(a: float) -> tuple[Any, Any, float]:
    cells = SimpleNamespace(regular=3, rectangle=None, is_diagonal=lambda _: False)
    turns = np.radians([0.0, 60.0, 120.0])
    bonds = [((a * math.cos(t), a * math.sin(t)), 1) for t in turns]
    return cells, bonds, math.sqrt(0.75) * a * a / 2


def constants(bonds: Any, c: Stiffness, cells: Any) -> list[float]:
    """Spring constants within the cell."""
    return [
        share * bond_springs(SimpleNamespace(rest=rest), c, cells) * (rest[0] ** 2 + rest[1] ** 2)
        for rest, share in bonds
    ]


def of_springs(bonds: Any, springs: Any, area: float) -> Any:
    """Stiffness for uniform strain: Σ k l² n ⊗ n ⊗ n ⊗ n / area, in Voigt's notation."""
    total = np.zeros((3, 3))
    for ((x, y), _), k in zip(bonds, springs, strict=True):
        strain = np.array([x * x, y * y, x * y])
        total += k / (x * x + y * y) / area * np.outer(strain, strain)
    return total


def matrix(c: Stiffness) -> Any:
    return np.array([[c.xx, c.xy, 0.0], [c.xy, c.yy, 0.0], [0.0, 0.0, c.shear]])


def isotropic(nu: float) -> Stiffness:
    return Stiffness(1 / (1 - nu**2), 1 / (1 - nu**2), nu / (1 - nu**2), 0.5 / (1 + nu))


def orthotropic() -> Stiffness:
    xx, yy, shear = RNG.uniform(0.5, 3.0, 3)
    return Stiffness(xx, yy, RNG.uniform(-0.3, 0.9) * math.sqrt(xx * yy), shear)


@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (1.0, 0.6), (0.5, 1.3)])
def test_springs_of_rectangles_are_as_stiff_as_the_cell_permits(a: float, b: float) -> None:
    """Neither a uniform strain nor an hourglass mode has more energy in the springs. The factor of
    `springs_in` is the largest one for other cells: one of the two is reached."""
    cells, bonds, area = rectangle(a, b)
    for c in [*(orthotropic() for _ in range(12)), *map(isotropic, (-0.5, 0.0, 0.2, 0.33, 0.45))]:
        springs = constants(bonds, c, cells)
        S, stiffest = of_springs(bonds, springs, area), max(springs[:4])
        assert np.linalg.eigvalsh(matrix(c) - S)[0] > -1e-12
        assert stiffest <= c.shear * (a / b + b / a) / 2 + 1e-12
        other = matrix(orthotropic())
        (factor,) = springs_in(other[None], c, cells)
        rest = np.linalg.eigvalsh(other - factor * S)[0]
        hourglass = other[2, 2] * (a / b + b / a) / 2 - factor * stiffest
        assert rest > -1e-9
        assert hourglass > -1e-9
        assert min(rest, hourglass) < 1e-9


@pytest.mark.parametrize("nu", [0.0, 0.2, 1 / 3])
def test_remainder_of_isotropic_squares_is_a_pure_shear_stiffness(nu: float) -> None:
    """An edge beside a straight cut has the stiffness 1/(2(1 + ν))."""
    cells, bonds, area = rectangle(1.0, 1.0)
    springs = constants(bonds, isotropic(nu), cells)
    remainder = matrix(isotropic(nu)) - of_springs(bonds, springs, area)
    np.testing.assert_allclose(springs[:4], 1 / (2 * (1 + nu)), rtol=1e-12)
    np.testing.assert_allclose(remainder[:2], 0.0, atol=1e-12)


@pytest.mark.parametrize("a", [1.0, 0.7])
def test_springs_of_triangles_are_as_stiff_as_the_cell_permits(a: float) -> None:
    """With Poisson's ratio 1/3 they are the cell."""
    cells, bonds, area = triangle(a)
    for nu in (-0.6, 0.0, 0.2, 1 / 3, 0.45):
        c = isotropic(nu)
        S = of_springs(bonds, constants(bonds, c, cells), area)
        assert abs(np.linalg.eigvalsh(matrix(c) - S)[0]) < 1e-12
        if nu == 1 / 3:
            np.testing.assert_allclose(S, matrix(c), atol=1e-12)
        other = matrix(orthotropic())
        (factor,) = springs_in(other[None], c, cells)
        assert abs(np.linalg.eigvalsh(other - factor * S)[0]) < 1e-9


def test_particles_without_springs_and_springs_without_length_are_at_rest() -> None:
    """Neither divides by zero: sums without a cell cause no move, and a spring the ends of which
    coincide has no direction."""
    none, zero = np.zeros(3), Vector(np.zeros(3), np.zeros(3))
    springs: Any = Springs()
    still = Vector(*np.zeros((2, 3)))
    for move in (
        springs.apply((zero, none), None, None),
        mean_move((zero, none, none, none)),
        spring_pull(Vector(*-np.ones((2, 3))), Vector(*np.ones((2, 3))), none + 2.0, none + 1.4),
    ):
        np.testing.assert_array_equal(np.array([*move]), np.array([*still]))
