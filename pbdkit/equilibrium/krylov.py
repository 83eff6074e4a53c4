"""Krylov iterations on stencils, preconditioned by multigrid, with estimates of their error.

The multigrid cycle is computed in single precision, and everything else in double precision. Single
precision in the cycle does not increase the number of iterations.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.multigrid import Grids
from pbdkit.equilibrium.stencil_matrix import kernels
from pbdkit.equilibrium.system import ALL, Rows

MAX_ITERATIONS = 400
"""Maximum number of iterations."""
ALIKE = 1e-13
"""Relative singular value (`rcond` of `lstsq`) below which combinations of fields are discarded,
because the fields are nearly linearly dependent."""
SLOWEST = 0.9
"""The distance is extrapolated from successive jumps only if their ratio is at most this number."""


def best_of(krylov: LatticeKrylov, near: Sequence[Floats], b: Floats) -> Floats | float:
    """Return the Galerkin solution of K x = b in the span of the fields `near`, or 0 if there are
    no fields.

    The residual is orthogonal to the fields; where K is symmetric the energy is minimal. b is
    overwritten with the residual.
    """
    if not near:
        return 0.0
    pulls = [krylov.product(v) for v in near]
    products = np.array([[krylov.dot(v, pull) for pull in pulls] for v in near])
    along = np.array([krylov.dot(v, b) for v in near])
    size = np.sqrt(np.abs(products.diagonal()))
    size[size == 0.0] = 1.0
    scaled = products / np.outer(size, size)
    weights = np.linalg.lstsq(scaled, along / size, rcond=ALIKE)[0] / size
    x = np.zeros_like(b)
    for weight, v, pull in zip(weights, near, pulls, strict=True):
        x += weight * v
        b -= weight * pull
    return x


class KrylovResult(ABC):
    """Result of an iteration: x with K x ≈ b, and the largest displacement of each iteration,
    `jumps`."""

    x: Floats
    jumps: list[float]

    @property
    def ahead(self) -> float:
        """Estimated distance of x from the solution, extrapolated from the last jumps."""
        if len(self.jumps) < 3:
            return math.inf
        a, b, c = self.jumps[-3:]
        fall = max(b / a, c / b) if a and b else 0.0
        return c * fall / (1.0 - fall) if fall <= SLOWEST else math.inf


@dataclass
class Descent(KrylovResult):
    """Result of conjugate gradients: `steps` and `turns` are the numbers α and β, and
    `residual_energy` is rᵀ B r with the residual r and the cycle B."""

    x: Floats
    residual_energy: float = math.inf
    jumps: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    indefinite: bool = False
    """True if a direction of negative curvature has occurred."""

    def smallest(self) -> float:
        """Return an estimate of the smallest eigenvalue of B K from the Krylov space (Lanczos)."""
        a, b = np.array(self.steps), np.array(self.turns)
        diagonal = 1.0 / a
        diagonal[1:] += b[1:] / a[:-1]
        off_diagonal = np.sqrt(b[1:]) / a[:-1]
        T = np.diag(diagonal) + np.diag(off_diagonal, 1) + np.diag(off_diagonal, -1)
        return float(np.linalg.eigvalsh(T)[0])


class LatticeKrylov(ABC):
    """Solver of K x = b on the finest grid of K, or on a coarser one at a given depth."""

    name: str

    def __init__(self, grids: Grids, depth: int = 0, rows: Rows = ALL) -> None:
        self._grids, self._depth, self._rows = grids, depth, rows
        self._grid = grids.grid(depth)
        self.matrix = self._grid.given(np.float64)
        self._sums = np.empty(len(self._grid.code))

    def dot(self, a: Floats, b: Floats) -> float:
        """Return the scalar product a · b."""
        kernels().dot(a, b, self._sums)
        return self._rows.total(self._sums)

    def product(self, x: Floats, out: Floats | None = None) -> Floats:
        """Return the product K x."""
        product = self._grid.field(np.float64) if out is None else out
        kernels().product(self.matrix, x, product, self._sums)
        return product

    def energy(self, x: Floats, out: Floats) -> float:
        """Return x · K x, and write K x into `out`."""
        self.product(x, out)
        return self._rows.total(self._sums)

    @abstractmethod
    def solve(
        self, b: Floats, is_done: Callable[[Any], bool], max_iterations: int = MAX_ITERATIONS
    ) -> KrylovResult:
        """Iterate until `is_done` is true or no progress is made; b is overwritten with the
        residual."""


class ConjugateGradients(LatticeKrylov):
    """Conjugate gradients, for a symmetric positive definite K."""

    name = "conjugate-gradients"

    def solve(
        self, b: Floats, is_done: Callable[[Descent], bool], max_iterations: int = MAX_ITERATIONS
    ) -> Descent:
        """Solve with one cycle in each iteration."""
        kernel, grid = kernels(), self._grid
        descent, r = Descent(grid.field(np.float64)), b
        p, q, rounded = grid.field(np.float64), grid.field(np.float64), grid.field(np.float32)
        size, sums = math.sqrt(self.dot(r, r)), np.empty((2, r.shape[1]))
        if not 0.0 < size < math.inf:
            descent.residual_energy = 0.0 if size == 0.0 else math.inf
            return descent
        np.multiply(r, 1.0 / size, out=rounded, casting="same_kind")
        while True:
            z = self._grids.cycle(rounded, self._depth)
            previous, descent.residual_energy = descent.residual_energy, size * self.dot(r, z)
            if len(descent.steps) >= max_iterations or (descent.steps and is_done(descent)):
                return descent
            turned = descent.residual_energy / previous if descent.steps else 0.0
            kernel.turn(size, z, turned, p)
            bent = self.energy(p, q)
            if not 0.0 < bent < math.inf:
                descent.indefinite = bent <= 0.0
                return descent
            step = descent.residual_energy / bent
            kernel.descend(step, p, q, descent.x, r, 1.0 / size, rounded, sums)
            squares, jumps = self._rows.whole(sums)
            descent.steps.append(step)
            descent.turns.append(turned)
            descent.jumps.append(float(jumps.max()))
            if not squares.any():
                descent.residual_energy = 0.0
                return descent


@dataclass
class Stabilised(KrylovResult):
    """Result of the stabilised biconjugate gradient iteration; its jumps are not monotonic."""

    x: Floats
    jumps: list[float] = field(default_factory=list)

    @property
    def ahead(self) -> float:
        """Largest displacement in the last two iterations. It is used as the estimate, because an
        extrapolation requires monotonic jumps."""
        return max(self.jumps[-2:]) if len(self.jumps) > 1 else math.inf


class BiconjugateGradients(LatticeKrylov):
    """Stabilised biconjugate gradients (van der Vorst), for a K that is not symmetric."""

    name = "bicgstab"

    def solve(
        self,
        b: Floats,
        is_done: Callable[[KrylovResult], bool],
        max_iterations: int = MAX_ITERATIONS,
    ) -> Stabilised:
        """Solve with two cycles in each iteration."""
        r, iteration = b, Stabilised(self._grid.field(np.float64))
        shadow, p, q, t = r.copy(), r.copy(), np.zeros_like(r), np.zeros_like(r)
        rho = self.dot(shadow, r)
        while rho and math.isfinite(rho) and len(iteration.jumps) < max_iterations:
            p_smooth = self._smoothed(p)
            self.product(p_smooth, q)
            step = rho / self.dot(shadow, q)
            r -= step * q
            r_smooth = self._smoothed(r)
            self.product(r_smooth, t)
            square = self.dot(t, t)
            weight = self.dot(t, r) / square if square else 0.0
            correction = step * p_smooth + weight * r_smooth
            iteration.x += correction
            r -= weight * t
            iteration.jumps.append(self._rows.max_norm(correction))
            if is_done(iteration) or not weight:
                break
            previous, rho = rho, self.dot(shadow, r)
            p -= weight * q
            p *= rho / previous * step / weight
            p += r
        return iteration

    def _smoothed(self, r: Floats) -> Floats:
        """Return B r; r is scaled, since it may be tiny in single precision."""
        size = math.sqrt(self.dot(r, r)) or 1.0
        rounded = np.multiply(r, 1.0 / size).astype(np.float32)
        return size * self._grids.cycle(rounded, self._depth).astype(np.float64)
