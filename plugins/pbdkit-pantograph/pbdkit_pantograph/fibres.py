"""Two families of fibres: who is next along them, and across the cells between."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, TypeVar

import pbdkit
from pbdkit.plugin import Cell, NeighbourMetric, Offset, Slot, Vector, length

ALONG, NEXT, ACROSS = "along", "next", "across"
Role = tuple[str, int]
"""What a neighbour is to a pivot: along a fibre, next but one along it, or across a cell; and in
which of the four directions: 0 and 1 are the two ends of the first family, 2 and 3 of the other."""
Step = TypeVar("Step", Offset, Slot)


class Fibres(NeighbourMetric):
    """Shell 1: the next pivots along two families of fibres. Shell 2: the next but one. Shell 3:
    those across the cells between.

    The fibres run along the two shortest steps of the lattice that are not in line: along the axes
    of a square lattice, along the half diagonals of a centred-rectangular one, at ±45° where its
    a = b.
    """

    type: Literal["fibres"] = "fibres"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Four neighbours a shell. Raises ExperimentError where the lattice lacks one of them."""
        radius = 4 * max(math.hypot(*vector) for vector in cell.vectors)
        roles = roles_of(cell.offsets(sublattice, radius))
        return [[o for o, (what, _) in roles if what == shell] for shell in (ALONG, NEXT, ACROSS)]


def roles_of(steps: Iterable[Step]) -> list[tuple[Step, Role]]:
    """Those among the steps to a site's neighbours that are along or across the fibres.

    Raises ExperimentError where one of the twelve is missing.
    """
    known = list(steps)
    one, other = families_of([step.rest for step in known])
    rests = {
        (what, n): reach * e
        for what, reach in ((ALONG, 1), (NEXT, 2))
        for n, e in enumerate((one, -one, other, -other))
    }
    diagonals = one + other, -one - other, one - other, other - one
    rests |= {(ACROSS, n): e for n, e in enumerate(diagonals)}
    return [(_found(known, rest), role) for role, rest in rests.items()]


def families_of(rests: list[Vector[float]]) -> tuple[Vector[float], Vector[float]]:
    """The two shortest that are not in line, of equal ones those of the smallest angle to x."""
    shortest = min(math.hypot(*rest) for rest in rests)
    flat = 1e-6 * shortest
    ahead = [r for r in rests if r.y > flat or (abs(r.y) <= flat and r.x > 0)]
    ahead.sort(key=lambda r: (round(math.hypot(*r) / shortest, 6), math.atan2(max(r.y, 0.0), r.x)))
    one = ahead[0]
    other = next((r for r in ahead if abs(one.x * r.y - one.y * r.x) > flat * shortest), one)
    return one, other


def _found(steps: list[Step], rest: Vector[float]) -> Step:
    for step in steps:
        if length(step.rest - rest) < 1e-6 * length(rest):
            return step
    raise pbdkit.ExperimentError(
        f"fibres need a neighbour at ({rest.x:.4g}, {rest.y:.4g}): take a lattice of one site, "
        "and {type: fibres} for the neighbours"
    )
