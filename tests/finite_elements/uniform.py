"""Error against time of scikit-fem: whole bodies on uniform meshes, meshing not counted.

`python tests/finite_elements/uniform.py` prints it for all problems; `measure` returns it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import skfem
from scipy.sparse.linalg import cg, splu
from skfem import Basis, ElementVector

sys.path.insert(0, str(Path(__file__).parents[1]))
from finite_elements.elasticity import find, plane_stress, values
from finite_elements.errors import load, relative_l2
from finite_elements.problems import BAR, CANTILEVER, HOLE, Problem
from finite_elements.timing import best

ELEMENTS = {
    "P1": (skfem.ElementTriP1, 1),
    "Q1": (skfem.ElementQuad1, 3),
    "P2": (skfem.ElementTriP2, 2),
    "Q2": (skfem.ElementQuad2, 5),
}
"""Each with the order of integration that is exact on straight elements, and no more."""
CURVED = {"P2": skfem.MeshTri2, "Q2": skfem.MeshQuad2}
RESOLUTIONS = (5, 10, 20, 40, 80)
TOLERANCE = 1e-8
"""Tolerance of the iterative solver, relative to the load; below every error measured here."""
SMALL, LARGE = 2_000, 300_000
"""Unknowns below which only the direct solver is tried, and above which it is not."""


@dataclass(frozen=True)
class Row:
    """One solution: `resolution` in elements per unit length, the best seconds of all repeats;
    `setup_s` is meshing and what scikit-fem prepares for assembly (Basis), `processor_s` the
    processor time of assembly and solving, `setup_processor_s` that of preparing."""

    problem: str
    element: str
    resolution: int
    unknowns: int
    setup_s: float
    assembly_s: float
    solve_s: float
    solver: str
    error: float
    reaction: float
    processor_s: float
    setup_processor_s: float


def measure(
    problem: Problem,
    element: str,
    resolutions: Iterable[int] = RESOLUTIONS,
    repeats: int = 3,
    cells: int = 80,
) -> Iterator[Row]:
    """Errors are those at the sites of the lattice of `cells` per unit length, wherever the nodes
    lie: what is interpolated between nodes counts."""
    for resolution in resolutions:
        setup, basis = best(repeats, lambda n=resolution: basis_of(problem, element, n))
        held, u = _held(problem, basis)
        assembly, K = best(repeats, lambda basis=basis: plane_stress().assemble(basis))
        solving, solver, u = _fastest(repeats, basis, K, held, u)
        forces = K @ u
        right = basis.get_dofs(lambda x: np.isclose(x[0], problem.length))
        reaction = float(forces[right.all(f"u^{problem.pulled + 1}")].sum())
        error = relative_l2(at_sites(problem, basis, u, cells), load(problem.name, cells))
        sizes = (problem.name, element, resolution, K.shape[0])
        walls = (setup.wall, assembly.wall, solving.wall)
        processor_s = assembly.plus(solving).processor
        yield Row(*sizes, *walls, solver, error, reaction, processor_s, setup.processor)


def basis_of(problem: Problem, element: str, resolution: int) -> Basis:
    kind, order = ELEMENTS[element]
    return Basis(mesh(problem, element, resolution), ElementVector(kind()), intorder=order)


def mesh(problem: Problem, element: str, resolution: int):
    """Squares, or each cut in two; around a hole squares in rings, curved if quadratic."""
    if problem.radius:
        flat, place = _rings(problem, resolution)
    else:
        extents = (problem.length, problem.height)
        flat = skfem.MeshQuad.init_tensor(
            *(np.linspace(0, size, round(size * resolution) + 1) for size in extents)
        )
    if "P" in element:
        flat = flat.to_meshtri()
    if not problem.radius or element not in CURVED:
        return flat
    curved = CURVED[element].from_mesh(flat)
    return type(curved)(place(curved.doflocs), curved.t)


def at_sites(problem: Problem, basis: Basis, u, cells: int):
    """The solution at the reference's sites, (2, i, j)."""
    reference = load(problem.name, cells)
    sites = ~np.isnan(reference.u[0])
    points = np.array([reference.x[sites], reference.y[sites]])
    found = np.full_like(reference.u, np.nan)
    found[:, sites] = values(basis, u, points, find(basis, points))
    return found


def _rings(problem: Problem, resolution: int):
    """Quadrilaterals between the hole and a square, and what puts all nodes on curved rings."""
    half, rings = problem.length / 2, max(1, resolution // 2)
    around = 8 * rings

    def place(turn, ring):
        direction = np.array([np.cos(turn), np.sin(turn)])
        outer = half / np.abs(direction).max(axis=0)
        return half + (outer + ring * (problem.radius - outer)) * direction

    def placed(points):
        x, y = points - half
        outer = half * np.hypot(x, y) / np.maximum(np.abs(x), np.abs(y))
        ring = (outer - np.hypot(x, y)) / (outer - problem.radius)
        return place(np.arctan2(y, x), np.round(2 * rings * ring) / (2 * rings))

    turns = np.arange(around) * 2 * np.pi / around
    points = place(*(a.ravel() for a in np.meshgrid(turns, np.arange(rings + 1) / rings)))
    first = np.arange(around * rings).reshape(rings, around)
    beside = np.roll(first, -1, axis=1)
    corners = [first, beside, beside + around, first + around]
    return skfem.MeshQuad(points, np.array([c.ravel() for c in corners])), placed


def _held(problem: Problem, basis: Basis):
    """Held dofs, and a field with their values."""
    u = basis.zeros()
    left = basis.get_dofs(lambda x: np.isclose(x[0], 0)).all()
    right = basis.get_dofs(lambda x: np.isclose(x[0], problem.length))
    u[right.all(f"u^{problem.pulled + 1}")] = 1
    return np.concatenate([left, right.all()]), u


def _fastest(repeats: int, basis: Basis, K, held, u):
    """Seconds, name and solution of the faster of the solvers worth trying at this size."""
    tried = []
    if K.shape[0] <= LARGE:
        tried.append((*best(repeats, lambda: _solved(_direct, basis, K, held, u)), "direct"))
    if K.shape[0] >= SMALL:
        tried.append((*best(repeats, lambda: _solved(_multigrid, basis, K, held, u)), "multigrid"))
    seconds, solution, name = min(tried, key=lambda result: result[0].wall)
    return seconds, name, solution


def _solved(solver, basis: Basis, K, held, u):
    free = np.setdiff1d(np.arange(len(u)), held)
    rows = K[free]
    solution = u.copy()
    solution[free] = solver(rows[:, free], -(rows @ u), basis, free)
    return solution


def _direct(K, load, basis, free):
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    return splu(K.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options).solve(load)


def _multigrid(K, load, basis, free):
    """Solve by conjugate gradients, preconditioned with smoothed aggregation with the rigid
    motions."""
    import pyamg  # scikit-fem does without it, and so does all but this solver

    x, y = basis.doflocs[:, free]
    along = np.isin(free, basis.get_dofs(elements=True).all("u^1"))
    rigid = np.column_stack([along, ~along, np.where(along, -y, x)]).astype(float)
    levels = pyamg.smoothed_aggregation_solver(K, B=rigid, max_coarse=200)
    found, failed = cg(K, load, rtol=TOLERANCE, M=levels.aspreconditioner())
    if failed:
        raise RuntimeError(f"conjugate gradients: not converged after {failed} iterations")
    return found


if __name__ == "__main__":
    for problem in (BAR, CANTILEVER, HOLE):
        for element in ELEMENTS:
            for row in measure(problem, element):
                print(
                    f"{row.problem:10} {row.element} {row.resolution:3} {row.unknowns:7} unknowns, "
                    f"set-up {row.setup_s * 1e3:7.2f} ms, "
                    f"assembly {row.assembly_s * 1e3:8.2f} ms, solve {row.solve_s * 1e3:8.2f} ms "
                    f"({row.solver}), error {row.error:.2e}, reaction {row.reaction:.8f}",
                    flush=True,
                )
