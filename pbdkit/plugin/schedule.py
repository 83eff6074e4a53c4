"""Time-dependent numbers and forces."""

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
"""Type of the values of a time-dependent number."""
MAX_KNOTS = 100_000
"""Maximum number of steps of a time-dependent number."""
PLAIN = "number"
"""Form of a constant number in the messages of pydantic."""
TIME_DEPENDENT = "time-dependent"
"""Form of a time-dependent number in the messages of pydantic."""
WORD = "a number or 'auto'"
"""Form, in messages, of a number that can also be 'auto'."""
BY_NAME = "by name"
"""Form, in messages, of a law that is given by its name."""
BY_POINTS = "by points"
"""Form, in messages, of a law that is given by points."""
AS_WORD = "as a word"
"""Form, in the messages of pydantic, of a value that can also be a list, a number or a part."""
AS_LIST = "as a list"
"""Form, in the messages of pydantic, of a list in place of a single value."""
AS_PART = "as a part"
"""Form, in the messages of pydantic, of a part with keys in place of a word."""
WITH_UNITS = "with units"
"""Form, in the messages of pydantic, of numbers with units."""
FORMS = (
    PLAIN, TIME_DEPENDENT, WORD, BY_NAME, BY_POINTS, AS_WORD, AS_LIST, AS_PART, WITH_UNITS,
)  # fmt: skip
"""Forms of values in messages."""


class TimeDependent(Strict, Generic[Value]):
    """Time-dependent number, piecewise linear in time.

    It has the `values` at the end of the `steps`, is interpolated linearly between them, and is
    constant before the first and after the last one.
    """

    steps: Annotated[
        tuple[Annotated[int, Field(ge=0, lt=2**53)], ...],
        Field(strict=False, min_length=1, max_length=MAX_KNOTS),
    ]
    values: Annotated[tuple[Value, ...], Field(strict=False, min_length=1, max_length=MAX_KNOTS)]

    @model_validator(mode="after")
    def _in_order(self) -> TimeDependent[Value]:
        if len(self.steps) != len(self.values):
            raise ValueError(f"{len(self.steps)} steps have {len(self.values)} values")
        for first, second in pairwise(self.steps):
            if second <= first:
                raise ValueError(f"steps should increase, but {second} follows {first}")
        return self

    @property
    def last(self) -> float:
        """Value at the end."""
        return float(self._values[-1])

    @property
    def samples(self) -> dict[str, float]:
        """Values for validation, by a description of their step; the first is the last value."""
        values = self._values
        return {"the last value": self.last, "the smallest value": min(values),
                "the largest value": max(values)}  # fmt: skip

    def at(self, moment: float) -> float:
        """Return the value at the end of a step. A fractional step number gives a value within a
        step."""
        return float(np.interp(moment, self.steps, self._values))

    @cached_property
    def breakpoints(self) -> tuple[int, ...]:
        """Steps after which the slope changes."""
        knots = list(zip(self.steps, self._values, strict=True))
        flat = (0.0, False)  # a change with a slope that rounds to zero is not flat
        slopes = [flat, *(((d - b) / (c - a), d != b) for (a, b), (c, d) in pairwise(knots)), flat]
        pairs = zip(self.steps, pairwise(slopes), strict=True)
        return tuple(step for step, (first, second) in pairs if first != second)

    def breakpoints_within(self, begin: int, end: int) -> list[int]:
        """Return the breakpoints from step `begin` to step `end`, and `end` if the number changes
        in it.

        The result is empty if `end` precedes `begin`.
        """
        if end < begin:
            return []
        breakpoints = [knot for knot in self.breakpoints if begin <= knot <= end]
        return (
            breakpoints
            if end in breakpoints or self.next_change(end - 1) > end
            else [*breakpoints, end]
        )

    def next_change(self, step: int) -> float:
        """Return the first step after `step` with another value than at `step`, or infinity."""
        k = bisect_right(self.steps, step)
        if 0 < k < len(self.steps) and self.values[k - 1] != self.values[k]:
            return step + 1
        return min((knot + 1 for knot in self.breakpoints[:-1] if knot > step), default=math.inf)

    def relative_change(self, begin: float, end: float) -> float:
        """Return the change between two times, divided by the largest absolute value."""
        largest = max(map(abs, self._values))
        return abs(self.at(end) - self.at(begin)) / largest if largest else 0.0

    @property
    def _values(self) -> tuple[float, ...]:
        values: Any = self.values  # the type parameter is always a number
        numbers: tuple[float, ...] = values
        return numbers


class TimeDependentNumber(TimeDependent[float]):
    """Time-dependent number without a unit.

    Each kind of number is a separate class, so that objects can be pickled.
    """


def form_of(value: Any) -> str:
    """Return the form of a value, `PLAIN` or `TIME_DEPENDENT`."""
    return TIME_DEPENDENT if isinstance(value, (dict, TimeDependent)) else PLAIN


def as_time_dependent(value: Any) -> TimeDependent[float] | None:
    """Return a value as a time-dependent number, or None if it is of another form.

    Raises
    ------
    ValueError
        If the value is malformed.
    """
    if isinstance(value, TimeDependent):
        return value
    if not (isinstance(value, dict) and "steps" in value):
        return None
    try:
        return TimeDependentNumber.model_validate(value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = "".join(f"{word}: " for word in fault["loc"])
        text = fault["msg"].removeprefix("Value error, ").replace("Input should", "should")
        missing = fault["type"] == "missing"
        raise ValueError(f"{place}{'is missing' if missing else text}") from None


def at(number: float | TimeDependent[float], moment: float) -> float:
    """Return the value of a constant or time-dependent number at a time, in steps."""
    return number.at(moment) if isinstance(number, TimeDependent) else number


def last(number: float | TimeDependent[float]) -> float:
    """Return the last value of a constant or time-dependent number."""
    return number.last if isinstance(number, TimeDependent) else number


class TimeDependentForce(TimeDependent[Annotated[float, FORCE]]):
    """Force that depends on time."""


class TimeDependentBodyForce(TimeDependent[Annotated[float, BODY_FORCE]]):
    """Time-dependent force per area."""


OneForce = Annotated[
    Annotated[float, FORCE, Tag(PLAIN)] | Annotated[TimeDependentForce, Tag(TIME_DEPENDENT)],
    Discriminator(form_of),
]
"""Type of a component of a force."""
Force = Annotated[tuple[OneForce, OneForce], Field(strict=False)]
"""Type of a force; a list of two numbers in an experiment file."""
OneBodyForce = Annotated[
    Annotated[float, BODY_FORCE, Tag(PLAIN)]
    | Annotated[TimeDependentBodyForce, Tag(TIME_DEPENDENT)],
    Discriminator(form_of),
]
"""Type of a component of a force per area."""
BodyForce = Annotated[tuple[OneBodyForce, OneBodyForce], Field(strict=False)]
"""Type of a force per area; a list of two numbers in an experiment file."""
