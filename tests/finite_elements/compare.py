"""Error against time, pbdkit and scikit-fem, in a minute or two on an idle machine:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tests/finite_elements/compare.py

Prints the tables of validation/materials.md and draws docs/pictures/finite-elements.png. All on one
thread, in one process, one after the other; imports and compiling are done before.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from finite_elements import uniform
from finite_elements.drawing import draw
from finite_elements.lattices import Solved, experiment, on_grid
from finite_elements.problems import BAR, CANTILEVER, HOLE, Problem
from finite_elements.stepping import setting_up, stepped
from finite_elements.timing import Seconds, best

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import build_scene

PICTURE = Path(__file__).parents[2] / "docs/pictures/finite-elements.png"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
REPEATS = 9
ELEMENTS = {"P1": (5, 10, 20, 40, 80), "Q1": (5, 10, 20, 40, 80), "P2": (5, 8, 10, 12, 20, 40),
            "Q2": (4, 5, 10, 20, 40)}  # fmt: skip
LATTICES = (4, 5, 8, 10, 14, 20, 28, 40, 80)
LONGEST = {"bar": 40, "cantilever": 20, "hole": 40}
"""Cells per unit length up to which steps without memory are made."""
EQUILIBRIUM, MEMORY, STEPS = "equilibrium", "steps with memory", "steps"
WANTED = (1e-3, 3e-4, 1.5e-4)


@dataclass(frozen=True)
class Point:
    """An error with the seconds of what prepares a solution (mesh and basis; the scene, the
    engine) and of finding it."""

    cells: int
    error: float
    setup: Seconds
    solving: Seconds
    note: str = ""


Curves = dict[str, list[Point]]


def curves(problem: Problem) -> Curves:
    found: Curves = {}
    for element, resolutions in ELEMENTS.items():
        rows = uniform.measure(problem, element, resolutions, REPEATS)
        found[element] = [
            Point(r.resolution, r.error, Seconds(r.setup_s, r.setup_processor_s),
                  Seconds(r.assembly_s + r.solve_s, r.processor_s), r.solver)
            for r in rows
        ]  # fmt: skip
    found[EQUILIBRIUM] = [_equilibrium(problem, n) for n in LATTICES]
    errors = {p.cells: p.error for p in found[EQUILIBRIUM]}
    rate = stepped(problem, 5, errors[5] / 10).rate
    for name in (STEPS, MEMORY):
        found[name] = [
            _stepping(problem, n, errors[n], _memory(rate, n) if name == MEMORY else 0.0)
            for n in LATTICES
            if name == MEMORY or n <= LONGEST[problem.name]
        ]
    return found


def _memory(rate: float, cells: int) -> float:
    """The best against the slowest mode, which steps of 5 cells per unit length shrink by `rate`:
    what it lacks to 1 goes with the square of the spacing."""
    return float((1 - np.sqrt((1 - rate) * (5 / cells) ** 2)) ** 2)


def _equilibrium(problem: Problem, cells: int) -> Point:
    asked = pbdkit.Experiment(**experiment(problem, cells))
    setup, scene = best(REPEATS, lambda: build_scene(asked))
    solving, (state, error_bound) = best(REPEATS, lambda: equilibrium_state(scene))
    rows = scene.raster.body_rows
    u = state.u.reshape(2, -1)[:, scene.raster.place_of(rows)].T
    u = on_grid(problem, cells, scene.raster.reference(rows), u)
    error = Solved(problem, cells, u, np.nan).throughout
    return Point(cells, error, setup, solving, error_bound.method)


def _stepping(problem: Problem, cells: int, error: float, memory: float) -> Point:
    steps = stepped(problem, cells, error / 10, REPEATS, memory)
    found = Solved(problem, cells, steps.u, np.nan).throughout
    setup = setting_up(problem, cells, memory, REPEATS)
    return Point(cells, found, setup, steps.seconds, f"{steps.count} steps, b = {memory:.4f}")


def seconds_at(points: list[Point], error: float, *, setup: bool, clock: str = "wall") -> float:
    """Between two measurements as a power law has it; that of the coarsest where it is better, NaN
    where the finest is worse."""
    times = [getattr(p.solving, clock) + setup * getattr(p.setup, clock) for p in points]
    if points[0].error <= error:
        return float(times[0])
    for (rough, before), (fine, after) in pairwise(zip(points, times, strict=True)):
        if rough.error >= error >= fine.error:
            share = np.log(rough.error / error) / np.log(rough.error / fine.error)
            return float(before ** (1 - share) * after**share)
    return np.nan


def print_row(name: str, found: Curves) -> None:
    for kind, points in found.items():
        for p in points:
            print(
                f"{name:10} {kind:18} {p.cells:3} error {p.error:.2e}, set-up "
                f"{p.setup.processor * 1e3:.2f} ms, solve {p.solving.processor * 1e3:.2f} ms of "
                f"processor, {p.setup.wall * 1e3:.2f} and {p.solving.wall * 1e3:.2f} ms of wall "
                f"time ({p.note})"
            )
    for clock in ("wall", "processor"):
        for error in WANTED:
            cells = [name, f"{error:.1e}"]
            for setup in (False, True):
                times = {e: seconds_at(found[e], error, setup=setup, clock=clock) for e in ELEMENTS}
                first = min(times, key=lambda e: np.nan_to_num(times[e], nan=np.inf))
                cells.append(f"{times[first] * 1e3:.3g} ({first})")
            for kind in (EQUILIBRIUM, MEMORY, STEPS):
                for setup in (False, True):
                    time = seconds_at(found[kind], error, setup=setup, clock=clock)
                    cells.append(f"{time * 1e3:.3g}")
            print(f"{clock}: | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    if any(os.environ.get(name) != "1" for name in THREADS):
        raise SystemExit(f"set {' and '.join(THREADS)} to 1: both sides work on one thread")
    found = {}
    for problem in (BAR, CANTILEVER, HOLE):
        found[problem.name] = curves(problem)
        print_row(problem.name, found[problem.name])
    draw(PICTURE, found, tuple(ELEMENTS))


if __name__ == "__main__":
    main()
