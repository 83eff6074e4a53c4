"""Count the steps from rest to near an equilibrium, and measure their time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from finite_elements.lattices import experiment, on_grid
from finite_elements.problems import Problem
from finite_elements.timing import Seconds, best

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.engine_choice import choose, make_engine
from pbdkit.stepping.state import initial_state

FINER = 50
"""Looks lie apart by this part of the steps so far: steps are counted to 2 %."""


@dataclass(frozen=True)
class Steps:
    """`count` steps to within `share` of the displacements (relative L2) of the equilibrium, the
    factor `rate` by which the last ones made the distance smaller each, and their seconds."""

    count: int
    rate: float
    seconds: Seconds
    u: np.ndarray


def stepped(
    problem: Problem, cells: int, share: float, repeats: int = 3, memory: float = 0.0
) -> Steps:
    """Time the compiled engine on one thread, from rest, with the kernel made beforehand."""
    exact = equilibrium_state(build_scene(_experiment(problem, cells, None)))[0].u
    scene = build_scene(_experiment(problem, cells, memory))
    engine = make_engine(scene, choose(scene))[0]
    count, rate = _count(scene, engine, exact, share)
    seconds, state = best(repeats, lambda: engine.advance(initial_state(scene), count))
    rows = scene.raster.body_rows
    u = state.u.reshape(2, -1)[:, scene.raster.place_of(rows)].T
    return Steps(count, rate, seconds, on_grid(problem, cells, scene.raster.reference(rows), u))


def setting_up(problem: Problem, cells: int, memory: float, repeats: int) -> Seconds:
    """Time scene and engine, with the kernel made beforehand."""
    asked = _experiment(problem, cells, memory)

    def set_up():
        scene = build_scene(asked)
        return make_engine(scene, choose(scene))

    return best(repeats, set_up)[0]


def _experiment(problem: Problem, cells: int, memory: float | None) -> pbdkit.Experiment:
    """To be stepped with a memory, or to be taken to equilibrium."""
    asked = experiment(problem, cells)
    if memory is not None:
        solver = {"type": "stepping", "engine": "compiled", "threads": 1, "memory": memory}
        asked |= {"solver": solver, "steps": 10**9}
    return pbdkit.Experiment(**asked)


def _count(scene: Scene, engine, exact: np.ndarray, share: float) -> tuple[int, float]:
    state, size = initial_state(scene), float(np.linalg.norm(exact))
    far, rate = 1.0, math.nan
    while far > share:
        steps = max(1, state.step // FINER)
        state = engine.advance(state, steps)
        before, far = far, float(np.linalg.norm(state.u - exact)) / size
        rate = (far / before) ** (1 / steps)
    return state.step, rate
