"""Response of a rule to plane waves u = exp(i k·r), its expansion for long waves, and the
dispersion of slow waves by direction and length.

With L(k) = -(own + Σ W exp(i k·r)) a step multiplies a wave by 1 - L(k). Where a cell has several
sites, L couples them; the slow waves, in which all sites move nearly alike, are

    L(k) X(k) = X(k) A(k),  A(k) = Σ_m A_m,  A_m of degree m in k,

order by order, with the relative shifts of the sites eliminated (X_0: all alike, Y·X = 1 with Y the
left null vectors of L(0)). The eigenvalues of the 2 × 2 matrix A(k) are the rates of the slow waves
to every order: a step removes A(k) u from u. With one site A is L.

A lattice may be described by a larger cell than necessary: two sites a cell for the rows of a
hexagonal lattice, one of which is the other shifted. Sites that a translation maps onto one
another, stencil included, count as one site; what remains are the sublattices of a lattice with a
basis.

The rate z of a wave is the part of it that a step removes. For long waves z = d k² (1 + λ² k²): d
is the diffusivity along the direction, of the faster and of the slower wave, and λ² the fourth-
order length. In gradient elasticity, u'' - l² u'''', λ² is l²; a lattice alone has λ² < 0. Along
the normal of a family of lattice rows, h apart, interactions with the next row alone give z = d s,
s = (2 sin(kh/2) / h)², hence λ² = -h²/12. That part belongs to the lattice, and

    l² = λ² + h²/12

to the material: the contribution of rows beyond the next. It is exactly c D for a rule (1 - P) u +
c (1 - P)² u whose P couples next rows, and negative, of the wrong sign for gradient elasticity,
where rows beyond the next attract.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.identification.elastic_constants import Elasticity
from pbdkit.linear.spectrum import Complex, largest_stable_relaxation
from pbdkit.linear.stencil import Stencil
from pbdkit.plugin import Cell

Floats = NDArray[np.float64]
NEAR = 1e-6
"""Places nearer than this, in units of the spacing, are one."""
ALIKE = 1e-8
"""Matrices that differ by less, as a share of the largest entry, are one."""


@dataclass(frozen=True)
class Primitive:
    """move_s = own_s u_s + Σ matrix_e u_target_e over the entries e with source_e = s.

    `spacing` is the smallest distance of two sites (lattice units), the unit of all other
    lengths; `basis` holds the shortest two independent translations as rows; `own` is
    (site, axis, axis), `source` and `target` (entry,), `rest` (entry, axis), `matrix`
    (entry, axis, axis).
    """

    spacing: float
    basis: Floats
    own: Floats
    source: NDArray[np.intp]
    target: NDArray[np.intp]
    rest: Floats
    matrix: Floats

    @property
    def sites(self) -> int:
        """How many sites a cell has."""
        return len(self.own)


def spacing_of(cell: Cell) -> float:
    """The smallest distance between two sites, in lattice units."""
    reach = min(float(np.hypot(v.x, v.y)) for v in cell.vectors) * (1 + NEAR)
    return min(o.length for s in range(len(cell.sites)) for o in cell.offsets(s, reach))


def primitive(cell: Cell, stencil: Stencil) -> Primitive:
    """The stencil with sites that are translated copies of one another taken together."""
    spacing = spacing_of(cell)
    at = np.array([site.at for site in cell.sites]) / spacing
    vectors = np.array(cell.vectors) / spacing
    source, target = np.array([(slot.source, slot.target) for slot in stencil.neighbours]).T
    rest = np.array([slot.rest for slot in stencil.neighbours]) / spacing
    matrix = np.array(list(stencil.neighbours.values()))
    whole = Primitive(spacing, vectors, stencil.own, source, target, rest, matrix)
    found = {s: _image(at, vectors, place - at[0]) for s, place in enumerate(at)}
    images = {s: i for s, i in found.items() if i is not None and _same_under(whole, i)}
    basis = _shortest(vectors, np.array([at[s] - at[0] for s in images]))
    names, number = np.unique(np.min(list(images.values()), axis=0), return_inverse=True)
    kept = np.isin(source, names)
    source, target, own = number[source[kept]], number[target[kept]], stencil.own[names]
    return Primitive(spacing, basis, own, source, target, rest[kept], matrix[kept])


def _image(at: Floats, vectors: Floats, shift: Floats) -> NDArray[np.intp] | None:
    """Which site each site lands on when all are shifted; None where one lands on no site."""
    apart = at[:, None, :] + shift - at[None, :, :]
    cells = apart @ np.linalg.inv(vectors)
    misses = np.linalg.norm((cells - np.rint(cells)) @ vectors, axis=-1)
    image: NDArray[np.intp] = misses.argmin(axis=1)
    return image if (misses.min(axis=1) < NEAR).all() else None


def _same_under(whole: Primitive, image: NDArray[np.intp]) -> bool:
    """Whether every site has the stencil of its image: it then answers some waves alike."""
    some = np.random.default_rng(0).uniform(-np.pi, np.pi, (8, 2))
    answer = operator(whole, some).reshape(8, whole.sites, 2, whole.sites, 2)
    apart = np.abs(answer[:, image][:, :, :, image] - answer).max()
    return bool(apart <= ALIKE * np.abs(whole.matrix).max())


def _shortest(vectors: Floats, shifts: Floats) -> Floats:
    """The shortest two independent translations among shifts + cells: a reduced basis."""
    a, b = sorted(vectors, key=lambda v: v @ v)
    # Lagrange and Gauss, so that few cells around have to be looked at.
    while turns := np.rint(a @ b / (a @ a)):
        a, b = sorted((a, b - turns * a), key=lambda v: v @ v)
    cells = np.array([m * a + n * b for m in range(-2, 3) for n in range(-2, 3)])
    within = shifts - np.rint(shifts @ np.linalg.inv(np.array([a, b]))) @ np.array([a, b])
    found = (cells[:, None] + within[None]).reshape(-1, 2)
    # Nearly equal lengths are told apart by direction, so that rounding does not choose.
    upper = found[(found[:, 1] > NEAR) | ((np.abs(found[:, 1]) <= NEAR) & (found[:, 0] > NEAR))]
    lengths = np.round(np.linalg.norm(upper, axis=1), 6)
    upper = upper[np.lexsort((np.arctan2(upper[:, 1], upper[:, 0]), lengths))]
    across = np.abs(upper[:, 0] * upper[0, 1] - upper[:, 1] * upper[0, 0])
    return np.array([upper[0], upper[across > NEAR][0]])


ZERO = 1e-8
"""What is smaller, as a share of the stencil's largest entry, is nothing."""


@dataclass(frozen=True)
class SlowWaves:
    """The slow waves of a stencil: see the module."""

    stencil: Primitive
    left: Complex
    solver: Complex

    def series(self, direction: Floats, order: int = 4) -> list[Complex]:
        """A_0 to A_order for k along `direction`, to be multiplied by |k|^m / |direction|^m;
        exact, from the moments of the stencil."""
        terms = [_moment(self.stencil, direction, m) for m in range(order + 1)]
        alike = _all_alike(self.stencil.sites).astype(complex)
        x, a = [alike], [np.zeros((2, 2), complex)]
        for m in range(1, order + 1):
            pushed = sum((terms[j] @ x[m - j] for j in range(1, m + 1)), 0 * alike)
            a.append(self.left @ pushed)
            taken = sum((x[m - j] @ a[j] for j in range(1, m + 1)), 0 * alike)
            right = np.concatenate([taken - pushed, np.zeros((2, 2))])
            x.append((self.solver @ right)[: len(alike)])
        return a


def slow_waves(stencil: Primitive) -> SlowWaves | str:
    """The slow waves, or why there are none: a translation of the whole is not left alone, or
    sites move by themselves."""
    rest = operator(stencil, np.zeros((1, 2)))[0].real
    alike = _all_alike(stencil.sites)
    scale = max(np.abs(stencil.matrix).max(), np.abs(stencil.own).max())
    defect = rest @ alike
    if np.abs(defect).max() > ZERO * scale:
        worst = np.unravel_index(np.abs(defect).argmax(), defect.shape)
        return (
            "a rigid translation is not left alone: when everything moves by 1 along "
            f"{'xy'[worst[1]]}, the rule moves a particle by {-defect[worst]:.6g} along "
            f"{'xy'[worst[0] % 2]} a step"
        )
    u, sizes, _ = np.linalg.svd(rest)
    left = u[:, -2:].T
    if len(rest) > 2 and sizes[-3] <= ZERO * scale:
        return "the sublattices can move against each other at no rate at all: not one body"
    shared = left @ alike
    if abs(np.linalg.det(shared)) < ZERO:
        return "the sublattices keep moving once they are shifted, ever faster"
    left = np.linalg.inv(shared) @ left
    bordered = np.block([[rest, alike], [left, np.zeros((2, 2))]])
    return SlowWaves(stencil, left.astype(complex), np.linalg.inv(bordered).astype(complex))


def operator(stencil: Primitive, k: Floats) -> Complex:
    """L(k) for waves k, (wave, axis): (wave, 2S, 2S); 1 - L(k) is what a step multiplies by."""
    return -_coupled(stencil, np.exp(1j * k @ stencil.rest.T), 1.0)


def _moment(stencil: Primitive, direction: Floats, m: int) -> Complex:
    """The part of L of degree m in k: -(i^m / m!) Σ W (k·r)^m, and -own for m = 0."""
    weight = -(1j**m) / math.factorial(m) * (stencil.rest @ direction) ** m
    found: Complex = _coupled(stencil, weight[None], -float(m == 0))[0]
    return found


def _coupled(stencil: Primitive, weight: Complex, share: float) -> Complex:
    """Σ weight W over the entries, (wave, entry), between the sites that they couple, and the share
    of each site's own."""
    sites = stencil.sites
    found = np.zeros((len(weight), sites, 2, sites, 2), complex)
    for e, (s, t) in enumerate(zip(stencil.source, stencil.target, strict=True)):
        found[:, s, :, t] += weight[:, e, None, None] * stencil.matrix[e]
    for s, own in enumerate(stencil.own):
        found[:, s, :, s] += share * own
    return found.reshape(len(weight), 2 * sites, 2 * sites)


def _all_alike(sites: int) -> Floats:
    return np.tile(np.eye(2), (sites, 1))


WAVES, ANGLES = 48, 180
"""Waves along each axis of the reciprocal cell, and directions in half a turn, to begin with."""
ROUNDS, FINER = 14, 7
"""How often the neighbourhood of a minimum is looked at again, and with how many points a side."""
SAME_CURVATURE, ROUNDING = 1e-6, 1e-13


@dataclass(frozen=True)
class DirectionalRange:
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
    fast: DirectionalRange
    slow: DirectionalRange
    gradients: tuple[Gradient, ...]

    def as_dict(self) -> dict[str, Any]:
        """By the names of ``pbdkit identify --json``."""
        found = {"second_order": self.second, "diffusivity_tensor": self.diffusivity}
        waves = {"fast": vars(self.fast), "slow": vars(self.slow)}
        return found | waves | {"gradients": [vars(gradient) for gradient in self.gradients]}


@dataclass(frozen=True)
class WaveSpectrum:
    """Over all waves: the smallest real part, the largest modulus of the imaginary part, the
    largest real part of the eigenvalues of the rule's step; the largest stable relaxation."""

    smallest: float
    imaginary: float
    largest: float
    largest_stable_relaxation: float | None


def ranges(q: Floats) -> tuple[DirectionalRange, DirectionalRange]:
    """Of the diffusivities of the fast and of the slow long wave; of the real parts where they
    turn."""

    def least(wave: int, sign: float) -> tuple[float, float]:
        def value(at: Floats) -> Floats:
            n = np.array([np.cos(np.radians(at[:, 0])), np.sin(np.radians(at[:, 0]))])
            rates = np.linalg.eigvals(np.einsum("abcd,c...,d...->...ab", q, n, n)).real
            return sign * np.sort(rates)[:, wave]

        at, found = minimum(value, np.array([0.0]), np.array([180.0]), ANGLES)
        return sign * found, round(float(at[0]), 3) % 180.0

    slow, fast = (DirectionalRange(*least(wave, 1.0), *least(wave, -1.0)) for wave in (0, 1))
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
    if abs(d[0] - d[1]) < SAME_CURVATURE * np.abs(d).max():
        # Any direction is one of the wave: the fourth-order term tells them apart.
        apart = np.sort(np.linalg.eigvals(fourth / d.mean()).real)[::-1]
        return float(apart[0]), float(apart[1])
    back = np.linalg.inv(vectors)
    odd, even = back @ third @ vectors, back @ fourth @ vectors
    mixing = odd[0, 1] * odd[1, 0] / (d[0] - d[1])
    lengths = (even.diagonal() + np.array([mixing, -mixing])) / d
    fast = int(d[0].real < d[1].real)
    return float(lengths[fast].real), float(lengths[1 - fast].real)


def spectrum(stencil: Primitive, memory: float) -> WaveSpectrum:
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
    return WaveSpectrum(smallest, imaginary, -largest, bound)


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
