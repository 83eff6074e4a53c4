"""Pivots that carry the rotations of the two beams that cross there."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

import pbdkit
from pbdkit.plugin import (
    AREA,
    LENGTH,
    FollowerRule,
    Here,
    Number,
    Parameters,
    Remembered,
    Setting,
    SharesParticles,
    Slot,
    TurnsParticles,
    Vector,
    dot,
    length,
    where,
)
from pbdkit_pantograph.fibres import families_of

SHARE = 0.75
"""Of the step at which the energy of the stiffest motion of a beam just would not fall."""
SLENDEREST = 1e-10
"""Below this bending over stretching · link² the stiffness of a fibre across its own axis drowns in
the roundings of that along it."""


class PantographBeams(SharesParticles, TurnsParticles, FollowerRule):
    """Beams of Euler and Bernoulli from pivot to pivot, which remember how the two beams that cross
    there have turned.

    With v = x_k - x_j, l = |r|, Q_j r the beam's direction at pivot j, and φ_j the angle from there
    to v, measured as t = 2 tan(φ/2), a link stores

        stretching/(2 l) (|v| - l)² + 2 bending/l (t_j² + t_j t_k + t_k²),

    a pivot pivot/2 · t², t of the angle between its two rotations. A pivot goes to where the forces
    on it vanish with its neighbours and directions as they are, its directions to where the moments
    do, by 3/4 of a stiffness with which the energy of small motions never rises. Leaders turn
    freely unless they are clamped.
    """

    type: Literal["pantograph-beams"] = "pantograph-beams"
    stretching: float = Field(
        1.0, gt=0.0, le=1e12, description="EA of a fibre: force over strain.", examples=[100.0]
    )
    bending: Annotated[float, Field(gt=0.0, le=1e12), AREA] = Field(
        0.01,
        description="EI of a fibre: moment over curvature, in the unit of `stretching` × length².",
        examples=[1.0],
    )
    pivot: Annotated[float, Field(ge=0.0, le=1e12), LENGTH] = Field(
        0.0,
        description="Moment of a pivot over the angle between its fibres, in the unit of "
        "`stretching` × length; 0: they turn freely.",
        examples=[0.1],
    )

    def parameters(self, setting: Setting) -> dict[str, float]:
        """Raises ExperimentError for fibres that are too slender for the numbers of a computer."""
        least = max(length(slot.rest) for slots in setting.slots for slot in slots[:1])
        if self.bending < SLENDEREST * self.stretching * least**2:
            raise pbdkit.ExperimentError(
                f"bending is less than {SLENDEREST:g} of stretching · link²; take stiffer fibres, "
                "or {type: pantograph}"
            )
        return self.numeric_parameters()

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """`one` and `other`: whether the neighbour is next along that family; the rest length."""
        around = setting.slots[slot.source]
        families = families_of([s.rest for s in around])
        along = [min(length(slot.rest - e), length(slot.rest + e)) for e in families]
        rest = float(length(slot.rest))
        one, other = (float(apart < 1e-6 * rest) for apart in along)
        return {"one": one, "other": other, "rest": rest}

    def remembered(self) -> tuple[Remembered, ...]:
        """Both rotations, and for those who record: the force of the beams and the energy."""
        rotations = [
            Remembered(f"{which}_{part}", f"{what} of the {which} fibre's rotation", "1", at)
            for which in ("first", "second")
            for part, what, at in (("cos", "cosine", 1.0), ("sin", "sine", 0.0))
        ]
        force = [
            Remembered(f"force_{c}", f"force of the beams on the pivot along {c}", "force")
            for c in "xy"
        ]
        energy = Remembered("energy", "energy of the pivot and half its links", "energy")
        return (*rotations, *force, energy)

    def rotations(self) -> tuple[tuple[str, str], ...]:
        """Of both fibres."""
        return ("first_cos", "first_sin"), ("second_cos", "second_sin")

    @staticmethod
    def gather(  # type: ignore[override]  # SharesParticles: it is given more
        d: Any, r: Any, w: Any, p: Any, own: Any, there: Any
    ) -> tuple[Any, ...]:
        """Force; stiffness xx, xy, yy; by family the moment, and the stiffness that goes with it;
        half the energy."""
        v, is_beam = r + d, w.one + w.other
        span = length(v)
        safe = where(span > 0.0, span, 1.0)
        t = _lag(_rotated(r, w, own), v, w.rest * span)
        t_there = _lag(_rotated(r, w, there), v, w.rest * span)
        # |v|² - |r|² = d·(r + v): small elongations keep all their digits.
        elongation = dot(d, r + v) / (span + w.rest)
        stretching, bending = is_beam * p.stretching / w.rest, is_beam * p.bending / w.rest
        slope, slope_there = 1.0 + t * t / 4.0, 1.0 + t_there * t_there / 4.0
        moment = 2.0 * bending * (2.0 * t + t_there) * slope
        moment_there = 2.0 * bending * (2.0 * t_there + t) * slope_there
        pull, shear = stretching * elongation, (moment + moment_there) / safe
        along = v / safe
        across = Vector(-along.y, along.x)
        tension = where(pull > 0.0, pull, 0.0 * pull) / safe
        # Least multiples of a link's own stiffnesses that bound it, rotations of both ends and all.
        stiff = 21.0 * bending * slope * slope_there / (safe * safe) + tension
        turning = 7.0 * bending * slope * slope
        bent = bending * (t * t + t * t_there + t_there * t_there)
        return (
            pull * along + shear * across,
            stretching * along.x * along.x + stiff * across.x * across.x,
            stretching * along.x * along.y + stiff * across.x * across.y,
            stretching * along.y * along.y + stiff * across.y * across.y,
            w.one * moment, w.other * moment, w.one * turning, w.other * turning,
            stretching * elongation * elongation / 4.0 + bent,
        )  # fmt: skip

    @staticmethod
    def apply(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """Stiffness⁻¹ · force, less a quarter; no move where there is no beam."""
        force, xx, xy, yy = total[0], total[1], total[2], total[3]
        area = xx * yy - xy * xy
        safe = where(area > 0.0, area, 1.0)
        x, y = yy * force.x - xy * force.y, xx * force.y - xy * force.x
        return SHARE * Vector(x / safe, y / safe)

    @staticmethod
    def remember(total: tuple[Any, ...], here: Here, p: Parameters) -> tuple[Number, ...]:
        """Rotations that balance the moments of beams and pivot; force and energy as they are."""
        own, force = here.own, total[0]
        sine = own.first_sin * own.second_cos - own.first_cos * own.second_sin
        cosine = own.first_cos * own.second_cos + own.first_sin * own.second_sin
        t = 2.0 * sine / where(cosine > -1.0, 1.0 + cosine, 1.0)
        slope = 1.0 + t * t / 4.0
        twist, spring = p.pivot * t * slope, p.pivot * slope * slope
        one, other = _stiffness(total[6], total[7]), _stiffness(total[7], total[6])
        first, second = total[4] - twist, total[5] + twist
        both = one * other + spring * (one + other)
        turn_one = ((other + spring) * first + spring * second) / both
        turn_other = ((one + spring) * second + spring * first) / both
        energy = total[8] + p.pivot * t * t / 2.0
        a, b = _turned(own.first_cos, own.first_sin, turn_one)
        c, d = _turned(own.second_cos, own.second_sin, turn_other)
        return a, b, c, d, force.x, force.y, energy


def _rotated(r: Any, w: Any, own: Any) -> Any:
    """Q r: the direction in which a beam leaves a pivot."""
    c = w.one * own.first_cos + w.other * own.second_cos
    s = w.one * own.first_sin + w.other * own.second_sin
    return Vector(c * r.x - s * r.y, s * r.x + c * r.y)


def _lag(e: Any, v: Any, lengths: Any) -> Any:
    """2 tan(φ/2) of the angle φ from e to v, `lengths` the product of theirs."""
    cosine = lengths + dot(e, v)
    return 2.0 * (e.x * v.y - e.y * v.x) / where(cosine > 0.0, cosine, 1.0)


def _stiffness(turning: Any, others: Any) -> Any:
    """That of one rotation; where no beam holds it, that of the other one, or any."""
    held = where(turning > 0.0, turning, others) / SHARE
    return where(held > 0.0, held, 1.0)


def _turned(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """The rotation (c, s) turned by 2 atan(angle/2), of length 1."""
    q = angle / 2.0
    x, y = (1.0 - q * q) * c - 2.0 * q * s, (1.0 - q * q) * s + 2.0 * q * c
    size = length(Vector(x, y))
    return x / size, y / size
