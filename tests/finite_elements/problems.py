"""The problems: E = 1, ν = .3, plane stress, thickness 1, left edge clamped, right edge moved by 1.

All of them look the same, up to signs, in a mirror along y = height/2 and in one along
x = length/2. So the lower left quarter is all that must be solved and kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

E, NU = 1.0, 0.3
FINEST = 80
"""Cells per unit length of the finest lattice on which references are kept."""


@dataclass(frozen=True)
class Problem:
    """A rectangle, with a hole in its middle where `radius` > 0.

    On the right edge the displacement is 1 along `pulled` (0 is x, 1 is y) and 0 across it.
    """

    name: str
    length: float
    height: float
    pulled: int = 0
    radius: float = 0.0
    hexagonal: bool = False
    """True if the reference is stored at the sites of the hexagonal lattice, and not of the square
    one."""

    @property
    def kept(self) -> tuple[int, ...]:
        """Cells per unit length of the lattices that have a reference at their sites."""
        return (20, 40, 80) if self.hexagonal else (10, 20, 40, 80)

    @property
    def rows(self) -> int:
        """Spacings of the finest lattice between the lower and the upper edge."""
        return round(self.height * FINEST * (2 / np.sqrt(3) if self.hexagonal else 1))

    @property
    def columns(self) -> int:
        """Spacings between the left and the right edge; half spacings if hexagonal, where every
        other row is shifted by one of them."""
        return round(self.length * FINEST) * (2 if self.hexagonal else 1)

    def sites(self, columns: int, rows: int):
        """x, y, both (i, j), of the kept grid's first `columns` and `rows` intervals, and which of
        its points are sites of the finest lattice in the body."""
        i, j = np.indices((columns + 1, rows + 1))
        x, y = i * self.length / self.columns, j * self.height / self.rows
        if self.hexagonal:
            return x, y, (i + j) % 2 == 0
        across_hole = (i - self.columns // 2) ** 2 + (j - self.rows // 2) ** 2
        return x, y, across_hole >= (self.radius * FINEST) ** 2

    @property
    def across(self) -> int:
        return 1 - self.pulled

    def unfold(self, quarter):
        """Displacements (2, i, j) of the whole body from those of the lower left quarter, both
        mid lines included.

        The displacement across the pull is odd in the lower mirror; the one along it, less ½, is
        odd in the other.
        """
        mirrored = quarter[:, ::-1].copy()
        mirrored[self.pulled] = 1 - mirrored[self.pulled]
        lower = np.concatenate([quarter, mirrored[:, 1:]], axis=1)
        upper = lower[:, :, ::-1].copy()
        upper[self.across] *= -1
        return np.concatenate([lower, upper[:, :, 1:]], axis=2)


BAR = Problem("bar", 2.0, 1.0)
CANTILEVER = Problem("cantilever", 4.0, 1.0, pulled=1)
HOLE = Problem("hole", 2.0, 2.0, radius=0.5)
HEXAGONAL_BAR = Problem("hexagonal-bar", 2.0, 92 * np.sqrt(3) / 2 / FINEST, hexagonal=True)
"""A whole even number of rows at n = 20, 40 and 80. Its height is .9959."""
PROBLEMS = {p.name: p for p in (BAR, CANTILEVER, HOLE, HEXAGONAL_BAR)}
