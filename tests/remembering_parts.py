"""Parts that remember, for tests: bonds that soften from their own onset, tiring particles."""

from typing import ClassVar, Literal

import numpy as np

import pbdkit


class Weakest(pbdkit.FractureModel):
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
        return (float(np.hypot(*slot.rest)),)

    def bond_state(self):
        return (
            pbdkit.Remembered("onset", "strain at which softening begins", "1", changes=False),
            pbdkit.Remembered("damage", "damage", "1"),
            pbdkit.Remembered("visits", "steps with more damage than before", "1", dtype="i4"),
        )

    def draw(self, bonds, generator):
        onset = self.onset * (1 + self.spread * generator.uniform(-1, 1, len(bonds)))
        middle = np.abs(bonds.midpoint - bonds.midpoint.mean(axis=0)).sum(axis=1)
        onset[np.argmin(middle)] *= self.weak
        return {"onset": onset}

    @staticmethod
    def update(d, r, c, p):
        strain = (pbdkit.length(pbdkit.Vector(r.x + d.x, r.y + d.y)) - c[0]) / c[0]
        over = strain > c[1]
        law = p.failure / (p.failure - c[1]) * (1.0 - c[1] / pbdkit.where(over, strain, 1.0))
        more = over & (law > c[2])
        return pbdkit.where(more, law, c[2]), pbdkit.where(more, c[3] + 1, c[3])

    @staticmethod
    def breaks(d, r, c, p):
        return c[2] >= 1.0

    @staticmethod
    def fictitious(u, r, p):
        return pbdkit.Vector(0.0, 0.0)

    @staticmethod
    def seen(d, lost, r, c, p):
        kept = 1.0 - c[2]
        return pbdkit.Vector(kept * d.x + c[2] * lost.x, kept * d.y + c[2] * lost.y)


class Tiring(pbdkit.FollowerRule):
    """Particles follow the barycentre the less, the farther they have come in all."""

    type: Literal["tiring"] = "tiring"
    rate: float = 0.5
    spread: float = 0.0

    uses_reference: ClassVar[bool] = False

    def particle_state(self):
        return (
            pbdkit.Remembered("way", "way made in x", "lattice unit"),
            pbdkit.Remembered("zeal", "share of the move that is made", "1", 0.9, changes=False),
        )

    def draw(self, particles, generator):
        return {"zeal": 0.9 + self.spread * generator.uniform(-1, 1, len(particles))}

    @staticmethod
    def gather(d, r, w, p):
        return d.x, d.y, r.x, r.y, 1.0

    @staticmethod
    def apply(total, here, p):
        dx, dy, rx, ry, n = total
        share = here.own[1] / (1.0 + p.rate * here.own[0])
        return share * (dx + rx) / n, share * (dy + ry) / n

    @staticmethod
    def remember(total, here, p):
        move = total[0] / total[4]
        return (here.own[0] + pbdkit.where(move > 0.0, move, -move),)
