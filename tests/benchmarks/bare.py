"""Baselines for measurements: a barycentre sweep written by hand, and the speed of the memory."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np


@numba.njit(error_model="numpy")
def sweep(ux, uy, vx, vy):
    """Means of four neighbours on padded planes, and nothing else."""
    rows, columns = ux.shape
    for i in range(1, rows - 1):
        a, b, c = ux[i, : columns - 2], ux[i, 2:], ux[i - 1, 1 : columns - 1]
        d, o = ux[i + 1, 1 : columns - 1], vx[i, 1 : columns - 1]
        a2, b2, c2 = uy[i, : columns - 2], uy[i, 2:], uy[i - 1, 1 : columns - 1]
        d2, o2 = uy[i + 1, 1 : columns - 1], vy[i, 1 : columns - 1]
        for j in range(columns - 2):
            o[j] = (a[j] + b[j] + c[j] + d[j]) * 0.25
            o2[j] = (a2[j] + b2[j] + c2[j] + d2[j]) * 0.25


def sweeping(size: int, steps: int):
    """Make `steps` sweeps of size² particles in a call. The loop over steps is Python's: inside the
    compiled function it made the sweeps slower, and a call costs a thousandth of a sweep."""
    ux, uy, vx, vy = np.random.default_rng(0).random((4, size + 2, size + 2)) * 0.01

    def work():
        for n in range(steps):
            sweep(*((vx, vy, ux, uy) if n % 2 else (ux, uy, vx, vy)))

    return work


class Copying:
    """Copying of 16 bytes read and 16 written for each of size² particles, once for each step, on
    one thread or two. Every step must do this."""

    def __init__(self, size: int, times: int, threads: int = 1):
        self.planes = np.random.default_rng(0).random((2, 2, size, size))
        self.times, self.pool = times, ThreadPoolExecutor(2) if threads == 2 else None

    def __call__(self) -> None:
        for n in range(self.times):
            to, of = self.planes if n % 2 else self.planes[::-1]
            if self.pool:  # numpy copies without holding the interpreter
                list(self.pool.map(np.copyto, to, of))
            else:
                np.copyto(to, of)
