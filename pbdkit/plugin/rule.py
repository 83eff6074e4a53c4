"""The interface FollowerRule: two elementwise functions and their parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, cast, get_origin

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError
from pbdkit.plugin.component import Remembers
from pbdkit.plugin.fields import TakesFields
from pbdkit.plugin.lattice import Cell, Slot, Tiling
from pbdkit.plugin.table import tables_of
from pbdkit.plugin.vector import Number, Numbers, Parameters, Vector, Weights


class Here(NamedTuple):
    """Local values at the follower.

    Parameters
    ----------
    u : Vector
        Displacement in the intermediate configuration, in lattice units.
    X : Vector
        Reference position, as in the experiment and the dataset; None unless the rule declares
        `uses_reference`.
    centred : Vector
        Reference position relative to the middle of the body's box. It does not depend on the
        position of the body, not even by rounding; None unless the rule declares `uses_reference`.
    own : Numbers
        State variables of the particle, by name.
    """

    u: Vector
    X: Vector = cast(Vector, None)
    centred: Vector = cast(Vector, None)
    own: Numbers = cast(Numbers, ())


class Stiffness(NamedTuple):
    """Stiffness of plane elasticity, divided by Young's modulus and thickness.

    σ_x = xx ε_x + xy ε_y + x_shear γ, σ_y = xy ε_x + yy ε_y + y_shear γ and
    τ = x_shear ε_x + y_shear ε_y + shear γ.

    Parameters
    ----------
    xx, yy, xy : float or array
        Normal stiffnesses: σ_x / ε_x, σ_y / ε_y, and σ_x / ε_y.
    shear : float or array
        Shear stiffness, τ / γ.
    x_shear, y_shear : float or array
        Coupling of shear with ε_x and ε_y; 0 if the axes are axes of symmetry.
    """

    xx: Any
    yy: Any
    xy: Any
    shear: Any
    x_shear: Any = 0.0
    y_shear: Any = 0.0

    def own_modulus(self, through_thickness: Any) -> Any:
        """Return the ratio of Young's modulus along x to that of the reference material.

        Parameters
        ----------
        through_thickness : float or array
            Ratio σ_zz / (σ_xx + σ_yy).

        Returns
        -------
        float
            Ratio of the moduli.
        """
        return (self.xx - self.xy * self.xy / self.yy) * (1.0 - through_thickness**2)


@dataclass(frozen=True)
class Setting:
    """Lattice and body, from which a rule may derive its constants.

    Parameters
    ----------
    cell : Cell
        Repeat cell of the lattice.
    slots : tuple of tuple of Slot
        Slots of each sublattice.
    lower, upper : Vector of float
        Corners of the body's box in the reference configuration, without the frame.
    cells : Tiling
        Cells of the lattice and those beside each slot.
    """

    cell: Cell
    slots: tuple[tuple[Slot, ...], ...]
    lower: Vector[float]
    upper: Vector[float]
    cells: Tiling = field(default_factory=Tiling)


SCALES_FORCES = (
    "displacements do not depend on it, and rules do not have this parameter; it scales forces and "
    "stresses: write it under `units`, or in each diagnostic of forces or stresses"
)
"""Message for a rule in which Young's modulus is given as a key."""


class FollowerRule(TakesFields):
    """Moves a follower according to its neighbours in the intermediate configuration m.

    To add a rule, write `gather` and `apply`. Both are static and elementwise, because they are
    called with whole arrays and with single numbers, and are compiled into kernels. With the
    displacement u = x - X, a step evaluates them as follows:

    1. For each neighbour k that exists, ``gather(d, r, w, p)`` returns contributions, which are
       vectors or numbers. d = u_k - u_j is the difference of the displacements, r = X_k - X_j is
       the rest offset (x_k - x_j = r + d), w are the weights of the slot, and p are the parameters.
    2. The contributions are summed over the neighbours in the order of the slots.
    3. ``apply(total, here, p)`` returns the move, a vector, from the position in m to the target. A
       particle with a move of exactly zero is at rest.

    pbdkit then applies relaxation and momentum to the move. A particle without neighbours does not
    move. A fictitious neighbour is a neighbour that exists.

    Optional capabilities are further base classes: `Calibrated`, `Loadable`, `TearsCells`,
    `MixesCells`, `StoresEnergy`, `Remembers`, `Draws`, `RenewsParticles`, `SharesParticles`,
    `TurnsParticles`, `AppliesTwice`, `UsesAngles`.
    """

    _elsewhere: ClassVar[Mapping[str, str]] = {
        "youngs_modulus": SCALES_FORCES,
        "thickness": SCALES_FORCES,
    }
    linear: ClassVar[bool] = False
    """True if moves superpose: as long as the neighbours do not change, the move is a constant plus
    a linear function of the displacements. Predictions of `check` then hold for the whole run."""
    uses_reference: ClassVar[bool] = False
    """True if the move depends on the position of the particle: `here.X` and `here.centred` are
    then set. With all other rules, moves do not change if the body is translated."""
    has_axes: ClassVar[bool] = False
    """True if directions matter: a body that is reflected, or rotated by a right angle, may then
    move differently."""
    uses_cells: ClassVar[bool] = False
    """True if the move is a sum over the cells of the lattice.

    A bond has a cell to its left and one to its right, as seen from j. ``w.left`` and ``w.right``
    are then the area fractions of these two cells inside the body. Both are 1 inside the body, and
    for all bonds if the frame does not weigh cells. If the bond is the diagonal of a cell, both
    belong to this cell.
    """

    def parameters(self, setting: Setting) -> dict[str, Any]:
        """Return the parameters that `gather` and `apply` receive as ``p.name``.

        By default these are the numeric fields, the tables, and the fields that are chosen by name
        (``mode: Literal["a", "b"]``). A word can be compared by ``==`` and ``!=``.

        Parameters
        ----------
        setting : Setting
            Lattice and body.

        Returns
        -------
        dict of str to float, str or Table
            Parameters by name.

        Raises
        ------
        ExperimentError
            If the rule cannot be combined with the lattice.
        """
        fields = type(self).model_fields.items()
        words = {
            name: getattr(self, name)
            for name, field in fields
            if get_origin(field.annotation) is Literal and isinstance(field.default, str)
        }
        words.pop("type", None)
        tables = {name: getattr(self, name) for name in tables_of(type(self))}
        return self.numeric_parameters() | words | tables

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return the constants of a slot, which `gather` receives as ``w.name``.

        By default there are none.

        Parameters
        ----------
        slot : Slot
            Slot; the constants of all slots must have the same names.
        setting : Setting
            Lattice and body.

        Returns
        -------
        dict of str to float
            Constants by name.
        """
        return {}

    @staticmethod
    @abstractmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector | Number, ...]:
        """Return the contributions of one neighbour, elementwise.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        w : Weights
            Constants of the slot.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        tuple of Vector or Number
            Contributions, which pbdkit sums over the neighbours.
        """

    @staticmethod
    @abstractmethod
    def apply(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """Return the move of the follower from its position in m to its target, elementwise.

        Parameters
        ----------
        total : tuple of Vector or Number
            Sums of the contributions.
        here : Here
            Local values of the particle.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        Vector
            Move, in lattice units.
        """


class Calibrated(ABC):
    """A rule that is calibrated to a material, so that it has forces."""

    @abstractmethod
    def elasticity(self) -> Stiffness | None:
        """Return the linear elasticity of the rule; None if its parameters define no material.

        Returns
        -------
        Stiffness or None
            Elasticity divided by Young's modulus and thickness.
        """

    def through_thickness(self) -> float:
        """Return σ_zz / (σ_xx + σ_yy): 0 in plane stress, Poisson's ratio in plane strain.

        Returns
        -------
        float
            Ratio of the stresses.
        """
        return 0.0

    @staticmethod
    @abstractmethod
    def force(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """Return the force of the neighbours on the particle, elementwise.

        It vanishes in equilibrium.

        Parameters
        ----------
        total : tuple of Vector or Number
            Sums of the contributions.
        here : Here
            Local values of the particle.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        Vector
            Force divided by Young's modulus and thickness, in lattice units.
        """


class Loadable(Calibrated):
    """A calibrated rule that supports loads, which are external forces on followers."""

    @staticmethod
    @abstractmethod
    def loaded(total: tuple[Any, ...], load: Vector, p: Parameters) -> tuple[Vector | Number, ...]:
        """Return the sums as if a further neighbour exerted the force `load`, elementwise.

        The contribution of the load to the move must not depend on the positions of the neighbours.

        Parameters
        ----------
        total : tuple of Vector or Number
            Sums of the contributions.
        load : Vector
            Force divided by Young's modulus and thickness, in lattice units.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        tuple of Vector or Number
            Sums of the contributions with the load.

        Notes
        -----
        With the force f, it must hold that
        ``force(loaded(total, f, p), here, p) = force(total, here, p) + f``.
        """


class StoresEnergy(Calibrated):
    """A nonlinear calibrated rule with a strain energy.

    Linear rules do not need this capability, because their energy is -½ Σ u·force.
    """

    @staticmethod
    @abstractmethod
    def energy(d: Vector, r: Vector, w: Weights, p: Parameters) -> Number:
        """Return half of the strain energy of a bond, elementwise. The function is evaluated at
        both ends of a bond.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        w : Weights
            Constants of the slot.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        Number
            Energy divided by Young's modulus and thickness.
        """


class Torn(NamedTuple):
    """Damage beside a bond: 0 is undamaged, 1 broken.

    Parameters
    ----------
    left, right : Number
        Largest damage of the bonds of the cell to the left of the bond, and of those of the cell to
        the right.
    bond_left, bond_right : Number
        Damage of the bond itself in the left cell and in the right cell.
    """

    left: Number
    right: Number
    bond_left: Number
    bond_right: Number


class TearsCells(Calibrated):
    """A calibrated rule that sums over cells and computes the forces of damaged cells.

    The forces must balance, and rigid motions must cause no forces. For a broken bond the rule
    receives the difference d between its real ends, and fictitious points are not used. A fracture
    model with fictitious points that exert forces can therefore not be combined with the rule.
    """

    @staticmethod
    @abstractmethod
    def torn(
        d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters
    ) -> tuple[Vector | Number, ...]:
        """Return the contributions of one neighbour in damaged cells, elementwise.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        w : Weights
            Constants of the slot.
        t : Torn
            Damage beside the bond. Where it is zero, the result must equal that of `gather` to the
            last bit.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        tuple of Vector or Number
            Contributions, of the same form as those of `gather`.
        """


class MixesCells(Calibrated):
    """A calibrated rule that sums over cells, of which each can have a material of its own."""

    @abstractmethod
    def cell_weights(self, slot: Slot, setting: Setting, c: Stiffness) -> dict[str, float]:
        """Return the weights of a slot for cells of another stiffness.

        Parameters
        ----------
        slot : Slot
            Slot; all slots must have the same names.
        setting : Setting
            Lattice and body.
        c : Stiffness
            Stiffness of the cells divided by the modulus of the rule. The weights must be linear in
            it.

        Returns
        -------
        dict of str to float
            Weights by name.
        """

    def spring_weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return the weights of springs, which act in torn cells only; by default there are none.

        In the returned weights, all weights except those of the springs are 0. The weights of
        springs are not linear in the stiffness of a cell, in contrast to those of `cell_weights`.
        In cells of another stiffness they are multiplied by `spring_share`.

        Parameters
        ----------
        slot : Slot
            Slot; all slots must have the same names.
        setting : Setting
            Lattice and body.

        Returns
        -------
        dict of str to float
            Weights by name.
        """
        return {}

    def spring_share(self, c: Floats, setting: Setting) -> Floats:
        """Return the factors that multiply `spring_weights` in cells of other stiffnesses.

        Parameters
        ----------
        c : array of float, shape (cell, 3, 3)
            Stiffness of each cell divided by Young's modulus, as a matrix for the components xx, yy
            and xy of strain and stress.
        setting : Setting
            Lattice and body.

        Returns
        -------
        array of float, shape (cell,)
            Factor of each cell.
        """
        return np.zeros(len(c))


class RenewsParticles(Remembers):
    """A rule with state variables that change from step to step."""

    @staticmethod
    @abstractmethod
    def remember(total: tuple[Any, ...], here: Here, p: Parameters) -> tuple[Number, ...]:
        """Return the new values of the state variables that change, elementwise.

        The order is that of `remembered`. State variables of leaders are updated like those of
        followers. Those of a particle without neighbours do not change.

        Parameters
        ----------
        total : tuple of Vector or Number
            Sums of the contributions.
        here : Here
            Local values of the particle.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        tuple of Number
            New values.
        """


class SharesParticles(Remembers):
    """A rule that reads the state variables of both particle and neighbour.

    Frame points and fictitious points have no state variables, so that the rule can be combined
    neither with a frame nor with bonds that break.
    """

    @staticmethod
    @abstractmethod
    def gather(
        d: Vector, r: Vector, w: Weights, p: Parameters, own: Numbers, there: Numbers
    ) -> tuple[Vector | Number, ...]:
        """Return the contributions of one neighbour, elementwise.

        Parameters
        ----------
        d : Vector
            Difference u_k - u_j, in lattice units.
        r : Vector
            Rest offset X_k - X_j, in lattice units.
        w : Weights
            Constants of the slot.
        p : Parameters
            Parameters of the rule.
        own : Numbers
            State variables of the particle before the step.
        there : Numbers
            State variables of the neighbour before the step.

        Returns
        -------
        tuple of Vector or Number
            Contributions, which pbdkit sums over the neighbours.
        """


class TurnsParticles(RenewsParticles):
    """A rule in which particles have directions, stored as state variables.

    The rotation of a direction is stored as two state variables, its cosine and its sine. Clamped
    leaders prescribe the directions, which rotate with the motion of the group.
    """

    @abstractmethod
    def rotations(self) -> tuple[tuple[str, str], ...]:
        """Return the names of the state variables with cosine and sine of each rotation.

        Rotations are counterclockwise, from the direction in the reference configuration.

        Returns
        -------
        tuple of (str, str)
            Names of cosine and sine.
        """


class AppliesTwice(ABC):
    """A rule that is applied to the moves of an inner rule, for operators that are applied twice.

    The moves z that the inner rule computes for followers and leaders replace the displacements in
    `gather` and `apply`: d = z_k - z_j and here.u = z_j.
    """

    @abstractmethod
    def inner(self) -> FollowerRule:
        """Return the inner rule.

        Returns
        -------
        FollowerRule
            Rule that computes the moves which `gather` and `apply` receive.
        """


class UsesAngles(ABC):
    """A rule that sums over pairs of neighbours in addition to the neighbours.

    A pair of neighbours k and l forms an angle at the particle j. Its sides are
    x_k - x_j = r1 + d1 and x_l - x_j = r2 + d2. The sums over the pairs are appended to the sums
    that `apply` receives. At a broken bond the fictitious point is a neighbour. A pair of which one
    neighbour does not exist makes no contribution.
    """

    def pairs(self, slots: tuple[Slot, ...]) -> tuple[tuple[int, int], ...]:
        """Return the pairs of slots of a sublattice.

        By default these are, for each shell, the slots that are consecutive counterclockwise.

        Parameters
        ----------
        slots : tuple of Slot
            Slots of the sublattice.

        Returns
        -------
        tuple of (int, int)
            Indices of the two slots of each pair, in the order of the summation.

        Raises
        ------
        ExperimentError
            In space, where slots are not ordered by an angle.
        """
        if len(slots[0].rest) != 2:
            raise ExperimentError(
                "has pairs of neighbours in the plane only; define `pairs(slots)` for lattices in "
                "space"
            )
        pairs: list[tuple[int, int]] = []
        for shell in {slot.shell for slot in slots}:
            numbers = [n for n, slot in enumerate(slots) if slot.shell == shell]
            numbers.sort(key=lambda n: math.atan2(slots[n].rest.y, slots[n].rest.x))
            following = [*numbers[1:], *numbers[:1]] if len(numbers) > 1 else []
            pairs += zip(numbers, following, strict=False)
        return tuple(sorted(pairs))

    @staticmethod
    @abstractmethod
    def gather_pair(
        d1: Vector, d2: Vector, r1: Vector, r2: Vector, w1: Weights, w2: Weights, p: Parameters
    ) -> tuple[Vector | Number, ...]:
        """Return the contributions of a pair of neighbours k and l, elementwise.

        Parameters
        ----------
        d1, d2 : Vector
            Differences u_k - u_j and u_l - u_j, in lattice units.
        r1, r2 : Vector
            Rest offsets X_k - X_j and X_l - X_j, in lattice units.
        w1, w2 : Weights
            Constants of the two slots.
        p : Parameters
            Parameters of the rule.

        Returns
        -------
        tuple of Vector or Number
            Contributions, which pbdkit sums over the pairs.
        """


def shares_particles(rule: object) -> bool:
    """Return whether a rule reads the state variables of neighbours."""
    return isinstance(rule, SharesParticles)


def material_of(rule: FollowerRule) -> Stiffness | None:
    """Return the material to which a rule is calibrated, or None."""
    return rule.elasticity() if isinstance(rule, Calibrated) else None
