"""Operations of particles with one fault each."""

from __future__ import annotations

from typing import ClassVar, Literal

import pbdkit


class Kicks(pbdkit.plugin.ParticleOperation):
    """Declares that it rests, and moves particles at rest."""

    type: Literal["kicks"] = "kicks"
    rests: ClassVar[bool] = True

    @staticmethod
    def displacement(u, new, p):
        return pbdkit.plugin.Vector(new.x + 1e-3, new.y)


class Pins(pbdkit.plugin.ParticleOperation):
    """Declares that it rests, and holds every particle where it is."""

    type: Literal["pins"] = "pins"
    rests: ClassVar[bool] = True

    @staticmethod
    def displacement(u, new, p):
        return u + 0.0 * (new - u)
