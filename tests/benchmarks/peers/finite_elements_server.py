"""Serve scikit-fem's contestants: read a problem as a line of JSON, and write its seconds as
another.

Runs in an environment with scikit-fem, cvxopt and pyamg; the first argument is the folder of
`finite_elements`. The displacements at the reference's sites are written to the path in the job.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pyamg
import scipy.sparse as sparse
from cvxopt import cholmod, matrix, spmatrix
from scipy.sparse.linalg import LinearOperator, cg, spsolve

sys.path.insert(0, sys.argv[1])
from finite_elements import uniform
from finite_elements.elasticity import find, plane_stress, values
from finite_elements.errors import load
from finite_elements.problems import BAR, CANTILEVER, HOLE
from finite_elements.varying import VARYING, modulus, reference
from skfem import BilinearForm
from skfem.helpers import ddot, sym_grad

PROBLEMS = {p.name: p for p in (BAR, CANTILEVER, HOLE, VARYING)}
TOLERANCE = 1e-6


@BilinearForm
def varying(u, v, w):
    """ν = 0: stress is the modulus times the strain."""
    return modulus(*w.x) * ddot(sym_grad(u), sym_grad(v))


def by_spsolve(K, load, basis, free):
    return spsolve(K, load)


def by_cholmod(K, load, basis, free):
    lower = sparse.tril(K).tocoo()
    rows, columns = (matrix(part.astype(np.int64)) for part in (lower.row, lower.col))
    x = matrix(load)
    cholmod.linsolve(spmatrix(matrix(lower.data), rows, columns, K.shape), x)
    return np.array(x).ravel()


def by_aggregation(K, load, basis, free):
    x, y = basis.doflocs[:, free]
    along = along_x(basis, free)
    rigid = np.column_stack([along, ~along, np.where(along, -y, x)]).astype(float)
    return solved(K, load, pyamg.smoothed_aggregation_solver(K, B=rigid).aspreconditioner())


def by_axes(K, load, basis, free):
    """Ruge and Stüben's grids of each axis by itself."""
    along = along_x(basis, free)
    parts = [np.flatnonzero(along), np.flatnonzero(~along)]
    cycles = [
        pyamg.ruge_stuben_solver(K[some][:, some].tocsr()).aspreconditioner() for some in parts
    ]

    def both(r):
        out = np.empty_like(r)
        for some, cycle in zip(parts, cycles, strict=True):
            out[some] = cycle @ r[some]
        return out

    return solved(K, load, LinearOperator(K.shape, matvec=both))


def along_x(basis, free):
    return np.isin(free, basis.get_dofs(elements=True).all("u^1"))


def solved(K, load, cycle):
    found, failed = cg(K, load, rtol=TOLERANCE, M=cycle)
    if failed:
        raise RuntimeError(f"conjugate gradients: not converged after {failed} iterations")
    return found


SOLVERS = {
    "spsolve": by_spsolve,
    "CHOLMOD": by_cholmod,
    "pyamg, aggregation": by_aggregation,
    "pyamg, Ruge-Stüben": by_axes,
}


def work(job):
    """Processor seconds of mesh and basis, of assembly, and of boundary conditions and solving."""
    problem, clock = PROBLEMS[job["problem"]], [time.process_time()]
    basis = uniform.basis_of(problem, job["element"], job["cells"])
    clock.append(time.process_time())
    K = (varying if problem is VARYING else plane_stress()).assemble(basis)
    clock.append(time.process_time())
    held, u = uniform._held(problem, basis)
    u = uniform._solved(SOLVERS[job["solver"]], basis, K, held, u)
    clock.append(time.process_time())
    if job["file"]:
        np.save(job["file"], at_sites(problem, basis, u))
    return [float(seconds) for seconds in np.diff(clock)]


def at_sites(problem, basis, u):
    known = reference() if problem is VARYING else load(problem.name)
    sites = ~np.isnan(known.u[0])
    points = np.array([known.x[sites], known.y[sites]])
    found = np.full_like(known.u, np.nan)
    found[:, sites] = values(basis, u, points, find(basis, points))
    return found


for line in sys.stdin:
    print(json.dumps(work(json.loads(line))), flush=True)
