"""Breaking and cutting of bonds in a step, and softening of one cell after the other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.neighbourhood import bonds_in, plane_block
from pbdkit.lattice.raster import Block
from pbdkit.plugin import (
    BreaksAtStrain,
    CellStress,
    FractureModel,
    RenewsBonds,
    Slot,
    SoftensCells,
    Vector,
    length,
)
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.rule_evaluation import BLOCK_CELLS, Evaluator
from pbdkit.stepping.state import State, cut_bonds
from pbdkit.stepping.step import Call, Hindrance, Mode, Operation, Reach, Step

Owner = tuple[Any, ...]
"""Type of the index of bonds in the arrays of bonds: the plane, and a slice of cells along each
axis."""
DIRECTIONS = 8
"""Number of directions in which the ends of a bond are displaced to test whether it may break."""
TIE_RTOL = 1e-6
"""Cells begin to soften together if their loads differ by at most this relative amount."""
MAX_DAMAGE_CHANGE = 1e-3
"""Further cells may begin to soften only if the damage of no cell changes by more than this."""


class Fracturing:
    """Fracture model of a scene, evaluated on its planes of bonds: arrays with one entry for each
    bond along a slot."""

    @classmethod
    def of(cls, scene: Scene) -> Self | None:
        """Return the fracture model of a scene in this form; None if the model breaks no bonds."""
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
                target = part.seen_through(plane.slot)
                self._breakable.append((n, plane.slot, part, target, where_))

    def break_bonds(
        self, m: NDArray[Any], state: State, step: int, *, in_turn: bool = False
    ) -> bool:
        """Update the state variables of bonds in the intermediate configuration m, in place, and
        record the step and the length of the bonds that break.

        With `in_turn` cells soften one after the other: only the cells with the largest load begin
        to soften, and only when the damage of the cells that already soften has become nearly
        constant. Return whether cells have to wait for this damage.
        """
        assert state.broken_step is not None
        assert state.broken_length is not None
        when = f"at step {step}"
        renewed: Iterable[UpdatedBonds] = self._renewed(m, state, when)
        waits = False
        if in_turn and self._cells:
            old = [value.copy() for value in state.bond_values]
            renewed = list(renewed)
            waits = self._hold_back(old, renewed)
        for part in renewed:
            breaks = self._breaks(part, when)
            if breaks.any():
                state.broken_step[part.owner][breaks] = step
                current = part.r + part.d.each(lambda values, where=breaks: values[where])
                state.broken_length[part.owner][breaks] = length(current)
        return waits

    def break_most_strained(self, m: NDArray[Any], state: State, step: int) -> bool:
        """Break the bond with the largest ratio of strain to breaking strain in a configuration m,
        if the ratio exceeds 1, and all bonds with the same ratio. Return whether a bond breaks."""
        assert state.broken_step is not None
        assert state.broken_length is not None
        model, when = self._model, f"at step {step}"
        assert isinstance(model, BreaksAtStrain)
        breaking = []
        for part in self._renewed(m, state, when):
            breaks = self._breaks(part, when)
            if breaks.any():
                limit = self._evaluator.breaking_strain(part.r, part.limits, part.numbers)
                current = np.asarray(length(part.r + part.d))
                strain = current / length(part.r) - 1.0
                ratio = np.divide(strain, limit, out=np.zeros_like(strain), where=breaks)
                breaking.append((part.owner, current, ratio))
        largest = max((float(ratio.max()) for _, _, ratio in breaking), default=0.0)
        for owner, current, ratio in breaking:
            first = ratio >= largest * (1.0 - TIE_RTOL)
            state.broken_step[owner][first] = step
            state.broken_length[owner][first] = current[first]
        return bool(breaking)

    def may_break(self, u: NDArray[Any], state: State, within: float) -> bool:
        """Return whether any bond breaks at u, or would break if the relative displacement of its
        ends differed by less than `within` from its value at u.

        Eight changes of the relative displacement are tested: the corners of an octagon that
        contains the circle with this radius.
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
    ) -> Iterator[UpdatedBonds]:
        """Generate the bonds of each slot, block by block, with updated state variables. They are
        updated in place, or in copies if the relative displacements of the ends of all bonds are
        changed by a `nudge`."""
        assert state.broken_step is not None
        for n, slot, block, target, breakable in self._breakable:
            d, r = vector(target.of(m) - block.of(m)), slot.rest
            intact = breakable & (block.within(state.broken_step[n]) < 0)
            numbers = [block.within(value[n]) for value in state.bond_values]
            if nudge:
                d, numbers = d + nudge, [value.copy() for value in numbers]
            with np.errstate(all="ignore"), errors_attributed_to(self._model, when):
                limits = self._constants.limits_at(slot, n, block)
                cells = self._cells.of(m, slot, block) if self._cells else ()
                self._evaluator.renew_bonds(d, r, limits, numbers, intact, cells)
            owner = (n, *block.slices()[1:])
            yield UpdatedBonds(owner, slot, block, d, limits, numbers, intact, cells)

    def _breaks(self, part: UpdatedBonds, when: str) -> NDArray[np.bool_]:
        """Return which bonds break."""
        with np.errstate(all="ignore"), errors_attributed_to(self._model, when):
            return np.asarray(
                part.intact & self._evaluator.breaks(part.d, part.r, part.limits, part.numbers)
            )

    def _hold_back(self, previous: list[NDArray[Any]], parts: Sequence[UpdatedBonds]) -> bool:
        """Restore the state variables of cells that would begin to soften, except the cells with
        the largest load. As long as the damage of cells that already soften still changes, restore
        the state variables of all cells that would begin. Return whether all of them wait."""
        assert self._cells
        sides = [[name.endswith(side) for name in self._numbers] for side in ("_left", "_right")]
        loads = np.zeros(len(self._cells.shares))
        softens, values = np.zeros(len(loads), np.bool_), []
        for part in parts:
            beside = self._cells.places(part.slot, part.block)
            for n, numbers in enumerate(sides):
                old = [
                    value[part.owner] for value, its in zip(previous, numbers, strict=True) if its
                ]
                new = [value for value, its in zip(part.numbers, numbers, strict=True) if its]
                cell, is_intact = beside[n], np.all([value == 0.0 for value in old], axis=0)
                softens[cell[~is_intact]] = True
                values.append((part, n, cell, is_intact, old, new))
        change, waiting = 0.0, []
        for part, n, cell, is_intact, old, new in values:
            waits = is_intact & ~softens[cell]
            ratios = (abs(b - a) / np.maximum(1.0, abs(a)) for a, b in zip(old, new, strict=True))
            change = max(change, *(float(ratio[~waits].max(initial=0.0)) for ratio in ratios))
            waits &= np.any([value != 0.0 for value in new], axis=0)
            if waits.any():
                np.maximum.at(loads, cell[waits], self._load(part, n)[waits])
                waiting.append((cell, waits, old, new))
        threshold = float(loads.max(initial=0.0)) * (1.0 - TIE_RTOL)
        threshold = threshold if change <= MAX_DAMAGE_CHANGE else math.inf
        for cell, waits, old, new in waiting:
            for a, b in zip(old, new, strict=True):
                np.copyto(b, a, where=waits & (loads[cell] < threshold))
        return bool(waiting) and threshold == math.inf

    def _load(self, part: UpdatedBonds, side: int) -> NDArray[Any]:
        """Return the load of bonds in the cells on one side. If there is no cell on that side, at
        the edge of the body, return the load in the cell on the other side."""
        loads = [
            self._evaluator.load(cell, part.r, part.limits, part.numbers) for cell in part.cells
        ]
        load: NDArray[Any] = np.where(part.cells[side].share > 0.0, loads[side], loads[1 - side])
        return np.broadcast_to(load, part.intact.shape)


class UpdatedBonds(NamedTuple):
    """Bonds along a slot, which start in a block, with updated state variables."""

    owner: Owner
    slot: Slot
    block: Block
    d: Vector
    limits: Any
    numbers: list[NDArray[Any]]
    intact: NDArray[np.bool_]
    cells: tuple[CellStress, ...]

    @property
    def r(self) -> Vector:
        """Rest offset of the bonds."""
        return self.slot.rest


BREAKS_AT_REST = Hindrance("an equilibrium with breaking bonds", "fracture")
"""Reason why an equilibrium cannot be computed on several ranks."""


class CutBonds(Operation):
    """Cut bonds at the beginning of a step."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether the experiment cuts bonds."""
        return bool(scene.experiment.cuts)

    def apply(self, step: Step) -> None:
        """Cut the bonds before leaders are placed."""
        cut_bonds(self.scene, step.state.broken_step, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Write nothing: a step with a cut is always the first step of a call, and the cut is made
        before the call."""

    def reads(self, state: State) -> bool:
        """Return whether the next step begins with a cut."""
        return state.step + 1 in self._steps

    def prepare(self, call: Call) -> None:
        """Cut the bonds of the first step of a call."""
        call.has_cuts = cut_bonds(self.scene, call.state.broken_step, call.step)

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the next step that begins with a cut."""
        return min((at for at in self._steps if at > step), default=math.inf)

    def events(self, steps: int) -> list[int]:
        """Return the steps that begin with a cut."""
        return self._steps

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why an equilibrium cannot be computed on several ranks, if bonds can
        break."""
        return BREAKS_AT_REST if mode is Mode.RANKS_AT_REST else None

    @property
    def _steps(self) -> list[int]:
        return [cut.at for cut in self.scene.experiment.cuts]


class BreakBonds(Operation):
    """Update the state variables of bonds in the intermediate configuration, and break bonds."""

    @cached_property
    def _fracturing(self) -> Fracturing:
        return Fracturing(self.scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether the fracture model can break bonds."""
        return scene.experiment.fracture.can_break

    def apply(self, step: Step) -> None:
        """Update and break the bonds before particles move."""
        self._fracturing.break_bonds(step.u, step.state, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Write the pass over bonds, unless the sweep over particles includes it."""
        kernel.judge_bonds()

    def reach(self, axis: int) -> Reach:
        """Return the reach of a pass over bonds. The pass precedes the moves of particles, because
        they read its result."""
        scene, fracture = self.scene, self.scene.experiment.fracture
        if not (isinstance(fracture, RenewsBonds) or scene.tears):
            return Reach()
        backward, forward = (owner[axis] for owner in scene.neighbourhood.owner_reach)
        back, ahead = (owner[axis] for owner in scene.owner_reach)
        return Reach(back=back, ahead=ahead, below=forward, above=backward)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return a reason if the model softens cells, because the stress of cells depends on
        particles beyond the reach of a pass."""
        if mode is Mode.RANKS_AT_REST:
            return BREAKS_AT_REST
        softens = isinstance(self.scene.experiment.fracture, SoftensCells)
        if mode is Mode.PASSES and softens:
            return Hindrance("bonds soften by the stress of cells", "fracture")
        return None
