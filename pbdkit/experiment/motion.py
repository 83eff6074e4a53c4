"""What a prescribed motion is (model.md, section 1)."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.interfaces import Component

Floats = NDArray[np.floating[Any]]
Steps = Annotated[int, Field(ge=1, le=2**62)]


class Motion(Component):
    """A prescribed motion, counted from the position at which it starts."""

    rests: ClassVar[bool] = True
    """Whether the motion ends, at the last of its knots."""

    of_reference: ClassVar[bool] = False
    """Whether `start` is where particles lie at rest, wherever the motion finds them."""

    @abstractmethod
    def offset(self, n: float, start: Floats) -> Floats:
        """How far from their start the leaders stand at the end of the motion's n-th step, n ≥ 1;
        on the way to an equilibrium also between two steps, n > 0.

        `start` are the positions at which the motion found them, (particle, axis); so is what is
        returned, or (axis,) where it is the same for all.
        """

    def knots(self) -> tuple[int, ...]:
        """The steps n between which, and after which, the offset changes as one formula in n; by
        default it always does."""
        return ()

    def turned(self, n: float) -> float:
        """By what angle the motion has turned at the end of its n-th step, radians."""
        return 0.0

    def rests_after(self) -> int | None:
        """The step n from which on the offset stays as it is; None where it never does."""
        return max((1, *self.knots())) if self.rests else None
