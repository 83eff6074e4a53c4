"""Fracture models and a rule that remember, and diagnostics of the end, with one fault each."""

from __future__ import annotations

import random
from typing import ClassVar, Literal

import numpy as np
from pydantic import PrivateAttr

import pbdkit
from faulty.others import Extent
from faulty.rules import Sound
from pbdkit import Remembered

STRENGTH = Remembered("strength", "strain at which the bond breaks", "1", 0.5, changes=False)
WEAR = Remembered("wear", "how much the bond has softened", "1")
TIMES = Remembered("times", "steps in which it has softened", "1", dtype="i4")


class Wearing(pbdkit.FractureModel):
    """A bond of a strength of its own softens as it is strained, and counts how often: what the
    others would be without their fault."""

    type: Literal["wearing"] = "wearing"

    def constants(self, slot):
        return (float(np.hypot(*slot.rest)),)

    def bond_state(self):
        return STRENGTH, WEAR, TIMES

    def draw(self, bonds, generator):
        return {"strength": generator.uniform(0.4, 0.6, len(bonds))}

    @staticmethod
    def update(d, r, c, p):
        strain = pbdkit.length(pbdkit.Vector(r.x + d.x, r.y + d.y)) / c[0] - 1.0
        more = strain > c[2]
        return pbdkit.where(more, strain, c[2]), pbdkit.where(more, c[3] + 1, c[3])

    @staticmethod
    def breaks(d, r, c, p):
        return c[2] > c[1]

    @staticmethod
    def fictitious(u, r, p):
        return pbdkit.Vector(0.0, 0.0)

    @staticmethod
    def seen(d, lost, r, c, p):
        kept = 1.0 - c[2]
        return pbdkit.Vector(kept * d.x + c[2] * lost.x, kept * d.y + c[2] * lost.y)

    @staticmethod
    def breaking_strain(r, c, p):
        return pbdkit.where(c[2] > c[1], c[2], c[1])


class TakesAName(Wearing):
    """Remembers by a name that every dataset has."""

    type: Literal["takes-a-name"] = "takes-a-name"

    def bond_state(self):
        return STRENGTH, Remembered("shell", "wear", "1"), TIMES


class Shouts(Wearing):
    """Remembers by a name in capitals."""

    type: Literal["shouts"] = "shouts"

    def bond_state(self):
        return STRENGTH, Remembered("WEAR", "wear", "1"), TIMES


class OfNoUnit(Wearing):
    """Does not say in which units its number is."""

    type: Literal["of-no-unit"] = "of-no-unit"

    def bond_state(self):
        return STRENGTH, Remembered("wear", "wear", ""), TIMES


class StartsHalfway(Wearing):
    """Counts from a half in whole numbers."""

    type: Literal["starts-halfway"] = "starts-halfway"

    def bond_state(self):
        return STRENGTH, WEAR, Remembered("times", "steps", "1", 0.5, dtype="i4")


class Misnames(Wearing):
    """Draws what it does not remember."""

    type: Literal["misnames"] = "misnames"

    def draw(self, bonds, generator):
        return {"strengths": generator.uniform(0.4, 0.6, len(bonds))}


class DrawsOne(Wearing):
    """Draws one number for all bonds."""

    type: Literal["draws-one"] = "draws-one"

    def draw(self, bonds, generator):
        return {"strength": generator.uniform(0.4, 0.6)}


class DrawsNothingFinite(Wearing):
    """Draws bonds that nothing can break."""

    type: Literal["draws-nothing-finite"] = "draws-nothing-finite"

    def draw(self, bonds, generator):
        return {"strength": np.full(len(bonds), np.inf)}


class Overflows(Wearing):
    """Draws more than a byte holds."""

    type: Literal["overflows"] = "overflows"

    def bond_state(self):
        return STRENGTH, WEAR, Remembered("times", "steps", "1", dtype="i1")

    def draw(self, bonds, generator):
        return {"times": generator.integers(200, 300, len(bonds))}


class DrawsElsewhere(Wearing):
    """Draws from a generator that nobody gave it."""

    type: Literal["draws-elsewhere"] = "draws-elsewhere"

    def draw(self, bonds, generator):
        return {"strength": np.random.default_rng().uniform(0.4, 0.6, len(bonds))}


class DrawsOnItsOwn(Wearing):
    """Draws from a seed that is not among its parameters."""

    type: Literal["draws-on-its-own"] = "draws-on-its-own"
    _seed: int = PrivateAttr(default_factory=lambda: random.randrange(10**9))

    def draw(self, bonds, generator):
        strength = np.random.default_rng(self._seed).uniform(0.4, 0.6)
        return {"strength": np.full(len(bonds), strength)}


class DrawsByRow(Wearing):
    """Bonds are the stronger the later they stand in the table."""

    type: Literal["draws-by-row"] = "draws-by-row"

    def draw(self, bonds, generator):
        first = 0.4 + 0.1 * generator.random()
        return {"strength": first + 0.1 * np.arange(len(bonds)) / len(bonds)}


class WritesBonds(Wearing):
    """Counts shells from 0, in the scene's own table."""

    type: Literal["writes-bonds"] = "writes-bonds"

    def draw(self, bonds, generator):
        bonds.shell[...] -= 1
        return {"strength": 0.5 + 0.1 * bonds.shell}


class WritesWear(Wearing):
    """Renews its numbers where they lie."""

    type: Literal["writes-wear"] = "writes-wear"

    @staticmethod
    def update(d, r, c, p):
        wear = c[2]
        wear += 0.125
        return wear, c[3]


class OneTooMany(Wearing):
    """Returns the number that stays, too."""

    type: Literal["one-too-many"] = "one-too-many"

    @staticmethod
    def update(d, r, c, p):
        return c[1], c[2], c[3]


class CountsHalves(Wearing):
    """Counts halves in whole numbers."""

    type: Literal["counts-halves"] = "counts-halves"

    @staticmethod
    def update(d, r, c, p):
        return c[2], c[3] + 0.5


class WearsTogether(Wearing):
    """Wears all bonds as the one that is strained most."""

    type: Literal["wears-together"] = "wears-together"

    @staticmethod
    def update(d, r, c, p):
        most = np.max(pbdkit.length(pbdkit.Vector(r.x + d.x, r.y + d.y)) / c[0] - 1.0)
        return pbdkit.where(most > c[2], most + 0.0 * c[2], c[2]), c[3]


class WearsInOrder(Wearing):
    """Wears each bond as those before it."""

    type: Literal["wears-in-order"] = "wears-in-order"

    @staticmethod
    def update(d, r, c, p):
        return np.reshape(np.maximum.accumulate(np.ravel(c[2] + d.x * d.x)), np.shape(c[2])), c[3]


class WearsInDoubles(Wearing):
    """Computes wear in double precision, whatever it is given."""

    type: Literal["wears-in-doubles"] = "wears-in-doubles"

    @staticmethod
    def update(d, r, c, p):
        wear, times = Wearing.update(d, r, c, p)
        return np.float64(1.0) * wear, times


class WearsOneWay(Wearing):
    """Wears where the far end has moved to the right."""

    type: Literal["wears-one-way"] = "wears-one-way"

    @staticmethod
    def update(d, r, c, p):
        return pbdkit.where(d.x > c[2], d.x, c[2]), c[3]

    @staticmethod
    def breaking_strain(r, c, p):
        return None


class Misstates(Wearing):
    """Says that bonds bear twice as much as they do."""

    type: Literal["misstates"] = "misstates"

    @staticmethod
    def breaking_strain(r, c, p):
        return 2.0 * c[1] + c[2]


class Sags(Wearing):
    """Shows bonds a little longer than they are, at rest too."""

    type: Literal["sags"] = "sags"

    @staticmethod
    def seen(d, lost, r, c, p):
        return pbdkit.Vector(d.x + 1e-9, d.y)


class Tired(Sound):
    """Follows the less, the farther it has come: what the others would be without their fault."""

    type: Literal["tired"] = "tired"

    def particle_state(self):
        return (Remembered("way", "way made in x", "lattice unit"),)

    @staticmethod
    def apply(total, here, p):
        share = 1.0 / (1.0 + here.own[0])
        return share * total[0] / total[2], share * total[1] / total[2]

    @staticmethod
    def remember(total, here, p):
        return (here.own[0] + np.abs(total[0] / total[2]),)


class ForgetsTheWay(Tired):
    """Returns nothing of what it says that changes."""

    type: Literal["forgets-the-way"] = "forgets-the-way"

    @staticmethod
    def remember(total, here, p):
        return ()


class WayAndMove(Tired):
    """Returns the move beside what it remembers."""

    type: Literal["way-and-move"] = "way-and-move"

    @staticmethod
    def remember(total, here, p):
        return here.own[0] + np.abs(total[0]), total[0]


class WritesTheWay(Tired):
    """Adds to the way where it lies."""

    type: Literal["writes-the-way"] = "writes-the-way"

    @staticmethod
    def remember(total, here, p):
        way = here.own[0]
        way += 1.0
        return (way,)


class SharesTheWay(Tired):
    """Remembers the mean way of all."""

    type: Literal["shares-the-way"] = "shares-the-way"

    @staticmethod
    def remember(total, here, p):
        return (np.mean(here.own[0] + np.abs(total[0])) + 0.0 * here.own[0],)


class DrawsAgain(Tired):
    """Draws with the dice of Python."""

    type: Literal["draws-again"] = "draws-again"

    def draw(self, particles, generator):
        return {"way": np.array([random.random() for _ in particles.number])}


class LastOnes(Extent):
    """How far those have moved that have moved farthest, at the end: what the others would be
    without their fault."""

    type: Literal["last-ones"] = "last-ones"
    at_end: ClassVar[bool] = True
    own_dimension: ClassVar[str] = "last"

    def variables(self):
        names = ("last_extent", "last_square")
        return tuple(pbdkit.Variable(name, ("last",), name, "lattice unit") for name in names)

    def measure(self, now):
        extent = super().measure(now)[0]
        far = np.sort(extent[extent > np.median(extent)])
        return far, far**2


class Ragged(LastOnes):
    """Gives its dimension two lengths."""

    type: Literal["ragged"] = "ragged"

    def measure(self, now):
        extent, square = super().measure(now)
        return extent, square[1:]


class Untimely(LastOnes):
    """Has a dimension of its own in the midst of the run."""

    type: Literal["untimely"] = "untimely"
    at_end: ClassVar[bool] = False
