"""Rules of particles with directions, with one fault each."""

from __future__ import annotations

from typing import Literal

import numpy as np

import pbdkit
from pbdkit.plugin import (
    Remembered,
    SharesParticles,
    TurnsParticles,
    Vector,
    length,
)


class Vane(SharesParticles, TurnsParticles, pbdkit.FollowerRule):
    """Particles go to the mean of where their neighbours see them, and turn as these do: what the
    others would be without their fault."""

    type: Literal["vane"] = "vane"

    def remembered(self):
        return Remembered("vane_cos", "cosine", "1", 1.0), Remembered("vane_sin", "sine", "1")

    def rotations(self):
        return (("vane_cos", "vane_sin"),)

    @staticmethod
    def gather(d, r, w, p, own, there):
        return off(d, r, there), 1.0, there.vane_cos, there.vane_sin

    @staticmethod
    def apply(total, here, p):
        return 0.5 * total[0] / total[1]

    @staticmethod
    def remember(total, here, p):
        c, s = 2.0 * here.own.vane_cos + total[2], 2.0 * here.own.vane_sin + total[3]
        size = 1e-6 + length(Vector(c, s))
        return c / size, s / size


def off(d, r, there):
    """Return the distance of the neighbour from its position after the turn."""
    c, s = there.vane_cos, there.vane_sin
    return r + d - Vector(c * r.x - s * r.y, s * r.x + c * r.y)


class Compass(Vane):
    """Counts the more, the more a neighbour points along x."""

    type: Literal["compass"] = "compass"

    @staticmethod
    def gather(d, r, w, p, own, there):
        more = 2.0 + there.vane_cos
        return more * off(d, r, there), more, there.vane_cos, there.vane_sin


class PointsNowhere(Vane):
    """Names a sine that it does not remember."""

    type: Literal["points-nowhere"] = "points-nowhere"

    def rotations(self):
        return (("vane_cos", "vane_tan"),)


class WritesThere(Vane):
    """Turns its neighbours itself."""

    type: Literal["writes-there"] = "writes-there"

    @staticmethod
    def gather(d, r, w, p, own, there):
        if isinstance(there.vane_sin, np.ndarray):
            there.vane_sin[...] = 2.0
        return off(d, r, there), 1.0, there.vane_cos, there.vane_sin


class Creeps(Vane):
    """Moves a little at rest."""

    type: Literal["creeps"] = "creeps"

    @staticmethod
    def apply(total, here, p):
        creep = Vector(1e-9 * here.own.vane_cos, 1e-9 * here.own.vane_sin)
        return 0.5 * total[0] / total[1] + creep
