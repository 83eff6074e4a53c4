"""Compare solvers of pbdkit, scipy and pyamg on linear systems without the lattice's stencils.

python tests/benchmarks/solvers.py [--size N] [--only PART_OF_A_NAME ...]

Processor time of set-up and of one solution, one thread. Iterations end at a relative residual of
1e-9 in the norm of each preconditioner; the final residual is printed. The results and the
conclusions are in docs/decisions/0010-solvers-of-equilibria.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from unittest.mock import patch

import numpy as np
import pyamg
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, cg, gmres, splu
from threadpoolctl import threadpool_limits

import pbdkit
from pbdkit.equilibrium import sparse
from pbdkit.equilibrium.linear_solver import (
    BandLU,
    Coordinates,
    SparseLU,
    band_order,
    is_symmetric,
)
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

Solver = tuple[Callable[[], str], Callable[[Any], Any]]
ELASTIC = {"rule": {"type": "elastic", "poisson_ratio": 0.3}, "frame": {"type": "natural"}}
ONE_SHELL, TWO_SHELLS = ({"neighbours": {"type": "chebyshev", "shells": n}} for n in (1, 2))
SPRINGS = {"rule": {"type": "springs"}, "lattice": {"type": "hexagonal", "a": 1.0}}
MIRROR = {"frame": {"type": "mirror"}}
GRADIENT = {"rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 2.0}}


def cracked(n: int) -> dict[str, Any]:
    """Three cracks, longer than half of the side."""
    lines = [
        [[0.5 * n + 0.2, -1.0], [0.5 * n + 0.2, 0.6 * n]],
        [[0.25 * n + 0.2, 0.4 * n], [0.25 * n + 0.2, n + 1.0]],
        [[0.75 * n + 0.2, 0.4 * n], [0.75 * n + 0.2, n + 1.0]],
    ]
    return {"fracture": {"type": "threshold", "thresholds": [1e9], "cracks": lines}}


def sheets(n: int) -> dict[str, dict[str, Any]]:
    """The parts of an experiment of each sheet."""
    slender = {"body": {"type": "grid", "columns": 4 * n, "rows": n // 4}}
    return {
        "elastic, cracked": ELASTIC | ONE_SHELL | cracked(n),
        "elastic, slender": ELASTIC | ONE_SHELL | slender,
        "strain-gradient": ELASTIC | ONE_SHELL | GRADIENT,
        "springs, hexagonal, cracked": SPRINGS | cracked(n),
        "distance-weighted, 2 shells": {"rule": {"type": "distance-weighted"}}
        | TWO_SHELLS
        | MIRROR,
        "mixed-coordinate, 2 shells": {"rule": {"type": "mixed-coordinate", "K": 0.3}}
        | TWO_SHELLS
        | MIRROR,
        "barycentre, hexagonal, cracked": SPRINGS | {"rule": {"type": "barycentre"}} | cracked(n),
    }


class FoundError(Exception):
    """The matrix is known."""


def system(n: int, parts: dict[str, Any]) -> tuple[Any, Coordinates]:
    """The matrix that MatrixSystem hands to its solver, and the coordinates of its unknowns."""
    moved = {"type": "displace", "displacement": [3.0, 0.5]}
    experiment: dict[str, Any] = {
        "version": 1,
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": n, "rows": n},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": moved},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium"},
    }
    scene = build_scene(pbdkit.Experiment(**experiment | parts))
    made = patch.object(sparse, "linear_solver", side_effect=FoundError)
    with made as solver, suppress(FoundError):
        sparse.MatrixSystem(scene, initial_state(scene), "auto", Watch())
    return sp.csr_array(solver.call_args.args[0]), solver.call_args.kwargs["coordinates"]


def by_band(A: Any, at: Coordinates) -> Solver:
    """Solve with LAPACK's band matrices."""
    order, half = band_order(A, at)
    factors = BandLU(A, order, half)
    return lambda: f"half-bandwidth {half}", lambda b: factors.solve(b, 0.0)


def by_dissection(A: Any, at: Coordinates) -> Solver:
    """SuperLU in the order of nested dissection, where there are enough particles."""
    factors = SparseLU(A, is_symmetric(A), at)
    return lambda: f"{factors._factors.nnz} entries", lambda b: factors.solve(b, 0.0)


def by_scipy(order: str) -> Callable[[Any, Coordinates], Solver]:
    """SuperLU in an order of its own."""

    def made(A: Any, at: Coordinates) -> Solver:
        factors = splu(A.tocsc(), permc_spec=order, diag_pivot_thresh=0.1)
        return lambda: f"{factors.nnz} entries", factors.solve

    return made


def iterated(A: Any, cycle: Callable[[Any], Any]) -> Solver:
    """Conjugate gradients or GMRES with a preconditioner."""
    count = 0

    def counted(r: Any) -> Any:
        nonlocal count
        count += 1
        return cycle(r)

    M = LinearOperator(A.shape, matvec=counted, dtype=float)

    def solve(b: Any) -> Any:
        if is_symmetric(A):
            return cg(A, b, M=M, rtol=1e-9, atol=0.0, maxiter=400)[0]
        return gmres(A, b, M=M, rtol=1e-9, atol=0.0, restart=30, maxiter=14)[0]

    return lambda: f"{count} cycles", solve


def by_own_multigrid(A: Any, at: Coordinates) -> Solver:
    """Solve with the multigrid of amg.py."""
    return iterated(A, at.grids(A))


def by_smoothed_aggregation(A: Any, at: Coordinates) -> Solver:
    """pyamg, with the rigid-body modes."""
    modes, blocks = np.ones((A.shape[0], 1)), sp.csr_matrix(A)
    how: dict[str, Any] = {"symmetry": "symmetric"}
    name = "gauss_seidel"
    if at.axes == 2:
        first = np.arange(A.shape[0]) % 2 == 0
        x, y = np.repeat(at.places - at.places.mean(axis=0), 2, axis=0).T
        modes = np.column_stack([first, ~first, np.where(first, -y, x)]).astype(float)
        blocks, name = sp.bsr_matrix(blocks, blocksize=(2, 2)), "block_gauss_seidel"
    if not is_symmetric(A):
        smoother = (name, {"sweep": "symmetric"})
        how = {"symmetry": "nonsymmetric", "BH": modes.copy()}
        how |= {"presmoother": smoother, "postsmoother": smoother}
    cycle = pyamg.smoothed_aggregation_solver(blocks, B=modes, max_coarse=400, **how)
    M = cycle.aspreconditioner()
    return iterated(A, lambda r: M @ r)


SOLVERS: dict[str, Callable[[Any, Coordinates], Solver]] = {
    "band": by_band,
    "nested dissection": by_dissection,
    "MMD_AT_PLUS_A": by_scipy("MMD_AT_PLUS_A"),
    "COLAMD": by_scipy("COLAMD"),
    "own multigrid": by_own_multigrid,
    "pyamg, smoothed aggregation": by_smoothed_aggregation,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=120)
    parser.add_argument("--only", nargs="+", default=[""])
    given = parser.parse_args()
    print("| sheet | unknowns | solver | set-up, s | solution, s | | residual |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for sheet, parts in sheets(given.size).items():
        if not any(name in sheet for name in given.only):
            continue
        A, at = system(given.size, parts)
        b = A @ np.random.default_rng(0).normal(size=A.shape[0])
        for name, make in SOLVERS.items():
            times = [time.process_time()]
            told, solve = make(A, at)
            times.append(time.process_time())
            x = solve(b)
            times.append(time.process_time())
            left = np.linalg.norm(b - A @ x) / np.linalg.norm(b)
            first, second = np.diff(times)
            print(f"| {sheet} | {A.shape[0]} | {name} | {first:.3f} | {second:.3f} | {told()} | "
                  f"{left:.1e} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
