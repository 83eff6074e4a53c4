"""The GPU engine: the state stays on the device, and is fetched at the end of a call."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from numba import cuda

from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import Arrays, changing_arrays, lost_bits
from pbdkit.stepping.compiled.leading import foreseen, leading_arrays
from pbdkit.stepping.compiled.levels import blamed, functions_of
from pbdkit.stepping.compiled.tearing import torn_marks
from pbdkit.stepping.cutting import cut_bonds
from pbdkit.stepping.gpu.arguments import flattened, without_doubles
from pbdkit.stepping.gpu.kernel import (
    first_launch,
    is_simulated,
    launcher,
    make_kernel,
    most_blocks,
)
from pbdkit.stepping.gpu.program import changing_planes, program_of
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.prescription import Led, prescribe, steady_steps
from pbdkit.stepping.state import State

THREADS, MOST_THREADS, SIMULATED_THREADS = 256, 1024, 8
"""Of a block where there are several, of one that is alone, and of the simulator."""


class GpuStepper(Engine):
    """Steps a scene with a kernel made for it, on the first GPU that there is.

    What a state holds is sent there where it does not come from here, and is fetched at the end of
    a call. Everything is looked at in every step.
    """

    name = "gpu"

    def __init__(self, scene: Scene) -> None:
        self._scene = self._numbered = scene
        self._last: State | None = None
        self._load_changes = -math.inf
        """The step at which other loads act than those that were sent."""
        program = program_of(scene)
        self._plan, self._names = program.plan, program.names
        self._device: Arrays = {}
        self._send(program.arrays)
        with blamed(self._plan.levels):
            threads = MOST_THREADS if program.alone else THREADS
            functions = functions_of(self._plan.levels)
            self._run = make_kernel(program.source, functions, threads)
            # No step is made, so that what does not compile is known before the first.
            first_launch(self._run, self._given(0, 0))
        self._launch = launcher(self._run, *self._blocks(program.alone))

    def advance(self, state: State, steps: int = 1) -> State:
        """As many steps a launch as it is known beforehand where the leaders are."""
        if state is not self._last:
            self._begin(state)
        end = state.step + steps
        while state.step < end:
            state = self._some_steps(state, end)
        self._fetch(state)
        self._last = state
        return state

    def renewed(self, state: State, rows: slice) -> None:
        """The device gets the state anew."""
        self._last = None

    def _blocks(self, alone: bool) -> tuple[int, int]:
        """How many blocks of how many threads take part."""
        size = self._scene.raster.kind.size
        if is_simulated():
            return 1, SIMULATED_THREADS
        if alone:
            return 1, min(MOST_THREADS, -(-size // 32) * 32)
        return min(most_blocks(self._run, THREADS), -(-size // THREADS)), THREADS

    def _begin(self, state: State) -> None:
        """Sends all that steps change, from a state that did not come from here."""
        self._load_changes = -math.inf
        held = changing_planes(self._plan, state)
        if self._plan.judged:
            held |= flattened({"lost": lost_bits(self._scene, state)})
        if self._plan.tears:
            held |= flattened({"torn": torn_marks(self._scene, state)})
        self._send(held)

    def _fetch(self, state: State) -> None:
        """Writes what steps have changed over the arrays of a state."""
        for name, array in changing_planes(self._plan, state).items():
            if name in self._device:
                self._device[name].copy_to_host(array)

    def _some_steps(self, state: State, end: int) -> State:
        scene, step = self._scene, state.step + 1
        is_cut = any(cut.at == step for cut in scene.experiment.cuts)
        begins = any(
            begun is None and leading.group.leads(step)
            for leading, begun in zip(scene.leading, state.starts, strict=True)
        )
        if is_cut or begins:  # where bodies and bonds are is needed here
            self._fetch(state)
        if cut_bonds(scene, state.broken_step, step):
            self._begin(state)
        self._renumber(scene.at(step))
        led, starts = prescribe(scene, state, step)
        steady, ways = steady_steps(scene, step, end - state.step), [led]
        if steady == 1:
            ways += foreseen(scene, replace(state, starts=starts), led, end)
        self._send(self._leading(ways, state) | flattened(self._loads(step, state)))
        count = max(steady, len(ways))
        with blaming(scene.experiment.rule, f"at step {step}"):
            self._launch(*self._given(state.step, count))
        if count % 2:
            for u, v in zip(*(self._plan.each(f"flat_{side}_@") for side in "uv"), strict=True):
                self._device[u], self._device[v] = self._device[v], self._device[u]
        return replace(state, step=state.step + count, starts=starts)

    def _renumber(self, scene: Scene) -> None:
        if scene is not self._numbered:
            self._send(changing_arrays(self._plan.renumbered(scene)))
            self._numbered = scene

    def _leading(self, ways: list[Led], state: State) -> Arrays:
        if self._scene.leaders_overlap:
            ways = [without_doubles(way) for way in ways]
        return leading_arrays(self._plan, ways, {}, state.u.dtype)

    def _loads(self, step: int, state: State) -> Arrays:
        """What acts in a step, where it is not there already."""
        loads = self._scene.loads
        if loads is None or step < self._load_changes:
            return {}
        self._load_changes = loads.next_change(step)
        load = loads.at(step, state.u.dtype)
        return dict(zip(self._plan.each("load_@"), load, strict=True))

    def _send(self, arrays: Arrays) -> None:
        """Those that the kernel takes."""
        self._device |= {
            name: cuda.to_device(array) for name, array in arrays.items() if name in self._names
        }

    def _given(self, step: int, count: int) -> tuple[Any, ...]:
        return step, count, *(self._device[name] for name in self._names)
