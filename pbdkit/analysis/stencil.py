"""The rule's move linearised at rest on the infinite lattice: a matrix for each neighbour.

    move_j = own u_j + Σ_k W_k u_k,  W_k = ∂move/∂u_k,  own = ∂move/∂u_j

from the rule's own `gather` and `apply`; exact for linear rules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.derivatives import derivative
from pbdkit.interfaces import Here, Slot
from pbdkit.interfaces.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed

Floats = NDArray[np.float64]
NOWHERE = Here(None)


@dataclass(frozen=True)
class Stencil:
    """`own` is (sublattice, axis of the move, axis of u), `neighbours` holds W_k of every slot,
    (axis of the move, axis of u)."""

    own: Floats
    neighbours: dict[Slot, Floats]


def stencil_of(scene: Scene, at: Here = NOWHERE) -> Stencil:
    """The stencil of the scene's rule alone; `at` says where for rules that ask."""
    every = scene.neighbourhood.slots
    own = np.array([_derivative(scene, slots, None, at) for slots in every])
    neighbours = {s: _derivative(scene, slots, s, at) for slots in every for s in slots}
    return Stencil(own, neighbours)


def move(scene: Scene, slots: Sequence[Slot], difference: Callable[[Slot], Any], here: Here) -> Any:
    """The rule's move of a particle with all its neighbours, d = difference(slot) along each."""
    evaluator = Evaluator(scene)
    neighbours = zip(slots, evaluator.everywhere(slots), strict=True)
    parts = [(evaluator.contribution(difference(s), here.u, to), None) for s, to in neighbours]
    return evaluator.move(summed(parts), here._replace(own=evaluator.initial_own()))


def _derivative(scene: Scene, slots: Sequence[Slot], of: Slot | None, at: Here) -> Floats:
    """∂move/∂u_k at rest, or ∂move/∂u_j with all neighbours where they are, (axis, axis)."""
    columns = []
    for along in np.eye(scene.axes):

        def moved(step: complex, along: Floats = along) -> Any:
            nudge = vector(np.multiply(step, component) for component in along)
            still = vector(np.zeros(scene.axes))

            def difference(slot: Slot) -> Any:
                return -nudge if of is None else nudge if slot is of else still

            return move(scene, slots, difference, at._replace(u=nudge if of is None else still))

        columns.append(derivative(moved))
    return np.array(columns).T
