"""Derivatives of elementwise functions: by a complex step where that serves, else by differences.

Where functions keep to arithmetic and roots they are analytic, and ∂f = Im f(x + ih) / h is exact
to rounding. Others (an absolute value, a hypotenuse) drop the imaginary part or refuse it: a
central difference finds that out, and takes its place with nine digits or so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Here, Slot
from pbdkit.interfaces.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed

TINY, SMALL = 1e-100, 1e-6
Moved = Callable[[complex], tuple[Any, Any]]
"""The components of a function's value, for a step along one direction."""


def derivative(moved: Moved, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """(component, *shape): the derivative at a step of zero."""
    found: NDArray[np.float64] = derivatives(moved, 1, shape)[0]
    return found


def derivatives(moved: Moved, directions: int, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """(direction, component, *shape): the derivatives of a function that steps along several
    directions at once, (direction, *shape) in each component."""
    whole = (directions, *shape)
    with np.errstate(all="ignore"):
        ahead, behind = _array(moved(SMALL), whole), _array(moved(-SMALL), whole)
        difference: NDArray[np.float64] = (ahead - behind).real / (2 * SMALL)
        difference = difference.swapaxes(0, 1)
        try:
            exact: NDArray[np.float64] = _array(moved(1j * TINY), whole).imag / TINY
        except (TypeError, ValueError):  # a function that takes no complex numbers
            return difference
    exact = exact.swapaxes(0, 1)
    known = np.isfinite(exact) & np.isfinite(difference)
    within = tuple(range(1, exact.ndim))
    scale = np.abs(difference).max(axis=within, initial=1.0, where=known)
    off = np.abs(exact - difference).max(axis=within, initial=0.0, where=known)
    agree = (off <= 1e-4 * scale).reshape(-1, *(1 for _ in within))
    return np.where(agree, exact, difference)


def _array(components: tuple[Any, Any], shape: tuple[int, ...]) -> NDArray[Any]:
    return np.array([np.broadcast_to(component, shape) for component in components])


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
