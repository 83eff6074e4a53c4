"""A cantilever under its own weight: a beam 4 by 1, clamped on the left, on which every unit of
area weighs 1/1000 (E = 1, ν = .3, plane stress); and what holds it up.

`python tests/finite_elements/weight.py` prints the errors of the lattice rule and of bilinear
elements on the same squares, against graded quadratic ones.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import splu
from skfem import (
    Basis,
    ElementQuad1,
    ElementQuad2,
    ElementVector,
    LinearForm,
    MeshQuad,
    MeshQuad2,
    condense,
)

sys.path.insert(0, str(Path(__file__).parents[1]))
from finite_elements.elasticity import plane_stress
from finite_elements.graded import Rectangle, Solution, graded

import pbdkit

LENGTH, HEIGHT, WEIGHT = 4.0, 1.0, 1e-3
ELEMENTS = 24
SIZES = (10, 20, 40)
"""Cells per unit length."""


@LinearForm
def _weight(v, _):
    return -WEIGHT * v[1]


def _solved(mesh, element, intorder):
    basis = Basis(mesh, ElementVector(element), intorder=intorder)
    K, f = plane_stress().assemble(basis), _weight.assemble(basis)
    held = basis.get_dofs(lambda x: np.isclose(x[0], 0)).all()
    u = basis.zeros()
    reduced, load, _, free = condense(K, f, x=u, D=held)
    u[free] = splu(reduced.tocsc()).solve(load)
    return basis, u


@cache
def reference(elements: int = ELEMENTS) -> Solution:
    """Return the mesh with a number of elements along the beam, and along half its height, graded
    towards both corners."""
    half = graded(elements) * HEIGHT / 2
    knots = graded(elements) * LENGTH, np.concatenate([half, HEIGHT - half[-2::-1]])
    mesh = MeshQuad2.from_mesh(MeshQuad.init_tensor(*knots))
    basis, u = _solved(mesh, ElementQuad2(), 5)
    return Solution(knots, Rectangle(LENGTH, HEIGHT), basis, u, math.nan, math.nan)


def bilinear(cells: int):
    """Places (2, node) and displacements (2, node) of bilinear elements."""
    knots = (np.linspace(0, size, round(size * cells) + 1) for size in (LENGTH, HEIGHT))
    basis, u = _solved(MeshQuad.init_tensor(*knots), ElementQuad1(), 3)
    return basis.mesh.p, u[basis.nodal_dofs]


@dataclass(frozen=True)
class Hanging:
    """Places (2, particle), displacements (2, particle), and what the leaders exert, for E = 1."""

    places: np.ndarray
    u: np.ndarray
    reaction: np.ndarray


@cache
def lattice(cells: int) -> Hanging:
    """The shipped experiment with other cells, solved directly: its reactions are exact."""
    settings = [f"lattice.a={1 / cells}", "solver.method=lu"]
    experiment = pbdkit.load("modelling/cantilever-weight", settings=settings)
    ds = pbdkit.run(experiment, progress=False)
    return Hanging(ds.reference.values.T, ds.u.values[-1].T, ds.reaction.values[-1].sum(axis=0))


def error(places, u) -> float:
    """Relative L2, corners and edges by the part of their surroundings that is in the beam."""
    x, y = places
    weights = np.where(np.isclose(x, 0) | np.isclose(x, LENGTH), 0.5, 1.0)
    weights *= np.where(np.isclose(y, 0) | np.isclose(y, HEIGHT), 0.5, 1.0)
    exact = reference().at(x, y)
    off, whole = (((v**2).sum(axis=0) * weights).sum() for v in (u - exact, exact))
    return math.sqrt(off / whole)


if __name__ == "__main__":
    rough, fine = reference(ELEMENTS // 2), reference()
    at = lattice(SIZES[0]).places
    apart = np.abs(rough.at(*at) - fine.at(*at)).max() / np.abs(fine.at(*at)).max()
    print(f"reference, of half as many elements: off by {apart:.2g} of the largest")
    for n in SIZES:
        found = lattice(n)
        off = np.abs(found.reaction - [0.0, WEIGHT * LENGTH * HEIGHT]).max()
        rule, elements = error(found.places, found.u), error(*bilinear(n))
        print(f"{n:3} cells: rule {rule:.3g}, bilinear {elements:.3g}, reaction off {off:.2g}")
