"""The cost model: seconds a run as a function of particles, neighbours, steps and records."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from pairing import best
from scipy.optimize import nnls
from sheets import Running, moving, scene_of

from pbdkit.io.netcdf import NetcdfSink
from pbdkit.simulation import Simulation, record
from pbdkit.stepping.numpy_engine import Stepper

NEIGHBOURS = {
    4: {"type": "coordination", "shells": 1},
    8: {"type": "chebyshev", "shells": 1},
    12: {"type": "coordination", "shells": 3},
    24: {"type": "chebyshev", "shells": 2},
}
SIZES = dict.fromkeys(("compiled", "numpy"), (10, 30, 100, 300, 1000))


SECOND_CACHE, THIRD_CACHE = 2**20, 2**23
"""Displacements, old and new, of more bytes come from farther away."""
TERMS = ("step_us", "slot_us", "particle_ns", "neighbour_ns", "far_ns", "farther_ns")
UNITS = np.array([1e6, 1e6, 1e9, 1e9, 1e9, 1e9])


def cost() -> dict[str, Any]:
    """Return, for each engine, the fit with its largest and its typical deviation, and predictions
    of set-up, records and whole runs."""
    found: dict[str, Any] = {engine: _fit(engine) for engine in SIZES}
    found["setup_ns_a_particle"] = _setup()
    found["file_ms"] = _run(10, {"steps": 1})[0] * 1e3
    found["record_ns_a_particle"] = _record()
    found["foretold"] = [_predicted(found, engine, k) for engine in SIZES for k in (4, 12)]
    return found


def _terms(particles: int, neighbours: int) -> list[float]:
    """Return the terms of which the seconds of a step are a linear function."""
    far, farther = (32 * particles > cache for cache in (SECOND_CACHE, THIRD_CACHE))
    near = [1.0, neighbours, particles, particles * neighbours]
    return [*near, particles * far, particles * farther]


def _fit(engine: str) -> dict[str, Any]:
    """Fit by non-negative least squares of the relative deviations."""
    points = [(n * n, k, _step(engine, n, k)) for n in SIZES[engine] for k in (4, 8, 24)]
    rows = np.array([_terms(n, k) for n, k, _ in points])
    seconds = np.array([s for *_, s in points])
    # Against the times themselves, small and large sheets weigh alike.
    scaled = rows / seconds[:, None]
    size = scaled.max(axis=0)
    x = nnls(scaled / size, np.ones(len(points)))[0] / size
    off = np.abs(rows @ x / seconds - 1)
    return dict(zip(TERMS, (x * UNITS).tolist(), strict=True)) | {
        "typical_deviation": float(np.median(off)),
        "largest_deviation": float(off.max()),
        "points": [
            {"particles": n, "neighbours": k, "step_us": s * 1e6, "model_us": m * 1e6}
            for (n, k, s), m in zip(points, rows @ x, strict=True)
        ],
    }


def _step(engine: str, size: int, neighbours: int) -> float:
    guess = (2e-6 + 1e-9 * size**2) if engine == "compiled" else (4e-5 * 4 + 2e-8 * size**2)
    steps = max(1, int(0.05 / guess))
    parts = moving(size, neighbours=NEIGHBOURS[neighbours])
    return best(Running(parts, steps, engine=Stepper if engine == "numpy" else None)) / steps


def _setup() -> float:
    seconds = best(lambda: scene_of(moving(1000)), 3) - best(lambda: scene_of(moving(10)), 3)
    return seconds / 10**6 * 1e9


def _record() -> float:
    """Measure the cost of a record for each particle: a run that records every step, against one
    that records the last alone."""
    often, seldom = (_run(500, {"steps": 21, "record": {"every": e}})[0] for e in (1, 21))
    return (often - seldom) / 20 / 500**2 * 1e9


def _run(size: int, parts: dict[str, Any], turns: int = 7) -> tuple[float, int]:
    """Seconds of stepping and recording into a file, the particles. Kernels are there already."""
    solver = {"type": "stepping", "engine": "compiled", "threads": 1}
    scene = scene_of(moving(size, **({"solver": solver} | parts)))
    found = float("inf")
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(turns):
            sink = NetcdfSink(Path(folder) / "out.nc", replace=True)
            report = record(Simulation.of_scene(scene), sink)
            found = min(found, report.wall_s)
            assert report.outcome.status == "complete"
    return found, scene.raster.count


def _predicted(model: dict[str, Any], engine: str, neighbours: int) -> dict[str, Any]:
    size, steps, every = (600, 300, 30) if engine == "compiled" else (250, 60, 20)
    solver = {"type": "stepping", "engine": engine, "threads": 1}
    parts = {"steps": steps, "record": {"every": every}, "neighbours": NEIGHBOURS[neighbours]}
    measured, _ = _run(size, parts | {"solver": solver}, 5)
    x = np.array([model[engine][term] for term in TERMS]) / UNITS
    records = (steps // every + 1) * size**2 * model["record_ns_a_particle"] * 1e-9
    model_s = model["file_ms"] * 1e-3 + steps * float(_terms(size**2, neighbours) @ x) + records
    what = f"{engine}, {size}², {neighbours} neighbours, {steps} steps, every {every}th recorded"
    return {"run": what, "measured_s": measured, "model_s": model_s}
