"""Who is whose neighbour: by shells or by weighted distance (model.md, section 4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from pbdkit.errors import ExperimentError
from pbdkit.plugin import Cell, Nearness, NeighbourMetric, Offset, Vector
from pbdkit.plugin.units import LENGTH

MOST_NEIGHBOURS = 4224
"""As many as 32 shells of chebyshev neighbours."""
BALL = {2: math.pi, 3: 4 * math.pi / 3}
"""Area or volume of the unit ball, by the number of axes."""
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
        """The `shells` smallest distances between any two sites. A sublattice may have no neighbour
        in some of them."""
        ranks: list[list[Offset]] = []
        room = 8 * self.shells * size_of(cell) / len(cell.sites)
        radius = (room / BALL[cell.axes]) ** (1 / cell.axes)
        while len(ranks) <= self.shells:  # with one more, the shells before it are complete
            around = [cell.offsets(s, radius) for s in range(len(cell.sites))]
            everywhere = sorted((o for own in around for o in own), key=lambda o: o.length)
            ranks = _ranked(everywhere, [o.length for o in everywhere])
            radius *= 1.5
        lengths = [(shell[0].length, shell[-1].length) for shell in ranks[: self.shells]]
        return [[o for o in around[sublattice] if a <= o.length <= b] for a, b in lengths]


class Chebyshev(LatticeNeighbours):
    """Index distance max(|Δp|, |Δq|) in the primitive basis; shell n is distance exactly n."""

    type: Literal["chebyshev"] = "chebyshev"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Every offset up to index distance `shells`, grouped by it."""
        shells: list[list[Offset]] = [[] for _ in range(self.shells)]
        m, n = self._cells(cell)
        ends = product(range(len(cell.sites)), product(range(-m, m + 1), range(-n, n + 1)))
        near = [cell.offset(sublattice, target, step) for target, step in ends]
        for offset in sorted(near, key=lambda o: (o.length, o.site)):
            distance = max(abs(offset.primitive[0]), abs(offset.primitive[1]))
            if offset.site != (0, 0) and distance <= self.shells:
                shells[distance - 1].append(offset)
        return shells

    def _cells(self, cell: Cell) -> tuple[int, int]:
        """How many repeat cells on a site of index distance `shells` can lie: (m, n) for which
        m (pa, qa) + n (pb, qb) is no larger than that, and what basis sites differ by."""
        (pa, qa), (pb, qb) = cell.primitive
        basis = max(abs(p) for site in cell.sites for p in site.primitive)
        most, det = self.shells + 2 * basis, abs(pa * qb - qa * pb)
        return most * (abs(pb) + abs(qb)) // det, most * (abs(pa) + abs(qa)) // det


class Euclidean(NeighbourMetric):
    """All within √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9); a shell is a distinct distance.

    Unequal weights make the neighbourhood, and with it the body, anisotropic. With `reevaluate`
    the neighbours are found anew at every step, in the intermediate configuration. More than
    MOST_NEIGHBOURS are refused.
    """

    type: Literal["euclidean"] = "euclidean"
    radius: Annotated[float, Field(gt=0.0), LENGTH] = Field(
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
        """Ranked by weighted distance: by distance, where the plane is stretched by √w."""
        near, (wx, wy) = self.radius * (1 + 1e-9), map(math.sqrt, self.weights)
        vectors = tuple(Vector(wx * v.x, wy * v.y) for v in cell.vectors)
        sites = tuple(replace(s, at=Vector(wx * s.at.x, wy * s.at.y)) for s in cell.sites)
        stretched = replace(cell, vectors=vectors, sites=sites)
        if not (count := cells_within(stretched, near) * len(cell.sites)) <= MOST_NEIGHBOURS:
            raise ExperimentError(
                f"a radius of {self.radius:g} holds some {count:.3g} neighbours on this lattice, "
                f"and {MOST_NEIGHBOURS} is the most; take a smaller one",
                ("radius",),
            )
        found = stretched.offsets(sublattice, near)
        rest = [cell.offset(sublattice, o.target, o.cell) for o in found]
        return _ranked(rest, [o.length for o in found])

    def nearness(self) -> Nearness | None:
        """The same distance in the current configuration, if `reevaluate`."""
        return Nearness(self.radius, self.weights) if self.reevaluate else None


def size_of(cell: Cell) -> float:
    """The area of the repeat cell, in space its volume."""
    return abs(float(np.linalg.det(np.array(cell.vectors))))


def cells_within(cell: Cell, radius: float) -> float:
    """About how many repeat cells lie within a radius, or in lines across it where these are
    more."""
    longest, ball = max(math.hypot(*v) for v in cell.vectors), BALL[cell.axes]
    around = max(ball * radius, 2 * longest) * radius ** (cell.axes - 1)
    return around / max(size_of(cell), 5e-324)


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
