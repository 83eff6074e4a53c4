"""Followers whose neighbours are found anew at every step: a compiled sweep over their list."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import Arrays, rule_arrays, state_arrays
from pbdkit.stepping.compiled.emitter import write_module, write_pass
from pbdkit.stepping.compiled.levels import levels_of, load_blamed
from pbdkit.stepping.compiled.particle import contributions, difference, parameters, target_lines
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.followers import Followers, GatheringFollowers
from pbdkit.stepping.state import Floats, State, unmoved_state


class PairFollowers(Followers):
    """Moves the followers of a scene in which neighbours come and go."""

    def __init__(self, scene: Scene, threads: int) -> None:
        self._finder = finder = GatheringFollowers(scene)
        self._chunks = 4 * threads
        self._plan = Plan(scene, levels_of(scene), threads > 1)
        self._arrays = rule_arrays(self._plan) | {
            "place": finder.place,
            "body": finder.body,
            "local": finder.X,
        }
        start, none = unmoved_state(scene, (1,) * scene.axes), np.zeros(0, np.intp)
        pairs = {"first_pair": none, "partner": none, "rests": np.zeros((scene.axes, 0))}
        arrays = self._named(start.u, start.previous, start, **pairs)
        source, self._names = _write_kernel(replace(self._plan, shared=tuple(arrays)))
        arguments = tuple(arrays[name] for name in self._names), 0, 0, self._chunks
        self._run = load_blamed(self._plan.levels, source, arguments)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Neighbours in the order in which the numpy engine sums them."""
        j, other, rest = self._finder.pairs(m)
        first = np.searchsorted(j, np.append(self._finder.body, len(self._finder.place)))
        rest = np.ascontiguousarray(rest)
        arrays = self._named(m, new, state, first_pair=first, partner=other, rests=rest)
        given = tuple(arrays[name] for name in self._names)
        self._run(given, 0, len(self._finder.body), self._chunks)

    def _named(self, m: Floats, new: Floats, state: State, **pairs: Any) -> Arrays:
        """By name the arrays of the kernel: `first_pair` is by particle of the body, `partner` and
        `rests` by pair, `place` and `local` by row of the table."""
        was = {f"was{n}": state.particle_values[n].copy() for n in self._plan.kept}
        return self._arrays | state_arrays(self._plan, m, new, state) | was | pairs


def _write_kernel(plan: Plan) -> tuple[str, list[str]]:
    """A module with ``run(given, first, last, chunks)`` for the particles of the body from `first`
    to `last`, and the names of the arrays that it is given."""
    (level,) = plan.levels
    sweep = Function(plan.shared, "sweep", "first_body", "last_body")
    sweep.add(0, *parameters(plan, level), *plan.each("o@ = flat_v_@"))
    sweep.add(0, *(f"a{n} = w{n} = flat_own{n}" for n in range(len(level.seen.own))))
    sweep.add(0, "for e in range(first_body, last_body):")
    sweep.add(1, "row = body[e]", "j = place[row]", f"u = {plan.vector('flat_u_@[j]')}")
    sweep.add(1, *(f"{t} = double(0.0)" for t in level.totals))
    sweep.add(1, "for n in range(first_pair[e], first_pair[e + 1]):")
    sweep.add(2, "there = place[partner[n]]", difference(plan, level, "flat_u_@[there]"))
    shown = [f"flat_{array}[there]" for array in plan.shown]
    sweep.add(2, f"r = {plan.vector('rests[#, n]')}")
    sweep.add(2, contributions(plan, level, "r", "", shown))
    sweep.add(2, *(f"{t} = {t} + c{n}" for n, t in enumerate(level.totals)))
    sweep.add(1, "moves = first_pair[e + 1] > first_pair[e]")
    sweep.add(1, *target_lines(plan, level, plan.each("local[#, row]"), level.totals, "moves"))
    run = Function(plan.shared, "run", "given", "first_body", "last_body", "chunks")
    write_pass(run, plan, 0, sweep, "first_body", "last_body")
    return write_module(plan, [sweep], run)
