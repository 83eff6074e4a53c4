"""A barycentre sweep of a sheet in NVIDIA warp, on the processor (one thread, as warp has it)."""

import json
import sys
import time

import numpy as np
import warp as wp

wp.config.quiet = True
wp.init()


@wp.kernel
def sweep64(u: wp.array2d(dtype=wp.vec2d), v: wp.array2d(dtype=wp.vec2d)):
    i, j = wp.tid()
    i, j = i + 1, j + 1
    v[i, j] = (u[i, j - 1] + u[i, j + 1] + u[i - 1, j] + u[i + 1, j]) * wp.float64(0.25)


@wp.kernel
def sweep32(u: wp.array2d(dtype=wp.vec2f), v: wp.array2d(dtype=wp.vec2f)):
    i, j = wp.tid()
    i, j = i + 1, j + 1
    v[i, j] = (u[i, j - 1] + u[i, j + 1] + u[i - 1, j] + u[i + 1, j]) * wp.float32(0.25)


def measure(n, kernel, dtype):
    start = np.random.default_rng(0).random((n + 2, n + 2, 2)) * 0.01
    u, v = (wp.array(start, dtype=dtype, device="cpu") for _ in range(2))
    sweeps, best = max(4, 10**7 // n**2), float("inf")
    for _ in range(6):
        begun = time.perf_counter()
        for _ in range(sweeps):
            wp.launch(kernel, dim=(n, n), inputs=[u, v], device="cpu")
            u, v = v, u
        best = min(best, time.perf_counter() - begun)
    return best / sweeps / n**2 * 1e9


size = int(sys.argv[1])
found = {
    "barycentre, float64": measure(size, sweep64, wp.vec2d),
    "barycentre, float32": measure(size, sweep32, wp.vec2f),
}
print(json.dumps(found))
