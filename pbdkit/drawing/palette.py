"""Colours of what has a name and no number: kinds of particles, roles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER

if TYPE_CHECKING:
    from pbdkit.drawing.quantity import Quantity
    from pbdkit.drawing.recording import Snapshot

KINDS = {
    int(FRAME): ("frame", "#F0E442"),
    int(FOLLOWER): ("follower", "#0072B2"),
    int(LEADER): ("leader", "#D55E00"),
}
"""Names and colours (of Okabe and Ito), in the order of drawing."""
OTHERS = ("#0072B2", "#F0E442", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")


@dataclass(frozen=True)
class Palette:
    """Names and colours by the number of a class, those on top last: of the kinds, or, not
    `of_kind`, of the values of a quantity."""

    colours: dict[int, tuple[str, str]]
    of_kind: bool

    def ranks(self, now: Snapshot) -> NDArray[Any]:
        """Which colour, counted from 0, each particle has; NaN where it is of no class."""
        classes = now.kind if self.of_kind or now.values is None else now.values
        found = np.full(len(now.kind), np.nan)
        for rank, number in enumerate(self.colours):
            found[classes == number] = rank
        return found


OF_KINDS = Palette(KINDS, True)


def palette_of(quantity: Quantity) -> Palette:
    """That of a quantity that has words."""
    if quantity.variable == "kind":
        return OF_KINDS
    words = enumerate(quantity.words.items())
    return Palette({k: (word, OTHERS[n % len(OTHERS)]) for n, (k, word) in words}, False)
