"""Quadratic quadrilaterals on a quarter of a body, graded towards its clamped corner.

At the corner of a clamped and a free edge stresses are infinite (u ~ r^0.76 for ν = .3). Knots that
begin as the cubes of equal steps make elements there small enough that errors fall as they do for a
smooth solution; away from the corner they go over into equal steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from finite_elements.elasticity import plane_stress, values
from finite_elements.problems import Problem
from scipy.sparse.linalg import splu
from skfem import Basis, ElementQuad2, ElementVector, MeshQuad, MeshQuad2, condense

UNIFORM_FROM = 0.2


def graded(elements: int):
    """Knots in [0, 1]: f(k/elements) with f' ∝ ξ²/(ξ² + δ²), so f ~ ξ³ below δ and even above."""
    even = np.linspace(0, 1, elements + 1)
    knots = even - UNIFORM_FROM * np.arctan(even / UNIFORM_FROM)
    return knots / knots[-1]


@dataclass(frozen=True)
class Rectangle:
    """The quarter of a full body: x, y are the parameters themselves, scaled."""

    width: float
    height: float

    def knots(self, elements: int):
        along = graded(elements)
        return along * self.width, along * self.height

    def place(self, s, t):
        return np.array([s, t])

    def find(self, x, y):
        return x, y


@dataclass(frozen=True)
class Holed:
    """The quarter of a square of side 2 with a hole: s turns about (1, 1) from the left mid line
    through the corner (s = 0) to the lower one; t goes from the outer edge (0) to the hole (1)."""

    radius: float

    def knots(self, elements: int):
        along = graded(elements)
        return np.concatenate([-along[:0:-1], along]), along

    def place(self, s, t):
        direction = np.array([np.cos(np.pi / 4 * (1 + s)), np.sin(np.pi / 4 * (1 + s))])
        outer = 1 / direction.max(axis=0)
        return 1 - (outer + t * (self.radius - outer)) * direction

    def find(self, x, y):
        dx, dy = 1 - x, 1 - y
        r = np.hypot(dx, dy)
        outer = r / np.maximum(dx, dy)
        return np.arctan2(dy, dx) * 4 / np.pi - 1, (outer - r) / (outer - self.radius)


@dataclass(frozen=True)
class Solution:
    """The displacement of the quarter; `reaction`: the force, along the pull, with which the whole
    right edge is moved; `energy`: of the whole body."""

    knots: tuple[np.ndarray, np.ndarray]
    shape: Rectangle | Holed
    basis: Basis
    u: np.ndarray
    reaction: float
    energy: float

    def at(self, x, y):
        """Displacements (2, points) at points of the quarter."""
        points = np.array([x, y])
        return values(self.basis, self.u, points, self._cells(*self.shape.find(x, y)))

    def _cells(self, s, t):
        """The element of each point: that of its parameters' knots."""
        columns, rows = (len(k) - 1 for k in self.knots)
        mesh = self.basis.mesh
        middles = [np.mean(c[mesh.t], axis=0) for c in self.shape.find(*mesh.p)]
        numbered = np.empty((columns, rows), int)
        numbered[self._between(middles)] = np.arange(columns * rows)
        return numbered[self._between((s, t))]

    def _between(self, parameters):
        pairs = zip(self.knots, parameters, strict=True)
        return tuple(np.clip(np.searchsorted(k, p, "right") - 1, 0, len(k) - 2) for k, p in pairs)


def solve(problem: Problem, elements: int) -> Solution:
    """With `elements` along each side of the quarter (along half of its turn, with a hole)."""
    shape = _shape(problem)
    knots = shape.knots(elements)
    basis = Basis(_mesh(shape, knots), ElementVector(ElementQuad2()), intorder=5)
    K = plane_stress().assemble(basis)
    held, u = _held(problem, basis)
    reduced, load, _, free = condense(K, x=u, D=held)
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    u[free] = splu(reduced.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options).solve(load)
    forces = K @ u
    clamped = basis.get_dofs(lambda x: np.isclose(x[0], 0)).all(f"u^{problem.pulled + 1}")
    return Solution(
        knots, shape, basis, u, float(-2 * forces[clamped].sum()), float(2 * (u @ forces))
    )


def _shape(problem: Problem) -> Rectangle | Holed:
    if problem.radius:
        return Holed(problem.radius)
    return Rectangle(problem.length / 2, problem.height / 2)


def _mesh(shape: Rectangle | Holed, knots) -> MeshQuad2:
    flat = MeshQuad2.from_mesh(MeshQuad.init_tensor(*knots))
    return MeshQuad2(shape.place(*flat.doflocs), flat.t)


def _held(problem: Problem, basis: Basis):
    """Return the held dofs of the quarter, and a field with their values: those of the clamped edge
    and, on the two mid lines, those of the mirror symmetry."""
    u = basis.zeros()
    along, across = (f"u^{axis + 1}" for axis in (problem.pulled, problem.across))
    clamped = basis.get_dofs(lambda x: np.isclose(x[0], 0)).all()
    middle = basis.get_dofs(lambda x: np.isclose(x[0], problem.length / 2)).all(along)
    lying = basis.get_dofs(lambda x: np.isclose(x[1], problem.height / 2)).all(across)
    u[middle] = 0.5
    return np.unique(np.concatenate([clamped, middle, lying])), u
