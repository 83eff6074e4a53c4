"""The GPU engine on large sheets in motion, against copying on the device."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from sheets import FRACTURE, Running, moving

from pbdkit.stepping.engine_choice import missing_for_gpu

SIZE, FEW, MANY, TURNS = 3000, 100, 1100, 5


def gpu() -> list[dict[str, Any]] | None:
    """Return None, after a message, if there is no device to measure."""
    if missing := missing_for_gpu():
        print(f"gpu: not measured: {missing}")
        return None
    from numba import cuda

    from pbdkit.stepping.cuda_engine import GpuStepper

    u, v = (cuda.to_device(np.zeros((2, SIZE, SIZE))) for _ in range(2))
    copying = _best(_copies(u, v, MANY)) - _best(_copies(u, v, FEW))
    found = [_row("copying on the device", "float64", copying)]
    for precision in ("float64", "float32"):
        solver = {"type": "stepping", "precision": precision}
        for name, parts in (("barycentre", {}), ("barycentre with fracture", FRACTURE)):
            sheet = moving(SIZE, **parts, solver=solver)
            few, many = (Running(sheet, steps, engine=GpuStepper) for steps in (FEW, MANY))
            found.append(_row(name, precision, _best(many) - _best(few)))
    return found


def _row(what: str, precision: str, seconds: float) -> dict[str, Any]:
    ps = seconds * 1e12 / (MANY - FEW) / SIZE**2
    return {"what": what, "precision": precision, "size": SIZE, "ps": ps}


def _copies(u: Any, v: Any, times: int) -> Callable[[], None]:
    from numba import cuda

    def copy() -> None:
        for _ in range(times):
            v.copy_to_device(u)
        cuda.synchronize()

    return copy


def _best(call: Callable[[], None]) -> float:
    """Seconds, after a warm-up: what is sent and fetched once a call goes with the difference of
    two."""
    call()
    seconds = []
    for _ in range(TURNS):
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    return min(seconds)
