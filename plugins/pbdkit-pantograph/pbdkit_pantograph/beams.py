"""Pantographic sheet of beams: pivots carry the rotations of the two beams that cross there."""

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
"""Fraction of the largest step for which the energy of the stiffest motion of a beam does not
increase."""
SLENDEREST = 1e-10
"""Smallest bending / (stretching · link²). Below it rounding errors of the axial stiffness exceed
the transverse stiffness."""


class PantographBeams(SharesParticles, TurnsParticles, FollowerRule):
    """Euler–Bernoulli beams between pivots that remember the rotations of the two beams that cross
    there.

    With v = x_k - x_j, l = |r|, Q_j r the direction of the beam at pivot j, and φ_j the angle from
    it to v, measured as t = 2 tan(φ/2), the energy of a link is

        stretching/(2 l) (|v| - l)² + 2 bending/l (t_j² + t_j t_k + t_k²),

    and that of a pivot is pivot/2 · t² with t of the angle between its two rotations. A pivot moves
    towards the position at which the forces on it vanish for the current neighbours and rotations,
    its rotations towards those at which the moments vanish, by 3/4 of the largest step for which
    the energy of small motions does not increase. Leaders rotate freely unless they are clamped.
    """

    type: Literal["pantograph-beams"] = "pantograph-beams"
    stretching: float = Field(
        1.0, gt=0.0, le=1e12, description="EA of a fibre: force per strain.", examples=[100.0]
    )
    bending: Annotated[float, Field(gt=0.0, le=1e12), AREA] = Field(
        0.01,
        description="EI of a fibre: moment per curvature, in the unit of `stretching` × length².",
        examples=[1.0],
    )
    pivot: Annotated[float, Field(ge=0.0, le=1e12), LENGTH] = Field(
        0.0,
        description="Moment of a pivot per angle between its fibres, in the unit of `stretching` × "
        "length; with 0 they rotate freely.",
        examples=[0.1],
    )

    def parameters(self, setting: Setting) -> dict[str, float]:
        """Return the numeric parameters.

        Raises
        ------
        ExperimentError
            If the fibres are too slender for floating-point numbers.
        """
        least = max(length(slot.rest) for slots in setting.slots for slot in slots[:1])
        if self.bending < SLENDEREST * self.stretching * least**2:
            raise pbdkit.ExperimentError(
                f"bending: is less than {SLENDEREST:g} · stretching · link²; use stiffer fibres, "
                "or rule: {type: pantograph}"
            )
        return self.numeric_parameters()

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return indicators of the first and the second family, `one` and `other`, and the rest
        length."""
        around = setting.slots[slot.source]
        families = families_of([s.rest for s in around])
        along = [min(length(slot.rest - e), length(slot.rest + e)) for e in families]
        rest = float(length(slot.rest))
        first, second = (float(distance < 1e-6 * rest) for distance in along)
        return {"one": first, "other": second, "rest": rest}

    def remembered(self) -> tuple[Remembered, ...]:
        """Declare both rotations and, for recording, the force of the beams and the energy."""
        rotations = [
            Remembered(f"{which}_{part}", f"{name} of the {which} fibre's rotation", "1", initial)
            for which in ("first", "second")
            for part, name, initial in (("cos", "cosine", 1.0), ("sin", "sine", 0.0))
        ]
        force = [
            Remembered(f"force_{c}", f"force of the beams on the pivot along {c}", "force")
            for c in "xy"
        ]
        energy = Remembered("energy", "energy of the pivot and half its links", "energy")
        return (*rotations, *force, energy)

    def rotations(self) -> tuple[tuple[str, str], ...]:
        """Return the names of cosine and sine of both rotations."""
        return ("first_cos", "first_sin"), ("second_cos", "second_sin")

    @staticmethod
    def gather(  # type: ignore[override]  # SharesParticles adds arguments
        d: Any, r: Any, w: Any, p: Any, own: Any, there: Any
    ) -> tuple[Any, ...]:
        """Return force, stiffness xx, xy, yy, moments and rotational stiffnesses of both families,
        and half the energy."""
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
        # Least multiples of the stiffnesses of a link that bound it for all rotations of both ends.
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
        """Return 3/4 of stiffness⁻¹ · force; zero without beams."""
        force, xx, xy, yy = total[0], total[1], total[2], total[3]
        area = xx * yy - xy * xy
        safe = where(area > 0.0, area, 1.0)
        x, y = yy * force.x - xy * force.y, xx * force.y - xy * force.x
        return SHARE * Vector(x / safe, y / safe)

    @staticmethod
    def remember(total: tuple[Any, ...], here: Here, p: Parameters) -> tuple[Number, ...]:
        """Return the rotations that balance the moments of beams and pivot, force and energy."""
        own, force = here.own, total[0]
        sine = own.first_sin * own.second_cos - own.first_cos * own.second_sin
        cosine = own.first_cos * own.second_cos + own.first_sin * own.second_sin
        t = 2.0 * sine / where(cosine > -1.0, 1.0 + cosine, 1.0)
        slope = 1.0 + t * t / 4.0
        twist, spring = p.pivot * t * slope, p.pivot * slope * slope
        k_first, k_second = _stiffness(total[6], total[7]), _stiffness(total[7], total[6])
        first, second = total[4] - twist, total[5] + twist
        determinant = k_first * k_second + spring * (k_first + k_second)
        turn_first = ((k_second + spring) * first + spring * second) / determinant
        turn_second = ((k_first + spring) * second + spring * first) / determinant
        energy = total[8] + p.pivot * t * t / 2.0
        a, b = _turned(own.first_cos, own.first_sin, turn_first)
        c, d = _turned(own.second_cos, own.second_sin, turn_second)
        return a, b, c, d, force.x, force.y, energy


def _rotated(r: Any, w: Any, own: Any) -> Any:
    """Return Q r, the direction of a beam at a pivot."""
    c = w.one * own.first_cos + w.other * own.second_cos
    s = w.one * own.first_sin + w.other * own.second_sin
    return Vector(c * r.x - s * r.y, s * r.x + c * r.y)


def _lag(e: Any, v: Any, lengths: Any) -> Any:
    """Return 2 tan(φ/2) of the angle φ from e to v; `lengths` is the product of their lengths."""
    cosine = lengths + dot(e, v)
    return 2.0 * (e.x * v.y - e.y * v.x) / where(cosine > 0.0, cosine, 1.0)


def _stiffness(turning: Any, others: Any) -> Any:
    """Return the stiffness of a rotation; without beams that of the other rotation, or 1."""
    stiffness = where(turning > 0.0, turning, others) / SHARE
    return where(stiffness > 0.0, stiffness, 1.0)


def _turned(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """Return the rotation (c, s) turned by 2 atan(angle/2), normalised."""
    q = angle / 2.0
    x, y = (1.0 - q * q) * c - 2.0 * q * s, (1.0 - q * q) * s + 2.0 * q * c
    size = length(Vector(x, y))
    return x / size, y / size
