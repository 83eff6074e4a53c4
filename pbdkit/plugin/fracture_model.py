"""The FractureModel interface: when a bond breaks, and what each end sees from then on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.plugin.component import Remembers
from pbdkit.plugin.fields import TakesFields
from pbdkit.plugin.lattice import Slot
from pbdkit.plugin.rule import Calibrated, Setting
from pbdkit.plugin.units import Place
from pbdkit.plugin.vector import Condition, Constants, Number, Parameters, Vector

Segment = tuple[Place, Place]
"""A straight crack, from one point to another (lattice units)."""


class FractureModel(TakesFields):
    """Breaks bonds for good, and puts a fictitious point in the place of the lost neighbour.

    To add a model, write `breaks` and `fictitious`, both static and elementwise as a rule's
    functions are. d = u_k - u_j is the difference along the bond, r its rest offset, c the
    slot's constants and what is remembered of the bond, by name, and p the parameters.

    In the intermediate configuration, for each bond that has not broken and can: a model that
    `RenewsBonds` gives their new values, then ``breaks`` decides; from then on they stay.
    Afterwards a model that `Softens` says what the rule sees at bonds that have not broken.

    What only some models can do is a class that they take on besides: `Remembers`, `Draws`,
    `RenewsBonds`, `Softens`, `SoftensCells`, `StartsCracked`, `BreaksAtStrain`, `KnowsStiffness`.
    """

    has_axes: ClassVar[bool] = False
    """Whether directions count: mirrored, or turned by a right angle, bonds may then break
    otherwise."""
    can_break: ClassVar[bool] = True
    """False where nothing ever breaks: the scene then has no bond state at all."""

    def breaks_frame_bonds(self) -> bool:
        """Whether bonds to frame points can break too; by default they do."""
        return True

    def parameters(self) -> dict[str, float]:
        """The numbers that the functions see as ``p.name``; by default the model's own."""
        return self.numeric_parameters()

    @abstractmethod
    def constants(self, slot: Slot) -> dict[str, float]:
        """The constants of a slot, seen as ``c.name``; the same for a slot and its opposite, and
        the same names for all."""

    @staticmethod
    @abstractmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Whether the bond breaks in the intermediate configuration; called for one end only."""

    @staticmethod
    @abstractmethod
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
        """The difference that stands in for d once the bond is broken, a vector; u is that of this
        end."""

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Warnings about the model on these rest lengths, a sequence a shell; by default none.

        Raise ExperimentError where the model does not go with them.
        """
        return []


class RenewsBonds(Remembers):
    """A fracture model of which some remembered numbers change from step to step."""

    @staticmethod
    @abstractmethod
    def update(d: Vector, r: Vector, c: Constants, p: Parameters) -> tuple[Number, ...]:
        """The new values of the numbers that change, in their order; called for one end only.

        Where a configuration lasts the values must come to an end (a largest value so far does, a
        count of steps does not), or the solver `equilibrium` finds none.
        """


class KnowsStiffness(ABC):
    """A fracture model that goes with calibrated rules, some constants of which follow from the
    material and the cells."""

    @abstractmethod
    def of_material(self, slot: Slot, rule: Calibrated, setting: Setting) -> dict[str, float]:
        """Further constants of a slot, seen as ``c.name`` after those of `constants`.

        `rule` has an elasticity. Raise ExperimentError where the model does not go with it.
        """


class Softens(ABC):
    """A fracture model under which the rule sees something else than d at bonds that have not
    broken."""

    @staticmethod
    @abstractmethod
    def seen(d: Vector, lost: Vector, r: Vector, c: Constants, p: Parameters) -> Vector:
        """The difference that the rule sees; `lost` is the fictitious one: damage D softens a bond
        as (1 - D) d + D lost."""


class CellStress(NamedTuple):
    """The stress that a cell would have without damage, over its own Young's modulus, and the
    `share` of it that belongs to the body: 0 where there is no cell."""

    xx: Number
    yy: Number
    xy: Number
    share: Number


class SoftensCells(RenewsBonds):
    """A fracture model that softens bonds in each of the two cells beside them, by the stress of
    that cell; for rules that `TearsCells`, with a frame that weighs cells.

    Its numbers come in pairs, with names that end in `_left` and `_right`, as seen along the slot
    by which the bond is kept; all start at 0, and stay there until the cell begins to soften.
    `damage_left` and `damage_right` are the shares of its pull that the bond has lost in the two.
    A diagonal has one cell on both sides.
    """

    @staticmethod
    @abstractmethod
    def update(  # type: ignore[override]  # receives the cells too
        d: Vector, r: Vector, c: Constants, p: Parameters, left: CellStress, right: CellStress
    ) -> tuple[Number, ...]:
        """The new values of the numbers that change, in their order, from the stress of the cell
        on either side of the bond as well."""

    @staticmethod
    @abstractmethod
    def load(stress: CellStress, c: Constants, p: Parameters) -> Number:
        """How far the stress of a cell has come on the way to where it begins to soften: 1 there.

        Of cells that would begin together under `solver: equilibrium`, the most loaded do."""


class StartsCracked(ABC):
    """A fracture model with cracks that are there from the start."""

    @abstractmethod
    def segments(self) -> Sequence[Segment]:
        """The cracks: all bonds that cross them are broken at step 0."""


class BreaksAtStrain(ABC):
    """A fracture model that says how far a bond may be strained, for those who explain."""

    @staticmethod
    @abstractmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """The strain |r + d| / |r| - 1 beyond which the bond breaks."""


def breaking_order(
    steps: NDArray[np.integer[Any]], strains: NDArray[np.floating[Any]]
) -> NDArray[np.intp]:
    """The places of the broken ones among some bonds, in the order in which they broke: by step
    (-1: not broken), within a step those that were cut (NaN) first, then the most strained, what
    ties as it comes."""
    broken = np.flatnonzero(steps >= 0)
    order = np.where(np.isnan(strains), -np.inf, -strains)
    return broken[np.lexsort((order[broken], steps[broken]))]
