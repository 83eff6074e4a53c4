"""The specimen of `pbdkit fit plate-with-hole` by quadratic elements: mesh, stiffness, and what it
shows at the points of the measurement. Lengths in mm, forces over Young's modulus and thickness."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from finite_elements.elasticity import find, local
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad2, ElementVector, MeshQuad, MeshQuad2
from skfem.helpers import ddot, div, sym_grad

import pbdkit

LENGTH, HEIGHT, RADIUS = 80.0, 20.0, 4.0
FORCE, THICKNESS, NOISE = 6501.0, 3.05, 3e-4
CENTRE, HALF = np.array([[40.0], [10.0]]), HEIGHT / 2
FILE = Path(pbdkit.__file__).parent / "fits" / "plate-with-hole.csv"
SYMMETRIC = {"SymmetricMode": True, "DiagPivotThresh": 0.0}


class Data(NamedTuple):
    """Points and displacements, (point, axis)."""

    points: np.ndarray
    displacements: np.ndarray

    def inside(self, margin: float, inset: float = 0.0) -> Data:
        """Return the points farther than that within the outline, and than `inset` from both
        ends."""
        x = self.points[:, 0]
        chosen = (depth(self.points) >= margin) & (np.minimum(x, LENGTH - x) >= inset)
        return Data(self.points[chosen], self.displacements[chosen])

    def at(self, places: np.ndarray) -> np.ndarray:
        """Linear between all points, beyond them the nearest."""
        found = LinearNDInterpolator(self.points, self.displacements)(places)
        beyond = np.isnan(found[:, 0])
        if beyond.any():
            nearest = NearestNDInterpolator(self.points, self.displacements)
            found[beyond] = nearest(places[beyond])
        return found


def read() -> Data:
    """Return all measured data of the file."""
    rows = np.loadtxt(FILE, delimiter=",", skiprows=1)
    return Data(rows[:, :2], rows[:, 2:])


def depth(points: np.ndarray) -> np.ndarray:
    """Return the depth of points within the outline."""
    x, y = points.T
    hole = np.hypot(*(points.T - CENTRE)) - RADIUS
    return np.min([x, LENGTH - x, y, HEIGHT - y, hole], axis=0)


@BilinearForm
def volumetric(u, v, _):
    """Return the part of λ."""
    return div(u) * div(v)


@BilinearForm
def distortional(u, v, _):
    """Return the part of 2μ."""
    return ddot(sym_grad(u), sym_grad(v))


def lame(nu: float) -> np.ndarray:
    """λ of plane stress and 2μ over Young's modulus."""
    return np.array([nu / (1.0 - nu**2), 1.0 / (1.0 + nu)])


def lame_slope(nu: float) -> np.ndarray:
    """Return the derivatives of both constants."""
    return np.array([(1.0 + nu**2) / (1.0 - nu**2) ** 2, -1.0 / (1.0 + nu) ** 2])


def mesh(n: int, inset: float = 0.0) -> MeshQuad2:
    """n elements, an even number, over the height, curved around the hole and finer there; so much
    shorter at both ends."""
    turns = np.linspace(-np.pi / 4, np.pi / 4, n + 1)
    y = HALF * (1.0 + np.tan(turns))
    along = np.linspace(inset, LENGTH / 2 - HALF, 3 * n // 2 + 1)
    left = MeshQuad.init_tensor(along, y)
    right = MeshQuad.init_tensor(LENGTH - along[::-1], y)
    rings, place = _rings(n)
    curved = MeshQuad2.from_mesh(_joined(left, rings, right))
    return MeshQuad2(np.ascontiguousarray(place(curved.doflocs)), curved.t)


def _joined(*parts: MeshQuad) -> MeshQuad:
    """Nodes that lie on one another are one."""
    points = np.hstack([part.p for part in parts])
    firsts = np.cumsum([0, *(part.p.shape[1] for part in parts)])
    corners = np.hstack([part.t + first for part, first in zip(parts, firsts, strict=False)])
    _, one, all_of = np.unique(np.round(points, 9), axis=1, return_index=True, return_inverse=True)
    return MeshQuad(np.ascontiguousarray(points[:, one]), all_of.ravel()[corners])


def _rings(n: int):
    """Quadrilaterals between the hole and a square, and what puts all nodes on their circles."""
    count, step = max(2, round(0.7 * n)), np.pi / 2 / n

    def outer(turn):
        return HALF / np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn)))

    def at(turn, ring):
        way = np.array([np.cos(turn), np.sin(turn)])
        return CENTRE + way * RADIUS * (outer(turn) / RADIUS) ** (ring / count)

    def placed(points):
        x, y = points - CENTRE
        turn = np.round(2.0 * np.arctan2(y, x) / step) / 2.0 * step
        ring = count * np.log(np.hypot(x, y) / RADIUS) / np.log(outer(turn) / RADIUS)
        near = np.maximum(np.abs(x), np.abs(y)) < HALF - 1e-9
        return np.where(near, at(turn, np.round(2.0 * ring) / 2.0), points)

    turns, rings = np.arange(4 * n) * step, np.arange(count + 1)
    points = at(*(a.ravel() for a in np.meshgrid(turns, rings)))
    first = np.arange(4 * n * count).reshape(count, 4 * n)
    beside = np.roll(first, -1, axis=1)
    corners = [first, beside, beside + 4 * n, first + 4 * n]
    return MeshQuad(np.ascontiguousarray(points), np.array([c.ravel() for c in corners])), placed


class Plate:
    """A mesh of n elements over the height with its basis."""

    def __init__(self, n: int, inset: float = 0.0) -> None:
        self.basis = Basis(mesh(n, inset), ElementVector(ElementQuad2()), intorder=5)
        at = self.basis.doflocs
        self.along_x = np.isin(
            np.arange(self.basis.N), self.basis.get_dofs(elements=True).all("u^1")
        )
        ends = (inset, LENGTH - inset)
        self.ends = [np.flatnonzero(np.abs(at[0] - x) < 1e-9) for x in ends]
        self.led = np.concatenate(self.ends)
        self.free = np.setdiff1d(np.arange(self.basis.N), self.led)
        self.pulled = self.ends[1][self.along_x[self.ends[1]]]

    @cached_property
    def parts(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Stiffness matrices of λ and of 2μ: the stiffness is linear in them."""
        return tuple(part.assemble(self.basis).tocsr() for part in (volumetric, distortional))

    def stiffness(self, coefficients: np.ndarray) -> sparse.csr_matrix:
        """Over Young's modulus and thickness, of [λ, 2μ] or of their derivatives."""
        return self.parts[0] * coefficients[0] + self.parts[1] * coefficients[1]

    def shows(self, points: np.ndarray) -> sparse.csr_matrix:
        """(x of all points, then y of all) from the unknowns of the mesh."""
        places = np.ascontiguousarray(points.T)
        cells = find(self.basis, places, 4)
        found = local(self.basis, places, cells)[:, :, 0]
        count, rows, columns, values = len(points), [], [], []
        for k, dofs in enumerate(self.basis.element_dofs[:, cells]):
            node, axis = divmod(k, 2)
            rows.append(np.arange(count) + axis * count)
            columns.append(dofs)
            values.append(self.basis.elem.elem.lbasis(found, node)[0])
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_matrix(entries, (2 * count, self.basis.N))

    def modes(self, count: int) -> np.ndarray:
        """Legendre's polynomials along both ends and axes, (unknown, coefficient)."""
        found = []
        for end in self.ends:
            s = self.basis.doflocs[1, end] / HALF - 1.0
            for axis in (self.along_x[end], ~self.along_x[end]):
                block = np.zeros((self.basis.N, count))
                block[end] = np.polynomial.legendre.legvander(s, count - 1) * axis[:, None]
                found.append(block)
        return np.hstack(found)

    def measured(self, data: Data) -> np.ndarray:
        """Displacements measured at both ends, on the unknowns there."""
        u = np.zeros(self.basis.N)
        both = data.at(self.basis.doflocs[:, self.led].T)
        u[self.led] = np.where(self.along_x[self.led], both[:, 0], both[:, 1])
        return u

    def factorised(self, stiffness: sparse.csr_matrix, free: np.ndarray | None = None):
        """Factorise the stiffness of the free unknowns, by default of those that are on no end."""
        free = self.free if free is None else free
        inner = stiffness[free][:, free].tocsc()
        return splu(inner, permc_spec="MMD_AT_PLUS_A", options=SYMMETRIC)
