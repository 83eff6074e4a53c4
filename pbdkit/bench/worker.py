"""What a fresh process does for one measurement: ``python -m pbdkit.bench.worker ANSWER``, with the
job as JSON on its input."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.api import load
from pbdkit.equilibrium.certificate import Certificate, UnconvergedError, scale_of
from pbdkit.equilibrium.grids.inverse_iteration import SlowMode
from pbdkit.equilibrium.increments import settle
from pbdkit.equilibrium.linearisation import linearised
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.results.progress import Watch
from pbdkit.runs.course import peak_memory
from pbdkit.runs.tuning import tuned
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.choice import choose, make_engine, obstacle
from pbdkit.stepping.state import State, initial_state

Floats = NDArray[np.floating[Any]]
Job = dict[str, Any]
REPEATS, PATIENCE_S = 7, 2.0
"""A way is gone so often, unless that takes longer; the best counts."""
LONGEST_S = 60.0
"""After a tolerance that took longer, tighter ones are left out."""
COMPILED = "pbdkit.stepping.compiled.compiled_stepper"
SOLVERS = ("scipy.sparse.linalg", "scipy.sparse.csgraph", "numba")
TURNS, ROUGH = 12, 1e-3
"""Of the inverse iteration for the slowest mode, and the accuracy of each."""


def main(answer: Path) -> None:
    """Does the job on the input; the result goes into the file `answer`."""
    answer.write_text(json.dumps(result_of(json.load(sys.stdin))), encoding="utf-8")


def result_of(job: Job) -> Job:
    """Does the job; what is wrong with it goes into the result."""
    try:
        return {"step": _step, "settle": _settle, "exact": _find_exact}[job["what"]](job)
    except PbdkitError as error:
        return {"fault": type(error).__name__, "message": str(error)}


def _import(*modules: str) -> int:
    """Imports are no part of what is measured; peak memory after them."""
    for module in modules:
        if find_spec(module.split(".")[0]):
            import_module(module)
    return peak_memory()


def _clock() -> Floats:
    return np.array([time.perf_counter(), time.process_time()])


def _turns(spent: list[Floats]) -> Iterator[int]:
    """Turns to go a way, until they are enough; each adds what it `spent`, (..., clock)."""
    for turn in range(REPEATS):
        yield turn
        took = [float(one[..., 0].max(initial=0.0)) for one in spent]
        if sum(took) + took[-1] > PATIENCE_S:
            break


def _step(job: Job) -> Job:
    """Set-up, and for each number of steps `at`: the seconds to there, the best of several runs;
    the largest distance from the truth in `sizes`, the largest displacements."""
    experiment, at = load(job["experiment"], settings=job["settings"]), job["at"]
    compiles = experiment.stepping.engine == "compiled" and not obstacle()
    imports = _import(*[COMPILED] * compiles)
    begun = _clock()
    scene = tuned(build_scene(experiment))
    built = _clock() - begun
    engine, _ = make_engine(scene, choose(scene))
    setup_s, _ = _clock() - begun
    runs: list[Floats] = []
    there, memory = [], imports
    for turn in _turns(runs):
        state, spent = initial_state(scene), np.zeros((len(at), 2))
        for n, step in enumerate(at):
            begun = _clock()
            state = engine.advance(state, step - state.step)
            spent[n:] += _clock() - begun
            if turn == 0:
                there.append(_compared(scene, state, Path(job["truth"])))
                memory = peak_memory()
        runs.append(spent)
    seconds, cpu = np.min(runs, axis=0).T.tolist()
    distances, sizes = np.reshape(there, (-1, 2)).T.tolist()
    found = {"particles": scene.raster.count, "built": built.tolist(), "setup_s": setup_s}
    found |= {"seconds": seconds, "cpu_s": cpu, "distances": distances, "sizes": sizes}
    return found | {"peak_memory_mib": (memory - imports) / 2**20}


def _compared(scene: Scene, state: State, truth: Path) -> tuple[float, float]:
    """(largest distance, largest displacement of the truth): of followers where the exact answer is
    known; else of what the first who comes to a step leaves for the others."""
    exact, u = truth / "exact.npy", state.u.reshape(len(state.u), -1).astype(float)
    file = exact if exact.exists() else truth / f"{state.step}.npy"
    u = _of_followers(scene, state) if file == exact else u
    if not file.exists():
        np.save(file, u)
    known = np.load(file)
    with np.errstate(all="ignore"):
        return _longest(u - known), _longest(known)


def _longest(u: Floats) -> float:
    return float(np.sqrt((u * u).sum(axis=0)).max(initial=0.0))


def _settle(job: Job) -> Job:
    """A row for each tolerance, the loosest first, until one takes too long."""
    imports, rows = _import(*SOLVERS), []
    for tolerance in job["tolerances"]:
        settings = [*job["settings"], f"solver.tolerance={tolerance:g}"]
        experiment = load(job["experiment"], settings=settings)
        runs: list[Floats] = []
        for _ in _turns(runs):
            begun = _clock()
            scene, state, certificate = _settled(experiment)
            runs.append(_clock() - begun)
        seconds, cpu_s = np.min(runs, axis=0)
        distance, _ = _compared(scene, state, Path(job["truth"]))
        told = {"steps": certificate.inner_iterations, "certified": certificate.share}
        rows.append(told | {"seconds": seconds, "cpu_s": cpu_s, "distance": distance})
        if seconds > LONGEST_S:
            break
    return {"rows": rows, "peak_memory_mib": (peak_memory() - imports) / 2**20}


def _settled(experiment: Experiment) -> tuple[Scene, State, Certificate]:
    scene = build_scene(experiment)
    state = initial_state(scene)
    try:
        return scene, state, settle(scene, state)
    except UnconvergedError as error:
        return scene, state, error.certificate


def _find_exact(job: Job) -> Job:
    """The solver's own answer, as good as it gets, for the others to be compared with, and how many
    steps lead to the tolerances."""
    _import(*SOLVERS)
    experiment = load(job["experiment"], settings=job["settings"])
    if experiment.fracture.type != "none":
        why = "speed against error is measured where no bond can break; set fracture={type: none}"
        raise experiment.located(ExperimentError(why, ("fracture",)))
    scene, state, certificate = _settled(experiment)
    exact = _of_followers(scene, state)
    np.save(Path(job["truth"]) / "exact.npy", exact)
    decay = decay_of(scene, exact)
    known = {"how": certificate.method, "within": certificate.share, "rate": decay.rate}
    steps = [decay.steps_to(tolerance) for tolerance in job["tolerances"]]
    scale = scale_of(scene, initial_state(scene))
    return known | {"particles": scene.raster.count, "scale": scale, "steps": steps}


@dataclass(frozen=True)
class Decay:
    """What is left of the way to equilibrium after n steps, as a share of the largest prescribed
    displacement: `share` · `rate`ⁿ, in the end."""

    share: float
    rate: float

    def steps_to(self, tolerance: float) -> int | None:
        """Steps until less than `tolerance` is left; None where it never is."""
        if not 0.0 < self.rate < 1.0:
            return None
        return max(1, math.ceil(math.log(max(1.0, self.share / tolerance)) / -math.log(self.rate)))


def followers_of(scene: Scene) -> NDArray[np.intp]:
    """The flat places of those who follow in the last step."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    return scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))


def _of_followers(scene: Scene, state: State) -> Floats:
    """Their displacements, (axis, follower)."""
    return state.u.reshape(len(state.u), -1)[:, followers_of(scene)].astype(float)


def decay_of(scene: Scene, exact: Floats) -> Decay:
    """Of the slowest mode that the start excites, by inverse iteration from the way that is to go
    to `exact`, (axis, follower): v ← A⁻¹ v, A = 1 - (step operator). Its share is the projection of
    that way onto it."""
    start = initial_state(scene)
    steps, resting = scene.experiment.steps, initial_state(scene)
    resting.u[...] = 0.0
    way = np.zeros_like(resting.u)
    way.reshape(len(way), -1)[:, followers_of(scene)] = exact - _of_followers(scene, start)
    if not way.any():
        return Decay(0.0, 0.0)
    system, slowest = linearised(scene, resting, steps, "auto", Watch()), SlowMode(way, 1.0)
    for _ in range(TURNS):
        slowest = slowest.improved(system, ROUGH)
    mode = slowest.planes
    along = float((way * mode).sum() / (mode * mode).sum())
    share = abs(along) * _longest(mode) / scale_of(scene, start)
    return Decay(share, 1.0 - 1.0 / slowest.slowness)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
