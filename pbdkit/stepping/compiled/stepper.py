"""The compiled engine: whole intervals of steps in one call, on what the motion has reached."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np

from pbdkit.interfaces import Components
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.bits import bits_for, lost_bits, presence_bits, spared_bits
from pbdkit.stepping.compiled.kernels import load_kernel
from pbdkit.stepping.compiled.reach import Reach
from pbdkit.stepping.compiled.source import write_kernel
from pbdkit.stepping.compiled.wanted import Wanted
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.prescription import prescribe, steady_steps
from pbdkit.stepping.state import Floats, State


class CompiledStepper(Engine):
    """Steps scenes of fixed neighbours with a kernel made for them.

    Lost bonds are one bit a bond and end in `lost`, which is made anew from a state that did not
    come from here; all else of the state is the same arrays that the numpy engine uses.
    """

    name = "compiled"

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self.threads = min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
        self._scene = scene
        self._bits = bits_for(scene)
        self._masks = presence_bits(scene, self._bits)
        self._spared = spared_bits(scene, self._bits)
        self._reach = Reach(scene)
        self._last: State | None = None
        with blaming(scene.experiment.rule, "to compile"):
            wanted = self._wanted()
            source = write_kernel(scene.experiment.lattice.cell(), scene.neighbourhood, wanted)
            fracture = scene.experiment.fracture if scene.has_fracture else None
            self._run = load_kernel(source, scene.experiment.rule, fracture)
            self._constant = self._constant_arguments()
            self._compile()

    def advance(self, state: State, steps: int = 1) -> State:
        """As many steps a call as the leaders stay where they are."""
        if state is not self._last:
            self._lost = lost_bits(self._scene, state, self._bits)
            self._reach.begin(state)
        end = state.step + steps
        while state.step < end:
            state = self._some_steps(state, end)
        self._last = state
        return state

    def _some_steps(self, state: State, end: int) -> State:
        step = state.step + 1
        led, starts = prescribe(self._scene, state, step)
        count = steady_steps(self._scene, step, end - state.step)
        count = self._reach.before(led, count)
        places = np.concatenate([p for p, _ in led]) if led else np.empty(0, np.intp)
        values = np.concatenate([v for _, v in led], axis=1) if led else np.empty((2, 0))
        with blaming(self._scene.experiment.rule, f"at step {step}"):
            self._call(state, count, places, values.astype(state.u.dtype))
        u, new = state.u, state.previous
        now, before = (new, u) if count % 2 else (u, new)
        self._reach.after(now, before)
        return replace(state, step=state.step + count, u=now, previous=before, starts=starts)

    def _call(self, state: State, count: int, places: Indices, values: Floats) -> None:
        """Makes `count` steps in the arrays of the state; with none it only compiles."""
        u, new, c = state.u, state.previous, self._constant
        broken = c["broken"] if state.broken_step is None else state.broken_step
        lengths = c["lengths"] if state.broken_length is None else state.broken_length
        kept = np.empty_like(values)
        if self.threads > 1:
            numba.set_num_threads(self.threads)
        self._run(
            u[0], u[1], new[0], new[1], self._masks, self._lost, self._spared,
            self._scene.raster.kind, broken, lengths, c["limits"], c["share"], state.step, count,
            self._reach.blocks, self._reach.box, self._reach.growth, 4 * self.threads, places,
            values[0], values[1], kept[0], kept[1], c["points"], c["entries"], c["bodies"],
            c["weights"], c["rule"], c["solver"], c["first"],
        )  # fmt: skip

    def _compile(self) -> None:
        """A call of no steps, so that what does not compile is known before the first."""
        u = np.zeros((2, 1, 1, 1), self._scene.experiment.stepping.precision)
        broken = np.zeros((1, 1, 1), np.int32) if self._scene.has_fracture else None
        lengths = None if broken is None else np.zeros(broken.shape, u.dtype)
        state = State(0, u, u.copy(), broken, lengths, ())
        self._lost = np.zeros((1, 1, 1), self._bits)
        self._call(state, 0, np.empty(0, np.intp), np.empty((2, 0), state.u.dtype))

    def _wanted(self) -> Wanted:
        scene = self._scene
        rule, solver, constants = scene.experiment.rule, scene.experiment.stepping, scene.constants
        evaluator, one = Evaluator(scene), vector(np.ones(scene.axes))
        parts = evaluator.contribution(
            one, one, evaluator.everywhere(scene.neighbourhood.slots[0])[0]
        )
        frame = scene.frame
        return Wanted(
            contributions=tuple(len(p) if isinstance(p, Components) else 1 for p in parts),
            fracture=scene.has_fracture,
            some_bonds_last=self._spared.size > 1,
            some_missing=self._masks.size > 1,
            reference=(tuple(scene.experiment.lattice.origin), tuple(scene.middle))
            if rule.uses_reference
            else None,
            relaxed=solver.relaxation != 1.0,
            memory=solver.memory != 0.0,
            frame=frame is not None,
            frame_matrices=frame is not None and frame.map.weight.ndim == 3,
            lag=frame is not None and frame.map.lag == 1,
            limits=next((c._fields for c in constants.limits.values()), ()),
            parallel=self.threads > 1,
            single=solver.precision == "float32",
            rule_parameters=constants.rule._fields,
            fracture_parameters=constants.fracture._asdict(),
            weights=constants.weights,
            tiling=scene.cells.tiling if scene.cells else None,
        )

    def _constant_arguments(self) -> dict[str, Any]:
        scene = self._scene
        solver, constants, frame = scene.experiment.stepping, scene.constants, scene.frame
        slots = scene.neighbourhood.slots
        number = np.dtype(solver.precision)
        width = max((len(c) for c in constants.limits.values()), default=0)
        limits = np.zeros((len(slots), max(map(len, slots)), max(width, 1)), number)
        for s, own in enumerate(slots):
            for k, slot in enumerate(own):
                for n, value in enumerate(constants.limits.get(slot, ())):
                    limits[s, k, n] = value
        none = np.empty(0, np.intp)
        entries = none
        if frame:
            counts = np.bincount(frame.map.point, minlength=len(frame.place))
            entries = np.concatenate([[0], np.cumsum(counts)])
        return {
            "limits": limits,
            "share": (scene.cells.share if scene.cells else np.empty((0,) * 4)).astype(number),
            "broken": np.empty((0, 0, 0), np.int32),
            "lengths": np.empty((0, 0, 0), number),
            "points": frame.place if frame else none,
            "entries": entries,
            "bodies": frame.body_place if frame else none,
            "weights": (frame.map.weight if frame else np.empty(0)).astype(number),
            "rule": np.array([*constants.rule, 0.0], number),
            "solver": np.array([solver.relaxation, solver.memory], number),
            "first": np.array(scene.raster.first, np.int64),
        }
