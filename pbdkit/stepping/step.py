"""Operations of a step, one for each feature of a scene (listed in ARCHITECTURE.md).

Engines process the list of operations and do not depend on features: numpy applies one operation
after the other, and kernels consist of the lines that operations emit. The order of the operations
is defined in `stepping/program.py`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from pbdkit.array_types import Array, Floats, Indices
from pbdkit.plugin import Component
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter, Lines
from pbdkit.stepping.state import State


class Placed(NamedTuple):
    """Leaders with prescribed displacements.

    Parameters
    ----------
    place
        Flat places.
    u
        Displacements, (axis, particle).
    axes
        Axes along which the displacements are prescribed.
    """

    place: Indices
    u: Floats
    axes: tuple[int, ...]


Leaders = list[Placed]
"""Type of the leaders of a step."""
Starts = tuple[Floats | None, ...]
"""Type of the displacements, or velocities, at which the motions of leader groups start."""


class Mode(Enum):
    """Mode of stepping that some operations do not support."""

    GPU = "on the threads of a GPU"
    PASSES = "several steps in a pass over the memory"
    RANKS = "rows of the lattice in several processes"
    RANKS_AT_REST = "an equilibrium in several processes"
    TIME_DEPENDENT = "in kernels, while numbers of rule or fracture model change in time"
    TIME_DEPENDENT_SOLVER = "in kernels, while numbers of the solver change in time"


PUSHED_BY_TIME_DEPENDENCE = (
    "the motion of masses, obstacles or leaders along an axis depends on time-dependent parameters"
)
"""Reason why kernels do not support the time-dependent parameters of some scenes."""


class Hindrance(NamedTuple):
    """Reason why an operation does not support a mode.

    Parameters
    ----------
    reason
        The reason in words.
    field
        Field of the experiment that leads to the operation.
    """

    reason: str
    field: str


class Reach(NamedTuple):
    """Distances along an axis, in repeat cells, over which an operation reads values that other
    operations write.

    Parameters
    ----------
    reach
        Largest distance to a neighbour.
    back, ahead
        Distances behind and ahead of a particle. Up to these distances bonds are updated, or moves
        of an inner rule are computed, before the particle moves.
    below, above
        Distances below and above a particle up to which displacements are read in order to update a
        bond or to compute a move of an inner rule.
    apart
        Distance of frame points from the particles that they follow.
    """

    reach: int = 0
    back: int = 0
    ahead: int = 0
    below: int = 0
    above: int = 0
    apart: int = 0

    @property
    def step(self) -> int:
        """Distance by which the region of each step in a pass is shifted against the region of the
        previous step."""
        sees = max(self.reach, self.above + self.ahead, self.below + self.back)
        return max(sees + self.apart, self.back + self.ahead)

    @property
    def sight(self) -> int:
        """Distance up to which a step reads displacements, for its moves or in order to update
        bonds or compute moves of an inner rule."""
        return max(self.reach - self.ahead, self.above)


@dataclass(slots=True)
class Step:
    """Step in progress, which is passed from operation to operation and modified by each.

    Parameters
    ----------
    number
        Number of the step.
    u
        Displacements at the end of the previous step. While particles move, leaders have their
        prescribed displacements, so that `u` is the intermediate configuration.
    new
        On entry the displacements at the beginning of the previous step; at the end those after
        this step.
    state
        State at the beginning of the step. State variables of bonds and particles are updated in
        place.
    invalid
        Treatment of arithmetic operations of the rule that give NaN.
    leaders, origins
        Leaders with the prescribed displacements, and with their displacements before the step.
    starts
        Starts of the motions of leader groups.
    directions
        Directions that clamped leaders prescribe, as (values, places, prescribed values).
    """

    number: int
    u: Floats
    new: Floats
    state: State
    invalid: Literal["raise", "ignore"] = "ignore"
    leaders: Leaders = field(default_factory=list)
    origins: Leaders = field(default_factory=list)
    starts: Starts = ()
    directions: list[tuple[Array, Indices, Array]] = field(default_factory=list)


@dataclass(slots=True)
class Call:
    """Data for one call of a kernel that computes several steps. They are prepared by the
    operations on the host.

    Parameters
    ----------
    state
        State before the first step.
    leaders
        Leaders in each step of the call. If there is only one entry, it is valid for all steps.
    starts
        Starts of the motions of leader groups.
    clamps
        Flat places of clamped leaders.
    has_cuts
        Whether bonds were cut.
    """

    state: State
    leaders: list[Leaders] = field(default_factory=lambda: [[]])
    starts: Starts = ()
    clamps: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    has_cuts: bool = False

    @property
    def step(self) -> int:
        """Number of the first step."""
        return self.state.step + 1

    @property
    def moments(self) -> range:
        """Numbers of the steps for which the leaders have separate displacements."""
        return range(self.step, self.step + len(self.leaders))


class Entries(NamedTuple):
    """List of particles over which the lines of an operation loop.

    Parameters
    ----------
    place
        Flat places.
    values
        Arrays by name, with the list along the last axis.
    """

    place: Indices
    values: dict[str, Array]


Cells = tuple[Indices, ...]
"""Type of repeat cells, one array for each axis."""


class Operation(ABC):
    """Part of a step that belongs to one feature of a scene.

    Subclasses define `apply` and `emit`. The other methods have defaults, which describe a feature
    that reads no neighbours, is the same in each step and does not move a body at rest. Subclasses
    override the methods for which this is not true.
    """

    makes_moves: ClassVar[bool] = False
    """True if the operation contributes to the moves of particles, which vanish in equilibrium.
    Other operations place particles, or change bonds."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @classmethod
    def of(cls, scene: Scene) -> Sequence[Self]:
        """Return the operations of this type that a scene needs."""
        return [cls(scene)] if cls.is_needed(scene) else []

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether the scene has the feature."""
        return True

    @abstractmethod
    def apply(self, step: Step) -> None:
        """Carry out this operation for one step with numpy, in place. All engines give the same
        result."""

    @abstractmethod
    def emit(self, kernel: KernelWriter) -> None:
        """Write the lines of this operation into a kernel."""

    def opening(self, step: str) -> Lines:
        """Return lines that are placed at the beginning of a step. `step` is the index of the step
        in the call."""
        return []

    def end_pass(self, kernel: KernelWriter) -> None:
        """Write lines that are executed after a pass of several steps. They complete the
        displacements that the body had before the last step."""
        return

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Return, by name, the elementwise functions that the lines of the operation call."""
        return {}

    def component(self) -> Component | None:
        """Return the component to which the functions of `functions` belong. Return None if they
        belong to the rule, the fracture model or pbdkit itself."""
        return None

    def numbers(self) -> dict[str, tuple[str, ...]]:
        """Return, by name, the named tuples that the lines of the operation create, with their
        fields."""
        return {}

    def constants(self) -> dict[str, Sequence[float]]:
        """Return, by name, the constant numbers that the lines of the operation read."""
        return {}

    def lists(self) -> dict[str, Indices]:
        """Return, by name, the constant lists of flat places over which the lines of the operation
        loop."""
        return {}

    def entries(self, call: Call) -> dict[str, Entries]:
        """Return, by name, the lists over which the lines of the operation loop in a call."""
        return {}

    def arrays(self, call: Call) -> dict[str, Array]:
        """Return, by name, the arrays that the lines of the operation read in a call."""
        return {}

    def prescribed_numbers(self) -> tuple[int, ...]:
        """Return the state variables of particles that the operation prescribes."""
        return ()

    def reads(self, state: State) -> bool:
        """Return whether `prepare` reads or writes the arrays of a state."""
        return False

    def prepare(self, call: Call) -> None:
        """Compute on the host what the lines of the operation need in the first step of a call."""
        return

    def can_precompute(self, step: int) -> bool:
        """Return whether `precompute` can prepare a later step."""
        return True

    def precompute(self, call: Call, step: int) -> None:
        """Compute on the host what the lines of the operation need in a later step of a call."""
        return

    def disturbances(self, call: Call) -> Iterator[Cells]:
        """Generate the cells of particles that rest before a call and are moved by the operation
        itself in the call. Their neighbours, which move in later steps, are not included."""
        yield from ()

    def fixed_places(self) -> Indices:
        """Return the flat places of particles that are not moved while the operation is active."""
        return np.zeros(0, np.intp)

    def reach(self, axis: int) -> Reach:
        """Return the distances along an axis over which the operation reads values that other
        operations write."""
        return Reach()

    def sweeps(self) -> int:
        """Return the number of successive evaluations of neighbours by the operation in a step."""
        return 0

    def carries(self) -> Indices:
        """Return an array of shape (difference, axis) with the differences of repeat cells by which
        the motion of a particle propagates in one step."""
        return np.zeros((0, self.scene.axes), np.intp)

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the first step after `step` in which the operation changes; infinity if there is
        none. With `precomputable`, motions that `precompute` can prepare are not included."""
        return math.inf

    def events(self, steps: int) -> list[int]:
        """Return the steps of a run in which the operation begins or ceases to act."""
        return []

    def breakpoints(self, steps: int) -> list[int]:
        """Return the steps of a run between which the parameters of the operation are linear
        functions of the step."""
        return []

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why the operation does not support a mode; None if it does."""
        return None
