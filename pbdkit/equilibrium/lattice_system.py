"""The linear system of an equilibrium solved on the stencils of its lattice.

The error e of a state solves K e = r. Some iterations find most of it; for the rest conjugate
gradients know its energy, rᵀ B r / λ at most, with the cycle B and the smallest eigenvalue λ of
B K, of which they have seen enough to estimate it. A place moves by √(g · energy) at most, g what
it gives way to a unit load there. That is an estimate, not a proof: λ is halved, g is
extrapolated from coarse grids.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.conjugate_gradients import ConjugateGradients, Descent
from pbdkit.equilibrium.multigrid import FloatingError, Multigrid, kernels
from pbdkit.equilibrium.stencil_matrix import FREE, LED, OUTSIDE, StencilMatrix, stencil_matrix
from pbdkit.equilibrium.system import System
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]
LOOKS_AHEAD = 2
"""Iterations that a bound takes."""
SAFETY = 2.0
"""By what λ is divided."""
SAME = 1e-12
"""Relative difference up to which a matrix counts as symmetric."""
ENOUGH = 8
"""Iterations that tell how far a place gives way."""


class LatticeSystem(System):
    """The system by multigrid; for a matrix that is symmetric and holds all of the body.

    Raises FloatingError where it does not.
    """

    methods = "multigrid, conjugate-gradients"
    how = "energy"

    def __init__(self, matrix: StencilMatrix, shape: tuple[int, ...], watch: Watch) -> None:
        self._matrix, self._shape, self._watch = matrix, shape, watch
        self._grids = Multigrid(matrix)
        self._solver = ConjugateGradients(self._grids)
        self._smallest = 1.0
        self.iterations = 0

    def solve(self, moves: Floats, tolerance: float, owed: State | None = None) -> Floats:
        """Until the jumps of the iteration say that no more than the tolerance is left. Nothing is
        owed: all is held."""
        self._watch.begin("solving")
        found = self._descended(self._pull(moves), lambda d: d.ahead <= tolerance)
        return self._planes(found.x)

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Of forces."""
        kernel, pull = kernels(), self._grids.grid().field(np.float64)
        kernel.product(self._solver.matrix, self._here(c), pull)
        left = self._pull(after) - self._pull(before) + pull
        return math.sqrt(kernel.dot(left, left) / kernel.dot(pull, pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """The error that some iterations find, and the bound on what they leave; rounding counts as
        random."""
        found = self._descended(self._pull(moves), lambda d: len(d.steps) >= LOOKS_AHEAD)
        way = math.sqrt(float((found.x * found.x).sum(axis=0).max()))
        return way + self._farthest(found.left) + rounding * self._spread

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """All is held."""

    def _descended(self, r: Floats, done: Callable[[Descent], bool]) -> Descent:
        found = self._solver.solve(r, done)
        self.iterations += len(found.steps)
        if len(found.steps) > 1:
            self._smallest = min(self._smallest, found.smallest())
        return found

    def _farthest(self, left: float) -> float:
        """How far any place moves by what has this rᵀ B r."""
        return math.sqrt(SAFETY / self._smallest * self._compliance * left)

    @cached_property
    def _spread(self) -> float:
        """How far rounding of moves by up to 1 takes a place."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], self._shape)
        r = self._pull(signs)
        return self._farthest(kernels().dot(r, self._grids.cycle(r.astype(np.float32))))

    @cached_property
    def _compliance(self) -> float:
        """How far a place gives way to a unit load at most: as on the coarsest grid, and on each
        finer one by so much more as on the first of them."""
        axis, place, found = self._grids.softest
        last = len(self._grids) - 1
        if last == 0:
            return found
        solver, b = (
            ConjugateGradients(self._grids, last - 1),
            self._grids.grid(last - 1).field(np.float64),
        )
        i, j = self._grids.finer_place(last, place)
        if i >= b.shape[1] or j >= b.shape[2] or self._grids.grid(last - 1).code[i, j] < 0:
            return found * (last + 1)
        b[axis, i, j] = 1.0
        x = solver.solve(b, lambda d: len(d.steps) >= ENOUGH).x
        return found + max(0.0, float(x[axis, i, j]) - found) * last

    def _pull(self, moves: Floats) -> Floats:
        """What K c equals, on the grid."""
        out, scale = self._grids.grid().field(np.float64), self._matrix.scale
        same = tuple(scale[0].tolist())
        kernels().scaled(self._solver.matrix, same, scale, self._here(moves), out)
        return out

    def _here(self, planes: Floats) -> Floats:
        """On the grid."""
        if self._matrix.at is None:
            return planes.reshape(2, *self._matrix.code.shape)
        out = self._grids.grid().field(np.float64)
        out.reshape(2, -1)[:, self._matrix.at] = planes.reshape(2, -1)[:, self._matrix.place]
        return out

    def _planes(self, field: Floats) -> Floats:
        """On the scene's raster."""
        if self._matrix.at is None:
            return field.reshape(self._shape)
        planes = np.zeros(self._shape)
        planes.reshape(2, -1)[:, self._matrix.place] = field.reshape(2, -1)[:, self._matrix.at]
        return planes


def lattice_system(scene: Scene, state: State, step: int, watch: Watch) -> LatticeSystem | None:
    """The system of a scene; None where it has no such form, or leaders do not hold the body."""
    matrix = stencil_matrix(scene, state, step)
    if matrix is None or not len(matrix.stencils):
        return None
    largest = float(np.abs(matrix.stencils).max())
    if kernels().asymmetry(matrix.code, matrix.stencils) > SAME * largest or not is_held(matrix):
        return None
    try:
        return LatticeSystem(matrix, state.u.shape, watch)
    except FloatingError:
        return None


def is_held(matrix: StencilMatrix) -> bool:
    """Whether every connected part of the body touches a leader, and no neighbours are apart."""
    from scipy.ndimage import binary_dilation, label

    bonds = np.abs(matrix.stencils).max(axis=-1) > 0.0
    lone = np.nonzero(matrix.code > 0)
    of_lone = bonds[matrix.code[lone]]
    for s in np.flatnonzero(bonds[0]):
        there = matrix.kind[lone[0] + s // 3 - 1, lone[1] + s % 3 - 1] != OUTSIDE
        if (there & ~of_lone[:, s]).any():
            return False
    pattern = bonds[0].reshape(3, 3)
    parts, count = label(matrix.kind == FREE, structure=pattern)
    touched = np.unique(parts[binary_dilation(matrix.kind == LED, structure=pattern)])
    return bool(np.count_nonzero(touched) == count)
