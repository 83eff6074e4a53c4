"""References for the displacements of a lattice, and norms of the difference. Needs numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from finite_elements.problems import FINEST, PROBLEMS, Problem

DATA = Path(__file__).parent / "data"


@dataclass(frozen=True)
class Reference:
    """The reference solution of a problem at the sites of the lattice of `cells` per unit length.

    `x`, `y` are of shape (i, j), `u` of shape (2, i, j): i counts along x, j along y, both from the
    lower left. In the hexagonal lattice site i of row j lies at x = (i + (j odd)/2)/cells. `u` is
    NaN in the hole and, hexagonal, at the last i of shifted rows, which lies outside.
    `reaction` is the force along the pull on the right edge, `energy` the strain energy of the
    whole body, `error` the relative L2 error of the displacements, estimated from a coarser mesh.
    """

    problem: Problem
    cells: int
    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    reaction: float
    energy: float
    error: float

    @property
    def weights(self):
        """The part of a site's surrounding that lies in the rectangle: 1, on edges ½, in corners
        ¼; 0 where there is no reference. The hole does not cut surroundings."""
        inside = (~np.isnan(self.u[0])).astype(float)
        for place, extent in ((self.x, self.problem.length), (self.y, self.problem.height)):
            inside[np.isclose(place, 0) | np.isclose(place, extent)] /= 2
        return inside


def load(name: str, cells: int = FINEST) -> Reference:
    """Return the reference of one of `PROBLEMS`.

    Raises ValueError if there is none for that number of cells per unit length.
    """
    problem = PROBLEMS[name]
    if cells not in problem.kept:
        kept = ", ".join(map(str, problem.kept))
        raise ValueError(f"{name}: kept for {kept} cells per unit length, not for {cells}")
    with np.load(DATA / f"{name}.npz") as data:
        u = problem.unfold(data["u"])
        scalars = [float(data[key]) for key in ("reaction", "energy", "error")]
    i, j = _chosen(problem, FINEST // cells)
    inside = i <= problem.columns
    u = np.where(inside, u[:, np.where(inside, i, 0), j], np.nan)
    x, y = i * problem.length / problem.columns, j * problem.height / problem.rows
    return Reference(problem, cells, x, y, u, *scalars)


def relative_l2(u, reference: Reference) -> float:
    """√(Σ A |u − u_ref|²) / √(Σ A |u_ref|²) over the sites, with `Reference.weights` as A.

    u is of the reference's shape (2, i, j) and may be anything where the reference is NaN.
    Raises ValueError for another shape.
    """
    if np.shape(u) != reference.u.shape:
        raise ValueError(f"u: expected shape {reference.u.shape}, got {np.shape(u)}")
    weights = reference.weights
    counted = weights > 0
    off, exact = (np.sum(v**2, axis=0)[counted] for v in (u - reference.u, reference.u))
    return float(np.sqrt(weights[counted] @ off / (weights[counted] @ exact)))


def _chosen(problem: Problem, step: int):
    """Indices into the kept grid, (i, j) each."""
    along = 2 * step if problem.hexagonal else step
    i, j = np.indices((problem.columns // along + 1, problem.rows // step + 1))
    shift = step * (j % 2) if problem.hexagonal else 0
    return along * i + shift, step * j
