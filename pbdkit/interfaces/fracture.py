"""The FractureModel interface: when a bond breaks, and what each end sees from then on."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from pbdkit.interfaces.arithmetic import Vector
from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.neighbours import Slot

Segment = tuple[Pair, Pair]
"""A straight crack, from one point to another (lattice units)."""


class FractureModel(Component):
    """Breaks bonds for good, and puts a fictitious point in the place of the lost neighbour.

    To add a model, write `breaks` and `fictitious`, both static and elementwise as a rule's
    functions are. d = u_k - u_j is the difference along the bond, r its rest offset, c the
    slot's constants and p the parameters.
    """

    can_break: ClassVar[bool] = True
    """False where nothing ever breaks: the scene then has no bond state at all."""

    def breaks_frame_bonds(self) -> bool:
        """Whether bonds to frame points can break too; by default they do."""
        return True

    def parameters(self) -> dict[str, float]:
        """The numbers that the functions see as ``p.name``; by default the model's own."""
        return self.numeric_parameters()

    def segments(self) -> Sequence[Segment]:
        """Cracks that are there from the start: all bonds that cross them are broken at step 0."""
        return ()

    @abstractmethod
    def constants(self, slot: Slot) -> tuple[float, ...]:
        """The constants of a slot, seen as ``c``; the same for a slot and its opposite."""

    @staticmethod
    @abstractmethod
    def breaks(d: Vector, r: Vector, c: Any, p: Any) -> Any:
        """Whether the bond breaks in the intermediate configuration; called for one end only."""

    @staticmethod
    @abstractmethod
    def fictitious(u: Vector, r: Vector, p: Any) -> Vector:
        """The difference that stands in for d once the bond is broken; u is that of this end."""

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Warnings about the model on these rest lengths, a sequence a shell; by default none.

        Raise ExperimentError where the model does not go with them.
        """
        return []
