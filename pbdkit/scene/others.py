"""Those who have the other rows of a lattice, while each process builds the scene of its own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.places import LeftOut, Mask, hull

Box = tuple[tuple[Any, ...], tuple[Any, ...]]


@dataclass(frozen=True)
class Stretch:
    """Some `lines` of sites of a lattice, from the first to below the second; `before` particles
    are before them. What of the body is near lies from the site `low` to below `high`. `rows` are
    the particles of each row of repeat cells of the lattice, padding included, from the cells
    `first` on. `left_out` are the cells left out at narrow voids, of the whole."""

    lines: tuple[int, int]
    low: Index
    high: Index
    before: int
    rows: NDArray[np.int64]
    first: int
    left_out: LeftOut


class Others:
    """Here there is nobody: one process has all rows. Each call is made by all processes, in the
    same order, and comes to the same in all of them."""

    size: int = 1
    """How many processes there are in all."""
    on_machine: int = 1
    """Of which so many share the memory of this machine."""
    stretch: Stretch | None = None
    """What this process builds of the scene; None of all."""

    def every(self, value: Any) -> list[Any]:
        """The values of all processes, in the order of their rows."""
        return [value]

    def least(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """The smallest of all processes, place by place of arrays of one shape."""
        return numbers

    def is_own(self, lines: Indices) -> Mask:
        """Which lines of sites are of its own rows; of each line that is so in one process."""
        return np.ones(len(lines), bool)

    def sees_frame(self, lines: Indices) -> Mask:
        """Of which lines of sites it has to know whom frame points follow."""
        return np.ones(len(lines), bool)

    def any(self, value: Any) -> bool:
        """Whether it is so in any process."""
        return any(self.every(bool(value)))

    def first(self, value: Any) -> Any:
        """What the first process has that has not None; None where none has."""
        return next((one for one in self.every(value) if one is not None), None)

    def hull(self, boxes: Iterable[Box]) -> Box:
        """The smallest and the largest number along each axis, over the boxes of all."""
        return hull(box for own in self.every(list(boxes)) for box in own)


ALONE: Final = Others()
