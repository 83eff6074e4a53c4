"""Neighbours along two families of fibres, and across the cells between them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, TypeVar

import pbdkit
from pbdkit.plugin import Cell, NeighbourMetric, Offset, Slot, Vector, length

ALONG, NEXT, ACROSS = "along", "next", "across"
Role = tuple[str, int]
"""Relation of a neighbour to a pivot (along a fibre, second along it, or across a cell), and its
direction: 0 and 1 are the two directions of the first family, 2 and 3 those of the second."""
Step = TypeVar("Step", Offset, Slot)


class Fibres(NeighbourMetric):
    """Neighbours along two families of fibres (shells 1 and 2) and across cells (shell 3).

    Shell 1 contains the next pivots along both families, shell 2 the second ones. Fibres run along
    the two shortest lattice vectors that are not parallel: along the axes of a square lattice,
    along the half diagonals of a centred-rectangular one, at ±45° if a = b.
    """

    type: Literal["fibres"] = "fibres"

    def shells_around(self, cell: Cell, sublattice: int) -> list[list[Offset]]:
        """Return four neighbours per shell.

        Raises
        ------
        ExperimentError
            If the lattice lacks one of them.
        """
        radius = 4 * max(math.hypot(*vector) for vector in cell.vectors)
        roles = roles_of(cell.offsets(sublattice, radius))
        return [[o for o, (what, _) in roles if what == shell] for shell in (ALONG, NEXT, ACROSS)]


def roles_of(steps: Iterable[Step]) -> list[tuple[Step, Role]]:
    """Select the steps to neighbours along and across the fibres.

    Raises
    ------
    ExperimentError
        If one of the twelve is missing.
    """
    candidates = list(steps)
    first, second = families_of([step.rest for step in candidates])
    rests = {
        (what, n): reach * e
        for what, reach in ((ALONG, 1), (NEXT, 2))
        for n, e in enumerate((first, -first, second, -second))
    }
    diagonals = first + second, -first - second, first - second, second - first
    rests |= {(ACROSS, n): e for n, e in enumerate(diagonals)}
    return [(_step_at(candidates, rest), role) for role, rest in rests.items()]


def families_of(rests: list[Vector[float]]) -> tuple[Vector[float], Vector[float]]:
    """Return the two shortest vectors that are not parallel; of equal ones those nearest to x."""
    shortest = min(math.hypot(*rest) for rest in rests)
    flat = 1e-6 * shortest
    ahead = [r for r in rests if r.y > flat or (abs(r.y) <= flat and r.x > 0)]
    ahead.sort(key=lambda r: (round(math.hypot(*r) / shortest, 6), math.atan2(max(r.y, 0.0), r.x)))
    first = ahead[0]
    across = (r for r in ahead if abs(first.x * r.y - first.y * r.x) > flat * shortest)
    return first, next(across, first)


def _step_at(steps: list[Step], rest: Vector[float]) -> Step:
    for step in steps:
        if length(step.rest - rest) < 1e-6 * length(rest):
            return step
    raise pbdkit.ExperimentError(
        f"fibres need a neighbour at ({rest.x:.4g}, {rest.y:.4g}); use a lattice with one site per "
        "cell, and neighbours: {type: fibres}"
    )
