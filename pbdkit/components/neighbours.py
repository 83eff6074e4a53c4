"""Who is whose neighbour: by shells or by weighted distance (model.md, section 4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from pbdkit.interfaces import Cell, Nearness, NeighbourMetric, Offset

Shells = Annotated[int, Field(ge=1, le=32)]
Weight = Annotated[float, Field(gt=0.0)]


class LatticeNeighbours(NeighbourMetric):
    """Common to neighbours in shells of the lattice, which stay as they are."""

    shells: Shells = Field(1, description="How many shells count, from the nearest.", examples=[2])
    reevaluate: bool = Field(False, description="Always false: these neighbours stay.")

    @model_validator(mode="after")
    def _stay(self) -> LatticeNeighbours:
        if self.reevaluate:
            raise ValueError(
                f"{self.type} neighbours are defined on the lattice and cannot be re-evaluated; "
                "take euclidean ones, which have a radius"
            )
        return self


class Coordination(LatticeNeighbours):
    """Shells of distinct distance on the infinite lattice, equal within 1e-6 relative."""

    type: Literal["coordination"] = "coordination"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """The `shells` smallest distances between any two sites; multiples of a cell vector give
        that many at least. A sublattice may have no neighbour in some of them."""
        radius = self.shells * min(math.hypot(*v) for v in cell.vectors) * (1 + 1e-6)
        around = [cell.offsets(s, radius) for s in range(len(cell.sites))]
        everywhere = sorted((o for own in around for o in own), key=lambda o: o.length)
        ranks = _ranked(everywhere, [o.length for o in everywhere])[: self.shells]
        lengths = [(shell[0].length, shell[-1].length) for shell in ranks]
        return [[o for o in around[sublattice] if a <= o.length <= b] for a, b in lengths]


class Chebyshev(LatticeNeighbours):
    """Index distance max(|Δp|, |Δq|) in the primitive basis; shell n is distance exactly n."""

    type: Literal["chebyshev"] = "chebyshev"

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


class Euclidean(NeighbourMetric):
    """All within √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9); a shell is a distinct distance.

    Unequal weights make the neighbourhood, and with it the body, anisotropic. With `reevaluate`
    the neighbours are found anew at every step, in the intermediate configuration.
    """

    type: Literal["euclidean"] = "euclidean"
    radius: Annotated[float, Field(gt=0.0)] = Field(
        description="Weighted distance up to which particles are neighbours (lattice units).",
        examples=[1.5],
    )
    weights: Annotated[tuple[Weight, Weight], Field(strict=False)] = Field(
        (1.0, 1.0), description="w_x and w_y of the distance.", examples=[[1.0, 1.7]]
    )
    reevaluate: bool = Field(
        False, description="Whether neighbours are found anew at every step.", examples=[True]
    )

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Ranked by weighted distance."""
        near = self.radius * (1 + 1e-9)
        found = sorted(
            ((self._distance(o), o) for o in cell.offsets(sublattice, near / self._shrinkage())),
            key=lambda pair: pair[0],
        )
        inside = [(distance, o) for distance, o in found if distance <= near]
        return _ranked([o for _, o in inside], [distance for distance, _ in inside])

    def nearness(self) -> Nearness | None:
        """The same distance in the current configuration, if `reevaluate`."""
        return Nearness(self.radius, self.weights) if self.reevaluate else None

    def _distance(self, offset: Offset) -> float:
        (wx, wy), (x, y) = self.weights, offset.rest
        return math.sqrt(wx * x * x + wy * y * y)

    def _shrinkage(self) -> float:
        """The smallest ratio of weighted to plain distance."""
        return math.sqrt(min(self.weights)) * (1 - 1e-9)


def _ranked(offsets: Sequence[Offset], distances: Sequence[float]) -> list[list[Offset]]:
    """Shells of equal distance, within 1e-6 relative; the distances come sorted."""
    shells: list[list[Offset]] = []
    first = -1.0
    for offset, distance in zip(offsets, distances, strict=True):
        if shells and distance <= first * (1 + 1e-6):
            shells[-1].append(offset)
        else:
            shells.append([offset])
            first = distance
    return shells
