"""Solvers of the finite-element problems: pbdkit here, scikit-fem in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from finite_elements.errors import Reference, load, relative_l2
from finite_elements.lattices import ELASTIC, experiment, interpolated, on_grid
from finite_elements.problems import BAR, CANTILEVER, FINEST, HOLE, NU, Problem
from finite_elements.varying import VARYING, modulus, reference
from peers import python_with

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Simulation
from pbdkit.stepping.state import State

HERE = Path(__file__).parent
PROBLEMS = (BAR, CANTILEVER, HOLE, VARYING)
TOLERANCE, SETTLED = 1e-6, 1e-5
STRAIGHT, STEPPING = "pbdkit, equilibrium", "pbdkit, stepping"
OWN = (STRAIGHT, STEPPING)
ELEMENTS = {
    "scikit-fem Q1, spsolve": ("Q1", "spsolve"),
    "scikit-fem Q1, CHOLMOD": ("Q1", "CHOLMOD"),
    "scikit-fem Q1, pyamg, aggregation": ("Q1", "pyamg, aggregation"),
    "scikit-fem Q1, pyamg, Ruge-Stüben": ("Q1", "pyamg, Ruge-Stüben"),
    "scikit-fem Q2, spsolve": ("Q2", "spsolve"),
}
"""Each with its element and its solver."""
PACKAGES = ("scikit-fem", "scipy", "cvxopt", "pyamg")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class Solved(NamedTuple):
    """Processor seconds of what prepares (mesh, basis; the scene) and of the rest, and a way to the
    relative L2 error."""

    setup_s: float
    solving_s: float
    error: Callable[[], float]

    @property
    def seconds(self) -> float:
        return self.setup_s + self.solving_s


Contestant = Callable[[Problem, int], Solved]


def known(problem: Problem) -> Reference:
    return reference() if problem is VARYING else load(problem.name)


def solver_of(name: str) -> dict[str, Any]:
    if name == STRAIGHT:
        return {"type": "equilibrium", "tolerance": TOLERANCE}
    auto = {"relaxation": "auto", "memory": "auto", "settle": {"tolerance": SETTLED}}
    return {"type": "stepping", "engine": "compiled", "threads": 1} | auto


def own(name: str) -> Contestant:
    """From the dict of an experiment to the state."""

    def solve(problem: Problem, cells: int) -> Solved:
        begun = time.process_time()
        rule = ELASTIC | {"poisson_ratio": 0.0 if problem is VARYING else NU}
        parts = {"rule": rule, "solver": solver_of(name)}
        if name == STEPPING:
            parts |= {"steps": 10**7, "record": {"every": 10**7}}
        scene = build_scene(pbdkit.Experiment(**experiment(problem, cells, **parts)))
        if problem is VARYING:
            stiffen(scene, cells)
        built = time.process_time()
        state = converged(scene) if name == STEPPING else equilibrium_state(scene)[0]
        ended = time.process_time()
        return Solved(built - begun, ended - built, lambda: error_of(problem, cells, scene, state))

    return solve


def stiffen(scene: Scene, cells: int) -> None:
    """Each cell gets the modulus of its middle."""
    assert scene.cells
    share = scene.cells.share
    corner = (np.indices(share.shape[2:]).T + scene.raster.first).T
    share *= modulus(*((corner + 0.5) / cells))


def converged(scene: Scene) -> State:
    run = Simulation.of_scene(scene)
    for _ in run:
        pass
    assert run.outcome
    assert run.outcome.status == "settled", run.outcome.stop_reason
    return run.driver.state


def error_of(problem: Problem, cells: int, scene: Scene, state: State) -> float:
    """Bilinear between sites, at those of the finest reference."""
    return relative_l2(throughout(problem, cells, scene, state), known(problem))


def throughout(problem: Problem, cells: int, scene: Scene, state: State) -> Any:
    u = gridded(problem, cells, scene, state)
    step = cells // FINEST
    return u[:, ::step, ::step] if cells % FINEST == 0 else interpolated(u, cells)


def gridded(problem: Problem, cells: int, scene: Scene, state: State) -> Any:
    rows = scene.raster.body_rows
    u = state.u.reshape(2, -1)[:, scene.raster.place_of(rows)].T
    return on_grid(problem, cells, scene.raster.reference(rows), u)


@contextmanager
def contestants() -> Iterator[dict[str, Contestant]]:
    """Yield all solvers by name; those of scikit-fem only if its environment is available."""
    found = {name: own(name) for name in OWN}
    python = python_with(*PACKAGES)
    if not python:
        yield found
        return
    call = [python, str(HERE / "peers" / "finite_elements_server.py"), str(HERE.parent)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(call, text=True, env=os.environ | ONE_THREAD, **pipes) as server,
    ):
        yield found | {name: _served(server, name, Path(folder)) for name in ELEMENTS}
        assert server.stdin
        server.stdin.close()


def _served(server: Any, name: str, folder: Path) -> Contestant:
    element, solver = ELEMENTS[name]

    def solve(problem: Problem, cells: int) -> Solved:
        file = folder / f"{problem.name}-{cells}-{element}-{solver}.npy"
        job = {"problem": problem.name, "cells": cells, "element": element, "solver": solver}
        job["file"] = "" if file.exists() else str(file)
        print(json.dumps(job), file=server.stdin, flush=True)
        if not (answer := server.stdout.readline()):
            raise ChildProcessError(f"{name} ended at {problem.name}, {cells} cells")
        setup, assembly, solving = json.loads(answer)
        return Solved(setup, assembly + solving, lambda: relative_l2(np.load(file), known(problem)))

    return solve
