"""Neighbours fixed on the reference lattice (model.md, section 4)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from pbdkit.interfaces import Cell, NeighbourMetric, Offset

Shells = Annotated[int, Field(ge=1, le=32)]


class Coordination(NeighbourMetric):
    """Shells of distinct distance on the infinite lattice, equal within 1e-6 relative."""

    type: Literal["coordination"] = "coordination"
    shells: Shells = 1

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """The `shells` smallest distances; multiples of a cell vector give that many at least."""
        radius = self.shells * min(math.hypot(*v) for v in cell.vectors) * (1 + 1e-6)
        shells: list[list[Offset]] = []
        for offset in cell.offsets(sublattice, radius):
            if shells and offset.length <= shells[-1][0].length * (1 + 1e-6):
                shells[-1].append(offset)
            else:
                shells.append([offset])
        return shells[: self.shells]


class Chebyshev(NeighbourMetric):
    """Index distance max(|Δp|, |Δq|) in the primitive basis; shell n is distance exactly n."""

    type: Literal["chebyshev"] = "chebyshev"
    shells: Shells = 1

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Every offset up to index distance `shells`, grouped by it."""
        shells: list[list[Offset]] = [[] for _ in range(self.shells)]
        for offset in cell.offsets(sublattice, self._radius(cell)):
            distance = max(abs(offset.primitive[0]), abs(offset.primitive[1]))
            if distance <= self.shells:
                shells[distance - 1].append(offset)
        return shells

    def _radius(self, cell: Cell) -> float:
        """No offset of index distance `shells` is longer: the sum of both primitive steps."""
        (a, b), ((pa, qa), (pb, qb)) = cell.vectors, cell.primitive
        det = pa * qb - qa * pb
        along_p = math.hypot(qb * a.x - qa * b.x, qb * a.y - qa * b.y) / abs(det)
        along_q = math.hypot(pa * b.x - pb * a.x, pa * b.y - pb * a.y) / abs(det)
        return self.shells * (along_p + along_q) * (1 + 1e-9)
