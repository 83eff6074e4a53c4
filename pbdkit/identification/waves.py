"""Response of a rule to plane waves u = exp(i k·r).

It is expanded for long waves, and the dispersion of slow waves is computed by direction and
wavelength.

With L(k) = -(W_0 + Σ W exp(i k·r)), where W_0 is the derivative with respect to the displacement of
the particle itself, a step multiplies a wave by 1 - L(k). If a cell has several sites, L couples
them. The slow waves, in which all sites move nearly alike, satisfy

    L(k) X(k) = X(k) A(k),  A(k) = Σ_m A_m,  A_m of degree m in k,

order by order, with the relative shifts of the sites eliminated. In X_0, all sites have the same
displacement, and Y·X = 1 with the left null vectors Y of L(0). The eigenvalues of the 2 × 2 matrix
A(k) are the rates of the slow waves to every order: a step subtracts A(k) u from u. With one site A
= L.

A lattice may be described by a larger cell than necessary, for instance the hexagonal lattice by a
rectangular cell with two sites. If a translation maps sites onto one another, and their stencils
are equal, they are treated as one site. The remaining ones are the sublattices of a lattice with a
basis.

The rate z of a wave is the fraction of its amplitude that a step removes. For long waves z = d k²
(1 + λ² k²), with the diffusivity d and the square λ² of the fourth-order length. Both depend on the
direction, and differ between the faster and the slower wave. In gradient elasticity, u'' - l²
u'''', λ² is l²; on a lattice without such a gradient term λ² is negative. Consider waves along the
normal of a family of lattice rows with the distance h. If only adjacent rows interact, z = d s with
s = (2 sin(kh/2) / h)², so that λ² = -h²/12. This part is due to the discreteness of the lattice.
The rest,

    l² = λ² + h²/12

is the contribution of interactions with rows beyond the adjacent ones, and a property of the
material. It is exactly c D for a rule (1 - P) u + c (1 - P)² u if P couples adjacent rows only. If
rows beyond the adjacent ones attract, l² is negative, which is the wrong sign for gradient
elasticity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.identification.elastic_constants import Elasticity
from pbdkit.linear.spectrum import Complex, largest_stable_relaxation
from pbdkit.linear.stencil import Stencil
from pbdkit.plugin import Cell

NEAR = 1e-6
"""Distance below which two places coincide, in units of the spacing."""
ALIKE = 1e-8
"""Tolerance for the equality of matrices, relative to the largest entry."""


@dataclass(frozen=True)
class Primitive:
    """Stencil on the smallest repeat cell.

    The move of site s is centre_s u_s + Σ matrix_e u_target_e, summed over the entries e with
    source_e = s.

    Parameters
    ----------
    spacing
        Smallest distance of two sites in lattice units; the unit of all other lengths.
    basis : (2, axis)
        The two shortest independent translations.
    centre : (site, axis, axis)
        Derivative of a particle's move with respect to its own displacement.
    source, target : (entry,)
        Sites of the particle and of its neighbour.
    rest : (entry, axis)
        Offset of the neighbour at rest.
    matrix : (entry, axis, axis)
        Derivative with respect to the neighbour's displacement.
    """

    spacing: float
    basis: Floats
    centre: Floats
    source: NDArray[np.intp]
    target: NDArray[np.intp]
    rest: Floats
    matrix: Floats

    @property
    def sites(self) -> int:
        """Return the number of sites in a cell."""
        return len(self.centre)


def spacing_of(cell: Cell) -> float:
    """Return the smallest distance between two sites, in lattice units."""
    reach = min(float(np.hypot(v.x, v.y)) for v in cell.vectors) * (1 + NEAR)
    return min(o.length for s in range(len(cell.sites)) for o in cell.offsets(s, reach))


def primitive(cell: Cell, stencil: Stencil) -> Primitive:
    """Return the stencil in which sites that are translated copies of one another are merged."""
    spacing = spacing_of(cell)
    positions = np.array([site.at for site in cell.sites]) / spacing
    vectors = np.array(cell.vectors) / spacing
    source, target = np.array([(slot.source, slot.target) for slot in stencil.neighbours]).T
    rest = np.array([slot.rest for slot in stencil.neighbours]) / spacing
    matrix = np.array(list(stencil.neighbours.values()))
    stencil_of_cell = Primitive(spacing, vectors, stencil.centre, source, target, rest, matrix)
    candidates = {
        s: _image(positions, vectors, place - positions[0]) for s, place in enumerate(positions)
    }
    images = {
        s: i for s, i in candidates.items() if i is not None and _is_invariant(stencil_of_cell, i)
    }
    basis = _shortest(vectors, np.array([positions[s] - positions[0] for s in images]))
    sites, number = np.unique(np.min(list(images.values()), axis=0), return_inverse=True)
    is_selected = np.isin(source, sites)
    source, target, centre = (
        number[source[is_selected]],
        number[target[is_selected]],
        stencil.centre[sites],
    )
    return Primitive(spacing, basis, centre, source, target, rest[is_selected], matrix[is_selected])


def _image(positions: Floats, vectors: Floats, shift: Floats) -> NDArray[np.intp] | None:
    """Return the site to which a shift maps each site.

    The result is None if a site is mapped to a position without a site.
    """
    differences = positions[:, None, :] + shift - positions[None, :, :]
    cells = differences @ np.linalg.inv(vectors)
    misses = np.linalg.norm((cells - np.rint(cells)) @ vectors, axis=-1)
    image: NDArray[np.intp] = misses.argmin(axis=1)
    return image if (misses.min(axis=1) < NEAR).all() else None


def _is_invariant(stencil: Primitive, image: NDArray[np.intp]) -> bool:
    """Return whether every site has the same stencil as its image.

    This is tested by the response to some waves.
    """
    wave_vectors = np.random.default_rng(0).uniform(-np.pi, np.pi, (8, 2))
    response = operator(stencil, wave_vectors).reshape(8, stencil.sites, 2, stencil.sites, 2)
    error = np.abs(response[:, image][:, :, :, image] - response).max()
    return bool(error <= ALIKE * np.abs(stencil.matrix).max())


def _shortest(vectors: Floats, shifts: Floats) -> Floats:
    """Return a reduced basis: the two shortest independent translations.

    The translations are sums of shifts and cell vectors.
    """
    a, b = sorted(vectors, key=lambda v: v @ v)
    # The reduction of Lagrange and Gauss limits the search to few cells.
    while multiple := np.rint(a @ b / (a @ a)):
        a, b = sorted((a, b - multiple * a), key=lambda v: v @ v)
    cells = np.array([m * a + n * b for m in range(-2, 3) for n in range(-2, 3)])
    reduced = shifts - np.rint(shifts @ np.linalg.inv(np.array([a, b]))) @ np.array([a, b])
    candidates = (cells[:, None] + reduced[None]).reshape(-1, 2)
    # Nearly equal lengths are ordered by direction, so that rounding does not affect the order.
    upper = candidates[
        (candidates[:, 1] > NEAR) | ((np.abs(candidates[:, 1]) <= NEAR) & (candidates[:, 0] > NEAR))
    ]
    lengths = np.round(np.linalg.norm(upper, axis=1), 6)
    upper = upper[np.lexsort((np.arctan2(upper[:, 1], upper[:, 0]), lengths))]
    across = np.abs(upper[:, 0] * upper[0, 1] - upper[:, 1] * upper[0, 0])
    return np.array([upper[0], upper[across > NEAR][0]])


ZERO = 1e-8
"""Tolerance for zero, relative to the largest entry of the stencil."""


@dataclass(frozen=True)
class SlowWaves:
    """Slow waves of a stencil (see the module's description).

    Parameters
    ----------
    stencil
        The stencil.
    left : (2, 2S)
        Y, the left null vectors of L(0), scaled so that Y·X_0 = 1.
    solver : (2S + 2, 2S + 2)
        Inverse of L(0), bordered by X_0 and Y.
    """

    stencil: Primitive
    left: Complex
    solver: Complex

    def series(self, direction: Floats, order: int = 4) -> list[Complex]:
        """Compute A_0 to A_order for k along a direction.

        A_m is to be multiplied by |k|^m / |direction|^m. The terms are exact: they are computed
        from the moments of the stencil.
        """
        terms = [_moment(self.stencil, direction, m) for m in range(order + 1)]
        translations = _translations(self.stencil.sites).astype(complex)
        x, a = [translations], [np.zeros((2, 2), complex)]
        for m in range(1, order + 1):
            forcing = sum((terms[j] @ x[m - j] for j in range(1, m + 1)), 0 * translations)
            a.append(self.left @ forcing)
            removal = sum((x[m - j] @ a[j] for j in range(1, m + 1)), 0 * translations)
            right = np.concatenate([removal - forcing, np.zeros((2, 2))])
            x.append((self.solver @ right)[: len(translations)])
        return a


def slow_waves(stencil: Primitive) -> SlowWaves | str:
    """Return the slow waves, or the reason why there are none.

    There are none if a step does not preserve a translation of the body, or if sites can move
    separately.
    """
    rest = operator(stencil, np.zeros((1, 2)))[0].real
    translations = _translations(stencil.sites)
    scale = max(np.abs(stencil.matrix).max(), np.abs(stencil.centre).max())
    defect = rest @ translations
    if np.abs(defect).max() > ZERO * scale:
        worst = np.unravel_index(np.abs(defect).argmax(), defect.shape)
        return (
            "a rigid translation is not preserved: under a translation by 1 along "
            f"{'xy'[worst[1]]}, the rule moves a particle by {-defect[worst]:.6g} along "
            f"{'xy'[worst[0] % 2]} per step"
        )
    u, sizes, _ = np.linalg.svd(rest)
    left_vectors = u[:, -2:].T
    if len(rest) > 2 and sizes[-3] <= ZERO * scale:
        return "relative displacements of the sublattices do not decay: they are not coupled"
    overlap = left_vectors @ translations
    if abs(np.linalg.det(overlap)) < ZERO:
        return "relative displacements of the sublattices grow without bound"
    left_vectors = np.linalg.inv(overlap) @ left_vectors
    bordered = np.block([[rest, translations], [left_vectors, np.zeros((2, 2))]])
    return SlowWaves(stencil, left_vectors.astype(complex), np.linalg.inv(bordered).astype(complex))


def operator(stencil: Primitive, k: Floats) -> Complex:
    """Return L(k) for waves k of shape (wave, axis) as matrices (wave, 2S, 2S) for S sites.

    A step multiplies a wave by 1 - L(k).
    """
    return -_coupled(stencil, np.exp(1j * k @ stencil.rest.T), 1.0)


def _moment(stencil: Primitive, direction: Floats, m: int) -> Complex:
    """Return the part of L of degree m in k: -(i^m / m!) Σ W (k·r)^m, and -W_0 for m = 0."""
    weight = -(1j**m) / math.factorial(m) * (stencil.rest @ direction) ** m
    moment: Complex = _coupled(stencil, weight[None], -float(m == 0))[0]
    return moment


def _coupled(stencil: Primitive, weight: Complex, share: float) -> Complex:
    """Return Σ weight W over the entries, plus `share` times W_0. The weights have the shape (wave,
    entry), and the result is given by pairs of sites."""
    sites = stencil.sites
    result = np.zeros((len(weight), sites, 2, sites, 2), complex)
    for e, (s, t) in enumerate(zip(stencil.source, stencil.target, strict=True)):
        result[:, s, :, t] += weight[:, e, None, None] * stencil.matrix[e]
    for s, centre in enumerate(stencil.centre):
        result[:, s, :, s] += share * centre
    return result.reshape(len(weight), 2 * sites, 2 * sites)


def _translations(sites: int) -> Floats:
    return np.tile(np.eye(2), (sites, 1))


WAVES = 48
"""Number of waves along each axis of the reciprocal cell in the first grid."""

ANGLES = 180
"""Number of directions in half a turn in the first grid."""
ROUNDS = 14
"""Number of grids by which a minimum is refined."""

FINER = 7
"""Number of points along each axis of a refined grid."""
SAME_CURVATURE = 1e-6
"""Relative difference of diffusivities below which both waves are regarded as equally fast."""

ROUNDING = 1e-13
"""Relative difference of values that are equal up to rounding."""


@dataclass(frozen=True)
class DirectionalRange:
    """Smallest and largest value over all directions, and their directions in degrees."""

    smallest: float
    at_smallest: float
    largest: float
    at_largest: float


@dataclass(frozen=True)
class Gradient:
    """Fourth-order lengths of the fast and of the slow wave along the normal of a family of lattice
    rows.

    Parameters
    ----------
    direction
        Direction of the normal in degrees.
    rows_apart
        Distance between the rows.
    total
        λ² of both waves, in units of the squared spacing.
    material
        l² = λ² + rows_apart²/12, the part of the material.
    """

    direction: float
    rows_apart: float
    total: tuple[float, float]
    material: tuple[float, float]


@dataclass(frozen=True)
class LongWaves:
    """Response to long waves, in units of the spacing and of a step.

    Parameters
    ----------
    second : (2, 2, 2, 2)
        Q_abcd: a step moves a body by Q_abcd ∂_c ∂_d u_b.
    diffusivity : (2, 2)
        D_cd if x and y diffuse separately and equally, else None.
    elasticity
        The elastic body with the equilibrium that the rule approaches; it is also given for
        diffusion.
    fast, slow
        Diffusivities of the two waves by direction.
    gradients
        Fourth-order lengths.
    """

    second: Floats
    diffusivity: Floats | None
    elasticity: Elasticity | None
    fast: DirectionalRange
    slow: DirectionalRange
    gradients: tuple[Gradient, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the values under the names that ``pbdkit identify --json`` uses."""
        numbers = {"second_order": self.second, "diffusivity_tensor": self.diffusivity}
        waves = {"fast": vars(self.fast), "slow": vars(self.slow)}
        return numbers | waves | {"gradients": [vars(gradient) for gradient in self.gradients]}


@dataclass(frozen=True)
class WaveSpectrum:
    """Eigenvalues of the rule's step over all plane waves.

    Parameters
    ----------
    smallest, largest
        Smallest and largest real part.
    imaginary
        Largest modulus of the imaginary part.
    largest_stable_relaxation
        Upper bound of stable relaxations; None if there is no bound.
    """

    smallest: float
    imaginary: float
    largest: float
    largest_stable_relaxation: float | None


def ranges(q: Floats) -> tuple[DirectionalRange, DirectionalRange]:
    """Return the ranges of the diffusivities of the fast and of the slow long wave.

    If they are complex, their real parts are used.
    """

    def extreme(wave: int, sign: float) -> tuple[float, float]:
        def value(angle: Floats) -> Floats:
            n = np.array([np.cos(np.radians(angle[:, 0])), np.sin(np.radians(angle[:, 0]))])
            rates = np.linalg.eigvals(np.einsum("abcd,c...,d...->...ab", q, n, n)).real
            return sign * np.sort(rates)[:, wave]

        angle, size = minimum(value, np.array([0.0]), np.array([180.0]), ANGLES)
        return sign * size, round(float(angle[0]), 3) % 180.0

    slow, fast = (DirectionalRange(*extreme(wave, 1.0), *extreme(wave, -1.0)) for wave in (0, 1))
    return fast, slow


def gradients(waves: SlowWaves) -> tuple[Gradient, ...]:
    """Return the lengths along the normals of the lattice's three densest families of rows, by
    direction."""
    a, b = waves.stencil.basis
    area = abs(float(np.linalg.det(waves.stencil.basis)))
    diagonal = min(a - b, a + b, key=lambda row: round(float(np.linalg.norm(row)), 6))
    result = []
    for row in (a, b, diagonal):
        length = float(np.linalg.norm(row))
        normal = np.array([-row[1], row[0]]) / length
        distance = area / length
        fast, slow = fourth_order(waves, normal)
        material = (fast + distance**2 / 12, slow + distance**2 / 12)
        degrees = round(float(np.degrees(np.arctan2(normal[1], normal[0]))), 9) % 180.0
        result.append(Gradient(degrees, distance, (fast, slow), material))
    return tuple(sorted(result, key=lambda gradient: gradient.direction))


def fourth_order(waves: SlowWaves, normal: Floats) -> tuple[float, float]:
    """Return λ² of the fast and of the slow wave along a unit vector: z = d k² (1 + λ² k²)."""
    _, _, second, third, fourth = waves.series(normal)
    d, vectors = np.linalg.eig(second)
    if abs(d[0] - d[1]) < SAME_CURVATURE * np.abs(d).max():
        # Both waves are equally fast, and the fourth-order term alone distinguishes them.
        lengths_of_both = np.sort(np.linalg.eigvals(fourth / d.mean()).real)[::-1]
        return float(lengths_of_both[0]), float(lengths_of_both[1])
    inverse = np.linalg.inv(vectors)
    odd, even = inverse @ third @ vectors, inverse @ fourth @ vectors
    mixing = odd[0, 1] * odd[1, 0] / (d[0] - d[1])
    lengths = (even.diagonal() + np.array([mixing, -mixing])) / d
    fast = int(d[0].real < d[1].real)
    return float(lengths[fast].real), float(lengths[1 - fast].real)


def spectrum(stencil: Primitive, memory: float) -> WaveSpectrum:
    """Compute the spectrum of all plane waves; extremes are refined beyond the grid of WAVES²."""
    reciprocal = 2 * np.pi * np.linalg.inv(stencil.basis).T
    low, high = np.zeros(2), np.ones(2)

    def eigenvalues(at: Floats) -> Complex:
        values: Complex = 1.0 - np.linalg.eigvals(operator(stencil, at @ reciprocal))
        return values

    at_smallest, smallest = minimum(lambda at: eigenvalues(at).real.min(axis=1), low, high, WAVES)
    at_largest, largest = minimum(lambda at: -eigenvalues(at).real.max(axis=1), low, high, WAVES)
    sampled = eigenvalues(_grid(low, high, WAVES)).ravel()
    ends = eigenvalues(np.array([at_smallest, at_largest])).ravel()
    all_values = np.concatenate([sampled, ends])
    imaginary, bound = (
        float(np.abs(all_values.imag).max()),
        largest_stable_relaxation(all_values, memory),
    )
    return WaveSpectrum(smallest, imaginary, -largest, bound)


def minimum(
    value: Callable[[Floats], Floats], low: Floats, high: Floats, points: int
) -> tuple[Floats, float]:
    """Minimise a periodic function of (point, axis) between low and high.

    The best point of a grid is the centre of the next, finer grid. If a point of the first grid
    lies in the valley of the minimum, the result is exact except for rounding errors.

    Returns
    -------
    where : (axis,)
        Place of the minimum.
    least
        Value at the minimum.
    """
    grid, half = _grid(low, high, points), (high - low) / points
    where, best = low, np.inf
    for _ in range(ROUNDS):
        values = value(grid)
        # Of points with values that differ by rounding only, the first is used, and none if the
        # best point so far has the same value.
        candidates = values <= values.min() + ROUNDING * np.abs(values).max()
        index = int(candidates.argmax())
        if best == np.inf or values[index] < best - ROUNDING * abs(best):
            where, best = grid[index], float(values[index])
        grid = _grid(where - half, where + half, FINER, ends=True)
        half = half * 2 / (FINER - 1)
    return where, best


def _grid(low: Floats, high: Floats, points: int, *, ends: bool = False) -> Floats:
    along = [np.linspace(a, b, points, endpoint=ends) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along))
