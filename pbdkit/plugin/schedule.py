"""Schedules: numbers, and forces along x and y, that are constant or change with the steps."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from pbdkit.plugin.component import Strict
from pbdkit.plugin.units import BODY_FORCE, FORCE

Value = TypeVar("Value")
MOST_KNOTS = 100_000
PLAIN, COURSE, WORD = FORMS = ("number", "course", "a number or 'auto'")
"""What faults call the forms of a number that may change, or be chosen."""


class Course(Strict, Generic[Value]):
    """A number in the course of the steps: `values` at the end of some `steps`, linear between; the
    first before them, the last after them."""

    steps: Annotated[
        tuple[Annotated[int, Field(ge=0, lt=2**53)], ...],
        Field(strict=False, min_length=1, max_length=MOST_KNOTS),
    ]
    values: Annotated[tuple[Value, ...], Field(strict=False, min_length=1, max_length=MOST_KNOTS)]

    @model_validator(mode="after")
    def _in_order(self) -> Course[Value]:
        if len(self.steps) != len(self.values):
            raise ValueError(f"{len(self.steps)} steps have {len(self.values)} values")
        for before, after in pairwise(self.steps):
            if after <= before:
                raise ValueError(f"steps should increase, and {after} comes after {before}")
        return self

    @property
    def last(self) -> float:
        """What it comes to."""
        return float(self._values[-1])

    @property
    def samples(self) -> dict[str, float]:
        """Values that occur, by what they are; the first is what it comes to."""
        values = self._values
        return {"the last value": self.last, "the smallest value": min(values),
                "the largest value": max(values)}  # fmt: skip

    def at(self, moment: float) -> float:
        """At the end of a step, or at a moment within it."""
        return float(np.interp(moment, self.steps, self._values))

    @cached_property
    def bends(self) -> tuple[int, ...]:
        """The steps at whose end it begins to change, changes otherwise or ceases to."""
        knots = list(zip(self.steps, self._values, strict=True))
        flat = (0.0, False)  # what is so small that its slope is zero is not flat
        slopes = [flat, *(((d - b) / (c - a), d != b) for (a, b), (c, d) in pairwise(knots)), flat]
        ways = zip(self.steps, pairwise(slopes), strict=True)
        return tuple(step for step, (before, after) in ways if before != after)

    def bends_within(self, begin: int, end: int) -> list[int]:
        """The bends between two steps, both included, and the second where it still changes there;
        none where the second comes first."""
        if end < begin:
            return []
        found = [bend for bend in self.bends if begin <= bend <= end]
        return found if end in found or self.next_change(end - 1) > end else [*found, end]

    def next_change(self, step: int) -> float:
        """The first step after `step` at whose end it is another than at that one's; infinite where
        there is none."""
        k = bisect_right(self.steps, step)
        if 0 < k < len(self.steps) and self.values[k - 1] != self.values[k]:
            return step + 1
        return min((bend + 1 for bend in self.bends[:-1] if bend > step), default=math.inf)

    def way(self, begin: float, end: float) -> float:
        """By what share of its largest value it changes between two moments."""
        most = max(map(abs, self._values))
        return abs(self.at(end) - self.at(begin)) / most if most else 0.0

    @property
    def _values(self) -> tuple[float, ...]:
        values: Any = self.values  # what stands for Value is a number
        found: tuple[float, ...] = values
        return found


class NumberCourse(Course[float]):
    """Of a plain number. Each kind of number has a class of its own, which can be pickled."""


def form_of(value: Any) -> str:
    """Which of two forms is meant."""
    return COURSE if isinstance(value, (dict, Course)) else PLAIN


def as_course(given: Any) -> Course[float] | None:
    """What stands in place of a number, if that is a course. Raises ValueError for a wrong one."""
    if isinstance(given, Course):
        return given
    if not (isinstance(given, dict) and "steps" in given):
        return None
    try:
        return NumberCourse.model_validate(given)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = "".join(f"{word}: " for word in fault["loc"])
        text = fault["msg"].removeprefix("Value error, ").replace("Input should", "should")
        missing = fault["type"] == "missing"
        raise ValueError(f"{place}{'is missing' if missing else text}") from None


def at(number: float | Course[float], moment: float) -> float:
    """A number at a moment, whether it changes or not."""
    return number.at(moment) if isinstance(number, Course) else number


def last(number: float | Course[float]) -> float:
    """What a number comes to."""
    return number.last if isinstance(number, Course) else number


class ForceCourse(Course[Annotated[float, FORCE]]):
    """Of a force."""


class BodyForceCourse(Course[Annotated[float, BODY_FORCE]]):
    """Of a force on a unit of area."""


OneForce = Annotated[
    Annotated[float, FORCE, Tag(PLAIN)] | Annotated[ForceCourse, Tag(COURSE)],
    Discriminator(form_of),
]
Force = Annotated[tuple[OneForce, OneForce], Field(strict=False)]
"""Two forces; an experiment file writes them as a list of two."""
OneBodyForce = Annotated[
    Annotated[float, BODY_FORCE, Tag(PLAIN)] | Annotated[BodyForceCourse, Tag(COURSE)],
    Discriminator(form_of),
]
BodyForce = Annotated[tuple[OneBodyForce, OneBodyForce], Field(strict=False)]
"""Two forces on a unit of area."""
