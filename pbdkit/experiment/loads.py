"""Loads: forces that act on particles from outside, and when."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pbdkit.experiment.leaders import Selection
from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.course import Course, at
from pbdkit.interfaces.forces import BodyForce, Force


class Load(Strict):
    """Forces on selected particles from step `from` to step `until`, both included.

    `force` is what acts on all of them together, in units of Young's modulus, thickness and lattice
    unit. Particles on a line share it by the length that falls to each, others equally.
    `body_force` acts on a unit of area, in units of Young's modulus and thickness over lattice
    unit. Each of the two may be a course in time. Followers are moved by it; leaders carry it.
    """

    select: Selection
    force: Force | None = None
    body_force: BodyForce | None = None
    from_: Annotated[int, Field(ge=1, alias="from")] = 1
    until: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _one_force(self) -> Load:
        if (self.force is None) == (self.body_force is None):
            raise ValueError("give exactly one of force, body_force")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Load:
        if self.until is not None and self.until < self.from_:
            raise ValueError(f"until ({self.until}) is before from ({self.from_})")
        return self

    def force_at(self, moment: float) -> NDArray[np.float64]:
        """(axis,): the force at a moment, in all or of a unit of area."""
        forces = [at(each, moment) for each in self.force or self.body_force or ()]
        return 0.0 + self.amplitude(moment) * np.array(forces)

    @property
    def courses(self) -> list[Course[float]]:
        """Of the forces that change while it acts."""
        forces = self.force or self.body_force or ()
        return [each for each in forces if isinstance(each, Course)]

    def amplitude(self, moment: float) -> float:
        """The share of the force that acts at the end of a step, or at a moment within it, where it
        comes and goes little by little; linear between whole steps."""
        come = min(max(moment - self.from_ + 1, 0.0), 1.0)
        gone = 0.0 if self.until is None else min(max(moment - self.until, 0.0), 1.0)
        return come - gone

    def last(self, steps: int) -> int:
        """The last step of a run of `steps` in which it acts."""
        return steps if self.until is None else min(self.until, steps)

    def changes(self) -> tuple[int, ...]:
        """The steps in which it begins and ceases to act."""
        return (self.from_,) if self.until is None else (self.from_, self.until + 1)
