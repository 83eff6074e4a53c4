"""How far the places of a lattice give way to loads."""

from __future__ import annotations

import numpy as np

from pbdkit.equilibrium.grids.lattice_krylov import ConjugateGradients
from pbdkit.equilibrium.grids.multigrid import Multigrid
from pbdkit.equilibrium.grids.parted_grids import PartedGrids

ENOUGH = 8
"""Iterations that tell how far a place gives way."""


def compliance(grids: Multigrid | PartedGrids) -> float:
    """How far a place gives way to a unit load at most: as on the coarsest grid, and on each finer
    one by so much more as on the first of them."""
    coarse, last = grids.whole, len(grids) - 1
    axis, place, found = coarse.softest
    if last == 0:
        return found
    depth = len(coarse) - 2
    grid, (i, j) = coarse.grid(depth), coarse.finer_place(depth + 1, place)
    b = grid.field(np.float64)
    if i >= b.shape[1] or j >= b.shape[2] or grid.code[i, j] < 0:
        return found * (last + 1)
    b[axis, i, j] = 1.0
    x = ConjugateGradients(coarse, depth).solve(b, lambda d: len(d.steps) >= ENOUGH).x
    return found + max(0.0, float(x[axis, i, j]) - found) * last
