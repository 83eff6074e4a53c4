"""The ParticleOperation interface: what happens to selected particles in a step besides the move of
their rule.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from pydantic import Field

from pbdkit.plugin.component import Component
from pbdkit.plugin.particles import Selection
from pbdkit.plugin.vector import Parameters, Vector


class ParticleOperation(Component):
    """What happens to selected particles in each step, after their rule has moved them.

    To add an operation, write `displacement`, static and elementwise as the functions of a rule
    are: numpy calls it with whole arrays, kernels have it inlined. It comes after the rule's move,
    with relaxation and memory, and before obstacles push; leaders stand where they are prescribed
    whatever it returns, and frame points follow. Operations are made in the order in which the
    experiment lists them.
    """

    rests: ClassVar[bool] = False
    """Whether a particle rests under the operation where it rests without, and nowhere else:
    ``displacement(u, u, p)`` is u, exactly, and for any other `new` it is not. Equilibria are then
    those of the rule alone; experiments that look for one refuse other operations."""

    select: Selection | None = Field(
        None, description="The particles of the body to which it happens; all where it is left out."
    )

    def parameters(self) -> dict[str, float]:
        """The numbers that `displacement` sees as ``p.name``; by default the operation's own."""
        return self.numeric_parameters()

    @staticmethod
    @abstractmethod
    def displacement(u: Vector, new: Vector, p: Parameters) -> Vector:
        """The displacement of a particle at the end of the step, a vector, elementwise: `u` is that
        at its beginning, and `new` where the rule, and operations before, have moved it."""
