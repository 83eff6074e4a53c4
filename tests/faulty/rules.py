"""Rules with one fault each."""

from __future__ import annotations

import random
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, PrivateAttr

import pbdkit
from pbdkit.plugin import (
    Loadable,
    Stiffness,
    StoresEnergy,
    Vector,
    length,
    squared_length,
)


class Sound(pbdkit.FollowerRule):
    """The mean displacement: what the others would be without their fault."""

    type: Literal["sound"] = "sound"

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1]


class WritesInput(Sound):
    """Doubles the difference where it lies."""

    type: Literal["writes-input"] = "writes-input"

    @staticmethod
    def gather(d, r, w, p):
        x, y = d
        x *= 2.0
        return Vector(x, y), 1.0


class CountsPlaces(Sound):
    """Moves the more, the later a particle comes."""

    type: Literal["counts-places"] = "counts-places"

    @staticmethod
    def apply(total, here, p):
        x = total[0].x
        return np.arange(np.size(x), dtype=x.dtype).reshape(np.shape(x)) * total[0]


class SumsInOrder(Sound):
    """Takes large numbers in and out again."""

    type: Literal["sums-in-order"] = "sums-in-order"

    @staticmethod
    def gather(d, r, w, p):
        return 1e8 * r + d, 1.0


class Doubles(Sound):
    """Computes in double precision, whatever it is given."""

    type: Literal["doubles"] = "doubles"

    @staticmethod
    def apply(total, here, p):
        return np.float64(0.5) * total[0]


class GathersDoubles(Sound):
    """Divides by a distance at rest, which numpy computes in double precision."""

    type: Literal["gathers-doubles"] = "gathers-doubles"

    @staticmethod
    def gather(d, r, w, p):
        far = pbdkit.plugin.length(r)
        return d / far, 1.0 / far


class GathersPairsOfDoubles(pbdkit.plugin.UsesAngles, Sound):
    """Divides by a side at rest, which numpy computes in double precision."""

    type: Literal["gathers-pairs-of-doubles"] = "gathers-pairs-of-doubles"

    @staticmethod
    def gather_pair(d1, d2, r1, r2, w1, w2, p):
        return ((d1 + d2) / pbdkit.plugin.length(r2 - r1),)


class LooksAround(Sound):
    """Moves every particle by the mean of all."""

    type: Literal["looks-around"] = "looks-around"

    @staticmethod
    def apply(total, here, p):
        x, y = total[0] / total[1]
        return Vector(np.mean(x) + 0.0 * x, y)


class NeedsArrays(Sound):
    """Calls a method that plain numbers do not have."""

    type: Literal["needs-arrays"] = "needs-arrays"

    @staticmethod
    def apply(total, here, p):
        x, y = total[0]
        return Vector(x.clip(-1.0, 1.0), y)


SEEN: list[float] = []


class Remembers(Sound):
    """Depends on the arguments of earlier calls."""

    type: Literal["remembers"] = "remembers"

    @staticmethod
    def apply(total, here, p):
        x, y = total[0]
        SEEN.append(float(np.sum(x)))
        return Vector(x + SEEN[-2 if len(SEEN) > 1 else -1], y)


class Counts(Sound):
    """Moves less with every call."""

    type: Literal["counts"] = "counts"
    calls: ClassVar[dict[str, int]] = {"apply": 0}

    @staticmethod
    def apply(total, here, p):
        Counts.calls["apply"] += 1
        return total[0] / Counts.calls["apply"]


class Throws(Sound):
    """Returns a random move."""

    type: Literal["throws"] = "throws"

    @staticmethod
    def apply(total, here, p):
        return random.random() * total[0]


class Seeds(Sound):
    """Seeds the generator that all share."""

    type: Literal["seeds"] = "seeds"

    @staticmethod
    def gather(d, r, w, p):
        np.random.seed(0)
        return d, 1.0


class Drifts(Sound):
    """Moves to the right, at rest too."""

    type: Literal["drifts"] = "drifts"

    @staticmethod
    def apply(total, here, p):
        return total[0] / total[1] + Vector(1e-9, 0.0)


class DriftsByRounding(Sound):
    """Adds a tenth for every neighbour, and takes it away again all at once."""

    type: Literal["drifts-by-rounding"] = "drifts-by-rounding"

    @staticmethod
    def gather(d, r, w, p):
        return d + Vector(0.1, 0.0), 1.0

    @staticmethod
    def apply(total, here, p):
        return total[0] - Vector(0.1 * total[1], 0.0)


class Divides(Sound):
    """Divides by the distance, which can be zero."""

    type: Literal["divides"] = "divides"

    @staticmethod
    def gather(d, r, w, p):
        share = 1.0 / length(r + d)
        return share * d, share


class Square(Sound):
    """Returns a value too many for every particle."""

    type: Literal["square-shaped"] = "square-shaped"

    @staticmethod
    def apply(total, here, p):
        x, y = total[0]
        return Vector(np.stack([x, x]), y)


class Varies(Sound):
    """Contributes more from some neighbours than from others."""

    type: Literal["varies"] = "varies"

    @staticmethod
    def gather(d, r, w, p):
        return (d, 1.0) if r.x > 0 else (d, 1.0, 1.0)


class ClaimsLinear(Sound):
    """Declares that displacements superpose, and squares them."""

    type: Literal["claims-linear"] = "claims-linear"
    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        return (squared_length(d) / (r.x * r.x + r.y * r.y)) * d, 1.0


class HoldsOn(Sound):
    """Pulls particles back to their sites, and does not declare it."""

    type: Literal["holds-on"] = "holds-on"

    @staticmethod
    def apply(total, here, p):
        return -0.5 * here.u


class Net(Loadable, Sound):
    """Springs between neighbours, for small displacements: what the next would be without their
    fault."""

    type: Literal["net"] = "net"

    def elasticity(self):
        return Stiffness(9 / 8, 9 / 8, 3 / 8, 3 / 8)

    def parameters(self, setting):
        if setting.cells.regular != 3:
            raise pbdkit.ExperimentError("requires the 6 neighbours of the hexagonal lattice")
        return super().parameters(setting)

    @staticmethod
    def gather(d, r, w, p):
        return pull_along(d, r), 1.0

    @staticmethod
    def force(total, here, p):
        return SPRING * total[0]

    @staticmethod
    def loaded(total, load, p):
        return total[0] + load / SPRING, total[1]


SPRING = 0.75**0.5
"""Stiffness of the springs, for which Young's modulus of the net is 1."""


def pull_along(d, r):
    """The part of d along r."""
    return ((d.x * r.x + d.y * r.y) / squared_length(r)) * r


class BearsTwice(Net):
    """Counts a load twice."""

    type: Literal["bears-twice"] = "bears-twice"

    @staticmethod
    def loaded(total, load, p):
        return total[0] + 2.0 * load, total[1]


class ResistsTurning(Net):
    """Pulls back whatever moves, across the bond as along it."""

    type: Literal["resists-turning"] = "resists-turning"

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0


class PullsOneWay(Net):
    """Springs pull more at their left end."""

    type: Literal["pulls-one-way"] = "pulls-one-way"
    has_axes: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        return (2.0 if r.x > 0.0 else 1.0) * pull_along(d, r), 1.0


class StoresTwice(StoresEnergy, Net):
    """The energy of a bond at both of its ends."""

    type: Literal["stores-twice"] = "stores-twice"

    @staticmethod
    def energy(d, r, w, p):
        pull = pull_along(d, r)
        return SPRING * (pull.x * d.x + pull.y * d.y) / 2.0


class Overstates(Net):
    """Declares twice the stiffness of its springs."""

    type: Literal["overstates"] = "overstates"

    def elasticity(self):
        return Stiffness(9 / 4, 9 / 4, 3 / 4, 3 / 4)


class Overshoots(Sound):
    """Moves by the cube of the mean displacement, which is stable for small displacements only."""

    type: Literal["overshoots"] = "overshoots"

    @staticmethod
    def apply(total, here, p):
        mean = total[0] / total[1]
        return (1.0 + 1e4 * squared_length(mean)) * mean


class Gives(Net):
    """Forces push where springs would pull."""

    type: Literal["gives"] = "gives"

    @staticmethod
    def force(total, here, p):
        return -1.0 * total[0]

    @staticmethod
    def loaded(total, load, p):
        return total[0] - load, total[1]


class HasAScale(Sound):
    """Moves no particle by more than a lattice unit."""

    type: Literal["has-a-scale"] = "has-a-scale"

    @staticmethod
    def apply(total, here, p):
        move = total[0] / total[1]
        return move / (1.0 + length(move))


class Decays(Sound):
    """Weights that decrease over a length, which is not annotated."""

    type: Literal["decays"] = "decays"
    decay_length: float = Field(1.0, description="Length over which weights decrease.")

    def weights(self, slot, setting):
        return {"share": float(np.exp(-length(slot.rest) / self.decay_length))}

    @staticmethod
    def gather(d, r, w, p):
        return w.share * d, w.share


class LeansRight(Sound):
    """Counts neighbours to the right twice."""

    type: Literal["leans-right"] = "leans-right"

    @staticmethod
    def gather(d, r, w, p):
        count = 2.0 if r.x > 0.0 else 1.0
        return count * d, count


class Unlike(Sound):
    """Multiplies whole numbers beyond 63 bits, which wrap around in compiled code."""

    type: Literal["unlike"] = "unlike"

    @staticmethod
    def apply(total, here, p):
        side = 3037000500
        return side * side / 2.0**63 * (total[0] / total[1])


class Restarts(Sound):
    """Draws a number when it is made, which is not among its parameters."""

    type: Literal["restarts"] = "restarts"
    _share: float = PrivateAttr(default_factory=random.random)

    def parameters(self, setting) -> dict[str, float]:
        return {"share": self._share}

    @staticmethod
    def apply(total, here, p):
        return p.share * total[0]


class Raises(Sound):
    """Uses a parameter that it does not have."""

    type: Literal["raises"] = "raises"

    @staticmethod
    def gather(d, r, w, p):
        return p.strength * d, 1.0


class Undescribed(Sound):
    """Has a parameter without a description."""

    type: Literal["undescribed"] = "undescribed"
    strength: float = 1.0


class Undocumented(Sound):
    type: Literal["undocumented"] = "undocumented"


class AnyName(Sound):
    """Goes by any name."""

    type: str = "any-name"


class CapitalName(Sound):
    """Is spelt as a class is."""

    type: Literal["CapitalName"] = "CapitalName"


class Thawed(Sound):
    """Can be changed after it is made."""

    model_config = ConfigDict(frozen=False)
    type: Literal["thawed"] = "thawed"
    strength: float = Field(1.0, description="Can be set.")


class Unhashable(Sound):
    """Has a parameter that cannot be hashed."""

    type: Literal["unhashable"] = "unhashable"
    shares: dict[str, float] = Field({"x": 1.0}, description="Can be changed from within.")


class Lenient(Sound):
    """Accepts any key in experiments."""

    model_config = ConfigDict(extra="allow")
    type: Literal["lenient"] = "lenient"

    @classmethod
    def known_keys(cls) -> list[str]:
        return ["type", "no_such_parameter"]


class Forgets(Sound):
    """Leaves a parameter out of its JSON."""

    type: Literal["forgets"] = "forgets"
    strength: float = Field(1.0, description="Lost on the way.", exclude=True)


class Chooses(Sound):
    """Rejects every lattice it is given."""

    type: Literal["chooses"] = "chooses"

    def parameters(self, setting) -> dict[str, float]:
        raise pbdkit.ExperimentError("'chooses' works on no lattice at all")


def without_location() -> Any:
    """A rule with a class that cannot be imported."""

    class WithoutLocation(Sound):
        """Is defined within a function."""

        type: Literal["homeless"] = "homeless"

    return WithoutLocation()
