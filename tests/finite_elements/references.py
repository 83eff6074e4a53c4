"""Compute the references: `python tests/finite_elements/references.py`, a quarter of a minute.

Prints their convergence. Each file holds the displacements `u` of the lower left quarter (2, i, j)
at the sites of the finest lattice, NaN elsewhere, with `reaction`, `energy` and `error`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from finite_elements.errors import DATA
from finite_elements.graded import Solution, solve
from finite_elements.problems import PROBLEMS, Problem

MESHES = (16, 32, 64, 128)
"""Elements along a side of the quarter."""
GAIN = 2**3 - 1
"""Halving quadratic elements divides the error by 8, so that the finest mesh is off by a seventh of
its difference to the mesh before."""


def make(problem: Problem) -> None:
    x, y, sites = problem.sites(problem.columns // 2, problem.rows // 2)
    found, before = np.full((2, *x.shape), np.nan), None
    for elements in MESHES:
        solution = solve(problem, elements)
        found[:, sites] = solution.at(x[sites], y[sites])
        off = np.nan if before is None else _relative(problem, before, found)
        _print_row(problem, elements, solution, off)
        before = found.copy()
    path = DATA / f"{problem.name}.npz"
    scalars = {"reaction": solution.reaction, "energy": solution.energy, "error": off / GAIN}
    np.savez_compressed(path, u=found, **scalars)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB, error {off / GAIN:.1e}\n", flush=True)


def _relative(problem: Problem, rough, fine) -> float:
    """Relative L2 difference of two quarters, as whole bodies."""
    rough, fine = (problem.unfold(quarter) for quarter in (rough, fine))
    return float(np.sqrt(np.nansum((rough - fine) ** 2) / np.nansum(fine**2)))


def _print_row(problem: Problem, elements: int, solution: Solution, off: float) -> None:
    print(
        f"{problem.name:14} {elements:4} {len(solution.u):7} dofs, from the mesh before {off:.2e}, "
        f"reaction {solution.reaction:.11f}, energy {solution.energy:.11f}",
        flush=True,
    )


if __name__ == "__main__":
    DATA.mkdir(exist_ok=True)
    for problem in PROBLEMS.values():
        make(problem)
