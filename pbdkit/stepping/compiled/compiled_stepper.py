"""The compiled engine: whole intervals of steps in one call, on what the motion has reached."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numba
import numpy as np

from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.clamps import Clamps
from pbdkit.stepping.compiled.arguments import (
    Arrays,
    bits_for,
    changing_arrays,
    constant_arrays,
    lost_bits,
    renew_lost_bits,
    state_arrays,
)
from pbdkit.stepping.compiled.bands import banded, goes_deep, pass_arrays
from pbdkit.stepping.compiled.emitter import write_kernel
from pbdkit.stepping.compiled.leading import foreseen, leading_arrays
from pbdkit.stepping.compiled.levels import levels_of, load_blamed
from pbdkit.stepping.compiled.obstacle_pass import wall_arrays
from pbdkit.stepping.compiled.pair_loop import PairFollowers
from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.compiled.reach import Reach
from pbdkit.stepping.compiled.stretches import find_runs
from pbdkit.stepping.compiled.tearing import renew_torn_marks, torn_marks
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.cutting import cut_bonds
from pbdkit.stepping.guidance import Guidance
from pbdkit.stepping.newton_forces import NewtonForces
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.prescription import Led, prescribe, steady_steps
from pbdkit.stepping.state import Floats, State, unmoved_state

BAND = 16384
"""Places that bonds are judged on before they are swept, on one thread: what they take stays in the
cache. On more threads starting them counts too."""


class CompiledStepper(Engine):
    """Steps a scene with a kernel made for it.

    Lost bonds are one bit a bond and end, made anew from a state that did not come from here; all
    else of the state is the same arrays that the numpy engine uses. Where neighbours are found anew
    at every step, the kernel sweeps over their list.
    """

    name = "compiled"

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self.threads = min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
        self._scene = scene
        self._pairs: Stepper | None = None
        if scene.experiment.neighbours.nearness():
            self._pairs = Stepper(scene, PairFollowers(scene, self.threads))
            return
        self._last: State | None = None
        self._numbered = scene
        """With the numbers that the arrays hold."""
        self._guidance, self._newton = Guidance(scene), NewtonForces(scene)
        self._contact = contact = Contact(scene) if scene.barriers else None
        levels = levels_of(scene)
        self._reach = Reach(levels)
        self._plan = plan = Plan(scene, levels, self.threads > 1)
        runs, starts, groups = find_runs(scene, plan.long)
        self._arrays = constant_arrays(plan) | {"runs": runs, "starts": starts}
        self._deep = goes_deep(plan)
        """Whether several steps may go in a pass."""
        self._arrays |= pass_arrays(plan, self.threads) if self._deep else {}
        if contact and contact.compliance is not None:
            self._arrays["compliance"] = contact.compliance
        start = unmoved_state(scene, (1,) * scene.axes)
        inner = [name for n in range(len(levels) - 1) for name in plan.each(f"z{n}_@")]
        self._moves = np.zeros((len(inner), *scene.raster.shape), start.u.dtype)
        self._arrays |= dict(zip(inner, self._moves, strict=True))
        self._clamps, self._clamped = Clamps(scene), np.zeros(0, np.intp)
        own = start.particle_values
        self._arrays |= {f"was{m}": np.zeros(scene.raster.shape, own[m].dtype) for m in plan.kept}
        if plan.judged:
            self._arrays["lost"] = np.zeros(start.u.shape[1:], bits_for(scene))
        if plan.tears:
            self._arrays["torn"] = np.zeros(start.u.shape[1:], np.uint8)
        shared = (*plan.shared, *self._named(start, [[]]))
        source, self._names = write_kernel(replace(plan, shared=shared), groups)
        # No step is made, so that what does not compile is known before the first.
        self._run = load_blamed(levels, source, self._given(start, [[]], 0))

    def advance(self, state: State, steps: int = 1) -> State:
        """As many steps a call as the leaders stay where they are."""
        if self._pairs:
            return self._pairs.advance(state, steps)
        if state is not self._last:
            self._begin(state)
        end = state.step + steps
        while state.step < end:
            state = self._some_steps(state, end)
        self._last = state
        return state

    def renewed(self, state: State, rows: slice) -> None:
        """Lost bonds are bits here, and what has moved is in a box."""
        if self._pairs is None and state is self._last:
            if self._plan.judged:
                renew_lost_bits(self._arrays["lost"], self._scene, state, rows)
            if self._plan.tears:
                renew_torn_marks(self._arrays["torn"], self._scene, state, rows)
            self._reach.take_in(state, rows)

    def _begin(self, state: State) -> None:
        self._moves[...] = 0.0
        if self._plan.judged:
            self._arrays["lost"] = lost_bits(self._scene, state)
        if self._plan.tears:
            self._arrays["torn"] = torn_marks(self._scene, state)
        self._reach.begin(state)

    def _some_steps(self, state: State, end: int) -> State:
        step = state.step + 1
        if cut_bonds(self._scene, state.broken_step, step):
            self._begin(state)
        self._renumber(self._scene.at(step))
        led, starts = prescribe(self._scene, state, step, self._newton)
        self._clamped = self._clamps.turn(state, step)
        load = self._load(state)
        steady = steady_steps(self._scene, step, end - state.step)
        ways = [led]
        if steady == 1:
            begun = replace(state, starts=starts)
            ways += foreseen(self._scene, begun, led, end, self._clamps.turning)
        placed = [each for way in ways for each in way]
        if self._contact:
            for later in range(step, step + len(ways)):
                self._reach.touch(self._contact.touched_at_rest(later))
        count = self._reach.before(placed, load, max(steady, len(ways)))
        with blaming(self._scene.experiment.rule, f"at step {step}"):
            self._run(*self._given(state, ways, count))
        u, new = state.u, state.previous
        now, before = (new, u) if count % 2 else (u, new)
        self._reach.after(now, before)
        return replace(state, step=state.step + count, u=now, previous=before, starts=starts)

    def _renumber(self, scene: Scene) -> None:
        if scene is not self._numbered:
            self._arrays |= changing_arrays(self._plan.renumbered(scene))
            self._numbered = scene

    def _named(self, state: State, ways: list[Led]) -> Arrays:
        """The arrays of a kernel that steps in those of the state, by name."""
        slants = self._guidance.slants(state.step + 1) if ways[0] and self._guidance.slanted else {}
        leaders = leading_arrays(self._plan, ways, slants, state.u.dtype, self._deep)
        reached = {"box": self._reach.box, "growth": self._reach.growth}
        if self._plan.rotations:
            reached |= self._clamped_arrays()
        moved = state_arrays(self._plan, state.u, state.previous, state)
        load = self._load(state)
        loads = {} if load is None else dict(zip(self._plan.each("load_@"), load, strict=True))
        first = state.step + 1
        walls = wall_arrays(self._scene, range(first, first + len(ways)))
        if self._contact and (codes := self._contact.led(first)) is not None:
            walls["led_axes"] = codes
        return self._arrays | moved | leaders | reached | loads | walls

    def _clamped_arrays(self) -> Arrays:
        if not self._deep:
            return {"clamped": self._clamped}
        order, rows = banded(self._plan, "clamped", self._clamped)
        return {"clamped": self._clamped[order]} | rows

    def _load(self, state: State) -> Floats | None:
        """What acts in the step after a state."""
        loads = self._scene.loads
        return loads.at(state.step + 1, state.u.dtype) if loads else None

    def _given(self, state: State, ways: list[Led], count: int) -> tuple[Any, ...]:
        """The arguments of the kernel that makes `count` steps."""
        if self.threads > 1:
            numba.set_num_threads(self.threads)
        arrays = self._named(state, ways)
        given = tuple(arrays[name] for name in self._names)
        chunks, row = 4 * self.threads, math.prod(self._scene.raster.shape[2:])
        return given, state.step, count, chunks, max(1, BAND * self.threads**2 // row)
