"""What a fresh process does to measure a way to equilibrium: see worker.py."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.benching.exact import decay_of, exact_answer, followers_of
from pbdkit.equilibrium.certificate import Certificate, scale_of
from pbdkit.equilibrium.finding import UnconvergedError
from pbdkit.equilibrium.increments import settle
from pbdkit.experiment.model import Experiment
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.choice import choose, make_engine
from pbdkit.stepping.state import State, initial_state

REPEATS, PATIENCE_S = 5, 10.0
"""A way is gone so often, unless that takes longer; the fastest counts."""
LONGEST_S = 60.0
"""After a tolerance that took longer, tighter ones are left out."""
RATE_STEPS = 40
Row = dict[str, Any]


def import_solvers(*modules: str) -> None:
    """Imports are no part of what is measured."""
    for module in ("scipy.sparse.linalg", "scipy.sparse.csgraph", *modules):
        if find_spec(module.split(".")[0]):
            import_module(module)


def find_exact(experiment: Experiment, tolerances: Sequence[float], folder: Path) -> Row:
    """The exact answer, into the folder, and how many steps lead to the tolerances."""
    import_solvers("pyamg")
    scene = build_scene(experiment)
    exact = exact_answer(scene)
    np.save(folder / "exact.npy", exact.u)
    decay = decay_of(scene, exact)
    return {
        "particles": scene.raster.count,
        "how": exact.how,
        "within": exact.within,
        "rate": decay.rate,
        "steps": [decay.steps_to(tolerance) for tolerance in tolerances],
    }


def settle_to(experiments: Sequence[Experiment], reference: Path) -> list[Row]:
    """A row for each experiment: they differ in their tolerance only, the loosest first."""
    import_solvers("pyamg")
    rows: list[Row] = []
    for experiment in experiments:
        seconds, cpu, (scene, state, certificate) = _fastest(partial(_settled, experiment))
        row = {
            "iterations": certificate.inner_iterations,
            "how": certificate.method,
            "seconds": seconds,
            "cpu_s": cpu,
            "certified": certificate.share,
            "error": error_of(scene, state, reference),
        }
        rows.append(row)
        if seconds > LONGEST_S:
            break
    return rows


def _settled(experiment: Experiment) -> tuple[Scene, State, Certificate]:
    scene = build_scene(experiment)
    state = initial_state(scene)
    try:
        return scene, state, settle(scene, state)
    except UnconvergedError as error:
        return scene, state, error.certificate


def _fastest(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """(wall seconds, processor seconds, what it returned) of the fastest of some turns."""
    best, spent = (np.inf, np.inf, None), 0.0
    for _ in range(REPEATS):
        begun, cpu = time.perf_counter(), time.process_time()
        found = work()
        wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
        best, spent = min(best, (wall, cpu, found), key=itemgetter(0)), spent + wall
        if spent + wall > PATIENCE_S:
            break
    return best


def step_to(experiment: Experiment, at: Sequence[int], reference: Path) -> list[Row]:
    """Steps through, with a row at each of some numbers of steps."""
    begun, cpu = time.perf_counter(), time.process_time()
    scene = build_scene(experiment)
    state = initial_state(scene)
    built, built_cpu = time.perf_counter() - begun, time.process_time() - cpu
    engine, _ = make_engine(scene, choose(scene))
    rows: list[Row] = []
    seconds, used = built, built_cpu
    for step in at:
        begun, cpu = time.perf_counter(), time.process_time()
        state = engine.advance(state, step - state.step)
        seconds += time.perf_counter() - begun
        used += time.process_time() - cpu
        error = error_of(scene, state, reference)
        rows.append({"iterations": step, "seconds": seconds, "cpu_s": used, "error": error})
    return rows


def seconds_a_step(experiment: Experiment) -> Row:
    """The fastest of some turns, with everything in motion: the experiment starts with noise."""
    scene = build_scene(experiment)
    engine, _ = make_engine(scene, choose(scene))
    state = engine.advance(initial_state(scene), 2)

    def turn() -> None:
        nonlocal state
        state = engine.advance(state, RATE_STEPS)

    seconds, cpu, _ = _fastest(turn)
    return {"seconds": seconds / RATE_STEPS, "cpu_s": cpu / RATE_STEPS}


def error_of(scene: Scene, state: State, reference: Path) -> float | None:
    """max |u - u*| over the followers, as a share of the largest prescribed displacement; None
    where it is not finite."""
    exact = np.load(reference / "exact.npy")
    here = state.u.reshape(2, -1)[:, followers_of(scene)].astype(float)
    with np.errstate(all="ignore"):
        error = float(np.hypot(*(here - exact)).max(initial=0.0))
    return error / scale_of(scene, initial_state(scene)) if np.isfinite(error) else None
