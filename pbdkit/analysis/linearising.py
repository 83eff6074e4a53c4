"""A rule's answer to small displacements, from the rule's own functions and nothing else.

Linear rules come out exactly, whatever the configuration; others linearised at a state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.derivatives import derivative
from pbdkit.interfaces import Here, Slot, Vector
from pbdkit.scene.raster import Block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.state import State
from pbdkit.stepping.sums import difference, planes, presence, sum_over_slots

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """The move of the followers of a block, linearised: ∂move/∂u_k for each slot and ∂move/∂u_j,
    (row, column, axis of the move, axis of u), and the move itself, (row, column, axis)."""

    block: Block
    neighbours: dict[Slot, Floats]
    own: Floats
    move: Floats


def respond(scene: Scene, state: State, block: Block) -> Response:
    """The response of a block's followers at a state."""
    linearisation = _Linearisation(scene, state, block)
    slots = scene.neighbourhood.slots[block.sublattice]
    neighbours = {slot: linearisation.derivative(slot) for slot in slots}
    return Response(block, neighbours, linearisation.derivative(None), linearisation.move())


class _Linearisation:
    """The rule's chain of functions on a block, with differences that can be nudged."""

    def __init__(self, scene: Scene, state: State, block: Block) -> None:
        self._rule, self._constants = scene.experiment.rule, scene.constants
        self._slots = scene.neighbourhood.slots[block.sublattice]
        self._present = presence(scene.raster, block, self._slots)
        self._block, self._state = block, state
        self._fracturing = Fracturing(scene) if scene.has_fracture else None
        self._u = planes(state.u, block)
        X = scene.raster.reference_planes(block) if self._rule.uses_reference else None
        self._X = X or Vector(None, None)

    def move(self) -> Floats:
        """(row, column, axis)."""
        moved = self._moved(self._u, {})
        return np.stack([np.broadcast_to(m, self._u.x.shape) for m in moved], axis=-1)

    def derivative(self, of: Slot | None) -> Floats:
        """∂move/∂u_k through a slot, or ∂move/∂u_j with all neighbours where they are."""
        columns = []
        for along in (Vector(1.0, 0.0), Vector(0.0, 1.0)):

            def moved(step: complex, along: Vector = along) -> tuple[Any, Any]:
                nudge = Vector(step * along.x, step * along.y)
                if of is not None:
                    return self._moved(self._u, {of: nudge})
                here = Vector(self._u.x + nudge.x, self._u.y + nudge.y)
                return self._moved(here, dict.fromkeys(self._slots, Vector(-nudge.x, -nudge.y)))

            columns.append(derivative(moved, self._u.x.shape))
        return np.moveaxis(np.array(columns), (0, 1), (3, 2))

    def _moved(self, here: Vector, nudges: dict[Slot, Vector]) -> tuple[Any, Any]:
        def contribution(slot: Slot) -> tuple[Any, ...]:
            d, nudge = difference(self._state.u, self._block, slot), nudges.get(slot)
            if nudge:
                d = Vector(d.x + nudge.x, d.y + nudge.y)
            if self._fracturing and self._state.broken_step is not None:
                d = self._fracturing.seen(d, here, self._block, slot, self._state.broken_step)
            weights = self._constants.weights[slot]
            return self._rule.gather(d, slot.rest, weights, self._constants.rule)

        with np.errstate(all="ignore"):
            total = sum_over_slots(self._slots, self._present, contribution)
            return self._rule.apply(total, Here(here, self._X), self._constants.rule)
