"""Script of a live session. It contains the leader groups that are moved by the mouse, the changed
parameters, and the cuts, each with its step. The script can be converted to an experiment file.

Long paths of the mouse are written to tables in the folder of the file.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path as FilePath
from typing import Any, Literal

import numpy as np
from pydantic import PrivateAttr

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.io.atomic_file import write_together
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Motion, Path
from pbdkit.model.reading import MAX_BYTES, MAX_NODES, yaml_text
from pbdkit.plugin.fracture_model import Segment
from pbdkit.plugin.schedule import TimeDependentNumber
from pbdkit.plugin.units import TEXT as WITH_UNIT

Displacement = tuple[float, float]


class ManualMotion(Motion):
    """Motion of a leader group that is moved by the mouse. It is given by knots, pairs of a step
    and a displacement. Between knots and after the last knot it is the same as the motion `path` of
    an experiment.

    Knots are appended while steps are made. For this reason the engine need not be rebuilt for each
    movement of the mouse.
    """

    type: Literal["hand"] = "hand"
    _steps: list[int] = PrivateAttr(default_factory=list)
    _displacements: list[Displacement] = PrivateAttr(default_factory=list)

    def offset(self, n: float, start: Floats) -> Floats:
        """Return the offset at step n of the path with the given knots."""
        if not self._steps:
            return np.zeros(2)
        # The lists are shared, because copying the path at each call would take time in proportion
        # to its length.
        knots: dict[str, Any] = {"steps": self._steps, "displacements": self._displacements}
        return Path.model_construct(**knots).offset(n, start)

    def knots(self) -> tuple[int, ...]:
        """Return the last knot. Earlier knots have no effect on later steps."""
        return tuple(self._steps[-1:])

    def at(self, n: int) -> Displacement:
        """Return the offset at the end of the n-th step of the motion, n ≥ 0."""
        x, y = self.offset(n, np.zeros((1, 2))) if n else (0.0, 0.0)
        return float(x), float(y)

    def lead(self, begin: int, end: int, displacement: Displacement) -> None:
        """Append a linear motion, which begins after step `begin` of this motion and reaches the
        offset `displacement` at its step `end`."""
        if begin and (not self._steps or self._steps[-1] < begin):
            self._add(begin, self.at(begin))
        self._add(end, displacement)

    def cut_back(self, n: int) -> None:
        """Remove the motion after step n. In all steps up to n the offsets keep all their bits."""
        knots = [(step, displacement) for step, displacement in self.path if step <= n]
        if len(knots) < len(self._steps):
            begin = knots[-1][0] if knots else 0
            knots += [(step, self.at(step)) for step in range(begin + 1, n + 1)]
        self._steps[:] = [step for step, _ in knots]
        self._displacements[:] = [displacement for _, displacement in knots]

    @property
    def path(self) -> list[tuple[int, Displacement]]:
        """Return the knots of the path."""
        return list(zip(self._steps, self._displacements, strict=True))

    def motion(self) -> dict[str, Any]:
        """Return the motion as in an experiment file."""
        if not self._steps:
            return {"type": "hold"}
        displacements = [list(displacement) for displacement in self._displacements]
        return {"type": "path", "steps": list(self._steps), "displacements": displacements}

    def _add(self, step: int, displacement: Displacement) -> None:
        self._steps.append(step)
        self._displacements.append(displacement)


ADJUSTABLE = ("rule", "fracture", "solver")
"""Parts of the experiment with adjustable numbers."""
SOLVER = {"relaxation": 1.0, "memory": 0.0}
"""Adjustable numbers of the solver, with their defaults."""
TEST_FACTOR = 1 + 2**-10
"""Factor by which a number is multiplied in order to test whether it is adjustable."""
TEST_VALUE = 2**-10
"""Value that replaces zero in this test."""
SPANS = {"solver.relaxation": (0.01, 2.0), "solver.memory": (0.0, 1.0)}
"""Ranges of the sliders of these numbers."""


@dataclass
class AdjustableNumber:
    """One adjustable number of the experiment, given by its path in the file, for instance
    ``fracture.thresholds.0``.

    `initial` is the number or the schedule in the experiment. `turns` are the steps after which it
    was changed, each with the new value. `bounds` are the bounds of the number, and `span` is the
    range of its slider. A value in lattice units times `factor` is in `units`, which are those of
    the experiment file.
    """

    name: str
    initial: float | dict[str, Any]
    bounds: tuple[float, float]
    units: str = ""
    factor: float = 1.0
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
        """Return the value for the steps after `step`: a number or a schedule."""
        values = [value for when, value in self.turns if when <= step]
        return values[-1] if values else self.initial

    def at(self, step: int) -> float:
        """Return the value at the end of a step."""
        value = self.after(step - 1)
        return (
            TimeDependentNumber.model_validate(value).at(step) if isinstance(value, dict) else value
        )

    def turn(self, step: int, value: float) -> None:
        """Change the value after a step."""
        if self.turns and self.turns[-1][0] == step:
            self.turns.pop()
        self.turns.append((step, value))

    def turned(self, value: float) -> dict[str, Any]:
        """Return a schedule that changes from the present value to another value. If a component
        needs the number before the first step, the schedule is rejected by validation."""
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
        """Return the knots of the initial schedule up to a step. If the last interval ends before
        its knot, it is written step by step, because interpolation to a different knot would change
        the last digits."""
        if not isinstance(self.initial, dict):
            return [(until, self.initial)]
        number = TimeDependentNumber.model_validate(self.initial)
        pairs = zip(number.steps, number.values, strict=True)
        knots = [(step, float(value)) for step, value in pairs if step <= until]
        begin = knots[-1][0] + 1 if knots else until
        if begin > number.steps[-1]:
            return knots
        return knots + [(step, number.at(step)) for step in range(begin, until + 1)]


def numbers_of(experiment: Experiment, parts: dict[str, Any]) -> dict[str, AdjustableNumber]:
    """Return all numbers that may change in time, by name."""
    numbers = {}
    for name, value in _candidates(parts):
        number = AdjustableNumber(name, value, _bounds(experiment, name))
        if unit := _written(experiment, number.where):
            number.units, number.factor = unit[2], float(unit[1]) / (number.at(0) or 1.0)
        with suppress(PbdkitError):
            experiment.of_parts(
                with_number(parts, number, number.turned(number.at(0) * TEST_FACTOR or TEST_VALUE))
            )
            numbers[name] = number
    return numbers


def _written(experiment: Experiment, where: tuple[str | int, ...]) -> re.Match[str] | None:
    """Return the number and the unit of a value as written in the experiment, or None for a value
    without a unit."""
    value: Any = experiment.as_written().data
    for key in where:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            return None
    return WITH_UNIT.fullmatch(value) if isinstance(value, str) else None


def with_number(parts: dict[str, Any], number: AdjustableNumber, value: Any) -> dict[str, Any]:
    """Return the parts of the experiment with another value of the number. Parts that do not change
    are shared."""
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
    for part in ADJUSTABLE:
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


NEVER = 2**62 - 1
"""Last step of a session without end."""
MADE = "-live"
"""Suffix of the names of saved sessions. With it the results of a session do not get the name of
the experiment's result."""
Parts = dict[str, Any]


@dataclass
class LeaderScript:
    """Leader group of the file (`of_file`), or leader group that is moved by the mouse after a
    certain step.

    `ended` is the last step in which the group is active. `instead_of` is given for a group that is
    moved by the mouse and has replaced a group of the file before that group became active: it is
    the replaced group.
    """

    of_file: Parts
    manual: ManualMotion | None = None
    ended: int | None = None
    instead_of: LeaderScript | None = None

    @property
    def begins(self) -> int:
        """Return the first step in which the group is active."""
        return int(self.of_file.get("from", 1))

    def leads(self, step: int) -> bool:
        """Return whether the group is active in a step."""
        ends = [end for end in (self.of_file.get("until"), self.ended) if end is not None]
        return self.begins <= step <= min(ends, default=step)

    def written(self, motion: bool) -> Parts:
        """Return the group as in an experiment file. A group moved by the mouse is at rest if its
        `motion` is omitted."""
        end = {} if self.ended is None else {"until": self.ended}
        motion_part = self.manual.motion() if self.manual and motion else {"type": "hold"}
        return self.of_file | ({"motion": motion_part} if self.manual else {}) | end


@dataclass
class Script:
    """An experiment and all changes in a session: groups moved by the mouse, changed parameters,
    and cuts."""

    experiment: Experiment
    parts: Parts
    numbers: dict[str, AdjustableNumber]
    groups: list[LeaderScript]
    cuts: list[Parts] = field(default_factory=list)

    @classmethod
    def of(cls, experiment: Experiment) -> Script:
        """Return the script of an experiment at the beginning of a session, when nothing has been
        changed. The experiment must contain numbers for relaxation and memory, not `auto`."""
        parts = parts_of(experiment)
        groups = [LeaderScript(_without_defaults(group)) for group in parts.get("leaders", ())]
        return cls(experiment, parts, numbers_of(experiment, parts), groups)

    def copy(self) -> Script:
        """Return an independent copy."""
        numbers = {name: replace(n, turns=[*n.turns]) for name, n in self.numbers.items()}
        return replace(self, numbers=numbers, groups=deepcopy(self.groups), cuts=[*self.cuts])

    def restore(self, snapshot: Script) -> None:
        """Restore the changes that a copy contains. The copy must not be used afterwards."""
        self.numbers, self.groups, self.cuts = snapshot.numbers, snapshot.groups, snapshot.cuts

    def grab(self, group: int, step: int) -> int:
        """Let the mouse move a leader group after a step. Return the index of the group that is
        moved."""
        original = self.groups[group]
        if original.manual is not None:
            return group
        selection = {
            key: of for key, of in original.of_file.items() if key not in ("motion", "until")
        }
        led_group = LeaderScript(selection | {"from": step + 1}, ManualMotion())
        if original.begins == step + 1:
            led_group.instead_of, self.groups[group] = original, led_group
            return group
        original.ended = step
        self.groups.append(led_group)
        return len(self.groups) - 1

    def pick(self, particle: int, step: int) -> int:
        """Let the mouse move a particle, given by its number, after a step."""
        self.groups.append(
            LeaderScript({"select": {"numbers": [particle]}, "from": step + 1}, ManualMotion())
        )
        return len(self.groups) - 1

    def let_go(self, group: int, step: int) -> None:
        """Let the particles of a group become followers after a step."""
        led_group = self.groups[group]
        if led_group.begins > step:
            del self.groups[group]
        else:
            led_group.ended = step

    def turn(self, name: str, step: int, value: float) -> None:
        """Change a number after a step. Raises ExperimentError if the new value is invalid."""
        number = self.numbers.get(name)
        if number is None:
            raise ExperimentError(f"there is no parameter '{name}' that can be changed")
        self.experiment.of_parts(with_number(self.playing(step), number, number.turned(value)))
        number.turn(step, value)

    def cut(self, segments: Sequence[Segment], step: int) -> None:
        """Cut at the beginning of the next step. Raises ExperimentError if the experiment does not
        support cuts."""
        cuts: list[Parts] = [{"from": list(a), "to": list(b), "at": step + 1} for a, b in segments]
        playing = self.playing(step)
        self.experiment.of_parts(playing | {"cuts": [*playing.get("cuts", ()), *cuts]})
        self.cuts += cuts

    def cut_back(self, step: int) -> None:
        """Remove all changes after a step."""
        for number in self.numbers.values():
            number.cut_back(step)
        self.cuts = [cut for cut in self.cuts if cut["at"] <= step]
        groups = [
            led_group.instead_of if _begins_after(led_group, step) else led_group
            for led_group in self.groups
        ]
        self.groups = [led_group for led_group in groups if led_group]
        for led_group in self.groups:
            if led_group.ended is not None and led_group.ended >= step:
                led_group.ended = None
            if led_group.manual:
                led_group.manual.cut_back(step - led_group.begins + 1)

    def next_turn(self, step: int) -> int:
        """Return the first step after which a parameter changes again."""
        turns = (when for number in self.numbers.values() for when, _ in number.turns)
        return min((when for when in turns if when > step), default=NEVER)

    def playing(self, step: int) -> Parts:
        """Return the parts of the experiment with which the next steps are made. Parameters are
        constant until the next change, and groups that are moved by the mouse are at rest. If there
        is no later cut, one past cut is included, so that the scene still stores the states of
        bonds."""
        parts = dict(self.parts)
        for number in self.numbers.values():
            if number.turns:
                parts = with_number(parts, number, number.after(step))
        cuts = [*parts.get("cuts", ()), *self.cuts]
        coming = [cut for cut in cuts if cut["at"] > step]
        parts["cuts"] = coming or cuts[-1:]
        parts["leaders"] = [led_group.written(motion=False) for led_group in self.groups]
        parts.pop("record", None)
        parts.pop("diagnostics", None)
        return parts | {"steps": NEVER}

    def written(self, last: int) -> Parts:
        """Return the session as an experiment of `last` steps."""
        parts = dict(self.parts)
        for number in self.numbers.values():
            if number.turns:
                parts = with_number(parts, number, number.written(last))
        cuts = [cut for cut in (*parts.get("cuts", ()), *self.cuts) if cut["at"] <= last]
        name = parts["name"].removesuffix(MADE) + MADE
        groups = [
            led_group.written(motion=True)
            for led_group in self.groups
            if not _begins_after(led_group, last)
        ]
        parts |= {"name": name, "steps": last, "leaders": groups}
        parts = _with_key(parts, "cuts", cuts)
        record = parts.get("record", {})
        if "at" in record:
            parts["record"] = record | {"at": [at for at in record["at"] if at <= last] or [0]}
        plain: Parts = json.loads(json.dumps(parts))  # A copy in which no object occurs twice.
        return plain


def parts_of(experiment: Experiment) -> Parts:
    """Return the parts of an experiment for a session. They are in lattice units and have no last
    step. Optional parts are omitted."""
    parts: Parts = json.loads(experiment.model_dump_json(by_alias=True))
    parts["solver"].pop("settle", None)
    whole = experiment.of_parts(parts)
    optional = [key for key, part in parts.items() if isinstance(part, dict | list)]
    for key in [key for key in optional if key != "solver"]:
        fewer = {name: part for name, part in parts.items() if name != key}
        try:
            if experiment.of_parts(fewer) == whole:
                parts = fewer
        except PbdkitError:
            continue
    return parts


def _without_defaults(group: Parts) -> Parts:
    """Omit the defaults of a leader group."""
    silent = {"from": 1, "until": None, "clamped": False}
    return {key: of for key, of in group.items() if key not in silent or of != silent[key]}


def _begins_after(group: LeaderScript, step: int) -> bool:
    return group.manual is not None and group.begins > step


def _with_key(parts: Parts, key: str, values: list[Any]) -> Parts:
    """Set a key, or omit it if there are no values."""
    rest = {name: part for name, part in parts.items() if name != key}
    return rest | ({key: values} if values else {})


MAX_INLINE_KNOTS = 500
"""A path is written in the experiment if it has at most this number of knots. Longer paths are
written to a table."""
COMMENT = "# Written by pbdkit live: `pbdkit run` repeats the session bit for bit.\n"
"""First line of a saved session."""


@dataclass(frozen=True)
class Saved:
    """Saved experiment: its path, and the content `text` of the file. `text` is None if the file
    refers to other files."""

    path: FilePath
    text: str | None


def save_script(script: Script, step: int, output: FilePath | None) -> Saved:
    """Write the session up to a step. If the file exists or no file is given, the next free name is
    used.

    Raises ExperimentError if no step has been made or the session exceeds the size of an experiment
    file, and StorageError if the file cannot be written.
    """
    if step < 1:
        raise ExperimentError("no step has been made yet, but an experiment has at least one")
    parts = script.written(step)
    name = parts["name"].replace("/", "-")
    path = _free(output or FilePath(f"{name}.yaml"), len(parts["leaders"]))
    tables = _tables(parts, path)
    text = COMMENT + yaml_text(parts)
    script.experiment.of_parts(script.written(step))
    if len(text) > MAX_BYTES or _nodes(parts) > MAX_NODES:
        text = "the session exceeds the size of an experiment file"
        raise ExperimentError(f"{text}; go back, and save a part of it")
    write_together({**tables, path: text})
    return Saved(path, None if tables else text)


def _free(path: FilePath, groups: int) -> FilePath:
    """Return the first name for which neither the file nor a table of its groups exists."""
    names = (path if n == 1 else path.with_stem(f"{path.stem}-{n}") for n in count(1))
    return next(
        name
        for name in names
        if not any(each.exists() for each in (name, *(_table(name, n) for n in range(groups))))
    )


def _table(path: FilePath, group: int) -> FilePath:
    """Return the path of the table of a group, in the folder of the experiment."""
    return path.with_name(f"{path.stem}-{group}.csv")


def _tables(parts: dict[str, Any], path: FilePath) -> dict[FilePath, str]:
    """Move the longest paths of groups to tables in the folder of the file. Return the text of each
    table by its path."""
    tables = {}
    for n, group in enumerate(parts["leaders"]):
        motion = group["motion"]
        if motion.get("type") == "path" and len(motion["steps"]) > MAX_INLINE_KNOTS:
            table = _table(path, n)
            rows = zip(motion["steps"], motion["displacements"], strict=True)
            out = io.StringIO()
            lines = csv.writer(out, lineterminator="\n")
            lines.writerow(["step", "ux", "uy"])
            lines.writerows([step, repr(x), repr(y)] for step, (x, y) in rows)
            tables[table] = out.getvalue()
            group["motion"] = {"type": "table", "file": table.name}
    return tables


def _nodes(parts: Any) -> int:
    """Return the approximate number of nodes that the reader of experiment files would count."""
    if isinstance(parts, dict):
        return 1 + sum(1 + _nodes(part) for part in parts.values())
    return 1 + sum(map(_nodes, parts)) if isinstance(parts, list) else 1
