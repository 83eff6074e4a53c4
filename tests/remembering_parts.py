"""Parts that remember, for tests: bonds that soften from their own onset, tiring particles."""

from typing import Literal

import numpy as np

import pbdkit
from pbdkit.plugin import (
    Draws,
    Remembered,
    RenewsBonds,
    RenewsParticles,
    SharesParticles,
    Softens,
    TurnsParticles,
    Vector,
    length,
    where,
)


class Weakest(Draws, RenewsBonds, Softens, pbdkit.FractureModel):
    """A bond's force falls linearly from strain `onset` to strain `failure`; the onset of each bond
    is drawn, uniform over `onset` (1 ± spread), and that of the bond in the middle is lower."""

    type: Literal["weakest"] = "weakest"
    onset: float = 0.1
    failure: float = 0.9
    spread: float = 0.0
    weak: float = 1.0
    frame_bonds: bool = True

    def breaks_frame_bonds(self):
        return self.frame_bonds

    def constants(self, slot):
        return {"rest": length(slot.rest)}

    def remembered(self):
        return (
            Remembered("onset", "strain at which softening begins", "1", changes=False),
            Remembered("damage", "damage", "1"),
            Remembered("visits", "steps with more damage than before", "1", dtype="i4"),
        )

    def draw(self, bonds, generator):
        onset = self.onset * (1 + self.spread * generator.uniform(-1, 1, len(bonds)))
        middle = np.abs(bonds.midpoint - bonds.midpoint.mean(axis=0)).sum(axis=1)
        onset[np.argmin(middle)] *= self.weak
        return {"onset": onset}

    @staticmethod
    def update(d, r, c, p):
        strain = (length(r + d) - c.rest) / c.rest
        over = strain > c.onset
        law = p.failure / (p.failure - c.onset) * (1.0 - c.onset / where(over, strain, 1.0))
        more = over & (law > c.damage)
        return where(more, law, c.damage), where(more, c.visits + 1, c.visits)

    @staticmethod
    def breaks(d, r, c, p):
        return c.damage >= 1.0

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r

    @staticmethod
    def seen(d, lost, r, c, p):
        return (1.0 - c.damage) * d + c.damage * lost


class Tiring(Draws, RenewsParticles, pbdkit.FollowerRule):
    """Particles follow the barycentre the less, the farther they have come in all."""

    type: Literal["tiring"] = "tiring"
    rate: float = 0.5
    spread: float = 0.0

    def remembered(self):
        return (
            Remembered("way", "way made in x", "lattice unit"),
            Remembered("zeal", "share of the move that is made", "1", 0.9, changes=False),
        )

    def draw(self, particles, generator):
        return {"zeal": 0.9 + self.spread * generator.uniform(-1, 1, len(particles))}

    @staticmethod
    def gather(d, r, w, p):
        return d, r, 1.0

    @staticmethod
    def apply(total, here, p):
        d, r, n = total
        return here.own.zeal / (1.0 + p.rate * here.own.way) * (d + r) / n

    @staticmethod
    def remember(total, here, p):
        move = total[0].x / total[2]
        return (here.own.way + where(move > 0.0, move, -move),)


class Vanes(SharesParticles, TurnsParticles, pbdkit.FollowerRule):
    """Each particle has a direction, goes halfway to the mean of its neighbours, of which those
    that point as it does count more, and turns halfway to theirs."""

    type: Literal["vanes"] = "vanes"
    pull: float = 0.5

    def remembered(self):
        return (
            Remembered("vane_cos", "cosine of the vane's rotation", "1", 1.0),
            Remembered("vane_sin", "sine of the vane's rotation", "1"),
            Remembered("lift", "lift of the vane", "1", 0.1, changes=False),
        )

    def rotations(self):
        return (("vane_cos", "vane_sin"),)

    @staticmethod
    def gather(d, r, w, p, own, there):
        weight = 1.5 + 0.5 * (own.vane_cos * there.vane_cos + own.vane_sin * there.vane_sin)
        v = r + d
        turned = (own.vane_cos * v.x + own.vane_sin * v.y) * there.lift
        return weight * d, weight, there.vane_cos - turned * v.y, there.vane_sin + turned * v.x

    @staticmethod
    def apply(total, here, p):
        return p.pull * total[0] / total[1]

    @staticmethod
    def remember(total, here, p):
        c, s = here.own.vane_cos + total[2], here.own.vane_sin + total[3]
        size = length(Vector(c, s)) + 1e-9
        return c / size, s / size
