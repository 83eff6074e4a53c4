"""Pantographic sheets for pbdkit: two families of fibres, joined where they cross by pivots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Literal, TypeVar

from pydantic import Field

import pbdkit

pbdkit_api = 1

ALONG, NEXT, ACROSS = "along", "next", "across"
Role = tuple[str, int]
"""What a neighbour is to a pivot: along a fibre, next but one along it, or across a cell; and in
which of the four directions: 0 and 1 are the two ends of the first family, 2 and 3 of the other."""
Step = TypeVar("Step", pbdkit.Offset, pbdkit.Slot)


class Fibres(pbdkit.NeighbourMetric):
    """Shell 1: the next pivots along two families of fibres. Shell 2: the next but one. Shell 3:
    those across the cells between.

    The fibres run along the two shortest steps of the lattice that are not in line: along the axes
    of a square lattice, along the half diagonals of a centred-rectangular one, at ±45° where its
    a = b.
    """

    type: Literal["fibres"] = "fibres"

    def shells_around(self, cell: pbdkit.Cell, sublattice: int) -> list[list[pbdkit.Offset]]:
        """Four neighbours a shell. Raises ExperimentError where the lattice lacks one of them."""
        radius = 4 * max(math.hypot(*vector) for vector in cell.vectors)
        roles = _roles(cell.offsets(sublattice, radius))
        return [[o for o, (what, _) in roles if what == shell] for shell in (ALONG, NEXT, ACROSS)]


class Pantograph(pbdkit.FollowerRule):
    """A pivot is two points that coincide, one on each fibre; it moves to the average of the places
    that the two fibres propose.

    The links of a fibre are springs of stiffness 1, and k_b = `bending` is that of the fibre
    against being bent. A fibre proposes to its point, with D = x_k - x_j to the next points (1) and
    those after them (2),

        (Σ (D_1 - l D_1/|D_1|) + k_b (4 Σ D_1 - Σ D_2)) / (2 + 8 k_b)

    which lowers ½ Σ (|D_1| - l)² + ½ k_b Σ |x_(i+1) - 2 x_i + x_(i-1)|². At the ends of fibres the
    terms that are missing are left out, and a fibre weighs the less, the fewer there are. Pivots
    turn freely unless `shear` k_s puts springs across the cells. The energy of all this never rises
    with relaxation 1, and rotations are exact.
    """

    type: Literal["pantograph"] = "pantograph"
    bending: float = Field(
        0.01,
        ge=0.0,
        le=1e6,
        description="Stiffness of fibres against bending, over that of their links.",
        examples=[0.1],
    )
    shear: float = Field(
        0.0,
        ge=0.0,
        le=1e6,
        description="Stiffness of springs across the cells, over that of the links.",
        examples=[0.01],
    )

    def weights(self, slot: pbdkit.Slot, setting: pbdkit.Setting) -> tuple[float, ...]:
        """Stiffness and rest length of the spring, then 1 for the one of the eight points along the
        fibres that it is."""
        roles = {s.rest: role for s, role in _roles(setting.slots[slot.source])}
        what, direction = roles.get(slot.rest, ("", 0))
        stiffness = {ALONG: 1.0, ACROSS: self.shear}.get(what, 0.0)
        places = [(ALONG, n) for n in range(4)] + [(NEXT, n) for n in range(4)]
        rest = float(pbdkit.length(slot.rest))
        return (stiffness, rest, *(float(place == (what, direction)) for place in places))

    @staticmethod
    def gather(d: pbdkit.Vector, r: pbdkit.Vector, w: Any, p: Any) -> tuple[Any, ...]:
        """(k e n, k) of the spring, e = |r + d| - |r|; then d and presence at each of the eight
        points along the fibres."""
        stiffness, rest = w[0], w[1]
        v = pbdkit.Vector(r.x + d.x, r.y + d.y)
        distance = pbdkit.length(v)
        # |v|² - |r|² = d·(r + v): small elongations keep all their digits.
        elongation = (d.x * (r.x + v.x) + d.y * (r.y + v.y)) / (distance + rest)
        pull = stiffness * elongation / pbdkit.where(distance > 0.0, distance, 1.0)
        x, y = d.x, d.y
        return (
            pull * v.x, pull * v.y, stiffness,
            w[2] * x, w[2] * y, w[2], w[3] * x, w[3] * y, w[3],
            w[4] * x, w[4] * y, w[4], w[5] * x, w[5] * y, w[5],
            w[6] * x, w[6] * y, w[6], w[7] * x, w[7] * y, w[7],
            w[8] * x, w[8] * y, w[8], w[9] * x, w[9] * y, w[9],
        )  # fmt: skip

    @staticmethod
    def apply(total: Any, here: pbdkit.Here, p: Any) -> tuple[Any, Any]:
        """Σ forces / Σ stiffness; no move where there is neither."""
        ax, ay, a = _bent(total[3:9], total[15:21])
        bx, by, b = _bent(total[9:15], total[21:27])
        x = total[0] + p.bending * (ax + bx)
        y = total[1] + p.bending * (ay + by)
        stiffness = total[2] + p.bending * (a + b)
        share = pbdkit.where(stiffness > 0.0, stiffness, 1.0)
        return x / share, y / share


def _bent(next_points: Any, after: Any) -> tuple[Any, Any, Any]:
    """Force and stiffness of one fibre against bending, from (d, presence) of the points at its
    both ends, next and next but one.

    Three points in a row that are all there resist; in differences of displacements, as rest
    offsets along a fibre cancel. The stiffness is half the sum of the moduli of a row of the
    quadratic form: with no less the energy might rise.
    """
    ux, uy, u, vx, vy, v = next_points
    uux, uuy, uu, vvx, vvy, vv = after
    middle, one, other = u * v, u * uu, v * vv
    x = 2.0 * middle * (ux + vx) + (one * (2.0 * ux - uux) + other * (2.0 * vx - vvx))
    y = 2.0 * middle * (uy + vy) + (one * (2.0 * uy - uuy) + other * (2.0 * vy - vvy))
    return x, y, 4.0 * middle + 2.0 * (one + other)


def _roles(steps: Iterable[Step]) -> list[tuple[Step, Role]]:
    """Those among the steps to a site's neighbours that are along or across the fibres.

    Raises ExperimentError where one of the twelve is missing.
    """
    known = list(steps)
    one, other = _families([step.rest for step in known])
    rests = {
        (ALONG, n): pbdkit.Vector(sign * e.x, sign * e.y)
        for n, (e, sign) in enumerate((e, sign) for e in (one, other) for sign in (1, -1))
    }
    rests |= {(NEXT, n): pbdkit.Vector(2 * e.x, 2 * e.y) for (_, n), e in list(rests.items())}
    diagonals = (1, 1), (-1, -1), (1, -1), (-1, 1)
    rests |= {
        (ACROSS, n): pbdkit.Vector(s * one.x + t * other.x, s * one.y + t * other.y)
        for n, (s, t) in enumerate(diagonals)
    }
    return [(_found(known, rest), role) for role, rest in rests.items()]


def _families(rests: list[pbdkit.Vector]) -> tuple[pbdkit.Vector, pbdkit.Vector]:
    """The two shortest that are not in line, of equal ones those of the smallest angle to x."""
    shortest = min(math.hypot(*rest) for rest in rests)
    flat = 1e-6 * shortest
    ahead = [r for r in rests if r.y > flat or (abs(r.y) <= flat and r.x > 0)]
    ahead.sort(key=lambda r: (round(math.hypot(*r) / shortest, 6), math.atan2(max(r.y, 0.0), r.x)))
    one = ahead[0]
    other = next((r for r in ahead if abs(one.x * r.y - one.y * r.x) > flat * shortest), one)
    return one, other


def _found(steps: list[Step], rest: pbdkit.Vector) -> Step:
    for step in steps:
        if math.hypot(step.rest.x - rest.x, step.rest.y - rest.y) < 1e-6 * math.hypot(*rest):
            return step
    raise pbdkit.ExperimentError(
        f"fibres need a neighbour at ({rest.x:.4g}, {rest.y:.4g}): take a lattice of one site, "
        "and {type: fibres} for the neighbours"
    )


@pbdkit.hookimpl
def pbdkit_components() -> list[type[pbdkit.Component]]:
    """What this distribution offers."""
    return [Fibres, Pantograph]
