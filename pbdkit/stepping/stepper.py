"""One step of the model (model.md, section 5) on whole arrays of numpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Here, Slot, Vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.raster import FOLLOWER, Block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.parameters import named
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.sums import Present, difference, planes, presence, sum_over_slots

BLOCK_CELLS = 16384
"""Places a block: small enough for its temporaries to stay in the cache."""


@dataclass(frozen=True)
class _Part:
    """What is constant on one block: its slots with weights and presence, X where the rule wants
    it, and where followers can move (None: everywhere)."""

    block: Block
    slots: tuple[Slot, ...]
    weights: dict[Slot, tuple[float, ...]]
    present: list[Present]
    X: Vector
    movable: Present


class Stepper:
    """Steps the states of one scene. It holds what is constant and no state of its own."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._rule = scene.experiment.rule
        self._parameters = named(self._rule.parameters(scene.setting()))
        self._parts = [part for s in range(scene.raster.shape[0]) for part in self._cut(s)]
        self._fracturing = Fracturing(scene) if scene.has_fracture else None

    def advance(self, state: State) -> State:
        """The state one step on. It takes over the arrays of `state`, which is void afterwards."""
        step, u, new = state.step + 1, state.u, state.previous
        led, starts = self._prescribe(state, step)
        before = [u.reshape(2, -1)[:, place].copy() for place, _ in led]
        _place(u, led)
        if self._fracturing and state.broken_step is not None:
            self._fracturing.break_bonds(u, state.broken_step, step)
        # What leaves the finite numbers is found at recording.
        with np.errstate(all="ignore"), blaming(self._rule, f"at step {step}"):
            for part in self._parts:
                self._move_followers(part, u, new, state.broken_step)
        _place(new, led)
        _place(u, [(place, x) for (place, _), x in zip(led, before, strict=True)])
        self._move_frame(u, new)
        return State(step, new, u, state.broken_step, starts)

    def _cut(self, sublattice: int) -> list[_Part]:
        whole = self._scene.raster.body_block(sublattice)
        return [self._part(block) for block in whole.rows(BLOCK_CELLS)] if whole else []

    def _part(self, block: Block) -> _Part:
        raster, slots = self._scene.raster, self._scene.neighbourhood.slots[block.sublattice]
        present = presence(raster, block, slots)
        neighbours = sum(1 if there is None else there.astype(int) for there in present)
        movable = (raster.kind[block.slices()] == FOLLOWER) & (neighbours > 0)
        return _Part(
            block,
            slots,
            {slot: self._rule.weights(slot) for slot in slots},
            present,
            raster.reference_planes(block) if self._rule.uses_reference else Vector(0.0, 0.0),
            None if movable.all() else movable,
        )

    def _prescribe(
        self, state: State, step: int
    ) -> tuple[list[tuple[Any, Floats]], tuple[Floats | None, ...]]:
        """(place, u) of the leaders of this step, and where each motion started."""
        led, starts = [], list(state.starts)
        for n, leading in enumerate(self._scene.leading):
            if not leading.group.leads(step):
                continue
            if starts[n] is None:
                starts[n] = state.u.reshape(2, -1)[:, leading.place].copy()
            offset = leading.group.motion.offset(step - leading.group.from_ + 1)
            led.append((leading.place, starts[n] + np.array(offset)[:, None]))
        return led, tuple(starts)

    def _move_followers(
        self, part: _Part, m: Floats, new: Floats, broken_step: NDArray[np.int32] | None
    ) -> None:
        """Writes the followers' displacements; `new` holds those of the step before."""
        u = planes(m, part.block)

        def contribution(slot: Slot) -> tuple[Any, ...]:
            d = difference(m, part.block, slot)
            if self._fracturing and broken_step is not None:
                d = self._fracturing.seen(d, u, part.block, slot, broken_step)
            return self._rule.gather(d, slot.rest, part.weights[slot], self._parameters)

        total = sum_over_slots(part.slots, part.present, contribution)
        move = self._rule.apply(total, Here(u, part.X), self._parameters)
        solver = self._scene.experiment.solver
        for here, step, out in zip(u, move, planes(new, part.block), strict=True):
            if np.shape(step) not in ((), here.shape):
                raise ValueError(
                    f"it returned the shape {np.shape(step)} for particles of shape {here.shape}: "
                    "it is not elementwise"
                )
            target = here + (step if solver.relaxation == 1.0 else solver.relaxation * step)
            if solver.memory != 0.0:
                target += solver.memory * (here - out)
            out[...] = target if part.movable is None else np.where(part.movable, target, here)

    def _move_frame(self, old: Floats, new: Floats) -> None:
        """u of every frame point from the body's, of this step or, with lag, of the last."""
        if self._scene.frame:
            frame = self._scene.frame
            flat, source = new.reshape(2, -1), (old if frame.map.lag else new).reshape(2, -1)
            for x, y in zip(flat, source, strict=True):
                x[frame.place] = np.bincount(
                    frame.map.point, frame.map.weight * y[frame.body_place], len(frame.place)
                )


def _place(u: Floats, led: list[tuple[Any, Floats]]) -> None:
    flat = u.reshape(2, -1)
    for place, values in led:
        flat[:, place] = values
