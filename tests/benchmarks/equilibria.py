"""Equilibria of large sheets against the best that libraries make of the same matrix, in turns.

python tests/benchmarks/equilibria.py [--sizes 300 600] [--turns N]

One thread for all. The matrix is scikit-fem's for the bilinear element, assembled before; what the
contestants do with it is timed from there, pbdkit's own set-up from the scene on.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pyamg
import scipy.sparse as sparse
from skfem import Basis, ElementQuad1, ElementVector, MeshQuad, condense
from skfem.assembly import BilinearForm
from skfem.helpers import ddot, eye, sym_grad, trace
from skfem.models.elasticity import plane_stress
from threadpoolctl import threadpool_limits

import pbdkit
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.load_stepping import equilibrate
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

TOLERANCE = 1e-6
RULES = {
    "elastic": {
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "frame": {"type": "natural"},
    },
    "barycentre": {"rule": {"type": "barycentre"}},
}


def sheet(rule: str, n: int) -> pbdkit.Experiment:
    """n × n particles, pulled and sheared."""
    moved = {"type": "displace", "displacement": [3.0, 0.5]}
    return pbdkit.Experiment(
        version=1,
        name="sheet",
        lattice={"type": "square", "a": 1.0},
        body={"type": "grid", "columns": n, "rows": n},
        leaders=[
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": moved},
        ],
        steps=1,
        solver={"type": "equilibrium", "tolerance": TOLERANCE},
        **RULES[rule],
    )


def whole(experiment: pbdkit.Experiment) -> Any:
    """From the experiment to the certified state."""
    scene = build_scene(experiment)
    return equilibrate(scene, initial_state(scene))


def prepared(experiment: pbdkit.Experiment) -> Callable[[], object]:
    """Set-up and solution alone: stencils, grids, iteration; the moves are known."""
    scene = build_scene(experiment)
    state = initial_state(scene)
    moves = np.zeros_like(state.u)
    kinds = scene.raster.kind[0] == 1
    moves[:, 0][:, kinds] = np.random.default_rng(0).normal(size=(2, np.count_nonzero(kinds)))
    for leading in scene.leading:
        moves.reshape(2, -1)[:, leading.place] = 0.0

    def work() -> object:
        system = linearised(scene, state, 1, "auto", Watch())
        return system.solve(moves, TOLERANCE * float(np.abs(moves).max()))

    return work


def assembled(n: int) -> tuple[Any, Any, Any]:
    """The stiffness of the free unknowns, the load, and the rigid motions."""
    mesh = MeshQuad.init_tensor(np.arange(n, dtype=float), np.arange(n, dtype=float))
    basis = Basis(mesh, ElementVector(ElementQuad1()))
    lam, mu = plane_stress(1.0, 0.3)

    @BilinearForm
    def stiffness(u, v, _):
        strain = sym_grad(u)
        return ddot(lam * eye(trace(strain), 2) + 2.0 * mu * strain, sym_grad(v))

    ends = basis.get_dofs(lambda x: (x[0] == 0.0) | (x[0] == n - 1.0))
    x = basis.zeros()
    right = basis.get_dofs(lambda x: x[0] == n - 1.0)
    x[right.all("u^1")], x[right.all("u^2")] = 3.0, 0.5
    K, f, _, free = condense(stiffness.assemble(basis), basis.zeros(), x=x, D=ends)
    u, v = basis.doflocs[:, free]
    first = np.arange(len(free)) % 2 == 0
    rigid = np.column_stack([first, ~first, np.where(first, -v, u)]).astype(float)
    return sparse.csr_matrix(K), f, rigid


def by_pyamg(make: Callable[[Any], Any], K: Any, f: Any) -> Callable[[], object]:
    """Hierarchy and conjugate gradients."""
    return lambda: make(K).solve(f, tol=TOLERANCE, accel="cg")


def axes_apart(K: Any, f: Any) -> Callable[[], object]:
    """Ruge and Stüben's grids of each axis by itself, around conjugate gradients for both."""
    from scipy.sparse.linalg import LinearOperator, cg

    def work() -> object:
        parts = [pyamg.ruge_stuben_solver(K[a::2][:, a::2].tocsr()) for a in (0, 1)]
        cycles = [part.aspreconditioner() for part in parts]

        def both(r: Any) -> Any:
            out = np.empty_like(r)
            for a, cycle in enumerate(cycles):
                out[a::2] = cycle @ r[a::2]
            return out

        return cg(K, f, rtol=TOLERANCE, M=LinearOperator(K.shape, matvec=both))[0]

    return work


def peak(work: Callable[[], object]) -> int:
    """Return the peak of allocated memory in bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--sizes", type=int, nargs="+", default=[300, 600, 1000])
    asked.add_argument("--turns", type=int, default=3)
    given = asked.parse_args()
    print("| sheet | contestant | best, s | against pbdkit's set-up and solution |")
    print("| --- | --- | --- | --- |")
    for n in given.sizes:
        K, f, rigid = assembled(n)
        work: dict[str, Callable[[], object]] = {
            "pbdkit, set-up and solution": prepared(sheet("elastic", n)),
            "pbdkit, the whole call": lambda n=n: whole(sheet("elastic", n)),
            "pbdkit, barycentre, the whole call": lambda n=n: whole(sheet("barycentre", n)),
            "pyamg, Ruge-Stüben, axes apart": axes_apart(K, f),
            "pyamg, smoothed aggregation": by_pyamg(
                lambda K, B=rigid: pyamg.smoothed_aggregation_solver(K, B=B), K, f
            ),
        }
        best = dict.fromkeys(work, np.inf)
        for turn in range(given.turns + 1):
            for name, run in work.items():
                begun = time.perf_counter()
                run()
                if turn:
                    best[name] = min(best[name], time.perf_counter() - begun)
        own = best["pbdkit, set-up and solution"]
        for name, seconds in best.items():
            print(f"| {n} × {n} | {name} | {seconds:.3f} | {seconds / own:.1f} |", flush=True)
        bytes_each = peak(work["pbdkit, set-up and solution"]) / n**2
        print(f"| {n} × {n} | memory of set-up and solution | {bytes_each:.0f} B a particle | |")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
