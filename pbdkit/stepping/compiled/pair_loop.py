"""Followers whose neighbours are found anew at every step: a compiled sweep over their list."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.scene.declarations import particle_numbers
from pbdkit.scene.raster import positions
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import rule_arrays
from pbdkit.stepping.compiled.emitter import write_tuples
from pbdkit.stepping.compiled.levels import levels_of, load_blamed, sample_values
from pbdkit.stepping.compiled.particle import contributions, named_tuples, target_lines
from pbdkit.stepping.compiled.plan import Function, Level, Plan
from pbdkit.stepping.followers import Followers
from pbdkit.stepping.moving_neighbours import GatheringFollowers
from pbdkit.stepping.state import Floats, State

PAIRS = ("begin", "other", "rests", "place", "body", "local", "solver")
"""By body particle its first pair, by pair the row of the neighbour and the rest offset; by row of
the table place and X from site (0, 0); the rows of the body."""


class PairFollowers(Followers):
    """Moves the followers of a scene in which neighbours come and go."""

    def __init__(self, scene: Scene, threads: int) -> None:
        near = scene.experiment.neighbours.nearness()
        assert near
        self._finder, self._chunks = GatheringFollowers(scene, near), 4 * threads
        raster, self._axes = scene.raster, scene.axes
        everybody = np.arange(raster.count)
        (level,) = levels_of(scene)
        self._plan = Plan(scene, (level,), (), threads > 1)
        self._arrays = rule_arrays(scene, [level]) | {
            "place": raster.place_of(everybody),
            "body": raster.body_rows,
            "local": np.stack(positions(raster.lattice.cell(), *raster.cells_of(everybody))),
        }
        source, self._names = _write_kernel(self._plan, level)
        shape = (1,) * (scene.axes + 1)
        u = np.zeros((scene.axes, *shape), scene.experiment.stepping.precision)
        own = sample_values(scene, particle_numbers(scene.experiment), shape)
        state = State(0, u, u, None, None, (), (), own)
        none = np.zeros(0, np.intp)
        given = self._given(u, u, state, none, none, np.zeros((scene.axes, 0)))
        self._run = load_blamed((level,), source, (given, 0, 0, self._chunks))

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Neighbours in the order in which the numpy engine sums them."""
        u = m.reshape(len(m), -1)[:, self._arrays["place"]]
        j, other, rest = self._finder.pairs(self._arrays["local"] + u)
        count = len(self._arrays["body"])
        begin = np.searchsorted(j, np.append(self._arrays["body"], len(u[0])))
        given = self._given(m, new, state, begin, other, rest)
        self._run(given, 0, count, self._chunks)

    def _given(
        self, m: Floats, new: Floats, state: State, begin: Any, other: Any, rest: Floats
    ) -> tuple[Any, ...]:
        planes = (("u", m), ("v", new))
        arrays = self._arrays | {
            f"{name}_{c}": plane.reshape(-1)
            for name, each in planes
            for c, plane in zip(self._plan.axes, each, strict=True)
        }
        arrays |= {"begin": begin, "other": other, "rests": np.ascontiguousarray(rest)}
        arrays |= {f"own{n}": value.reshape(-1) for n, value in enumerate(state.particle_values)}
        return tuple(arrays[name] for name in self._names)


def _write_kernel(plan: Plan, level: Level) -> tuple[str, list[str]]:
    """A module with ``run(given, first, last, chunks)`` for the particles of the body from `first`
    to `last`, and the names of the arrays that it is given."""
    shared = [name for name in plan.shared if name not in PAIRS] + list(PAIRS)
    sweep = Function(shared, "sweep", "first_body", "last_body")
    sums = range(sum(level.parts))
    sweep.add(0, *named_tuples(plan, level))
    for c in plan.axes:
        sweep.add(0, f"o{c} = v_{c}")
    sweep.add(0, *(f"a{n} = own{n}" for n in range(len(level.seen.own))))
    sweep.add(
        0, "for e in range(first_body, last_body):", "    row = body[e]", "    j = place[row]"
    )
    sweep.add(1, f"u = {plan.vector(f'u_{c}[j]' for c in plan.axes)}")
    sweep.add(1, *(f"t{n} = double(0.0)" for n in sums))
    sweep.add(1, "for n in range(begin[e], begin[e + 1]):", "    there = place[other[n]]")
    sweep.add(2, f"d = {plan.vector(f'u_{c}[there] - u.{c}' for c in plan.axes)}")
    sweep.add(2, f"r = {plan.vector(f'rests[{a}, n]' for a in range(len(plan.axes)))}")
    sweep.add(2, f"{contributions(level)}, = gather0(d, r, Weights0(), p)")
    sweep.add(2, *(f"t{n} = t{n} + c{n}" for n in sums))
    sweep.add(1, "moves = begin[e + 1] > begin[e]")
    local = [f"local[{a}, row]" for a in range(len(plan.axes))]
    sweep.add(1, *target_lines(plan, level, local, [f"t{n}" for n in sums], "moves"))
    run = Function(shared, "run", "given", "first_body", "last_body", "chunks")
    run.add(0, f"for c in {'prange' if plan.parallel else 'range'}(chunks):")
    span = (f"first_body + (last_body - first_body) * {c} // chunks" for c in ("c", "(c + 1)"))
    run.add(1, sweep.call(*span))
    head = [
        f'@njit(parallel={plan.parallel}, error_model="numpy", nogil=True, cache=KEPT)',
        f"def run({', '.join(run.own)}):",
        f"    {', '.join(run.used)}, = given",
    ]
    lines = [*write_tuples(plan), *sweep.source, "", "", *head]
    return "\n".join([*lines, *("    " + line for line in run.lines)]) + "\n", run.used
