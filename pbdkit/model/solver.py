"""Settings of the solver, a closed family (stepping or equilibrium), and of what is recorded."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, SerializeAsAny, Tag, model_serializer, model_validator

from pbdkit.errors import ExperimentError
from pbdkit.model.validation import closed_part
from pbdkit.plugin import Component
from pbdkit.plugin.component import Strict
from pbdkit.plugin.schedule import COURSE, PLAIN, WORD, Course, form_of, last

Steps = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)]


class Record(Strict):
    """Every so many steps, or at chosen ones; time 0 and the last step always.

    Under `solver: {type: equilibrium}` each of these steps is an equilibrium; `increments` also
    records those found between them. `dtype` is that of recorded positions and diagnostics; the run
    itself is not affected.
    `compression` is that of the file: zlib makes it smaller, and writing it slower.
    """

    every: Annotated[int, Field(ge=1)] = 1
    at: Steps | None = None
    increments: bool = False
    dtype: Literal["float64", "float32"] = "float64"
    compression: Literal["none", "zlib"] = "none"

    @model_validator(mode="after")
    def _one_way(self) -> Record:
        if self.at is not None:
            if "every" in self.model_fields_set:
                raise ValueError("give `every` or `at`, not both")
            if any(a >= b for a, b in zip(self.at, self.at[1:], strict=False)):
                raise ValueError(f"`at` must increase, got {list(self.at[:8])}")
        return self

    @model_serializer
    def _serialize(self) -> dict[str, Any]:
        which: dict[str, Any] = {"every": self.every}
        if self.at is not None:
            which = {"at": list(self.at)}
        which |= {"increments": True} if self.increments else {}
        return which | {"dtype": self.dtype, "compression": self.compression}

    def keeps(self, step: int, steps: int) -> bool:
        """Whether that step of a run of `steps` is recorded."""
        return step in (0, self.next_after(step - 1, steps))

    def steps_before(self, steps: int) -> Iterator[int]:
        """The recorded steps of a run of `steps` between its start and its last step."""
        step = self.next_after(0, steps)
        while step < steps:
            yield step
            step = self.next_after(step, steps)

    def next_after(self, step: int, steps: int) -> int:
        """The first recorded step after `step`, in a run of `steps`."""
        if self.at is None:
            return min(steps, (step // self.every + 1) * self.every)
        place = bisect_right(self.at, step)
        return min([steps, *self.at[place : place + 1]])

    def count(self, steps: int) -> int:
        """How many steps of a run of `steps` are recorded."""
        if self.at is None:
            return steps // self.every + 1 + (steps % self.every > 0)
        return len({0, steps, *(step for step in self.at if step <= steps)})


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
        text = (
            "'auto' is a number only once it is chosen for a scene: "
            "pbdkit.stability.relaxation.tuned"
        )
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
