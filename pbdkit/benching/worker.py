"""What a fresh process does for one measurement: ``python -m pbdkit.benching.worker FOLDER``.

The folder holds `job.json` and gets `result.json`; a run leaves its displacements there too.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.api import load
from pbdkit.benching import equilibrium_worker
from pbdkit.errors import PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.choice import choose, make_engine
from pbdkit.stepping.engine import Engine
from pbdkit.stepping.state import initial_state

REPEATS, PATIENCE_S = 7, 2.0
"""A run is repeated so often, unless that takes longer; the best counts."""
LOOKS = 4
"""At so many steps, evenly spread and the last among them, displacements are kept."""


def main(folder: Path) -> None:
    """Does the job; what is wrong with it goes into the result."""
    job = json.loads((folder / "job.json").read_text("utf-8"))
    try:
        result = _do(job, folder)
    except PbdkitError as error:
        result = {"fault": type(error).__name__, "message": str(error)}
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")


def _do(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    if "reference" in job:
        return _do_equilibrium(job, folder)
    experiment = load(job["experiment"], settings=job["settings"])
    if job["what"] == "imports":
        _import_engine(experiment)
        return {"peak_memory": peak_memory()}
    begun = time.perf_counter()
    scene = build_scene(experiment)
    engine, _ = make_engine(scene, choose(scene))
    result: dict[str, Any] = {"setup_s": time.perf_counter() - begun}
    if job["what"] == "run":
        best = _first_run(scene, engine, folder)
        result["peak_memory"] = peak_memory()
        result["best_s"] = _best(scene, engine, best)
        result["particles"] = scene.raster.count
    return result


def _do_equilibrium(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The jobs of equilibria.py."""
    settings, reference = job["settings"], Path(job["reference"])
    experiment = load(job["experiment"], settings=settings)
    if job["what"] == "exact":
        return equilibrium_worker.find_exact(experiment, job["tolerances"], folder)
    if job["what"] == "rate":
        return equilibrium_worker.seconds_a_step(experiment)
    if job["what"] == "step":
        return {"rows": equilibrium_worker.step_to(experiment, job["at"], reference)}
    each = (f"solver.tolerance={tolerance:g}" for tolerance in job["tolerances"])
    experiments = [load(job["experiment"], settings=(*settings, one)) for one in each]
    equilibrium_worker.import_solvers("pyamg")
    imports = peak_memory()
    rows = equilibrium_worker.settle_to(experiments, reference)
    return {"rows": rows, "peak_memory_mib": max(0, peak_memory() - imports) / 2**20}


def _import_engine(experiment: Experiment) -> None:
    if experiment.stepping.engine == "compiled":
        import_module("pbdkit.stepping.compiled.compiled_stepper")


def _first_run(scene: Scene, engine: Engine, folder: Path) -> float:
    """Steps through, keeps displacements, and returns the seconds that the steps took."""
    state, seconds = initial_state(scene), 0.0
    for step in looks(scene.experiment.steps):
        begun = time.perf_counter()
        state = engine.advance(state, step - state.step)
        seconds += time.perf_counter() - begun
        np.save(folder / f"{step}.npy", state.u)
    return seconds


def _best(scene: Scene, engine: Engine, best: float) -> float:
    spent = 0.0
    for _ in range(REPEATS - 1):
        if spent + best > PATIENCE_S:
            break
        state = initial_state(scene)
        begun = time.perf_counter()
        engine.advance(state, scene.experiment.steps)
        seconds = time.perf_counter() - begun
        best, spent = min(best, seconds), spent + seconds
    return best


def looks(steps: int) -> list[int]:
    """The steps at which displacements are compared."""
    return sorted({max(1, steps * n // LOOKS) for n in range(1, LOOKS + 1)})


def peak_memory() -> int:
    """Bytes at most resident in this process.

    Linux counts what the process that started this one had resident into ru_maxrss, so the
    figure of this program's own memory is taken where there is one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    from resource import RUSAGE_SELF, getrusage

    return getrusage(RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
