"""Fracture models and a rule that remember, and diagnostics of the end, with one fault each."""

from __future__ import annotations

import random
from typing import Annotated, ClassVar, Literal

import numpy as np
from faulty.others import Extent
from faulty.rules import Sound
from pydantic import Field, PrivateAttr

import pbdkit
from pbdkit.plugin import (
    LENGTH,
    BreaksAtStrain,
    Draws,
    Remembered,
    RenewsBonds,
    RenewsParticles,
    Softens,
    Variable,
    Vector,
    length,
    where,
)

STRENGTH = Remembered("strength", "strain at which the bond breaks", "1", 0.5, changes=False)
WEAR = Remembered("wear", "how much the bond has softened", "1")
TIMES = Remembered("times", "steps in which it has softened", "1", dtype="i4")


class Wearing(
    Draws,
    RenewsBonds,
    Softens,
    BreaksAtStrain,
    pbdkit.FractureModel,
):
    """A bond of a strength of its own softens as it is strained, and counts how often: what the
    others would be without their fault."""

    type: Literal["wearing"] = "wearing"

    def constants(self, slot):
        return {"rest": length(slot.rest)}

    def remembered(self):
        return STRENGTH, WEAR, TIMES

    def draw(self, bonds, generator):
        return {"strength": generator.uniform(0.4, 0.6, len(bonds))}

    @staticmethod
    def update(d, r, c, p):
        strain = length(r + d) / c.rest - 1.0
        more = strain > c.wear
        return where(more, strain, c.wear), where(more, c.times + 1, c.times)

    @staticmethod
    def breaks(d, r, c, p):
        return c.wear > c.strength

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r

    @staticmethod
    def seen(d, lost, r, c, p):
        return (1.0 - c.wear) * d + c.wear * lost

    @staticmethod
    def breaking_strain(r, c, p):
        return where(c.wear > c.strength, c.wear, c.strength)


class Hardens(Wearing):
    """Bonds are the stiffer, the more they were strained."""

    type: Literal["hardens"] = "hardens"

    @staticmethod
    def seen(d, lost, r, c, p):
        return (1.0 + c.wear) * d


class TakesAName(Wearing):
    """Remembers by a name that every dataset has."""

    type: Literal["takes-a-name"] = "takes-a-name"

    def remembered(self):
        return STRENGTH, Remembered("shell", "wear", "1"), TIMES


class Shouts(Wearing):
    """Remembers by a name in capitals."""

    type: Literal["shouts"] = "shouts"

    def remembered(self):
        return STRENGTH, Remembered("WEAR", "wear", "1"), TIMES


class OfNoUnit(Wearing):
    """Does not define the unit of its number."""

    type: Literal["of-no-unit"] = "of-no-unit"

    def remembered(self):
        return STRENGTH, Remembered("wear", "wear", ""), TIMES


class StartsHalfway(Wearing):
    """Counts from a half in whole numbers."""

    type: Literal["starts-halfway"] = "starts-halfway"

    def remembered(self):
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

    def remembered(self):
        return STRENGTH, WEAR, Remembered("times", "steps", "1", dtype="i1")

    def draw(self, bonds, generator):
        return {"times": generator.integers(200, 300, len(bonds))}


class DrawsElsewhere(Wearing):
    """Draws from a generator that it was not given."""

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
        wear = c.wear
        wear += 0.125
        return wear, c.times


class OneTooMany(Wearing):
    """Returns the number that stays, too."""

    type: Literal["one-too-many"] = "one-too-many"

    @staticmethod
    def update(d, r, c, p):
        return c.strength, c.wear, c.times


class CountsHalves(Wearing):
    """Counts halves in whole numbers."""

    type: Literal["counts-halves"] = "counts-halves"

    @staticmethod
    def update(d, r, c, p):
        return c.wear, c.times + 0.5


class WearsTogether(Wearing):
    """Wears all bonds as the one that is strained most."""

    type: Literal["wears-together"] = "wears-together"

    @staticmethod
    def update(d, r, c, p):
        most = np.max(length(r + d) / c.rest - 1.0)
        return where(most > c.wear, most + 0.0 * c.wear, c.wear), c.times


class WearsInOrder(Wearing):
    """Wears each bond as those before it."""

    type: Literal["wears-in-order"] = "wears-in-order"

    @staticmethod
    def update(d, r, c, p):
        wear = np.maximum.accumulate(np.ravel(c.wear + d.x * d.x))
        return np.reshape(wear, np.shape(c.wear)), c.times


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
        return where(d.x > c.wear, d.x, c.wear), c.times


class Misstates(Wearing):
    """Declares that bonds bear twice the force that they do."""

    type: Literal["misstates"] = "misstates"

    @staticmethod
    def breaking_strain(r, c, p):
        return 2.0 * c.strength + c.wear


class Sags(Wearing):
    """Shows bonds a little longer than they are, at rest too."""

    type: Literal["sags"] = "sags"

    @staticmethod
    def seen(d, lost, r, c, p):
        return d + Vector(1e-9, 0.0)


class Tired(RenewsParticles, Sound):
    """Follows the less, the farther it has come: what the others would be without their fault."""

    type: Literal["tired"] = "tired"
    stamina: Annotated[float, LENGTH] = Field(1.0, description="The way that halves moves.")

    def remembered(self):
        return (Remembered("way", "way made in x", "lattice unit"),)

    @staticmethod
    def apply(total, here, p):
        return total[0] / (total[1] * (1.0 + here.own.way / p.stamina))

    @staticmethod
    def remember(total, here, p):
        return (here.own.way + np.abs(total[0].x / total[1]),)


class ForgetsThePath(Tired):
    """Returns none of the numbers that it declares to change."""

    type: Literal["forgets-the-way"] = "forgets-the-way"

    @staticmethod
    def remember(total, here, p):
        return ()


class PathAndMove(Tired):
    """Returns the move beside what it remembers."""

    type: Literal["way-and-move"] = "way-and-move"

    @staticmethod
    def remember(total, here, p):
        return here.own.way + np.abs(total[0].x), total[0].x


class WritesThePath(Tired):
    """Adds to the way where it lies."""

    type: Literal["writes-the-way"] = "writes-the-way"

    @staticmethod
    def remember(total, here, p):
        way = here.own.way
        way += 1.0
        return (way,)


class SharesThePath(Tired):
    """Remembers the mean way of all."""

    type: Literal["shares-the-way"] = "shares-the-way"

    @staticmethod
    def remember(total, here, p):
        way = here.own.way
        return (np.mean(way + np.abs(total[0].x)) + 0.0 * way,)


class DrawsAgain(Draws, Tired):
    """Draws with the dice of Python."""

    type: Literal["draws-again"] = "draws-again"

    def draw(self, particles, generator):
        return {"way": np.array([random.random() for _ in particles.number])}


class LastOnes(Extent):
    """The largest displacements at the end: the result of the others without their fault."""

    type: Literal["last-ones"] = "last-ones"
    at_end: ClassVar[bool] = True
    own_dimension: ClassVar[str] = "last"

    def variables(self):
        names = ("last_extent", "last_square")
        return tuple(Variable(name, ("last",), name, "lattice unit") for name in names)

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
