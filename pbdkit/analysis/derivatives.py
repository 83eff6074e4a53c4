"""Derivatives of elementwise functions: by a complex step where that serves, else by differences.

Where functions keep to arithmetic and roots they are analytic, and ∂f = Im f(x + ih) / h is exact
to rounding. Others (an absolute value, a hypotenuse) drop the imaginary part or refuse it: a
central difference finds that out, and takes its place with nine digits or so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
