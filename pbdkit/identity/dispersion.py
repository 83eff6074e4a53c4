"""The slow waves by direction and length, and the eigenvalues of all waves.

The rate z of a wave is what a step takes away of it. For long waves z = d k² (1 + λ² k²): d is the
diffusivity along the direction, of the faster and of the slower of the two waves, and λ² the
fourth-order length. Of gradient elasticity, u'' - l² u'''', λ² is l²; a lattice has λ² < 0 of its
own. Along the normal of a family of lattice rows, h apart, interactions with the next row alone
give z = d s, s = (2 sin(kh/2) / h)², and so λ² = -h²/12. That much is the lattice's, and

    l² = λ² + h²/12

is the material's: what rows beyond the next contribute. It is exactly c D for a rule
(1 - P) u + c (1 - P)² u whose P couples next rows, and negative, of the wrong sign for gradient
elasticity, where rows beyond the next attract.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.spectrum import Complex, largest_stable_relaxation
from pbdkit.identity.elastic_constants import Elasticity
from pbdkit.identity.waves import Primitive, SlowWaves, operator

Floats = NDArray[np.float64]
WAVES, ANGLES = 48, 180
"""Waves along each axis of the reciprocal cell, and directions in half a turn, to begin with."""
ROUNDS, FINER = 14, 7
"""How often the neighbourhood of a minimum is looked at again, and with how many points a side."""
ALIKE, ROUNDING = 1e-6, 1e-13


@dataclass(frozen=True)
class Range:
    """The smallest and the largest value over all directions, and where they are, in degrees."""

    smallest: float
    at_smallest: float
    largest: float
    at_largest: float


@dataclass(frozen=True)
class Gradient:
    """Lengths along the normal, at `direction` degrees, of lattice rows `rows_apart`: of the fast
    and the slow wave λ² in all, and l² = λ² + rows_apart²/12 of the material (spacing²)."""

    direction: float
    rows_apart: float
    total: tuple[float, float]
    material: tuple[float, float]


@dataclass(frozen=True)
class LongWaves:
    """What long waves see, in units of the spacing and of a step.

    `second` is Q_abcd, of which a step moves a body by Q_abcd ∂_c ∂_d u_b; `diffusivity` D_cd where
    x and y diffuse by themselves and alike; `elasticity` the body that the rule solves for, also
    that of a diffusion; `fast` and `slow` the diffusivities of the two waves by direction;
    `gradients` the lengths of the fourth order.
    """

    second: Floats
    diffusivity: Floats | None
    elasticity: Elasticity | None
    fast: Range
    slow: Range
    gradients: tuple[Gradient, ...]

    def as_dict(self) -> dict[str, Any]:
        """By the names of ``pbdkit identify --json``."""
        found = {"second_order": self.second, "diffusivity_tensor": self.diffusivity}
        waves = {"fast": vars(self.fast), "slow": vars(self.slow)}
        return found | waves | {"gradients": [vars(gradient) for gradient in self.gradients]}


@dataclass(frozen=True)
class Spectrum:
    """Over all waves: the smallest real part, the largest modulus of the imaginary part, the
    largest real part of the eigenvalues of the rule's step; the largest stable relaxation."""

    smallest: float
    imaginary: float
    largest: float
    largest_stable_relaxation: float | None


def ranges(q: Floats) -> tuple[Range, Range]:
    """Of the diffusivities of the fast and of the slow long wave; of the real parts where they
    turn."""

    def least(wave: int, sign: float) -> tuple[float, float]:
        def value(at: Floats) -> Floats:
            n = np.array([np.cos(np.radians(at[:, 0])), np.sin(np.radians(at[:, 0]))])
            rates = np.linalg.eigvals(np.einsum("abcd,c...,d...->...ab", q, n, n)).real
            return sign * np.sort(rates)[:, wave]

        at, found = minimum(value, np.array([0.0]), np.array([180.0]), ANGLES)
        return sign * found, round(float(at[0]), 3) % 180.0

    slow, fast = (Range(*least(wave, 1.0), *least(wave, -1.0)) for wave in (0, 1))
    return fast, slow


def gradients(waves: SlowWaves) -> tuple[Gradient, ...]:
    """Along the normals of the lattice's three densest families of rows, by direction."""
    a, b = waves.stencil.basis
    area = abs(float(np.linalg.det(waves.stencil.basis)))
    diagonal = min(a - b, a + b, key=lambda row: round(float(np.linalg.norm(row)), 6))
    found = []
    for row in (a, b, diagonal):
        length = float(np.linalg.norm(row))
        normal = np.array([-row[1], row[0]]) / length
        apart = area / length
        fast, slow = fourth_order(waves, normal)
        material = (fast + apart**2 / 12, slow + apart**2 / 12)
        degrees = round(float(np.degrees(np.arctan2(normal[1], normal[0]))), 9) % 180.0
        found.append(Gradient(degrees, apart, (fast, slow), material))
    return tuple(sorted(found, key=lambda gradient: gradient.direction))


def fourth_order(waves: SlowWaves, normal: Floats) -> tuple[float, float]:
    """λ² of the fast and of the slow wave along a unit vector: z = d k² (1 + λ² k²)."""
    _, _, second, third, fourth = waves.series(normal)
    d, vectors = np.linalg.eig(second)
    if abs(d[0] - d[1]) < ALIKE * np.abs(d).max():
        # Any direction is one of the wave: the fourth-order term tells them apart.
        apart = np.sort(np.linalg.eigvals(fourth / d.mean()).real)[::-1]
        return float(apart[0]), float(apart[1])
    back = np.linalg.inv(vectors)
    odd, even = back @ third @ vectors, back @ fourth @ vectors
    mixing = odd[0, 1] * odd[1, 0] / (d[0] - d[1])
    lengths = (even.diagonal() + np.array([mixing, -mixing])) / d
    fast = int(d[0].real < d[1].real)
    return float(lengths[fast].real), float(lengths[1 - fast].real)


def spectrum(stencil: Primitive, memory: float) -> Spectrum:
    """Of all waves on the infinite lattice, extremes refined beyond the grid of WAVES²."""
    reciprocal = 2 * np.pi * np.linalg.inv(stencil.basis).T
    low, high = np.zeros(2), np.ones(2)

    def eigenvalues(at: Floats) -> Complex:
        found: Complex = 1.0 - np.linalg.eigvals(operator(stencil, at @ reciprocal))
        return found

    at_smallest, smallest = minimum(lambda at: eigenvalues(at).real.min(axis=1), low, high, WAVES)
    at_largest, largest = minimum(lambda at: -eigenvalues(at).real.max(axis=1), low, high, WAVES)
    sampled = eigenvalues(_grid(low, high, WAVES)).ravel()
    ends = eigenvalues(np.array([at_smallest, at_largest])).ravel()
    known = np.concatenate([sampled, ends])
    imaginary, bound = float(np.abs(known.imag).max()), largest_stable_relaxation(known, memory)
    return Spectrum(smallest, imaginary, -largest, bound)


def minimum(
    value: Callable[[Floats], Floats], low: Floats, high: Floats, points: int
) -> tuple[Floats, float]:
    """(where, least): of a periodic function of (point, axis) between low and high.

    The best of a grid, then of ever finer grids around it; found to rounding where one point of
    the first grid lies in its valley.
    """
    grid, half = _grid(low, high, points), (high - low) / points
    where, best = low, np.inf
    for _ in range(ROUNDS):
        values = value(grid)
        # Where rounding alone tells points apart, the first one, or none.
        alike = values <= values.min() + ROUNDING * np.abs(values).max()
        one = int(alike.argmax())
        if best == np.inf or values[one] < best - ROUNDING * abs(best):
            where, best = grid[one], float(values[one])
        grid = _grid(where - half, where + half, FINER, ends=True)
        half = half * 2 / (FINER - 1)
    return where, best


def _grid(low: Floats, high: Floats, points: int, *, ends: bool = False) -> Floats:
    along = [np.linspace(a, b, points, endpoint=ends) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along))
