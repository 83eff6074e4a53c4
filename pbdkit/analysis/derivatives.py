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
    with np.errstate(all="ignore"):
        ahead, behind = _array(moved(SMALL), shape), _array(moved(-SMALL), shape)
        difference: NDArray[np.float64] = (ahead - behind).real / (2 * SMALL)
        try:
            exact: NDArray[np.float64] = _array(moved(1j * TINY), shape).imag / TINY
        except (TypeError, ValueError):  # a function that takes no complex numbers
            return difference
    known = np.isfinite(exact) & np.isfinite(difference)
    scale = max(1.0, float(np.abs(difference[known]).max(initial=0.0)))
    agree = np.abs(exact - difference)[known].max(initial=0.0) <= 1e-4 * scale
    return exact if agree else difference


def _array(components: tuple[Any, Any], shape: tuple[int, ...]) -> NDArray[Any]:
    return np.array([np.broadcast_to(component, shape) for component in components])
