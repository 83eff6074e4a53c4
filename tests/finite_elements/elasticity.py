"""The bilinear form, and a solution's values anywhere in the body."""

from __future__ import annotations

import numpy as np
from finite_elements.problems import NU, E
from scipy.spatial import cKDTree
from skfem import Basis
from skfem.models.elasticity import linear_elasticity

NEWTON = 6


def plane_stress():
    """scikit-fem's form, with Lamé's λ of plane stress, Eν/(1−ν²)."""
    return linear_elasticity(E * NU / (1 - NU**2), E / (2 * (1 + NU)))


def values(basis: Basis, u, points, cells):
    """Displacements (2, points) at points (2, points) of the given elements."""
    return _shaped(basis, u, local(basis, points, cells), cells)


def local(basis: Basis, points, cells):
    """Return coordinates (2, points, 1) within the elements, by Newton's method. scikit-fem's own
    iterates to more digits than points in the smallest elements have."""
    mapping, points = basis.mapping, points[:, :, None]
    found = np.full_like(points, 1 / 3)
    for _ in range(NEWTON):
        missed = points - mapping.F(found, tind=cells)
        found += np.einsum("ij...,j...->i...", mapping.invDF(found, tind=cells), missed)
    return found


def _shaped(basis: Basis, u, found, cells):
    total = np.zeros(found.shape[:2])
    for k, dofs in enumerate(basis.element_dofs[:, cells]):
        shape = basis.elem.gbasis(basis.mapping, found, k, tind=cells)[0]
        total += u[dofs] * np.asarray(shape)[:, :, 0]
    return total


def find(basis: Basis, points, candidates: int = 8):
    """Return the element of each point (2, points), curved edges included: among those with the
    nearest middles the one with a reference element that contains the point, or misses it by
    least."""
    mesh = basis.mesh
    middles = mesh.p[:, mesh.t].mean(axis=1)
    count = min(candidates, middles.shape[1])
    near = cKDTree(middles.T).query(points.T, count)[1].reshape(-1, count)
    missed = [_missed(mesh, local(basis, points, cells)[:, :, 0]) for cells in near.T]
    return near[np.arange(len(near)), np.argmin(missed, axis=0)]


def _missed(mesh, found):
    """Return the distance of points outside the reference element; negative inside."""
    x, y = found
    beyond = x + y - 1 if len(mesh.t) == 3 else np.maximum(x, y) - 1
    return np.maximum(np.maximum(-x, -y), beyond)
