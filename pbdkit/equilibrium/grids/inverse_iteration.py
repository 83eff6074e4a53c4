"""The slowest mode of the steps, by inverse iteration: of v ← A⁻¹ v remains what fades last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbdkit.equilibrium.grids.lattice_krylov import Krylov
from pbdkit.equilibrium.grids.multigrid import Multigrid
from pbdkit.equilibrium.system import Floats, System

MOST_TURNS, TURN = 32, 3
"""Of inverse iteration on a coarser grid, and iterations in each turn."""


@dataclass(frozen=True)
class SlowMode:
    """A mode of the steps, planes, and its slowness 1 / (1 - λ), λ its eigenvalue."""

    planes: Floats
    slowness: float

    def improved(self, system: System, accuracy: float) -> SlowMode:
        """After a turn, solved to an accuracy relative to where it leads."""
        force = self.planes / np.abs(self.planes).max()
        found = system.solve(force, accuracy * self.slowness)
        return SlowMode(found, float((found * found).sum() / (found * force).sum()))


def softest(grids: Multigrid, krylov: type[Krylov]) -> tuple[Floats, float]:
    """Of K⁻¹ about the largest eigenvalue and its field on the finest grid, up to some factor: by
    inverse iteration on ever finer grids, but for the two finest."""
    mode, softness = grids.softest_field(), 1.0
    for depth in range(len(grids) - 1, 0, -1):
        solver, finer = krylov(grids, depth), grids.grid().unknowns / grids.grid(depth).unknowns
        for _ in range(min(4 ** (depth - 1) // 2, MOST_TURNS)):
            force = mode.astype(float) / np.abs(mode).max()
            mode = solver.solve(force.copy(), lambda d: len(d.jumps) >= TURN).x
            softness = finer * float((mode * mode).sum() / (mode * force).sum())
        mode = grids.finer_field(depth, mode)
    return mode.astype(float), softness
