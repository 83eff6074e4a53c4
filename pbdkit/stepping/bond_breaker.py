"""Breaking bonds (model.md, section 6)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Components, FractureModel, length
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.state import State
from pbdkit.stepping.surroundings import BLOCK_CELLS

Home = tuple[Any, ...]
"""Where bonds are kept: plane and cells."""
DIRECTIONS = 8


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
        for n, plane in enumerate(scene.neighbourhood.planes):
            block = plane_block(scene.raster, plane)
            for part in block.rows(BLOCK_CELLS) if block else ():
                where_ = bonds_in(scene.raster, part, plane, frame_too)
                self._breakable.append((n, plane.slot, part, where_))

    def break_bonds(self, m: NDArray[Any], state: State, step: int) -> None:
        """Renews, in place, what is remembered of the bonds in the intermediate configuration m,
        and marks those that break, with their length."""
        assert state.broken_step is not None
        assert state.broken_length is not None
        for place, d, r, breaks in self._judged(m, state, f"at step {step}"):
            if breaks.any():
                state.broken_step[place][breaks] = step
                now = r + d.each(lambda values, where=breaks: values[where])
                state.broken_length[place][breaks] = length(now)

    def may_break(self, u: NDArray[Any], state: State, within: float) -> bool:
        """Whether any bond breaks at u, or at a configuration in which one of its ends is less than
        `within` away from there as seen from the other.

        Looked for in eight directions, so far out that the octagon takes in the circle.
        """
        radius = within / np.cos(np.pi / DIRECTIONS)
        angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1).tolist()
        return any(
            breaks.any()
            for along in ([0.0, 0.0], *around)
            for *_, breaks in self._judged(u, state, "near equilibrium", radius * vector(along))
        )

    def _judged(
        self, m: NDArray[Any], state: State, when: str, nudge: Components | None = None
    ) -> Iterator[tuple[Home, Components, Components, NDArray[np.bool_]]]:
        """Part by part of each slot's bonds where they are kept, their d and r, and which break.
        What is remembered is renewed in place; not where d is nudged, all alike, to see."""
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
                self._evaluator.renew_bonds(d, r, limits, own, intact)
                breaks = intact & self._evaluator.breaks(d, r, limits, own)
            yield (n, *block.slices()[1:]), d, r, breaks
