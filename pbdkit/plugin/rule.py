"""The FollowerRule interface: two elementwise functions and their parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.plugin.component import Remembers
from pbdkit.plugin.fields import TakesFields
from pbdkit.plugin.lattice import Cell, Slot, Tiling
from pbdkit.plugin.vector import Number, Numbers, Parameters, Vector, Weights


class Here(NamedTuple):
    """What stands at the follower itself.

    `u` is its displacement in the intermediate configuration. `X` is its reference position, as in
    the experiment and the dataset, and `centred` the same from the middle of the body's box, of
    which no digit depends on where the body lies; both are given to rules that declare
    `uses_reference`, otherwise None. `own` are the numbers that the rule remembers of the particle,
    by name.
    """

    u: Vector
    X: Vector = cast(Vector, None)
    centred: Vector = cast(Vector, None)
    own: Numbers = cast(Numbers, ())


class Stiffness(NamedTuple):
    """Plane elasticity over Young's modulus and thickness: σ_x = xx ε_x + xy ε_y + x_shear γ,
    σ_y = xy ε_x + yy ε_y + y_shear γ, τ = x_shear ε_x + y_shear ε_y + shear γ."""

    xx: Any
    yy: Any
    xy: Any
    shear: Any
    x_shear: Any = 0.0
    y_shear: Any = 0.0

    def own_modulus(self, through_thickness: Any) -> Any:
        """Young's modulus along x, over that of the material it is compared with, given σ_zz over
        σ_xx + σ_yy."""
        return (self.xx - self.xy * self.xy / self.yy) * (1.0 - through_thickness**2)


@dataclass(frozen=True)
class Setting:
    """What a rule may derive its constants from: the lattice, the slots of each sublattice, and
    the box (`lower`, `upper`) of the body's reference configuration, frame not included. `cells`
    are the lattice's cells, and which of them lie beside a slot."""

    cell: Cell
    slots: tuple[tuple[Slot, ...], ...]
    lower: Vector[float]
    upper: Vector[float]
    cells: Tiling = field(default_factory=Tiling)


SCALES_FORCES = (
    "a rule says where particles go, which does not depend on it; it scales forces and stresses, "
    "and stands under `units`, or in each diagnostic that gives them"
)


class FollowerRule(TakesFields):
    """How a follower moves, given its neighbours in the intermediate configuration m.

    To add a rule, write `gather` and `apply`, both static and elementwise: the framework calls
    them with whole arrays, single numbers or probes. With u = x - X:

    1. for each neighbour k that is present, ``gather(d, r, w, p)`` with the difference
       d = u_k - u_j, the rest offset r = X_k - X_j (so x_k - x_j = r + d), the slot's weights w
       and the parameters p returns a tuple of contributions, vectors and numbers;
    2. the contributions are summed over the neighbours, in the order of the slots;
    3. ``apply(total, here, p)`` returns the move, a vector, from where the particle stands in m to
       its target: zero moves mean rest, exactly.

    Relaxation and memory are applied afterwards and are no concern of the rule. A particle that
    has no neighbour stays. A fictitious neighbour counts as present.

    What only some rules can do is a class that they take on besides: `Calibrated`, `Loadable`,
    `TearsCells`, `MixesCells`, `StoresEnergy`, `Remembers`, `Draws`, `RenewsParticles`,
    `SharesParticles`, `TurnsParticles`, `AppliesTwice`.
    """

    _elsewhere: ClassVar[Mapping[str, str]] = {
        "youngs_modulus": SCALES_FORCES,
        "thickness": SCALES_FORCES,
    }
    linear: ClassVar[bool] = False
    """Whether moves superpose: with the same neighbours the move is a constant and a part linear in
    the displacements. What `check` predicts then holds for the whole run, not near its start
    alone."""
    uses_reference: ClassVar[bool] = False
    """Whether it counts where the particle stands: `here.X` and `here.centred` are then given.
    Other rules move a translated body in the same way, wherever it stands."""
    has_axes: ClassVar[bool] = False
    """Whether directions count: mirrored, or turned by a right angle, a body may then move
    otherwise."""
    uses_cells: ClassVar[bool] = False
    """Whether the rule works cell by cell of the lattice. ``w.left`` and ``w.right`` are then the
    shares, 0 to 1, of the cells to the left and to the right of the bond, seen from j, that belong
    to the body: both 1 inside, and everywhere unless the frame is one that weighs cells. A bond
    across a cell has that cell on both sides."""

    def parameters(self, setting: Setting) -> dict[str, float]:
        """The numbers that `gather` and `apply` see as ``p.name``; by default the rule's own.

        Raise ExperimentError where the rule does not go with the lattice.
        """
        return self.numeric_parameters()

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """The constants of a slot that `gather` sees as ``w.name``; by default none. All slots
        have the same names."""
        return {}

    @staticmethod
    @abstractmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector | Number, ...]:
        """The contributions of one neighbour, elementwise."""

    @staticmethod
    @abstractmethod
    def apply(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """The move of the follower (target - where it stands in m), elementwise."""


class Calibrated(ABC):
    """A rule that is calibrated to a material: it knows forces."""

    @abstractmethod
    def elasticity(self) -> Stiffness | None:
        """The material whose linear elasticity the rule is; None where its parameters leave it
        without one."""

    def through_thickness(self) -> float:
        """σ_zz over σ_xx + σ_yy: 0 in plane stress, Poisson's ratio in plane strain."""
        return 0.0

    @staticmethod
    @abstractmethod
    def force(total: tuple[Any, ...], here: Here, p: Parameters) -> Vector:
        """The force of the neighbours on the particle over Young's modulus and thickness, a vector
        in the lattice's units, from the sums. It vanishes in equilibrium."""


class Loadable(Calibrated):
    """A calibrated rule that takes loads: forces from outside that act on followers."""

    @staticmethod
    @abstractmethod
    def loaded(total: tuple[Any, ...], load: Vector, p: Parameters) -> tuple[Vector | Number, ...]:
        """The sums as they would be if a neighbour exerted the force `load` besides, a vector over
        Young's modulus and thickness in the lattice's units, elementwise:

            force(loaded(total, f, p), here, p) = force(total, here, p) + f.

        What it adds to the move is the same wherever neighbours stand.
        """


class StoresEnergy(Calibrated):
    """A calibrated rule that is not linear; the energy of others is -½ Σ u·force."""

    @staticmethod
    @abstractmethod
    def energy(d: Vector, r: Vector, w: Weights, p: Parameters) -> Number:
        """The half of a bond's strain energy that falls to this end, over Young's modulus and
        thickness, elementwise."""


class Torn(NamedTuple):
    """Damage beside a bond, 0 where nothing is damaged and 1 where a bond is broken: the largest of
    any bond of the cell to the left and to the right of it, and its own in each of the two."""

    left: Number
    right: Number
    bond_left: Number
    bond_right: Number


class TearsCells(Calibrated):
    """A calibrated rule that works cell by cell, and computes itself what cells with broken and
    softened bonds exert: forces that balance and that no rigid motion causes.

    Where bonds can break, a bond that is lost keeps its difference d; no fictitious point takes its
    place, and models must not place one that would pull.
    """

    @staticmethod
    @abstractmethod
    def torn(
        d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters
    ) -> tuple[Vector | Number, ...]:
        """The contributions of one neighbour, as `gather` returns them, with the damage t beside
        the bond; those of `gather`, to the last bit, where t is zero."""


class MixesCells(Calibrated):
    """A calibrated rule that works cell by cell, of whatever material each cell is: its numbers may
    then differ from cell to cell."""

    @abstractmethod
    def cell_weights(self, slot: Slot, setting: Setting, c: Stiffness) -> dict[str, float]:
        """The weights of a slot, as `weights`, were the cells of stiffness c over the modulus of
        the rule: linear in c."""

    def spring_weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """The weights that act in torn cells alone, the others 0; by default there are none. They
        are not linear in the stiffness of a cell: cells of another have `spring_share` of them."""
        return {}

    def spring_share(self, c: Floats, setting: Setting) -> Floats:
        """(cell,): how many times the `spring_weights` cells have, for their stiffness c over
        Young's modulus, (cell, 3, 3) in the components xx, yy, xy."""
        return np.zeros(len(c))


class RenewsParticles(Remembers):
    """A rule of which some remembered numbers change from step to step."""

    @staticmethod
    @abstractmethod
    def remember(total: tuple[Any, ...], here: Here, p: Parameters) -> tuple[Number, ...]:
        """The new values of the numbers that change, in their order, from what `apply` is given.

        Leaders remember as followers do; who has no neighbour keeps its numbers.
        """


class SharesParticles(Remembers):
    """A rule whose particles see what is remembered of each other: its `gather` is given two
    arguments more. Frame points and fictitious ones remember nothing, so that it goes with neither
    a frame nor bonds that break."""

    @staticmethod
    @abstractmethod
    def gather(
        d: Vector, r: Vector, w: Weights, p: Parameters, own: Numbers, there: Numbers
    ) -> tuple[Vector | Number, ...]:
        """The contributions of one neighbour, elementwise. ``own.name`` is what is remembered of
        the particle, ``there.name`` what is remembered of the neighbour, both before the step."""


class TurnsParticles(RenewsParticles):
    """A rule whose particles have directions: some remembered numbers are rotations, each by its
    cosine and sine. Leaders that are clamped prescribe them, and turn with their motion."""

    @abstractmethod
    def rotations(self) -> tuple[tuple[str, str], ...]:
        """The names of the cosine and the sine of each rotation from the reference, which is
        counterclockwise."""


class AppliesTwice(ABC):
    """A rule that works on the moves of another, for operators that are applied twice: `gather` and
    `apply` are given its moves z, of followers and leaders alike, in place of displacements:
    d = z_k - z_j and here.u = z_j."""

    @abstractmethod
    def inner(self) -> FollowerRule:
        """The rule whose moves this rule works on."""


def shares_particles(rule: object) -> bool:
    """Whether neighbours see what is remembered of each other."""
    return isinstance(rule, SharesParticles)


def material_of(rule: FollowerRule) -> Stiffness | None:
    """The material that a rule is calibrated to, if it is."""
    return rule.elasticity() if isinstance(rule, Calibrated) else None
