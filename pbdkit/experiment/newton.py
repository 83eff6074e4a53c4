"""A motion by Newton's law."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pbdkit.experiment.motion import Floats, Motion
from pbdkit.interfaces.course import at
from pbdkit.interfaces.forces import Force
from pbdkit.interfaces.units import Place


class Newton(Motion):
    """Each particle is a mass that its neighbours and a force move; a step is the unit of time:

    mass · a = its share of `force` + what its neighbours exert - damping · v,

    forces over Young's modulus and thickness, in lattice units; `mass` and `damping` of each. By
    the symplectic Euler method, v += a, u += v, with the forces at the end of the last step.
    """

    type: Literal["newton"] = "newton"
    rests: ClassVar[bool] = False
    mass: Annotated[float, Field(gt=0.0, le=1e300)]
    force: Force = (0.0, 0.0)
    damping: Annotated[float, Field(ge=0.0, le=1e300)] = 0.0
    velocity: Place = (0.0, 0.0)

    def offset(self, n: float, start: Floats) -> Floats:
        """Nothing is known beforehand."""
        return np.zeros(start.shape[1])

    def faster(self, step: int, velocity: Floats, pull: Floats, share: Floats) -> Floats:
        """The velocities (particle, axis) at the end of a step, with what neighbours exert and each
        one's share of the force."""
        force = share[:, None] * np.array([at(each, step) for each in self.force])
        force += pull - self.damping * velocity
        return np.asarray(velocity + force / self.mass)

    def lightest(self, stiffness: float) -> float:
        """The mass below which a particle held by such a spring swings ever farther: steps are
        stable for k ≤ 4 m - 2 c, which without damping is ω ≤ 2."""
        return stiffness / 4.0 + self.damping / 2.0
