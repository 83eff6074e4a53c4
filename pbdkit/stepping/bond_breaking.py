"""Breaking and cutting of bonds in a step (model.md, section 6)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.neighbourhood import bonds_in, plane_block
from pbdkit.plugin import CellStress, FractureModel, SoftensCells, Vector, length
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.rule_evaluation import BLOCK_CELLS, Evaluator
from pbdkit.stepping.state import State, cut_bonds
from pbdkit.stepping.step import Hindrance, Mode, Operation, Step

Home = tuple[Any, ...]
"""Where bonds are kept: plane and cells."""
DIRECTIONS = 8
TIE = 1e-6
"""Cells begin to soften together whose loads differ by no more than this share."""
CALM = 1e-3
"""Other cells begin once none that has begun changes its damage by more."""


class Fracturing:
    """The fracture model of a scene on its planes of bonds."""

    @classmethod
    def of(cls, scene: Scene) -> Self | None:
        """None where the model breaks nothing."""
        return cls(scene) if scene.experiment.fracture.can_break else None

    def __init__(self, scene: Scene) -> None:
        self._model: FractureModel = scene.experiment.fracture
        self._constants, self._evaluator = scene.constants, Evaluator(scene)
        self._breakable = []
        frame_too = self._model.breaks_frame_bonds()
        inside = isinstance(self._model, SoftensCells)
        self._cells = CellStresses(scene) if inside else None
        self._numbers = [number.name for number in bond_numbers(scene.experiment)]
        for n, plane in enumerate(scene.neighbourhood.planes):
            block = plane_block(scene.raster, plane, inside=inside)
            for part in block.rows(BLOCK_CELLS) if block else ():
                where_ = bonds_in(scene.raster, part, plane, frame_too)
                self._breakable.append((n, plane.slot, part, where_))

    def break_bonds(
        self, m: NDArray[Any], state: State, step: int, *, in_turn: bool = False
    ) -> None:
        """Renews, in place, what is remembered of the bonds in the intermediate configuration m,
        and marks those that break, with their length.

        Of cells that would begin to soften the most loaded begin if they are to do so `in_turn`,
        and none before those that have begun are nearly settled.
        """
        assert state.broken_step is not None
        assert state.broken_length is not None
        when = f"at step {step}"
        renewed: Iterable[_Renewed] = self._renewed(m, state, when)
        if in_turn and self._cells:
            before = [value.copy() for value in state.bond_values]
            renewed = list(renewed)
            self._hold_back(before, renewed)
        for part in renewed:
            breaks = self._breaks(part, when)
            if breaks.any():
                state.broken_step[part.home][breaks] = step
                now = part.r + part.d.each(lambda values, where=breaks: values[where])
                state.broken_length[part.home][breaks] = length(now)

    def may_break(self, u: NDArray[Any], state: State, within: float) -> bool:
        """Whether any bond breaks at u, or at a configuration in which one of its ends is less than
        `within` away from there as seen from the other.

        Looked for in eight directions, so far out that the octagon takes in the circle.
        """
        radius = within / np.cos(np.pi / DIRECTIONS)
        angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1).tolist()
        return any(
            self._breaks(part, "near equilibrium").any()
            for along in ([0.0, 0.0], *around)
            for part in self._renewed(u, state, "near equilibrium", radius * vector(along))
        )

    def _renewed(
        self, m: NDArray[Any], state: State, when: str, nudge: Vector | None = None
    ) -> Iterator[_Renewed]:
        """Part by part the bonds of each slot where they are kept. What is remembered is renewed in
        place; not where d is nudged, all alike, to see."""
        assert state.broken_step is not None
        for n, slot, block, breakable in self._breakable:
            there, here = block.seen_through(slot).of(m), block.of(m)
            d, r = vector(there) - vector(here), slot.rest
            intact = breakable & (block.within(state.broken_step[n]) < 0)
            own = [block.within(value[n]) for value in state.bond_values]
            if nudge:
                d, own = d + nudge, [value.copy() for value in own]
            with np.errstate(all="ignore"), blaming(self._model, when):
                limits = self._constants.limits_at(slot, n, block)
                cells = self._cells.of(m, slot, block) if self._cells else ()
                self._evaluator.renew_bonds(d, r, limits, own, intact, cells)
            yield _Renewed((n, *block.slices()[1:]), d, r, limits, own, intact, cells)

    def _breaks(self, part: _Renewed, when: str) -> NDArray[np.bool_]:
        """Which of some bonds break."""
        with np.errstate(all="ignore"), blaming(self._model, when):
            return np.asarray(
                part.intact & self._evaluator.breaks(part.d, part.r, part.limits, part.own)
            )

    def _hold_back(self, before: list[NDArray[Any]], parts: Sequence[_Renewed]) -> None:
        """Leaves cells as they were `before` that would begin to soften, all but the most loaded,
        or all as long as what has begun to soften still changes."""
        changed, most = 0.0, 0.0
        sides = [[name.endswith(side) for name in self._numbers] for side in ("_left", "_right")]
        waiting = []
        for part in parts:
            for n, numbers in enumerate(sides):
                old = [value[part.home] for value, its in zip(before, numbers, strict=True) if its]
                new = [value for value, its in zip(part.own, numbers, strict=True) if its]
                begins = np.all([value == 0.0 for value in old], axis=0)
                ways = (abs(b - a) / np.maximum(1.0, abs(a)) for a, b in zip(old, new, strict=True))
                changed = max(changed, *(float(way[~begins].max(initial=0.0)) for way in ways))
                begins &= np.any([value != 0.0 for value in new], axis=0)
                if begins.any():
                    load = self._load(part, n)
                    most = max(most, float(load[begins].max()))
                    waiting.append((begins, load, old, new))
        least = most * (1.0 - TIE) if changed <= CALM else math.inf
        for begins, load, old, new in waiting:
            for a, b in zip(old, new, strict=True):
                np.copyto(b, a, where=begins & (load < least))

    def _load(self, part: _Renewed, side: int) -> NDArray[Any]:
        """The load of the cells on a side of some bonds, or of those on the other where they have
        none there."""
        loads = [self._evaluator.load(cell, part.limits, part.own) for cell in part.cells]
        found: NDArray[Any] = np.where(part.cells[side].share > 0.0, loads[side], loads[1 - side])
        return np.broadcast_to(found, part.intact.shape)


class _Renewed(NamedTuple):
    """Some bonds along a slot where they are kept, with what is remembered of them."""

    home: Home
    d: Vector
    r: Vector
    limits: Any
    own: list[NDArray[Any]]
    intact: NDArray[np.bool_]
    cells: tuple[CellStress, ...]


class CutBonds(Operation):
    """Make the cuts of the beginning of a step."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where the experiment cuts bonds."""
        return bool(scene.experiment.cuts)

    def apply(self, step: Step) -> None:
        """Before leaders are placed."""
        cut_bonds(self.scene, step.state.broken_step, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Nothing: no kernel goes on beyond a step that begins with a cut."""


class BreakBonds(Operation):
    """Renew what bonds remember in the intermediate configuration, and break them there."""

    @cached_property
    def _fracturing(self) -> Fracturing:
        return Fracturing(self.scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where the fracture model can break bonds."""
        return scene.experiment.fracture.can_break

    def apply(self, step: Step) -> None:
        """Before particles move."""
        self._fracturing.break_bonds(step.u, step.state, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Before particles move, or with them."""
        kernel.judge_bonds()

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """The stress of cells takes in particles farther away than a pass knows."""
        softens = isinstance(self.scene.experiment.fracture, SoftensCells)
        if mode is Mode.PASSES and softens:
            return Hindrance("bonds soften by the stress of cells", "fracture")
        return None
