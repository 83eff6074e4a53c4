"""The rule's move linearised at rest on the infinite lattice: a matrix for each neighbour.

    move_j = own u_j + Σ_k W_k u_k,  W_k = ∂move/∂u_k,  own = ∂move/∂u_j

from the rule's own `gather` and `apply`; exact for linear rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.derivatives import derivative
from pbdkit.interfaces import Here, Slot
from pbdkit.interfaces.lattice import Index
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


def linearised(scene: Scene, at: Here = NOWHERE) -> Stencil:
    """The stencil of the scene's rule; `at` says where for rules that ask."""
    if scene.inner:
        return _composed(linearised(replace(scene, inner=None), at), linearised(scene.inner, at))
    every = scene.neighbourhood.slots
    own = np.array([_derivative(scene, slots, None, at) for slots in every])
    neighbours = {s: _derivative(scene, slots, s, at) for slots in every for s in slots}
    return Stencil(own, neighbours)


def _composed(outer: Stencil, inner: Stencil) -> Stencil:
    """The stencil of a rule that works on the moves of another."""
    own = np.zeros_like(outer.own)
    neighbours: dict[Slot, Floats] = {}
    known: dict[tuple[int, int, Index], Slot] = {}
    for first, W in _with_itself(outer):
        for second, V in _with_itself(inner):
            if first.target != second.source:
                continue
            slot = _after(first, second)
            key = slot.source, slot.target, slot.cell
            if slot.source == slot.target and not any(slot.cell):
                own[slot.source] += W @ V
            else:
                slot = known.setdefault(key, slot)
                neighbours[slot] = neighbours.get(slot, 0.0) + W @ V
    return Stencil(own, neighbours)


def _with_itself(stencil: Stencil) -> Iterator[tuple[Slot, Floats]]:
    for s, own in enumerate(stencil.own):
        nowhere = (0,) * len(own)
        yield Slot(s, s, nowhere, nowhere, vector(np.zeros(len(own))), 0), own
    yield from stencil.neighbours.items()


def _after(first: Slot, second: Slot) -> Slot:
    """Where two slots lead, one after the other."""
    return Slot(
        first.source,
        second.target,
        tuple(map(add, first.cell, second.cell)),
        tuple(map(add, first.site, second.site)),
        first.rest + second.rest,
        first.shell + second.shell,
    )


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
