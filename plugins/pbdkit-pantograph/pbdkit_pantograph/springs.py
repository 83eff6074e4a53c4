"""Pivots as two points that coincide, on fibres of springs that stay straight."""

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

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Stiffness and rest length of the spring, and 1 for the one of the eight points along the
        fibres that it is: `next0` to `next3`, and `after0` to `after3` behind them."""
        roles = {s.rest: role for s, role in roles_of(setting.slots[slot.source])}
        what, direction = roles.get(slot.rest, ("", 0))
        stiffness = {ALONG: 1.0, ACROSS: self.shear}.get(what, 0.0)
        return {
            "stiffness": stiffness,
            "rest": length(slot.rest),
            **{f"next{n}": float((ALONG, n) == (what, direction)) for n in range(4)},
            **{f"after{n}": float((NEXT, n) == (what, direction)) for n in range(4)},
        }

    @staticmethod
    def gather(d: Vector, r: Vector, w: Any, p: Any) -> tuple[Any, ...]:
        """(k e n, k) of the spring, e = |r + d| - |r|; then d and presence at each of the eight
        points along the fibres."""
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
        """Σ forces / Σ stiffness; no move where there is neither."""
        pull, stiffness = total[0], total[1]
        one, one_stiffness = _bent(total[2:6], total[10:14])
        other, other_stiffness = _bent(total[6:10], total[14:18])
        stiffness = stiffness + p.bending * (one_stiffness + other_stiffness)
        force = pull + p.bending * (one + other)
        move: Vector = force / where(stiffness > 0.0, stiffness, 1.0)
        return move


def _bent(next_points: Any, after: Any) -> tuple[Any, Any]:
    """Force and stiffness of one fibre against bending, from (d, presence) of the points at its
    both ends, next and next but one.

    Three points in a row that are all there resist; in differences of displacements, as rest
    offsets along a fibre cancel. The stiffness is half the sum of the moduli of a row of the
    quadratic form: with no less the energy might rise.
    """
    u, has_u, v, has_v = next_points
    uu, has_uu, vv, has_vv = after
    middle, one, other = has_u * has_v, has_u * has_uu, has_v * has_vv
    force = 2.0 * middle * (u + v) + (one * (2.0 * u - uu) + other * (2.0 * v - vv))
    return force, 4.0 * middle + 2.0 * (one + other)
