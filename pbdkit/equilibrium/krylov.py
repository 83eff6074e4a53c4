"""Krylov iterations on stencils, preconditioned by multigrid, with estimates of their error.

The cycle runs in single precision, all else in double; no iteration is lost by that.
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

MOST = 400
"""Turns of an iteration."""
ALIKE = 1e-13
"""The share of what others add by which a field differs from them at least."""
SLOWEST = 0.9
"""The slowest fall of the jumps that is extrapolated."""


def best_of(krylov: LatticeKrylov, near: Sequence[Floats], b: Floats) -> Floats | float:
    """The x among combinations of some fields that leaves nothing of K x = b along any of them, and
    least energy where K is symmetric (Galerkin); b is overwritten with what it leaves. 0 of none.
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


class Found(ABC):
    """An iteration's x with K x ≈ b; `jumps` are the largest ways made in each turn."""

    x: Floats
    jumps: list[float]

    @property
    def ahead(self) -> float:
        """About how far x still is from the solution, extrapolated from the last jumps."""
        if len(self.jumps) < 3:
            return math.inf
        a, b, c = self.jumps[-3:]
        fall = max(b / a, c / b) if a and b else 0.0
        return c * fall / (1.0 - fall) if fall <= SLOWEST else math.inf


@dataclass
class Descent(Found):
    """By conjugate gradients: `steps` and `turns` are their numbers α and β, `left` is rᵀ B r of
    what is left, B the cycle."""

    x: Floats
    left: float = math.inf
    jumps: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    indefinite: bool = False
    """Whether a way was met that does not lead uphill."""

    def smallest(self) -> float:
        """The smallest eigenvalue of B K that the iteration has seen (Lanczos)."""
        a, b = np.array(self.steps), np.array(self.turns)
        diagonal = 1.0 / a
        diagonal[1:] += b[1:] / a[:-1]
        beside = np.sqrt(b[1:]) / a[:-1]
        T = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
        return float(np.linalg.eigvalsh(T)[0])


class LatticeKrylov(ABC):
    """Solves K x = b by the grids of K, or that of a coarser one."""

    name: str

    def __init__(self, grids: Grids, depth: int = 0, rows: Rows = ALL) -> None:
        self._grids, self._depth, self._rows = grids, depth, rows
        self._grid = grids.grid(depth)
        self.matrix = self._grid.given(np.float64)
        self._sums = np.empty(len(self._grid.code))

    def dot(self, a: Floats, b: Floats) -> float:
        """a · b."""
        kernels().dot(a, b, self._sums)
        return self._rows.total(self._sums)

    def product(self, x: Floats, out: Floats | None = None) -> Floats:
        """K x."""
        found = self._grid.field(np.float64) if out is None else out
        kernels().product(self.matrix, x, found, self._sums)
        return found

    def energy(self, x: Floats, out: Floats) -> float:
        """x · K x; out = K x."""
        self.product(x, out)
        return self._rows.total(self._sums)

    @abstractmethod
    def solve(self, b: Floats, done: Callable[[Any], bool], most: int = MOST) -> Found:
        """Iterates until `done`, or as far as it gets. b is overwritten with what is left of it."""


class ConjugateGradients(LatticeKrylov):
    """For a symmetric positive K."""

    name = "conjugate-gradients"

    def solve(self, b: Floats, done: Callable[[Descent], bool], most: int = MOST) -> Descent:
        """A cycle a turn."""
        kernel, grid = kernels(), self._grid
        found, r = Descent(grid.field(np.float64)), b
        p, q, rounded = grid.field(np.float64), grid.field(np.float64), grid.field(np.float32)
        size, sums = math.sqrt(self.dot(r, r)), np.empty((2, r.shape[1]))
        if not 0.0 < size < math.inf:
            found.left = 0.0 if size == 0.0 else math.inf
            return found
        np.multiply(r, 1.0 / size, out=rounded, casting="same_kind")
        while True:
            z = self._grids.cycle(rounded, self._depth)
            before, found.left = found.left, size * self.dot(r, z)
            if len(found.steps) >= most or (found.steps and done(found)):
                return found
            turned = found.left / before if found.steps else 0.0
            kernel.turn(size, z, turned, p)
            bent = self.energy(p, q)
            if not 0.0 < bent < math.inf:
                found.indefinite = bent <= 0.0
                return found
            step = found.left / bent
            kernel.descend(step, p, q, found.x, r, 1.0 / size, rounded, sums)
            squares, jumps = self._rows.whole(sums)
            found.steps.append(step)
            found.turns.append(turned)
            found.jumps.append(float(jumps.max()))
            if not squares.any():
                found.left = 0.0
                return found


@dataclass
class Stabilised(Found):
    """By the stabilised iteration of biconjugate gradients. Its jumps waver."""

    x: Floats
    jumps: list[float] = field(default_factory=list)

    @property
    def ahead(self) -> float:
        """The larger of the last two jumps."""
        return max(self.jumps[-2:]) if len(self.jumps) > 1 else math.inf


class BiconjugateGradients(LatticeKrylov):
    """For a K that is not symmetric (van der Vorst's BiCGStab)."""

    name = "bicgstab"

    def solve(self, b: Floats, done: Callable[[Found], bool], most: int = MOST) -> Stabilised:
        """Two cycles a turn."""
        r, found = b, Stabilised(self._grid.field(np.float64))
        shadow, p, q, t = r.copy(), r.copy(), np.zeros_like(r), np.zeros_like(r)
        rho = self.dot(shadow, r)
        while rho and math.isfinite(rho) and len(found.jumps) < most:
            p_smooth = self._smoothed(p)
            self.product(p_smooth, q)
            step = rho / self.dot(shadow, q)
            r -= step * q
            r_smooth = self._smoothed(r)
            self.product(r_smooth, t)
            square = self.dot(t, t)
            weight = self.dot(t, r) / square if square else 0.0
            way = step * p_smooth + weight * r_smooth
            found.x += way
            r -= weight * t
            found.jumps.append(self._rows.max_norm(way))
            if done(found) or not weight:
                break
            before, rho = rho, self.dot(shadow, r)
            p -= weight * q
            p *= rho / before * step / weight
            p += r
        return found

    def _smoothed(self, r: Floats) -> Floats:
        """B r; r is scaled, for it may be tiny in single precision."""
        size = math.sqrt(self.dot(r, r)) or 1.0
        rounded = np.multiply(r, 1.0 / size).astype(np.float32)
        return size * self._grids.cycle(rounded, self._depth).astype(np.float64)
