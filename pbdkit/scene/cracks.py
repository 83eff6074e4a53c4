"""Cracks that are there from the start: the bonds that cross them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Vector
from pbdkit.interfaces.fracture import Segment

Mask = NDArray[np.bool_]


def crosses(start: Vector, end: Vector, crack: Segment) -> Mask:
    """Whether each bond from `start` to `end` crosses the crack.

    A particle exactly on the crack's line counts to its left side, so that a crack along a row of
    particles parts the row from those on its right; a bond that a tip touches is crossed.
    """
    a, b = (Vector(*point) for point in crack)
    sides = (_side(a, b, start) >= 0) != (_side(a, b, end) >= 0)
    ends = _side(start, end, a) * _side(start, end, b) <= 0
    found: Mask = sides & ends
    return found


def _side(a: Vector, b: Vector, c: Vector) -> Any:
    """Twice the signed area of a, b, c: positive where c lies left of the line from a to b."""
    return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
