"""The interface FractureModel.

It defines the condition under which a bond breaks, and what replaces the neighbour afterwards.
"""

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
"""Straight crack, from one point to another, in lattice units."""


class FractureModel(TakesFields):
    """Breaks bonds permanently and replaces the lost neighbour by a fictitious point.

    To add a model, write `constants`, `breaks` and `fictitious`; the latter two are static and
    elementwise functions, like those of a rule. Their arguments are d = u_k - u_j, the difference
    between the displacements of the two ends; r, the rest offset of the bond; c, the constants of
    the slot and the state variables of the bond by name; and p, the parameters.

    In each step the intact bonds that can break are tested in the intermediate configuration. A
    model that derives from `RenewsBonds` first updates the state variables of a bond; then
    ``breaks`` is evaluated. The state variables of broken bonds no longer change. Afterwards, for a
    model that derives from `Softens`, the rule receives another difference in place of d at intact
    bonds. Optional capabilities are further base classes: `Remembers`, `Draws`, `RenewsBonds`,
    `Softens`, `SoftensCells`, `StartsCracked`, `BreaksAtStrain`, `UsesStiffness`.
    """

    has_axes: ClassVar[bool] = False
    """True if directions matter: bonds of a body that is reflected, or rotated by a right angle,
    may then break differently."""
    can_break: ClassVar[bool] = True
    """False if no bond ever breaks; the scene then has no bond state."""

    def breaks_frame_bonds(self) -> bool:
        """Return whether bonds to frame points can break; by default they can.

        Returns
        -------
        bool
            True if they can break.
        """
        return True

    def parameters(self) -> dict[str, float]:
        """Return the numbers that functions receive as ``p.name``.

        By default these are the numeric fields of the model.

        Returns
        -------
        dict of str to float
            Numbers by name.
        """
        return self.numeric_parameters()

    @abstractmethod
    def constants(self, slot: Slot) -> dict[str, float]:
        """Return the constants of a slot, which functions receive as ``c.name``.

        Parameters
        ----------
        slot : Slot
            Slot; its opposite must have the same constants.

        Returns
        -------
        dict of str to float
            Constants by name; all slots have the same names.
        """

    @staticmethod
    @abstractmethod
    def breaks(d: Vector, r: Vector, c: Constants, p: Parameters) -> Condition:
        """Return whether the bond breaks in the intermediate configuration, elementwise.

        pbdkit evaluates the function at one end of a bond only. At the other end, d and r have the
        opposite signs, so that the result must be the same for (-d, -r).

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        Condition
            True where the bond breaks.
        """

    @staticmethod
    @abstractmethod
    def fictitious(u: Vector, r: Vector, p: Parameters) -> Vector:
        """Return the difference that the rule receives in place of d at a broken bond, elementwise.

        Parameters
        ----------
        u : Vector
            Displacement of the particle at this end, in lattice units.
        r : Vector
            Rest offset of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        Vector
            Displacement of the fictitious neighbour minus the displacement of the particle.
        """

    def check(self, shells: Sequence[Sequence[float]]) -> list[str]:
        """Return warnings about the model; by default there are none.

        Parameters
        ----------
        shells : sequence of sequence of float
            Rest lengths of each shell, in lattice units.

        Returns
        -------
        list of str
            Warnings, one sentence each.

        Raises
        ------
        ExperimentError
            If the model cannot be combined with these shells.
        """
        return []


class RenewsBonds(Remembers):
    """A fracture model with state variables that change from step to step."""

    @staticmethod
    @abstractmethod
    def update(d: Vector, r: Vector, c: Constants, p: Parameters) -> tuple[Number, ...]:
        """Return the new values of the state variables that change, elementwise.

        The order is that of `remembered`. pbdkit evaluates the function at one end of a bond only.
        If the configuration no longer changes, the values must converge: a maximum over the steps
        converges, a number of steps does not. Otherwise the solver `equilibrium` cannot converge.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        tuple of Number
            New values.
        """


class SpacingLimits(NamedTuple):
    """Lengths of a fracture model with a fracture energy, which `pbdkit check` prints.

    Parameters
    ----------
    process_zone : float
        Length E G_c / f_t² of the process zone, in lattice units.
    factors : dict of float to float
        Largest admissible lattice constant divided by that of the scene, by the angle of the
        normal of a crack in degrees.
    """

    process_zone: float
    factors: dict[float, float]


class UsesStiffness(ABC):
    """A fracture model for calibrated rules.

    Some of its constants depend on the material and the cells.
    """

    @abstractmethod
    def of_material(self, slot: Slot, rule: Calibrated, setting: Setting) -> dict[str, float]:
        """Return further constants of a slot, which functions receive as ``c.name``.

        Parameters
        ----------
        slot : Slot
            Slot of the bond.
        rule : Calibrated
            Rule with an elasticity.
        setting : Setting
            Lattice and body.

        Returns
        -------
        dict of str to float
            Constants by name; all slots have the same names.

        Raises
        ------
        ExperimentError
            If the model cannot be combined with the rule.
        """

    def spacing_limits(self, rule: Calibrated, setting: Setting) -> SpacingLimits | None:
        """Return the limits of the lattice constant; None if there are none, the default.

        Parameters
        ----------
        rule : Calibrated
            Rule with an elasticity.
        setting : Setting
            Lattice and body.

        Returns
        -------
        SpacingLimits or None
            Limits, with the single numbers of parameters that vary.
        """
        return None


class Softens(ABC):
    """A fracture model that softens intact bonds.

    At intact bonds the rule receives the result of `seen` in place of d, the difference between the
    displacements of the two ends.
    """

    @staticmethod
    @abstractmethod
    def seen(d: Vector, lost: Vector, r: Vector, c: Constants, p: Parameters) -> Vector:
        """Return the difference that the rule receives in place of d, elementwise.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        lost : Vector
            Displacement of the fictitious point minus that of the particle. A bond with the damage
            D is softened by the result (1 - D) d + D lost.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        Vector
            Difference that replaces d.
        """


class CellStress(NamedTuple):
    """Stress of a cell without damage, divided by its own Young's modulus.

    Parameters
    ----------
    xx, yy, xy : Number
        Components σ_xx, σ_yy and σ_xy of the mean stress.
    share : Number
        Area fraction of the cell inside the body, 0 to 1; 0 if there is no cell.
    strain_xx, strain_yy, strain_xy : Number
        Components ε_xx, ε_yy and ε_xy of the mean strain.
    strain : Number
        Strain of the bond. It differs from the mean strain of the cell along the bond at the edges
        of rectangles.
    """

    xx: Number
    yy: Number
    xy: Number
    share: Number
    strain_xx: Number
    strain_yy: Number
    strain_xy: Number
    strain: Number


class SoftensCells(RenewsBonds):
    """A fracture model that softens bonds by the stress of the two cells beside them.

    It requires a rule that derives from `TearsCells`, and a frame that weighs cells. Each of its
    state variables has two values for a bond, one for the cell to the left and one for the cell to
    the right, as seen along the slot of the bond. Their names end in `_left` and `_right`. All
    values are 0 until the cell softens. `damage_left` and `damage_right` are the fractions by which
    the force of the bond is reduced in the two cells. A diagonal has the same cell on both sides.
    """

    @staticmethod
    @abstractmethod
    def update(  # type: ignore[override]  # cells are arguments, too
        d: Vector, r: Vector, c: Constants, p: Parameters, left: CellStress, right: CellStress
    ) -> tuple[Number, ...]:
        """Return the new values of the state variables that change, in their order, elementwise.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.
        left, right : CellStress
            Stress of the cells on both sides of the bond.

        Returns
        -------
        tuple of Number
            New values.
        """

    @staticmethod
    @abstractmethod
    def load(stress: CellStress, r: Vector, c: Constants, p: Parameters) -> Number:
        """Return the stress at a bond in a cell divided by that at which it begins to soften,
        elementwise.

        If several bonds have reached their limit, the solver `equilibrium` softens the one with the
        largest value first.

        Parameters
        ----------
        stress : CellStress
            Stress of the cell.
        r : Vector
            Rest offset X_k - X_j of the bond, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        Number
            Ratio of the stresses; 1 at the limit.
        """


class StartsCracked(ABC):
    """A fracture model with initial cracks."""

    @abstractmethod
    def segments(self) -> Sequence[Segment]:
        """Return the cracks; all bonds that cross them are broken at step 0.

        Returns
        -------
        sequence of Segment
            Straight cracks, in lattice units.
        """


class BreaksAtStrain(ABC):
    """A fracture model with a breaking strain, which `pbdkit explain` prints."""

    @staticmethod
    @abstractmethod
    def breaking_strain(r: Vector, c: Constants, p: Parameters) -> Number:
        """Return the strain |r + d| / |r| - 1 above which the bond breaks, elementwise.

        Parameters
        ----------
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        c : Constants
            Constants of the slot and state variables of the bond.
        p : Parameters
            Parameters of the model.

        Returns
        -------
        Number
            Strain.
        """


def breaking_order(
    steps: NDArray[np.integer[Any]], strains: NDArray[np.floating[Any]]
) -> NDArray[np.intp]:
    """Return the rows of broken bonds in the order in which they broke.

    Bonds are sorted by step. Within a step, bonds that were cut precede all others, which are
    sorted by decreasing strain.

    Parameters
    ----------
    steps : (bond,)
        Step in which each bond broke; -1 if it is intact.
    strains : (bond,)
        Strain at that step; NaN for bonds that were cut.
    """
    broken = np.flatnonzero(steps >= 0)
    order = np.where(np.isnan(strains), -np.inf, -strains)
    return broken[np.lexsort((order[broken], steps[broken]))]
