"""Sums over neighbours on whole arrays: the loop over slots that rules and diagnostics share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot, Vector
from pbdkit.scene.raster import EMPTY, Block, Raster

BLOCK_CELLS = 16384
"""Places a block: small enough for its temporaries to stay in the cache."""
Present = NDArray[np.bool_] | None
"""Where a neighbour is present on a block; None where it is present everywhere."""
Contribution = Callable[[Slot], tuple[Any, ...]]


def planes(u: NDArray[Any], block: Block) -> Vector:
    """The components of u on a block, as views."""
    s, rows, columns = block.slices()
    return Vector(u[0, s, rows, columns], u[1, s, rows, columns])


def read_only(v: Vector) -> Vector:
    """The same, as components hand it to a rule: nobody writes to the state but the stepper."""
    for plane in v:
        plane.flags.writeable = False
    return v


def difference(u: NDArray[Any], block: Block, slot: Slot) -> Vector:
    """u_k - u_j along a slot, for every j of the block."""
    here, there = planes(u, block), planes(u, block.seen_through(slot))
    return Vector(there.x - here.x, there.y - here.y)


def presence(raster: Raster, block: Block, slots: Sequence[Slot]) -> list[Present]:
    """For each slot, where on the block the neighbour exists; only places with a particle count."""
    nobody = raster.kind[block.slices()] == EMPTY
    found: list[Present] = []
    for slot in slots:
        present = raster.kind[block.seen_through(slot).slices()] != EMPTY
        found.append(None if (present | nobody).all() else present)
    return found


def sum_over_slots(
    slots: Sequence[Slot], present: Sequence[Present], contribution: Contribution
) -> tuple[Any, ...]:
    """Σ over the slots of the contributions of the neighbours present, in the order of the slots.

    What a neighbour contributes equally everywhere may be a plain number, and stays one.
    """
    total: tuple[Any, ...] | None = None
    for slot, there in zip(slots, present, strict=True):
        parts = contribution(slot)
        if there is not None:
            parts = tuple(np.where(there, part, 0.0) for part in parts)
        total = parts if total is None else tuple(a + b for a, b in zip(total, parts, strict=True))
    return total or ()
