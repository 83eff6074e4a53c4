"""The numbers of an experiment that can be turned while it is stepped, and their course."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from typing import Any

from pbdkit.errors import PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces.course import NumberCourse

PARTS = ("rule", "fracture", "solver")
SOLVER = {"relaxation": 1.0, "memory": 0.0}
"""Of the solver, with what they are where nothing is said."""
MORE, LITTLE = 1 + 2**-10, 2**-10
"""By so much a number is turned to see whether it can be."""
SPANS = {"solver.relaxation": (0.01, 2.0), "solver.memory": (0.0, 1.0)}
"""What sliders of these go over."""


@dataclass
class Number:
    """One number by its place in the file, e.g. ``fracture.thresholds.0``.

    `given` is what the experiment says, a number or a course; `turns` are the steps after which it
    was turned, each with the value from then on; `bounds` what it has to lie between, and `span`
    what a slider goes over.
    """

    name: str
    given: float | dict[str, Any]
    bounds: tuple[float, float]
    turns: list[tuple[int, float]] = field(default_factory=list)

    @property
    def where(self) -> tuple[str | int, ...]:
        """The keys on the way to it."""
        return tuple(int(key) if key.isdecimal() else key for key in self.name.split("."))

    @property
    def span(self) -> tuple[float, float]:
        """From about nothing to twice what it was, within its bounds."""
        value = self.at(0)
        low, high = SPANS.get(self.name, (min(2 * value, 0.0), max(2 * value, 0.0)))
        if low == high:
            low, high = 0.0, 1.0
        closest = (high - low) / 200
        inner = self.bounds[0] + closest, self.bounds[1] - closest
        return max(low, min(inner[0], value)), min(high, max(inner[1], value))

    def after(self, step: int) -> float | dict[str, Any]:
        """What holds from the next step on until it is turned: a number or a course."""
        known = [value for when, value in self.turns if when <= step]
        return known[-1] if known else self.given

    def at(self, step: int) -> float:
        """What it is at the end of a step."""
        found = self.after(step - 1)
        return NumberCourse.model_validate(found).at(step) if isinstance(found, dict) else found

    def turn(self, step: int, value: float) -> None:
        """From the step after that one on it is another."""
        if self.turns and self.turns[-1][0] == step:
            self.turns.pop()
        self.turns.append((step, value))

    def turned(self, value: float) -> dict[str, Any]:
        """As an experiment says that it comes to this value. One whose parts draw numbers from it
        before the first step refuses that."""
        return {"steps": [0, 1], "values": [self.at(0), value]}

    def cut_back(self, step: int) -> None:
        """Forgets what was turned after that step, or then and for later ones."""
        self.turns = [turn for turn in self.turns if turn[0] < step]

    def written(self, last: int) -> float | dict[str, Any]:
        """As an experiment file says it, that ends with step `last`."""
        turns = [turn for turn in self.turns if turn[0] < last]
        if not turns:
            return self.given
        first = turns[0][0]
        knots = self._begun(first)
        for step, value in turns:
            if knots[-1][0] < step:
                knots.append((step, knots[-1][1]))
            knots.append((step + 1, value))
        steps, values = zip(*knots, strict=True)
        return {"steps": list(steps), "values": list(values)}

    def _begun(self, until: int) -> list[tuple[int, float]]:
        """The knots of what was given, up to a step. A stretch that ends before its knot is told
        step by step: the line to another knot would differ in its last digits."""
        if not isinstance(self.given, dict):
            return [(until, self.given)]
        course = NumberCourse.model_validate(self.given)
        pairs = zip(course.steps, course.values, strict=True)
        knots = [(step, float(value)) for step, value in pairs if step <= until]
        begin = knots[-1][0] + 1 if knots else until
        if begin > course.steps[-1]:
            return knots
        return knots + [(step, course.at(step)) for step in range(begin, until + 1)]


def numbers_of(experiment: Experiment, parts: dict[str, Any]) -> dict[str, Number]:
    """All that may change in time of an experiment with these parts, by name."""
    found = {}
    for name, value in _candidates(parts):
        number = Number(name, value, _bounds(experiment, name))
        with suppress(PbdkitError):
            experiment.of_parts(placed(parts, number, number.turned(number.at(0) * MORE or LITTLE)))
            found[name] = number
    return found


def placed(parts: dict[str, Any], number: Number, value: Any) -> dict[str, Any]:
    """The parts with another value there; what is not on the way to it is shared."""
    *parents, last = number.where
    parts = dict(parts)
    within: Any = parts
    for key in parents:
        inner = copy(within[key] if isinstance(key, int) else within.get(key, {}))
        within[key] = inner
        within = inner
    within[last] = value
    return parts


def _candidates(parts: dict[str, Any]) -> Iterator[tuple[str, float | dict[str, Any]]]:
    for part in PARTS:
        own = parts.get(part, {})
        for name, value in ((SOLVER | own) if part == "solver" else own).items():
            entries = value if isinstance(value, list) else [value]
            for n, entry in enumerate(entries):
                if isinstance(entry, float) or (isinstance(entry, dict) and "steps" in entry):
                    place = f"{part}.{name}.{n}" if isinstance(value, list) else f"{part}.{name}"
                    yield place, entry


def _bounds(experiment: Experiment, name: str) -> tuple[float, float]:
    """As the model declares them; infinite where it does not."""
    part, key, *_ = name.split(".")
    fields = type(getattr(experiment, part)).model_fields.items()
    metadata = [m for n, f in fields if key in (n, f.alias) for m in f.metadata]
    low = [getattr(m, bound) for m in metadata for bound in ("ge", "gt") if hasattr(m, bound)]
    high = [getattr(m, bound) for m in metadata for bound in ("le", "lt") if hasattr(m, bound)]
    return max(low, default=-math.inf), min(high, default=math.inf)
