"""How an experiment is carried out: step by step, or straight to where the steps lead. A closed
family."""

from __future__ import annotations

from functools import cache
from typing import Annotated, ClassVar, Literal

from pydantic import Discriminator, Field, SerializeAsAny, Tag

from pbdkit.errors import ExperimentError
from pbdkit.experiment.parts import closed_part
from pbdkit.interfaces import Component
from pbdkit.interfaces.component import Strict
from pbdkit.interfaces.course import COURSE, PLAIN, WORD, Course, form_of, last


def _form_of(value: object) -> str:
    """Which form is meant where a word is taken too."""
    return WORD if isinstance(value, str) else form_of(value)


Word = Annotated[Literal["auto"], Tag(WORD)]
Threads = Annotated[
    Word | Annotated[int, Field(ge=1, le=1024), Tag(PLAIN)], Discriminator(_form_of)
]
_Relaxation = Annotated[float, Field(gt=0.0, le=1e6)]


class RelaxationCourse(Course[_Relaxation]):
    """Of the relaxation."""


Relaxation = Annotated[
    Word | Annotated[_Relaxation, Tag(PLAIN)] | Annotated[RelaxationCourse, Tag(COURSE)],
    Discriminator(_form_of),
]
_Memory = Annotated[float, Field(ge=-1e6, le=1e6)]


class MemoryCourse(Course[_Memory]):
    """Of the memory."""


Memory = Annotated[
    Word | Annotated[_Memory, Tag(PLAIN)] | Annotated[MemoryCourse, Tag(COURSE)],
    Discriminator(_form_of),
]


class Settle(Strict):
    """Stop early: once no follower can be farther from equilibrium than `tolerance`, a share of the
    largest prescribed displacement."""

    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6


class Solver(Component):
    """What takes a scene from its start to its end."""

    makes_steps: ClassVar[bool] = True
    """Whether every step is made, one after the other."""

    @property
    def stepping(self) -> Stepping:
        """How a step is made, where one is: the rule's own unless the experiment says more."""
        return _stepping()

    @property
    def sought(self) -> Equilibrium:
        """How an equilibrium is looked for, where one is: as by default, unless the experiment says
        more."""
        return _sought()

    @property
    def courses(self) -> dict[str, Course[float]]:
        """The parameters that change in the course of the steps."""
        return {}


@cache
def _stepping() -> Stepping:
    return Stepping()


@cache
def _sought() -> Equilibrium:
    return Equilibrium()


class Stepping(Solver):
    """One step after the other.

    `relaxation` w and `memory` b apply to any rule's move, for followers only:
    x(t+1) = m + w · move + b · (x(t) - x(t-1)); each may be a course in time. `engine`: numpy,
    compiled, gpu, or what serves the scene best, never gpu; `precision` is that of the run's own
    numbers; `threads` for the compiled engine. With `settle` the run ends where it has settled,
    after `steps` at the latest. `auto` for `relaxation` or `memory` takes what lets the slowest
    mode of the scene shrink fastest; results hold numbers.
    """

    type: Literal["stepping"] = "stepping"
    engine: Literal["auto", "numpy", "compiled", "gpu"] = "auto"
    precision: Literal["float64", "float32"] = "float64"
    threads: Threads = "auto"
    asked_relaxation: Relaxation = Field(default=1.0, alias="relaxation")
    asked_memory: Memory = Field(default=0.0, alias="memory")
    settle: Settle | None = None

    @property
    def stepping(self) -> Stepping:
        """As the experiment says."""
        return self

    @property
    def is_open(self) -> bool:
        """Whether a number is yet to be chosen for the scene."""
        return bool(self.open_parameters)

    @property
    def open_parameters(self) -> tuple[str, ...]:
        """The names of the numbers that are yet to be chosen for the scene."""
        asked = {"relaxation": self.asked_relaxation, "memory": self.asked_memory}
        return tuple(name for name, number in asked.items() if number == "auto")

    @property
    def courses(self) -> dict[str, Course[float]]:
        """The course of relaxation and memory, where they have one."""
        both = {"relaxation": self.asked_relaxation, "memory": self.asked_memory}
        return {name: asked for name, asked in both.items() if isinstance(asked, Course)}

    def at(self, moment: float) -> Stepping:
        """The same with the numbers of a moment."""
        now = {f"asked_{name}": course.at(moment) for name, course in self.courses.items()}
        return self.model_copy(update=now)

    @property
    def relaxation(self) -> float:
        """w, in the end. Raises ExperimentError where it is yet to be chosen."""
        return _number(self.asked_relaxation, "relaxation")

    @property
    def memory(self) -> float:
        """b, in the end. Raises ExperimentError where it is yet to be chosen."""
        return _number(self.asked_memory, "memory")

    def with_weights(self, relaxation: float, memory: float) -> Stepping:
        """The same with these numbers."""
        chosen = {"asked_relaxation": relaxation, "asked_memory": memory}
        return self.model_copy(update=chosen)


def _number(asked: Literal["auto"] | float | Course[float], name: str) -> float:
    if asked == "auto":
        text = "'auto' is a number only once it is chosen for a scene: pbdkit.runs.tuning.tuned"
        raise ExperimentError(text, ("solver", name))
    return last(asked)


class Equilibrium(Solver):
    """Straight to where the steps converge to, leaders at their last prescribed position with the
    roles of the last step.

    `tolerance` is the largest distance from equilibrium, as a share of the largest prescribed
    displacement. Where bonds can break, the leaders' way is made in so many `increments`, within
    steps too, each settled before the next; for rules that are not linear in as many as it takes.
    `method` solves the linear systems: lu, multigrid (with an iteration around it),
    conjugate-gradients alone, or what serves their size.
    """

    makes_steps: ClassVar[bool] = False
    type: Literal["equilibrium"] = "equilibrium"
    method: Literal["auto", "lu", "multigrid", "conjugate-gradients"] = "auto"
    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-8
    increments: Annotated[int, Field(ge=1, le=100_000)] = 100

    @property
    def sought(self) -> Equilibrium:
        """As the experiment says."""
        return self


AnySolver = Annotated[
    SerializeAsAny[Stepping | Equilibrium], closed_part(Solver, Stepping, Equilibrium)
]
