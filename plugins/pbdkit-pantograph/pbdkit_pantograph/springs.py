"""Pantographic sheet of springs: pivots are pairs of coincident points on elastic fibres."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from pbdkit.plugin import (
    FollowerRule,
    Here,
    Parameters,
    Setting,
    Slot,
    Vector,
    dot,
    length,
    where,
)
from pbdkit_pantograph.fibres import ACROSS, ALONG, NEXT, roles_of


class Pantograph(FollowerRule):
    """A pivot is a pair of coincident points, one on each fibre; its target is the weighted mean of
    the targets of both fibres.

    The links of a fibre are springs of stiffness 1, and k_b = `bending` is the bending stiffness of
    a fibre. With D = x_k - x_j to the first (1) and second (2) points along it, the move of a fibre
    is

        (Σ (D_1 - l D_1/|D_1|) + k_b (4 Σ D_1 - Σ D_2)) / (2 + 8 k_b)

    which decreases ½ Σ (|D_1| - l)² + ½ k_b Σ |x_(i+1) - 2 x_i + x_(i-1)|². At the ends of fibres
    missing terms are omitted, and the weight of the fibre decreases with their number. Pivots
    rotate freely unless `shear` k_s adds springs across the cells. The energy does not increase
    with relaxation 1, and it is invariant under rotations.
    """

    type: Literal["pantograph"] = "pantograph"
    bending: float = Field(
        0.01,
        ge=0.0,
        le=1e6,
        description="Bending stiffness of fibres relative to the stiffness of their links.",
        examples=[0.1],
    )
    shear: float = Field(
        0.0,
        ge=0.0,
        le=1e6,
        description="Stiffness of springs across cells relative to that of the links.",
        examples=[0.01],
    )

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return stiffness and rest length of a spring, and indicators of the points along fibres.

        `next0` to `next3` are 1 for the first point in that direction, `after0` to `after3` for the
        second.
        """
        roles = {s.rest: role for s, role in roles_of(setting.slots[slot.source])}
        relation, direction = roles.get(slot.rest, ("", 0))
        stiffness = {ALONG: 1.0, ACROSS: self.shear}.get(relation, 0.0)
        return {
            "stiffness": stiffness,
            "rest": length(slot.rest),
            **{f"next{n}": float((ALONG, n) == (relation, direction)) for n in range(4)},
            **{f"after{n}": float((NEXT, n) == (relation, direction)) for n in range(4)},
        }

    @staticmethod
    def gather(d: Vector, r: Vector, w: Any, p: Any) -> tuple[Any, ...]:
        """Return (k e n, k) of the spring, e = |r + d| - |r|, n its direction; then d and presence
        of each of the eight points along the fibres."""
        v = r + d
        distance = length(v)
        # |v|² - |r|² = d·(r + v): small elongations keep all their digits.
        elongation = dot(d, r + v) / (distance + w.rest)
        pull = w.stiffness * elongation / where(distance > 0.0, distance, 1.0)
        return (
            pull * v, w.stiffness,
            w.next0 * d, w.next0, w.next1 * d, w.next1,
            w.next2 * d, w.next2, w.next3 * d, w.next3,
            w.after0 * d, w.after0, w.after1 * d, w.after1,
            w.after2 * d, w.after2, w.after3 * d, w.after3,
        )  # fmt: skip

    @staticmethod
    def apply(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """Return Σ forces / Σ stiffness; zero without stiffness."""
        pull, stiffness = total[0], total[1]
        first, first_stiffness = _bending(total[2:6], total[10:14])
        second, second_stiffness = _bending(total[6:10], total[14:18])
        stiffness = stiffness + p.bending * (first_stiffness + second_stiffness)
        force = pull + p.bending * (first + second)
        move: Vector = force / where(stiffness > 0.0, stiffness, 1.0)
        return move


def _bending(first_points: Any, second_points: Any) -> tuple[Any, Any]:
    """Return bending force and stiffness of one fibre, from (d, presence) of its first and second
    points in both directions.

    Each triple of consecutive points that are present contributes. Rest offsets along a fibre
    cancel, so that differences of displacements suffice. The stiffness is half the sum of the
    absolute values in a row of the quadratic form, the least for which the energy cannot increase.
    """
    u, has_u, v, has_v = first_points
    uu, has_uu, vv, has_vv = second_points
    middle, ahead, behind = has_u * has_v, has_u * has_uu, has_v * has_vv
    force = 2.0 * middle * (u + v) + (ahead * (2.0 * u - uu) + behind * (2.0 * v - vv))
    return force, 4.0 * middle + 2.0 * (ahead + behind)
