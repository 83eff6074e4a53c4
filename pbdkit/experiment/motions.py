"""How leaders move (model.md, section 1). A closed family."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import Field, SerializeAsAny

from pbdkit.experiment.parts import closed_part
from pbdkit.interfaces import Component, Pair


class Motion(Component):
    """A prescribed motion, counted from the position at which it starts."""

    @abstractmethod
    def offset(self, n: int) -> Pair:
        """How far from its start the leader stands at the end of the motion's n-th step, n ≥ 1."""

    @abstractmethod
    def knots(self) -> tuple[int, ...]:
        """The steps n between which, and after which, the offset is linear in n."""


class Hold(Motion):
    """Stays where it is."""

    type: Literal["hold"] = "hold"

    def offset(self, n: int) -> Pair:
        """None."""
        return (0.0, 0.0)

    def knots(self) -> tuple[int, ...]:
        """None."""
        return ()


class Velocity(Motion):
    """Moves by `velocity` in each of `steps` steps, then holds."""

    type: Literal["velocity"] = "velocity"
    velocity: Pair
    steps: Annotated[int, Field(ge=1)]

    def offset(self, n: int) -> Pair:
        """velocity · min(n, steps)."""
        moved = min(n, self.steps)
        return (self.velocity[0] * moved, self.velocity[1] * moved)

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Displace(Motion):
    """Moves by `displacement` in the first step, then holds."""

    type: Literal["displace"] = "displace"
    displacement: Pair

    def offset(self, n: int) -> Pair:
        """The displacement, from the first step on."""
        return self.displacement

    def knots(self) -> tuple[int, ...]:
        """The first step."""
        return (1,)


AnyMotion = Annotated[SerializeAsAny[Motion], closed_part(Motion, Hold, Velocity, Displace)]
