"""Operations of particles, for tests: as a distribution offers them, and handed over as classes."""

from typing import ClassVar, Literal

from pbdkit.plugin import ParticleOperation, Vector, hookimpl


class Drag(ParticleOperation):
    """Particles keep a share of their old place."""

    type: Literal["drag"] = "drag"
    factor: float = 0.25

    rests: ClassVar[bool] = True

    @staticmethod
    def displacement(u, new, p):
        return new - p.factor * (new - u)


class Wind(ParticleOperation):
    """Displacement of particles by a constant in every step."""

    type: Literal["wind"] = "wind"
    speed: float = 0.01

    @staticmethod
    def displacement(u, new, p):
        return Vector(new.x + p.speed, new.y)


@hookimpl
def pbdkit_components():
    return [Drag, Wind]
