"""What to measure against: a barycentre sweep written by hand, and the memory's own speed."""

from __future__ import annotations

import numba
import numpy as np
from pairing import best


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
    """A call makes so many sweeps of size² particles. The loop over steps is Python's: inside the
    compiled function it made the sweeps slower, and a call costs a thousandth of a sweep."""
    ux, uy, vx, vy = np.random.default_rng(0).random((4, size + 2, size + 2)) * 0.01

    def work():
        for n in range(steps):
            sweep(*((vx, vy, ux, uy) if n % 2 else (ux, uy, vx, vy)))

    return work


def copy_ns(size: int) -> float:
    """ns to read 16 bytes and write 16, as every particle and step must, by plain copying."""
    u, v = np.random.default_rng(0).random((2, 2, size, size))
    times = max(2, 10**7 // size**2)

    def copying():
        for n in range(times):
            np.copyto(*((u, v) if n % 2 else (v, u)))

    return best(copying, 9) / times / size**2 * 1e9
