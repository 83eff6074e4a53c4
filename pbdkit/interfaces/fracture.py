"""The FractureModel interface: when a bond breaks, and what each end sees from then on."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.arithmetic import Vector
from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.neighbours import Slot
from pbdkit.interfaces.remembered import Bonds, Drawn, Remembered, is_own

Segment = tuple[Pair, Pair]
"""A straight crack, from one point to another (lattice units)."""


class FractureModel(Component):
    """Breaks bonds for good, and puts a fictitious point in the place of the lost neighbour.

    To add a model, write `breaks` and `fictitious`, both static and elementwise as a rule's
    functions are. d = u_k - u_j is the difference along the bond, r its rest offset, c the
    slot's constants and p the parameters.

    A model that remembers numbers of each bond declares them with `bond_state`; the functions see
    them as further entries of c, in that order. In the intermediate configuration, for each bond
    that has not broken and can: ``update`` gives their new values, then ``breaks`` decides; from
    then on they stay. Afterwards ``seen`` is what the rule sees at bonds that have not broken.
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

    def bond_state(self) -> tuple[Remembered, ...]:
        """The numbers that the model remembers of each bond; by default none."""
        return ()

    def draw(self, bonds: Bonds, generator: np.random.Generator) -> Drawn:
        """Where these numbers start, (bond,) by name, if not all at their `initial`.

        The generator depends on the experiment's `seed` and on nothing else: neither on other
        random parts, nor on engine or threads.
        """
        return {}

    @staticmethod
    @abstractmethod
    def breaks(d: Vector, r: Vector, c: Any, p: Any) -> Any:
        """Whether the bond breaks in the intermediate configuration; called for one end only."""

    @staticmethod
    def update(d: Vector, r: Vector, c: Any, p: Any) -> tuple[Any, ...]:
        """The new values of the numbers that change, in their order; called for one end only.

        By default they stay. Where a configuration lasts the values must come to an end (a largest
        value so far does, a count of steps does not), or the solver `equilibrium` finds none.
        """
        return ()

    @staticmethod
    @abstractmethod
    def fictitious(u: Vector, r: Vector, p: Any) -> Vector:
        """The difference that stands in for d once the bond is broken; u is that of this end."""

    @staticmethod
    def seen(d: Vector, lost: Vector, r: Vector, c: Any, p: Any) -> Vector:
        """The difference that the rule sees at a bond that has not broken; by default d.

        `lost` is the fictitious difference: damage D softens a bond as (1 - D) d + D lost.
        """
        return d

    @staticmethod
    def breaking_strain(r: Vector, c: Any, p: Any) -> Any:
        """The strain |r + d| / |r| - 1 beyond which the bond breaks, for those who explain; by
        default None: the model breaks bonds by something else, or does not say."""
        return None

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Warnings about the model on these rest lengths, a sequence a shell; by default none.

        Raise ExperimentError where the model does not go with them.
        """
        return []

    def updates(self) -> bool:
        """Whether what it remembers changes."""
        return is_own(self, FractureModel, "update")

    def softens(self) -> bool:
        """Whether the rule sees something else than d at bonds that have not broken."""
        return is_own(self, FractureModel, "seen")

    def draws(self) -> bool:
        """Whether bonds differ from the start."""
        return is_own(self, FractureModel, "draw")


def breaking_order(
    steps: NDArray[np.integer[Any]], strains: NDArray[np.floating[Any]]
) -> NDArray[np.intp]:
    """The places of the broken ones among some bonds, in the order in which they broke: by step
    (-1: not broken), within a step the most strained first, what ties as it comes."""
    broken = np.flatnonzero(steps >= 0)
    return broken[np.lexsort((-strains[broken], steps[broken]))]
