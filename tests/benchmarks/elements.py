"""Error against the true solution over time: pbdkit and scikit-fem on the finite-element problems.

Contestants take turns, set-up included, one thread; the best of their turns counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from contestants import (
    OWN,
    PROBLEMS,
    STRAIGHT,
    Contestant,
    Solved,
    contestants,
    gridded,
    solver_of,
)
from finite_elements.errors import load, relative_l2
from finite_elements.lattices import experiment, interpolated
from finite_elements.problems import BAR, CANTILEVER, FINEST, Problem
from threadpoolctl import threadpool_limits

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.scene.scene import build_scene

CELLS = (10, 20, 40, 80, 160, 320, 640)
TURNS, ENOUGH_S = 7, 2.0
"""Number of turns, and seconds after which there are fewer; the first contestant of pbdkit may
compile, so that it has two."""
PATIENCE_S, GROWTH = 15.0, 6.0
"""Contestants that would take longer at the next size, predicted by their growth, are left out."""
WANTED = {1e-3: 4.0, 2e-4: 10.0}
"""Errors, and by how many times pbdkit is to be faster there."""


@dataclass
class Row:
    """A contestant at a size: the best processor seconds of all turns; with a `reason` it was left
    out."""

    problem: str
    contestant: str
    cells: int
    error: float = math.nan
    setup_s: float = math.nan
    solving_s: float = math.nan
    reason: str = ""

    @property
    def seconds(self) -> float:
        return self.setup_s + self.solving_s


def elements() -> dict[str, Any]:
    """Measure all rows, times to errors against goals, and errors against goals."""
    with threadpool_limits(1), contestants() as found:
        rows = [row for problem in PROBLEMS for row in _of_problem(problem, found)]
        goals = [goal for problem in PROBLEMS[:3] for goal in _times(problem, rows)]
        return {"rows": [asdict(row) for row in rows], "times": goals, "errors": _errors()}


def _of_problem(problem: Problem, found: dict[str, Contestant]) -> Iterator[Row]:
    for solve in found.values():  # what is loaded and compiled once is not measured
        solve(problem, CELLS[0])
    out: dict[str, str] = {}
    for cells in CELLS:
        taking = {name: solve for name, solve in found.items() if name not in out}
        for name, turns in _in_turns(taking, problem, cells).items():
            row = Row(problem.name, name, cells)
            if isinstance(turns, Exception):
                out[name] = row.reason = f"{type(turns).__name__}: {turns}"
            else:
                best = min(turns, key=lambda one: one.seconds)
                row.error, row.setup_s, row.solving_s = best.error(), best.setup_s, best.solving_s
                if GROWTH * best.seconds > PATIENCE_S:
                    out[name] = f"would take over {PATIENCE_S:.0f} s"
            told = row.reason or f"{row.seconds:.4g} s, error {row.error:.3g}"
            print(f"{problem.name} {cells} {name}: {told}", flush=True)
            yield row
        for name, reason in out.items():
            if name not in taking:
                yield Row(problem.name, name, cells, reason=reason)


def _in_turns(
    found: dict[str, Contestant], problem: Problem, cells: int
) -> dict[str, list[Solved] | Exception]:
    done: dict[str, Any] = {name: [] for name in found}
    for _ in range(TURNS):
        for name, solve in found.items():
            if isinstance(done[name], Exception) or _is_enough(name, done[name]):
                continue
            try:
                done[name].append(solve(problem, cells))
            except (pbdkit.PbdkitError, AssertionError, MemoryError) as error:
                done[name] = error
    return done


def _is_enough(name: str, done: list[Solved]) -> bool:
    return len(done) > (name in OWN) and sum(one.seconds for one in done) > ENOUGH_S


def _times(problem: Problem, rows: list[Row]) -> Iterator[dict[str, Any]]:
    """To each error wanted: pbdkit's best, scene and all, against the best of assembly and
    solution of scikit-fem's."""
    for error, goal in WANTED.items():
        times: dict[str, float] = {}
        for name in dict.fromkeys(row.contestant for row in rows):
            own = [r for r in rows if (r.problem, r.contestant) == (problem.name, name)]
            times[name] = _seconds_at([r for r in own if not r.reason], error, name in OWN)
        ours, theirs = (_first(times, lambda n, o=o: (n in OWN) == o) for o in (True, False))
        yield {
            "problem": problem.name, "error": error, "goal": goal,
            "own": ours, "own_s": times[ours], "other": theirs, "other_s": times[theirs],
            "factor": times[theirs] / times[ours],
        }  # fmt: skip


def _first(times: dict[str, float], counts: Any) -> str:
    some = {name: np.nan_to_num(t, nan=np.inf) for name, t in times.items() if counts(name)}
    return min(some, key=some.__getitem__)


def _seconds_at(rows: list[Row], error: float, setup: bool) -> float:
    """Between two sizes as a power law has it; that of the coarsest where it is better, NaN where
    the finest is worse."""
    times = [row.seconds if setup else row.solving_s for row in rows]
    if rows and rows[0].error <= error:
        return times[0]
    for (rough, before), (fine, after) in pairwise(zip(rows, times, strict=True)):
        if rough.error >= error >= fine.error:
            share = math.log(rough.error / error) / math.log(rough.error / fine.error)
            return before ** (1 - share) * after**share
    return math.nan


def _errors() -> list[dict[str, Any]]:
    """Errors of equilibria against what they were when the goal was set, to as many digits."""
    wanted = [
        (BAR, 40, "at sites", "2.004e-4"),
        (CANTILEVER, 20, "deflection throughout", "1.505e-4"),
        (CANTILEVER, 40, "deflection throughout", "6.97e-5"),
    ]
    return [
        {"problem": p.name, "cells": n, "measure": what, "goal": goal, "error": _error(p, n, what)}
        for p, n, what, goal in wanted
    ]


def _error(problem: Problem, cells: int, measure: str) -> float:
    solver = solver_of(STRAIGHT) | {"tolerance": 1e-10}
    scene = build_scene(pbdkit.Experiment(**experiment(problem, cells, solver=solver)))
    u = gridded(problem, cells, scene, equilibrium_state(scene)[0])
    if measure == "at sites":
        return relative_l2(u, load(problem.name, cells))
    exact, u = load(problem.name, FINEST), interpolated(u, cells)
    away, along = (np.arange(2) == k for k in (1 - problem.pulled, problem.pulled))
    u[away] = exact.u[away]
    share = np.sqrt(
        np.nansum(exact.weights * exact.u**2) / np.nansum(exact.weights * exact.u[along] ** 2)
    )
    return float(relative_l2(u, exact) * share)
