"""From where a run starts. A closed family."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny

from pbdkit.experiment.parts import closed_part
from pbdkit.interfaces import Component
from pbdkit.interfaces.units import LENGTH

Floats = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]
Share = Annotated[float, Field(ge=-1e100, le=1e100)]
Shares = Annotated[tuple[Share, Share], Field(strict=False)]
Shift = Annotated[tuple[Annotated[Share, LENGTH], Annotated[Share, LENGTH]], Field(strict=False)]
Gradient = Annotated[tuple[Shares, Shares], Field(strict=False)]


class Initial(Component):
    """The displacements of the body at time 0; nothing has moved before, and the frame follows."""

    at_rest: ClassVar[bool] = False
    """Whether everything starts where it rests; `displacement` is then not asked."""
    is_drawn: ClassVar[bool] = False
    """Whether it takes numbers from the generator."""

    @abstractmethod
    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """u of the body particles at X, (particle, axis), in the order of their numbers; `leads`
        marks the leaders of step 1."""


class Reference(Initial):
    """The run starts from the reference configuration."""

    type: Literal["reference"] = "reference"

    at_rest: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Zeros."""
        return np.zeros_like(X)


class Noise(Initial):
    """Every follower starts off its site by up to ±`amplitude` along each axis, uniformly, drawn
    from the experiment's seed in the order of the numbers; leaders of step 1 start on theirs."""

    type: Literal["noise"] = "noise"
    amplitude: Annotated[float, Field(ge=0.0, le=1e100), LENGTH]

    is_drawn: ClassVar[bool] = True

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """Uniform in [-amplitude, amplitude)."""
        drawn = generator.uniform(-self.amplitude, self.amplitude, X.shape)
        return np.where(leads[:, None], 0.0, drawn)


class Affine(Initial):
    """The body starts deformed: u = gradient · X + shift, leaders included."""

    type: Literal["affine"] = "affine"
    gradient: Gradient
    shift: Shift = (0.0, 0.0)

    def displacement(self, X: Floats, leads: Flags, generator: np.random.Generator) -> Floats:
        """u_a = Σ_b gradient[a][b] X_b + shift_a."""
        (xx, xy), (yx, yy) = self.gradient
        x, y = X.T
        return np.stack([xx * x + xy * y + self.shift[0], yx * x + yy * y + self.shift[1]], axis=1)


AnyInitial = Annotated[SerializeAsAny[Initial], closed_part(Initial, Reference, Noise, Affine)]
