"""What stands around particles: their neighbours, and who is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Components, Slot
from pbdkit.scene.raster import EMPTY, Raster, Where

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Neighbour:
    """One neighbour of some particles, or of one: its rest offset r and the rule's weights w; where
    it is `present` and where the bond is `broken` (None: everywhere, nowhere); with fracture the
    constants c of the bond, what is remembered of it included."""

    r: Components
    w: Any
    present: Mask | None = None
    broken: Mask | None = None
    c: Any = None


@dataclass(frozen=True)
class Around:
    """What stays as it is around some particles: their slots with weights and presence, X and its
    distance from the middle of the body where the rule asks for them, and where particles of the
    body have a neighbour (None: everywhere)."""

    where: Where
    slots: tuple[Slot, ...]
    weights: tuple[Any, ...]
    present: tuple[Mask | None, ...]
    X: Any
    centred: Any
    movable: Mask | None


def read_only(v: Any) -> Any:
    """The same, as components hand it to a rule: nobody writes to the state but the stepper."""
    for plane in v:
        plane.flags.writeable = False
    return v


def presence(raster: Raster, place: Where, slots: Sequence[Slot]) -> list[Mask | None]:
    """For each slot, where the neighbour exists, None where it does everywhere; only places with a
    particle count."""
    nobody = place.of(raster.kind) == EMPTY
    found: list[Mask | None] = []
    for slot in slots:
        present = place.seen_through(slot).of(raster.kind) != EMPTY
        found.append(None if (present | nobody).all() else present)
    return found
