"""The compiled engine: whole intervals of steps in one call, on what the motion has reached."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numba
import numpy as np

from pbdkit.interfaces.frame import Indices
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import bits_for, constant_arrays, lost_bits
from pbdkit.stepping.compiled.emitter import write_kernel
from pbdkit.stepping.compiled.levels import levels_of, load_blamed, sample_values
from pbdkit.stepping.compiled.pair_loop import PairFollowers
from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.compiled.reach import Reach
from pbdkit.stepping.compiled.runs import find_runs
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.prescription import prescribe, steady_steps
from pbdkit.stepping.state import Floats, State

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
        self._reach = Reach(scene)
        self._last: State | None = None
        levels = levels_of(scene)
        plan = Plan(scene, levels, (), self.threads > 1)
        runs, starts, rows = find_runs(scene, plan.long)
        self._plan = plan = replace(plan, rows=rows)
        self._arrays = constant_arrays(scene, levels) | {"runs": runs, "starts": starts}
        for level in levels[:-1]:
            moves = np.zeros((scene.axes, *scene.raster.shape), scene.experiment.stepping.precision)
            self._arrays |= {
                f"z{level.number}_{c}": z for c, z in zip(plan.axes, moves, strict=True)
            }
        source, self._names = write_kernel(plan)
        self._run = load_blamed(levels, source, self._sample())

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

    def _begin(self, state: State) -> None:
        for name, array in self._arrays.items():
            if name[0] == "z":
                array[...] = 0.0
        if self._plan.judged:
            self._arrays["lost"] = lost_bits(self._scene, state)
        self._reach.begin(state)

    def _some_steps(self, state: State, end: int) -> State:
        step = state.step + 1
        led, starts = prescribe(self._scene, state, step)
        count = steady_steps(self._scene, step, end - state.step)
        count = self._reach.before(led, count)
        axes = self._scene.axes
        places = np.concatenate([np.empty(0, np.intp), *(p for p, _ in led)])
        values = np.concatenate([np.empty((axes, 0)), *(v for _, v in led)], axis=1)
        with blaming(self._scene.experiment.rule, f"at step {step}"):
            self._run(*self._given(state, places, values.astype(state.u.dtype), count))
        u, new = state.u, state.previous
        now, before = (new, u) if count % 2 else (u, new)
        self._reach.after(now, before)
        return replace(state, step=state.step + count, u=now, previous=before, starts=starts)

    def _given(self, state: State, places: Indices, values: Floats, count: int) -> tuple[Any, ...]:
        """The arguments of the kernel that makes `count` steps in the arrays of the state."""
        arrays = self._arrays | {
            **{f"u_{c}": plane for c, plane in zip(self._plan.axes, state.u, strict=True)},
            **{f"v_{c}": plane for c, plane in zip(self._plan.axes, state.previous, strict=True)},
            **{f"bond{n}": value for n, value in enumerate(state.bond_values)},
            **{f"own{n}": value for n, value in enumerate(state.particle_values)},
            "led": places,
            "led_values": values,
            "led_kept": np.empty_like(values),
            "box": self._reach.box,
            "growth": self._reach.growth,
        }
        if state.broken_step is not None and state.broken_length is not None:
            arrays |= {"broken": state.broken_step, "lengths": state.broken_length}
        if self.threads > 1:
            numba.set_num_threads(self.threads)
        given = tuple(arrays[name] for name in self._names)
        chunks, row = 4 * self.threads, math.prod(self._scene.raster.shape[2:])
        return given, state.step, count, chunks, max(1, BAND * self.threads**2 // row)

    def _sample(self) -> tuple[Any, ...]:
        """Arguments for no step, so that what does not compile is known before the first."""
        scene, shape = self._scene, (1,) * (self._scene.axes + 1)
        u = np.zeros((scene.axes, *shape), scene.experiment.stepping.precision)
        bonds = sample_values(scene, bond_numbers(scene.experiment), shape)
        own = sample_values(scene, particle_numbers(scene.experiment), shape)
        broken = np.zeros(shape, np.int32) if scene.has_fracture else None
        lengths = None if broken is None else np.zeros(shape, u.dtype)
        if self._plan.judged:
            self._arrays["lost"] = np.zeros(shape, bits_for(scene))
        state = State(0, u, u.copy(), broken, lengths, (), bonds, own)
        return self._given(state, np.empty(0, np.intp), np.empty((scene.axes, 0), u.dtype), 0)
