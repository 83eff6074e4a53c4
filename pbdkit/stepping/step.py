"""A step is a list of operations, one for each feature of a scene (listed in ARCHITECTURE.md).

An engine interprets the list and knows no feature by name: numpy applies one operation after the
other, a kernel is written by letting each of them emit its lines. The order stands once, in
`stepping/program.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, Literal, NamedTuple, Self

from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.state import State


class Placed(NamedTuple):
    """Particles that lead: their places, and their displacements u (axis, particle) along those
    axes."""

    place: Indices
    u: Floats
    axes: tuple[int, ...]


Led = list[Placed]
Starts = tuple[Floats | None, ...]


class Mode(Enum):
    """A mode of stepping that not every operation goes with."""

    GPU = "on the threads of a GPU"
    PASSES = "several steps in a pass over the memory"
    RANKS = "rows of the lattice in several processes"
    COURSES = "in kernels, while numbers of rule or fracture model change in time"
    SOLVER_COURSES = "in kernels, while numbers of the solver change in time"


PUSHED_BY_COURSES = (
    "numbers change in time by which masses, obstacles or leaders along an axis push"
)


class Hindrance(NamedTuple):
    """Why an operation cannot be made in a mode, and the field of the experiment that asks for
    it."""

    reason: str
    field: str


@dataclass(slots=True)
class Step:
    """A step under way, as its operations see it one after the other.

    `u` are the displacements at the end of the step before, with the leaders in place as long as
    particles move: the intermediate configuration. `new` comes holding those of the step before
    that, and leaves holding those at the end of this one. What bonds and particles remember is
    renewed in place in `state`. `led` are the leaders with where they are put, `stood` the same
    with where they stood; `turned` is what clamped leaders prescribe, as (values, places,
    prescribed). `invalid` says what becomes of operations of the rule that give NaN.
    """

    number: int
    u: Floats
    new: Floats
    state: State
    invalid: Literal["raise", "ignore"] = "ignore"
    led: Led = field(default_factory=list)
    stood: Led = field(default_factory=list)
    starts: Starts = ()
    turned: list[tuple[NDArray[Any], Indices, NDArray[Any]]] = field(default_factory=list)


class Operation(ABC):
    """What one feature of a scene does in a step."""

    makes_moves: ClassVar[bool] = False
    """Whether it contributes to the move that a rule makes from given positions. An equilibrium is
    where these moves vanish; the other operations place what is given there, or change bonds."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @classmethod
    def of(cls, scene: Scene) -> Sequence[Self]:
        """The operations of this kind that a scene needs; none of a feature that it lacks."""
        return [cls(scene)] if cls.is_needed(scene) else []

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Whether a scene has the feature."""
        return True

    @abstractmethod
    def apply(self, step: Step) -> None:
        """Compute its part of a step by numpy, in place: the reference for every engine."""

    @abstractmethod
    def emit(self, kernel: KernelWriter) -> None:
        """Write its part of a step into a kernel."""

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Return by name the elementwise functions that its lines call."""
        return {}

    def numbers(self) -> dict[str, tuple[str, ...]]:
        """Return by name the named tuples that its lines make, with their fields."""
        return {}

    def constants(self) -> dict[str, Sequence[float]]:
        """Return by name the constant numbers that its lines read."""
        return {}

    def lists(self) -> dict[str, Indices]:
        """Return by name the flat places that its lines go by, where they are always the same."""
        return {}

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return why it cannot be made in a mode; None where it can."""
        return None
