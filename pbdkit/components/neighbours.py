"""Neighbour metrics: shells of the lattice, or a weighted distance."""

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

MAX_NEIGHBOURS = 4224
"""Largest number of neighbours of a particle, as with 32 shells of Chebyshev neighbours."""
BALL = {2: math.pi, 3: 4 * math.pi / 3}
"""Area or volume of the unit ball, by the number of axes."""
Shells = Annotated[int, Field(ge=1, le=32)]
"""Type of the number of shells."""
Weight = Annotated[float, Field(gt=0.0)]
"""Type of a weight of the squared distance along an axis."""


class LatticeNeighbours(NeighbourMetric):
    """Base class of metrics that select shells of the lattice once, before the first step."""

    shells: Shells = Field(1, description="Number of shells, from the nearest.", examples=[2])
    reevaluate: bool = Field(False, description="Always false: these neighbours do not change.")

    @model_validator(mode="after")
    def _stay(self) -> LatticeNeighbours:
        if self.reevaluate:
            raise ValueError(
                f"{self.type} neighbours are defined on the lattice and cannot be re-evaluated; "
                "use {type: euclidean}, which has a radius"
            )
        return self


class Coordination(LatticeNeighbours):
    """Neighbours in shells of equal distance on the infinite lattice.

    Distances with a relative difference of at most 1e-6 are equal.
    """

    type: Literal["coordination"] = "coordination"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Return the offsets within the `shells` smallest distances between any two sites.

        A sublattice may have no neighbour in some of these shells.
        """
        groups: list[list[Offset]] = []
        room = 8 * self.shells * size_of(cell) / len(cell.sites)
        radius = (room / BALL[cell.axes]) ** (1 / cell.axes)
        # If there is one more group than requested shells, all these shells are complete.
        while len(groups) <= self.shells:
            offsets = [cell.offsets(s, radius) for s in range(len(cell.sites))]
            sorted_offsets = sorted((o for ends in offsets for o in ends), key=lambda o: o.length)
            groups = _ranked(sorted_offsets, [o.length for o in sorted_offsets])
            radius *= 1.5
        lengths = [(shell[0].length, shell[-1].length) for shell in groups[: self.shells]]
        return [[o for o in offsets[sublattice] if a <= o.length <= b] for a, b in lengths]


class Chebyshev(LatticeNeighbours):
    """Neighbours by the index distance max(|Δp|, |Δq|) in the primitive basis.

    A shell contains all neighbours at one index distance.
    """

    type: Literal["chebyshev"] = "chebyshev"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Return all offsets up to the index distance `shells`, grouped by their index distance."""
        shells: list[list[Offset]] = [[] for _ in range(self.shells)]
        m, n = self._cells(cell)
        ends = product(range(len(cell.sites)), product(range(-m, m + 1), range(-n, n + 1)))
        candidates = [cell.offset(sublattice, target, step) for target, step in ends]
        for offset in sorted(candidates, key=lambda o: (o.length, o.site)):
            distance = max(abs(offset.primitive[0]), abs(offset.primitive[1]))
            if offset.site != (0, 0) and distance <= self.shells:
                shells[distance - 1].append(offset)
        return shells

    def _cells(self, cell: Cell) -> tuple[int, int]:
        """Return bounds on |m| and |n| of the repeat cells with neighbours.

        These are the (m, n) for which m (pa, qa) + n (pb, qb) does not exceed `shells` plus the
        largest difference between basis sites.
        """
        (pa, qa), (pb, qb) = cell.primitive
        basis = max(abs(p) for site in cell.sites for p in site.primitive)
        bound, det = self.shells + 2 * basis, abs(pa * qb - qa * pb)
        return bound * (abs(pb) + abs(qb)) // det, bound * (abs(pa) + abs(qa)) // det


class Euclidean(NeighbourMetric):
    """Neighbours within a weighted distance: √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9).

    A shell consists of all offsets at one distance. With unequal weights, the neighbourhood and
    thus the body are anisotropic. With `reevaluate`, the neighbours are determined again in every
    step, in the intermediate configuration. More than `MAX_NEIGHBOURS` neighbours are an error.
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
        False, description="Determine the neighbours again at every step.", examples=[True]
    )

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Return the offsets within the radius, grouped by weighted distance.

        The weighted distance is the Euclidean distance in a plane stretched by √w along each axis.

        Raises
        ------
        ExperimentError
            If the radius contains more than `MAX_NEIGHBOURS` neighbours.
        """
        radius, (wx, wy) = self.radius * (1 + 1e-9), map(math.sqrt, self.weights)
        vectors = tuple(Vector(wx * v.x, wy * v.y) for v in cell.vectors)
        sites = tuple(replace(s, at=Vector(wx * s.at.x, wy * s.at.y)) for s in cell.sites)
        stretched = replace(cell, vectors=vectors, sites=sites)
        if not (count := cells_within(stretched, radius) * len(cell.sites)) <= MAX_NEIGHBOURS:
            raise ExperimentError(
                f"a radius of {self.radius:g} contains about {count:.3g} neighbours on this "
                f"lattice; the maximum is {MAX_NEIGHBOURS}; decrease the radius",
                ("radius",),
            )
        offsets = stretched.offsets(sublattice, radius)
        rest = [cell.offset(sublattice, o.target, o.cell) for o in offsets]
        return _ranked(rest, [o.length for o in offsets])

    def nearness(self) -> Nearness | None:
        """Return the distance in the current configuration if `reevaluate` is set, else None."""
        return Nearness(self.radius, self.weights) if self.reevaluate else None


def size_of(cell: Cell) -> float:
    """Return the area of the repeat cell; in three dimensions its volume."""
    return abs(float(np.linalg.det(np.array(cell.vectors))))


def cells_within(cell: Cell, radius: float) -> float:
    """Estimate the number of repeat cells within a radius.

    If a cell vector is longer than the radius, at least one cell is counted along it.
    """
    longest, ball = max(math.hypot(*v) for v in cell.vectors), BALL[cell.axes]
    region = max(ball * radius, 2 * longest) * radius ** (cell.axes - 1)
    return region / max(size_of(cell), 5e-324)


def _ranked(offsets: Sequence[Offset], distances: Sequence[float]) -> list[list[Offset]]:
    """Group sorted offsets into shells of equal distance, to a relative tolerance of 1e-6."""
    shells: list[list[Offset]] = []
    first = -1.0
    for offset, distance in zip(offsets, distances, strict=True):
        if shells and distance <= first * (1 + 1e-6):
            shells[-1].append(offset)
        else:
            shells.append([offset])
            first = distance
    return shells
