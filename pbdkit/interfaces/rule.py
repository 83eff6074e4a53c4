"""The FollowerRule interface: two elementwise functions and their parameters."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pbdkit.interfaces.arithmetic import Vector
from pbdkit.interfaces.component import Component
from pbdkit.interfaces.lattice import Cell
from pbdkit.interfaces.neighbours import Slot
from pbdkit.interfaces.polygons import Tiling
from pbdkit.interfaces.remembered import Drawn, Particles, Remembered, is_own


class Here(NamedTuple):
    """What stands at the follower itself, one component a plane.

    `u` is its displacement in the intermediate configuration; `X` its reference position from the
    lattice's site (0, 0), so that no digit depends on where the body lies, given to rules that
    declare `uses_reference`, otherwise None. `own` are the numbers that the rule remembers of the
    particle, in the order of `particle_state`.
    """

    u: Vector
    X: Vector
    own: tuple[Any, ...] = ()


class Stiffness(NamedTuple):
    """Plane elasticity along the lattice's axes, over Young's modulus and thickness:
    σ_x = xx ε_x + xy ε_y, σ_y = xy ε_x + yy ε_y, τ = shear · γ."""

    xx: float
    yy: float
    xy: float
    shear: float


@dataclass(frozen=True)
class Setting:
    """What a rule may derive its constants from: the lattice, the slots of each sublattice, and
    the box (`lower`, `upper`) of the body's reference configuration, frame not included, from the
    lattice's site (0, 0). `cells` are the lattice's cells, and which of them lie beside a slot."""

    cell: Cell
    slots: tuple[tuple[Slot, ...], ...]
    lower: Vector
    upper: Vector
    cells: Tiling = field(default_factory=Tiling)


class FollowerRule(Component):
    """How a follower moves, given its neighbours in the intermediate configuration m.

    To add a rule, write `gather` and `apply`, both static and elementwise: the framework calls
    them with whole arrays, single numbers or probes. With u = x - X:

    1. for each neighbour k that is present, ``gather(d, r, w, p)`` with the difference
       d = u_k - u_j, the rest offset r = X_k - X_j (so x_k - x_j = r + d), the slot's weights w
       and the parameters p returns a tuple of contributions;
    2. the contributions are summed over the neighbours, in the order of the slots;
    3. ``apply(total, here, p)`` returns the move (x, y) from where the particle stands in m to its
       target: zero moves mean rest, exactly.

    Relaxation and memory are applied afterwards and are no concern of the rule. A particle that
    has no neighbour stays. A fictitious neighbour counts as present.
    """

    linear: ClassVar[bool] = False
    """Whether moves superpose: with the same neighbours the move is a constant and a part linear in
    the displacements. What `check` predicts then holds for the whole run, not near its start
    alone."""
    uses_reference: ClassVar[bool] = False
    """Whether it counts where the particle stands: `here.X` is then given. Other rules move a
    translated body in the same way, wherever it stands."""
    uses_cells: ClassVar[bool] = False
    """Whether the rule works cell by cell of the lattice. The last two of `gather`'s w are then the
    shares, 0 to 1, of the cells to the left and to the right of the bond, seen from j, that belong
    to the body: both 1 inside, and everywhere unless the frame is one that weighs cells. A bond
    across a cell has that cell on both sides."""

    def parameters(self, setting: Setting) -> dict[str, float]:
        """The numbers that `gather` and `apply` see as ``p.name``; by default the rule's own.

        Raise ExperimentError where the rule does not go with the lattice.
        """
        return self.numeric_parameters()

    def weights(self, slot: Slot, setting: Setting) -> tuple[float, ...]:
        """The constants of a slot that `gather` sees as ``w``; by default none."""
        return ()

    def stiffness(self) -> Stiffness | None:
        """The material whose linear elasticity the rule is, where it is calibrated to one."""
        return None

    def inner(self) -> FollowerRule | None:
        """The rule whose moves this rule works on, for operators that are applied twice; by default
        none. With one, `gather` and `apply` are given its moves z, of followers and leaders alike,
        in place of displacements: d = z_k - z_j and here.u = z_j."""
        return None

    @staticmethod
    @abstractmethod
    def gather(d: Vector, r: Vector, w: Any, p: Any) -> tuple[Any, ...]:
        """The contributions of one neighbour, elementwise."""

    @staticmethod
    @abstractmethod
    def apply(total: Any, here: Here, p: Any) -> tuple[Any, Any]:
        """The move of the follower (target - where it stands in m), elementwise."""

    @staticmethod
    def force(total: Any, here: Here, p: Any) -> tuple[Any, Any]:
        """The force of the neighbours on the particle over Young's modulus and thickness, (x, y)
        in the lattice's units, from the sums. Calibrated rules have it; it vanishes in
        equilibrium."""
        raise NotImplementedError("the rule is not calibrated to a material: it knows no forces")

    def particle_state(self) -> tuple[Remembered, ...]:
        """The numbers that the rule remembers of each particle of the body, seen as ``here.own``;
        by default none."""
        return ()

    def draw(self, particles: Particles, generator: np.random.Generator) -> Drawn:
        """Where these numbers start, (particle,) by name, if not all at their `initial`.

        The generator depends on the experiment's `seed` and on nothing else.
        """
        return {}

    @staticmethod
    def remember(total: Any, here: Here, p: Any) -> tuple[Any, ...]:
        """The new values of the numbers that change, in their order, from what `apply` is given.

        By default they stay. Leaders remember as followers do; who has no neighbour keeps its
        numbers.
        """
        return ()

    def remembers(self) -> bool:
        """Whether what it remembers changes."""
        return is_own(self, FollowerRule, "remember")

    def draws(self) -> bool:
        """Whether particles differ from the start."""
        return is_own(self, FollowerRule, "draw")

    @staticmethod
    def energy(d: Vector, r: Vector, w: Any, p: Any) -> Any:
        """The half of a bond's strain energy that falls to this end, over Young's modulus and
        thickness, elementwise, for calibrated rules that are not linear. A rule that does not write
        it is taken as linear, with the energy -½ Σ u·force."""
        raise NotImplementedError("the rule has no energy of its own")
