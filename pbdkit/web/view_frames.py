"""Frames of a live session: positions in single precision, thinned for a canvas, and the adjustable
numbers of an experiment with their schedules."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Bytes
from pbdkit.errors import PbdkitError
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.schedule import NumberCourse
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

MOST_POINTS = 50_000
MOST_LEADERS = 2000
"""Maximum number of leaders of a group that are shown."""
MOST_BONDS = 500_000
COLOURS = {"kind": "kind", "displacement": "displacement", "last-step": "way of the last step"}
"""Variables that can colour particles, with their names."""
HEAD = struct.Struct("<IIIIIIIIdd")
VALUES, KINDS, BROKEN = 1, 2, 4
"""Flags for the optional content of a frame."""


@dataclass(frozen=True)
class ViewFrame:
    """A state as it is shown: positions (particle, 2), a value of each (None: coloured by kind),
    its kind, and which bonds are broken. `kinds` and `broken` are the same objects until they
    change. `end` is the last step that was made, `picture` the number of the picture, and `step_s`
    the time of a step in seconds."""

    step: int
    end: int
    picture: int
    step_s: float
    positions: NDArray[np.float32]
    values: NDArray[np.float32] | None
    kinds: Bytes
    broken: Bytes

    def encoded(self, previous: ViewFrame | None) -> bytes:
        """Encode the frame for a viewer of the previous one: unchanged parts are omitted."""
        parts: list[NDArray[Any]] = [self.positions]
        holds = 0
        for bit, part, previous_part in (
            (VALUES, self.values, None),
            (KINDS, self.kinds, previous and previous.kinds),
            (BROKEN, self.broken, previous and previous.broken),
        ):
            if part is not None and part is not previous_part:
                holds |= bit
                parts.append(part)
        low, high = _range(self.values)
        nanoseconds = min(int(1e9 * self.step_s), 2**32 - 1)
        steps = self.step % 2**32, self.end % 2**32, self.picture % 2**32, nanoseconds
        sizes = len(self.positions), len(self.broken), 0
        head = HEAD.pack(holds, *steps, *sizes, low, high)
        return b"".join([head, *(part.tobytes() for part in parts)])


class Camera:
    """Takes frames of the states of a body.

    `every` is n where of large bodies each n-th particle along both axes is shown, those at the
    ends, and leaders; `rows` are those that are shown, `spacing` how far apart they lie at rest.
    """

    def __init__(self, scene: Scene) -> None:
        raster = scene.raster
        self.every = max(1, math.ceil(math.sqrt(raster.count / MOST_POINTS)))
        self.rows = np.arange(raster.count)
        if self.every > 1:
            self.rows = _thinned(scene, self.every)
        self.reference = raster.reference(self.rows)
        self.spacing = min(map(min, scene.neighbourhood.shells())) * self.every
        self.colour = "kind"
        self._scene, self._place = scene, raster.place_of(self.rows)
        self._leading: list[Any] = []
        self._kinds = self._broken = np.zeros(0, np.uint8)

    @cached_property
    def bonds(self) -> NDArray[np.uint32]:
        """Rows of the ends of bonds, (bond, end); none where particles or bonds are omitted."""
        table = self._scene.bonds.ends if self._shows_bonds else np.zeros((0, 2))
        return table.astype(np.uint32) if len(table) <= MOST_BONDS else np.zeros((0, 2), np.uint32)

    @property
    def _shows_bonds(self) -> bool:
        return self.every == 1 and not self._scene.experiment.neighbours.nearness()

    def positions(self, state: State) -> NDArray[np.float64]:
        """Return the positions of the visible particles, (particle, axis)."""
        u = state.u.reshape(len(state.u), -1)[:, self._place]
        return np.asarray(self.reference + u.T, np.float64)

    def frame(
        self, scene: Scene, state: State, end: int, pictures: int, step_s: float
    ) -> ViewFrame:
        """Return the frame of a state."""
        with np.errstate(over="ignore"):  # of what diverges
            positions = self.positions(state).astype(np.float32)
            values = self._values(state)
        kinds, broken = self._kinds_of(scene, state.step), self._broken_of(state)
        return ViewFrame(state.step, end, pictures, step_s, positions, values, kinds, broken)

    def _values(self, state: State) -> NDArray[np.float32] | None:
        if self.colour == "kind":
            return None
        u = state.u if self.colour == "displacement" else state.u - state.previous
        displacements = u.reshape(len(u), -1)[:, self._place]
        return np.asarray(np.sqrt((displacements.astype(np.float64) ** 2).sum(axis=0)), np.float32)

    def _kinds_of(self, scene: Scene, step: int) -> Bytes:
        leading = [group.rows for group in scene.leading if group.group.leads(step + 1)]
        same = len(leading) == len(self._leading) and all(map(is_, leading, self._leading))
        if not (same and len(self._kinds)):
            self._leading = leading
            kinds = kinds_at(scene.raster, scene.leading, step + 1)
            self._kinds = kinds[self.rows].astype(np.uint8)
        return self._kinds

    def _broken_of(self, state: State) -> Bytes:
        broken = np.zeros(len(self.bonds), np.uint8)
        if state.broken_step is not None and len(broken):
            table = self._scene.bonds
            planes = state.broken_step.reshape(len(state.broken_step), -1)
            broken[...] = planes[table.plane, table.place] >= 0
        if not np.array_equal(broken, self._broken):
            self._broken = broken
        return self._broken


def _thinned(scene: Scene, every: int) -> NDArray[np.intp]:
    """Return the rows of each n-th particle along both axes, of the last, and of leaders unless
    they are many."""
    raster = scene.raster
    site = raster.site_table()
    selection = ((site % every == 0) | (site == site.max(axis=0))).all(axis=1)
    for leading in scene.leading:
        selection[leading.rows[:: max(1, len(leading.rows) // MOST_LEADERS)]] = True
    return np.flatnonzero(selection)


def _range(values: NDArray[np.float32] | None) -> tuple[float, float]:
    if values is None or not len(values):
        return 0.0, 1.0
    finite = values[np.isfinite(values)]
    high = float(finite.max(initial=0.0))
    return 0.0, high if high > 0.0 else 1.0


PARTS = ("rule", "fracture", "solver")
SOLVER = {"relaxation": 1.0, "memory": 0.0}
"""Adjustable numbers of the solver, with their defaults."""
MORE, LITTLE = 1 + 2**-10, 2**-10
"""Test factor, and test value instead of zero, by which a number is recognised as adjustable."""
SPANS = {"solver.relaxation": (0.01, 2.0), "solver.memory": (0.0, 1.0)}
"""Ranges of the sliders of these numbers."""


@dataclass
class AdjustableNumber:
    """One number by its path in the file, e.g. ``fracture.thresholds.0``.

    `initial` is the number or schedule of the experiment; `turns` are the steps after which it
    was turned, each with the value from then on; `bounds` what it has to lie between, and `span`
    what a slider goes over.
    """

    name: str
    initial: float | dict[str, Any]
    bounds: tuple[float, float]
    turns: list[tuple[int, float]] = field(default_factory=list)

    @property
    def where(self) -> tuple[str | int, ...]:
        """Return the keys of the path."""
        return tuple(int(key) if key.isdecimal() else key for key in self.name.split("."))

    @property
    def span(self) -> tuple[float, float]:
        """Return the range of the slider: from zero to twice the initial value, within the
        bounds."""
        value = self.at(0)
        low, high = SPANS.get(self.name, (min(2 * value, 0.0), max(2 * value, 0.0)))
        if low == high:
            low, high = 0.0, 1.0
        closest = (high - low) / 200
        inner = self.bounds[0] + closest, self.bounds[1] - closest
        return max(low, min(inner[0], value)), min(high, max(inner[1], value))

    def after(self, step: int) -> float | dict[str, Any]:
        """Return the value from the next step on: a number or a schedule."""
        values = [value for when, value in self.turns if when <= step]
        return values[-1] if values else self.initial

    def at(self, step: int) -> float:
        """Return the value at the end of a step."""
        value = self.after(step - 1)
        return NumberCourse.model_validate(value).at(step) if isinstance(value, dict) else value

    def turn(self, step: int, value: float) -> None:
        """Change the value after a step."""
        if self.turns and self.turns[-1][0] == step:
            self.turns.pop()
        self.turns.append((step, value))

    def turned(self, value: float) -> dict[str, Any]:
        """Return a schedule that reaches a value. Experiments whose components use the number
        before the first step reject it."""
        return {"steps": [0, 1], "values": [self.at(0), value]}

    def cut_back(self, step: int) -> None:
        """Remove changes at and after a step."""
        self.turns = [turn for turn in self.turns if turn[0] < step]

    def written(self, last: int) -> float | dict[str, Any]:
        """Return the schedule for an experiment file with `last` steps."""
        turns = [turn for turn in self.turns if turn[0] < last]
        if not turns:
            return self.initial
        first = turns[0][0]
        knots = self._begun(first)
        for step, value in turns:
            if knots[-1][0] < step:
                knots.append((step, knots[-1][1]))
            knots.append((step + 1, value))
        steps, values = zip(*knots, strict=True)
        return {"steps": list(steps), "values": list(values)}

    def _begun(self, until: int) -> list[tuple[int, float]]:
        """Return the knots of the initial schedule, up to a step. An interval that ends before its
        knot is written step by step: interpolation to another knot would differ in the last digits.
        """
        if not isinstance(self.initial, dict):
            return [(until, self.initial)]
        course = NumberCourse.model_validate(self.initial)
        pairs = zip(course.steps, course.values, strict=True)
        knots = [(step, float(value)) for step, value in pairs if step <= until]
        begin = knots[-1][0] + 1 if knots else until
        if begin > course.steps[-1]:
            return knots
        return knots + [(step, course.at(step)) for step in range(begin, until + 1)]


def numbers_of(experiment: Experiment, parts: dict[str, Any]) -> dict[str, AdjustableNumber]:
    """Return all numbers that may change in time, by name."""
    numbers = {}
    for name, value in _candidates(parts):
        number = AdjustableNumber(name, value, _bounds(experiment, name))
        with suppress(PbdkitError):
            experiment.of_parts(
                with_number(parts, number, number.turned(number.at(0) * MORE or LITTLE))
            )
            numbers[name] = number
    return numbers


def with_number(parts: dict[str, Any], number: AdjustableNumber, value: Any) -> dict[str, Any]:
    """Return the parts with another value; unaffected parts are shared."""
    *parents, last = number.where
    parts = dict(parts)
    container: Any = parts
    for key in parents:
        inner = copy(container[key] if isinstance(key, int) else container.get(key, {}))
        container[key] = inner
        container = inner
    container[last] = value
    return parts


def _candidates(parts: dict[str, Any]) -> Iterator[tuple[str, float | dict[str, Any]]]:
    for part in PARTS:
        fields = parts.get(part, {})
        for name, value in ((SOLVER | fields) if part == "solver" else fields).items():
            entries = value if isinstance(value, list) else [value]
            for n, entry in enumerate(entries):
                if isinstance(entry, float) or (isinstance(entry, dict) and "steps" in entry):
                    place = f"{part}.{name}.{n}" if isinstance(value, list) else f"{part}.{name}"
                    yield place, entry


def _bounds(experiment: Experiment, name: str) -> tuple[float, float]:
    """Return the bounds declared by the model, or infinite ones."""
    part, key, *_ = name.split(".")
    fields = type(getattr(experiment, part)).model_fields.items()
    metadata = [m for n, f in fields if key in (n, f.alias) for m in f.metadata]
    low = [getattr(m, bound) for m in metadata for bound in ("ge", "gt") if hasattr(m, bound)]
    high = [getattr(m, bound) for m in metadata for bound in ("le", "lt") if hasattr(m, bound)]
    return max(low, default=-math.inf), min(high, default=math.inf)
