"""The motion of a group that is led by hand: a path that is still being made.

What was done by hand, step by step, in the words of an experiment file.

Writes a script as an experiment file, and long ways of the hand beside it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from copy import deepcopy
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
from pbdkit.web.view_frames import AdjustableNumber, numbers_of, placed

Way = tuple[float, float]


class Hand(Motion):
    """Where the hand has led a group, knot by knot; between knots, and after the last, as `path`.

    The knots grow while it is stepped, so that no engine is made anew for a move of the mouse.
    """

    type: Literal["hand"] = "hand"
    _steps: list[int] = PrivateAttr(default_factory=list)
    _ways: list[Way] = PrivateAttr(default_factory=list)

    def offset(self, n: float, start: Floats) -> Floats:
        """That of the path which a file would say."""
        if not self._steps:
            return np.zeros(2)
        # The two lists themselves: a path of copies would cost as much as it is long.
        knots: dict[str, Any] = {"steps": self._steps, "displacements": self._ways}
        return Path.model_construct(**knots).offset(n, start)

    def knots(self) -> tuple[int, ...]:
        """The last: what came before it is over."""
        return tuple(self._steps[-1:])

    def at(self, n: int) -> Way:
        """The offset at the end of its n-th step, n ≥ 0."""
        x, y = self.offset(n, np.zeros((1, 2))) if n else (0.0, 0.0)
        return float(x), float(y)

    def lead(self, begin: int, end: int, way: Way) -> None:
        """Goes on evenly, after its step `begin`, to `way` at its step `end`."""
        if begin and (not self._steps or self._steps[-1] < begin):
            self._add(begin, self.at(begin))
        self._add(end, way)

    def cut_back(self, n: int) -> None:
        """Forgets what comes after its step n; every step until then stays to the bit."""
        known = [(step, way) for step, way in self.path if step <= n]
        if len(known) < len(self._steps):
            begin = known[-1][0] if known else 0
            known += [(step, self.at(step)) for step in range(begin + 1, n + 1)]
        self._steps[:] = [step for step, _ in known]
        self._ways[:] = [way for _, way in known]

    @property
    def path(self) -> list[tuple[int, Way]]:
        """Its knots."""
        return list(zip(self._steps, self._ways, strict=True))

    def motion(self) -> dict[str, Any]:
        """As an experiment file says it."""
        if not self._steps:
            return {"type": "hold"}
        ways = [list(way) for way in self._ways]
        return {"type": "path", "steps": list(self._steps), "displacements": ways}

    def _add(self, step: int, way: Way) -> None:
        self._steps.append(step)
        self._ways.append(way)


NEVER = 2**62 - 1
"""The last step of what is stepped until somebody has seen enough."""
MADE = "-live"
"""How the names of experiments end that were made by hand: their results lie beside the others."""
Parts = dict[str, Any]


@dataclass
class Led:
    """A leader group: as the file says it, `of_file`, or one of the hand's, from a step on.

    `ended` is the last step for which it was let lead. A hand's group may stand in place of one
    that had not begun to lead, `instead_of`.
    """

    of_file: Parts
    hand: Hand | None = None
    ended: int | None = None
    instead_of: Led | None = None

    @property
    def begins(self) -> int:
        """The first step in which it leads."""
        return int(self.of_file.get("from", 1))

    def leads(self, step: int) -> bool:
        """Whether it leads in that step."""
        ends = [end for end in (self.of_file.get("until"), self.ended) if end is not None]
        return self.begins <= step <= min(ends, default=step)

    def written(self, motion: bool) -> Parts:
        """As an experiment file says it; without its `motion` a hand's group rests."""
        ended = {} if self.ended is None else {"until": self.ended}
        own = self.hand.motion() if self.hand and motion else {"type": "hold"}
        return self.of_file | ({"motion": own} if self.hand else {}) | ended


@dataclass
class Script:
    """An experiment and all that was done to it: groups led by hand, numbers turned, cuts."""

    experiment: Experiment
    parts: Parts
    numbers: dict[str, AdjustableNumber]
    groups: list[Led]
    cuts: list[Parts] = field(default_factory=list)

    @classmethod
    def of(cls, experiment: Experiment) -> Script:
        """Of an experiment whose relaxation and memory are numbers, to which nothing was done."""
        parts = parts_of(experiment)
        groups = [Led(_said(group)) for group in parts.get("leaders", ())]
        return cls(experiment, parts, numbers_of(experiment, parts), groups)

    def copy(self) -> Script:
        """The same, for what is done to one of the two is not done to the other."""
        numbers = {name: replace(n, turns=[*n.turns]) for name, n in self.numbers.items()}
        return replace(self, numbers=numbers, groups=deepcopy(self.groups), cuts=[*self.cuts])

    def restore(self, kept: Script) -> None:
        """Says what a copy says that is not needed any more."""
        self.numbers, self.groups, self.cuts = kept.numbers, kept.groups, kept.cuts

    def grab(self, group: int, step: int) -> int:
        """Lets the hand lead a group after that step; returns the place of the group that it
        leads."""
        found = self.groups[group]
        if found.hand is not None:
            return group
        kept = {key: of for key, of in found.of_file.items() if key not in ("motion", "until")}
        led = Led(kept | {"from": step + 1}, Hand())
        if found.begins == step + 1:
            led.instead_of, self.groups[group] = found, led
            return group
        found.ended = step
        self.groups.append(led)
        return len(self.groups) - 1

    def pick(self, particle: int, step: int) -> int:
        """Lets the hand lead the particle of that number after that step."""
        self.groups.append(Led({"select": {"numbers": [particle]}, "from": step + 1}, Hand()))
        return len(self.groups) - 1

    def let_go(self, group: int, step: int) -> None:
        """Lets a group follow after that step."""
        led = self.groups[group]
        if led.begins > step:
            del self.groups[group]
        else:
            led.ended = step

    def turn(self, name: str, step: int, value: float) -> None:
        """Another number after that step. Raises ExperimentError for one that cannot be."""
        number = self.numbers.get(name)
        if number is None:
            raise ExperimentError(f"there is no number '{name}' that can be turned")
        self.experiment.of_parts(placed(self.playing(step), number, number.turned(value)))
        number.turn(step, value)

    def cut(self, segments: Sequence[Segment], step: int) -> None:
        """Cuts at the beginning of the step after that one. Raises ExperimentError where the
        experiment takes none."""
        more: list[Parts] = [{"from": list(a), "to": list(b), "at": step + 1} for a, b in segments]
        playing = self.playing(step)
        self.experiment.of_parts(playing | {"cuts": [*playing.get("cuts", ()), *more]})
        self.cuts += more

    def cut_back(self, step: int) -> None:
        """Forgets all that was done after a step."""
        for number in self.numbers.values():
            number.cut_back(step)
        self.cuts = [cut for cut in self.cuts if cut["at"] <= step]
        groups = [led.instead_of if _comes_after(led, step) else led for led in self.groups]
        self.groups = [led for led in groups if led]
        for led in self.groups:
            if led.ended is not None and led.ended >= step:
                led.ended = None
            if led.hand:
                led.hand.cut_back(step - led.begins + 1)

    def next_turn(self, step: int) -> int:
        """The first step after that one after which a number is another."""
        turns = (when for number in self.numbers.values() for when, _ in number.turns)
        return min((when for when in turns if when > step), default=NEVER)

    def playing(self, step: int) -> Parts:
        """What is stepped after a step: its numbers as they are until the next turn, hands at rest,
        and of the cuts that were made no more than tells that there are some."""
        parts = dict(self.parts)
        for number in self.numbers.values():
            if number.turns:
                parts = placed(parts, number, number.after(step))
        cuts = [*parts.get("cuts", ()), *self.cuts]
        coming = [cut for cut in cuts if cut["at"] > step]
        parts["cuts"] = coming or cuts[-1:]
        parts["leaders"] = [led.written(motion=False) for led in self.groups]
        parts.pop("record", None)
        parts.pop("diagnostics", None)
        return parts | {"steps": NEVER}

    def written(self, last: int) -> Parts:
        """The whole as an experiment of `last` steps."""
        parts = dict(self.parts)
        for number in self.numbers.values():
            if number.turns:
                parts = placed(parts, number, number.written(last))
        cuts = [cut for cut in (*parts.get("cuts", ()), *self.cuts) if cut["at"] <= last]
        name = parts["name"].removesuffix(MADE) + MADE
        groups = [led.written(motion=True) for led in self.groups if not _comes_after(led, last)]
        parts |= {"name": name, "steps": last, "leaders": groups}
        parts = _where(parts, "cuts", cuts)
        record = parts.get("record", {})
        if "at" in record:
            parts["record"] = record | {"at": [at for at in record["at"] if at <= last] or [0]}
        plain: Parts = json.loads(json.dumps(parts))  # nothing in it is there twice
        return plain


def parts_of(experiment: Experiment) -> Parts:
    """What an experiment that is stepped is made of, in lattice units, without an end to it; parts
    that need not be said are left out."""
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


def _said(group: Parts) -> Parts:
    """Without what says nothing."""
    silent = {"from": 1, "until": None, "clamped": False}
    return {key: of for key, of in group.items() if key not in silent or of != silent[key]}


def _comes_after(led: Led, step: int) -> bool:
    return led.hand is not None and led.begins > step


def _where(parts: Parts, key: str, some: list[Any]) -> Parts:
    """With what there is of it, without the key where there is nothing."""
    rest = {name: part for name, part in parts.items() if name != key}
    return rest | ({key: some} if some else {})


INLINE = 500
"""Knots of a way that are written into the experiment; those of longer ones take a table beside."""
COMMENT = "# Made by hand with pbdkit live: `pbdkit run` repeats it bit for bit.\n"


@dataclass(frozen=True)
class Saved:
    """Where it was written; `text` is the file where it needs no other, else None."""

    path: FilePath
    text: str | None


def saved(script: Script, step: int, output: FilePath | None) -> Saved:
    """Writes what was done until a step. Where there is such a file already, or none is named, it
    takes the next name that is free.

    Raises ExperimentError where there is no step yet, or more than a file may hold; StorageError
    where it cannot be written.
    """
    if step < 1:
        raise ExperimentError("nothing has been stepped yet: an experiment has a step at least")
    parts = script.written(step)
    name = parts["name"].replace("/", "-")
    path = _free(output or FilePath(f"{name}.yaml"), len(parts["leaders"]))
    tables = _tables(parts, path)
    text = COMMENT + yaml_text(parts)
    script.experiment.of_parts(script.written(step))
    if len(text) > MAX_BYTES or _nodes(parts) > MAX_NODES:
        text = "what was done is more than an experiment file may hold"
        raise ExperimentError(f"{text}; go back, and save a part of it")
    write_together({**tables, path: text})
    return Saved(path, None if tables else text)


def _free(path: FilePath, groups: int) -> FilePath:
    """The first name of which there is neither a file nor a table of one of so many groups."""
    names = (path if n == 1 else path.with_stem(f"{path.stem}-{n}") for n in count(1))
    return next(
        name
        for name in names
        if not any(each.exists() for each in (name, *(_table(name, n) for n in range(groups))))
    )


def _table(path: FilePath, group: int) -> FilePath:
    """Where the way of a group is, beside the experiment."""
    return path.with_name(f"{path.stem}-{group}.csv")


def _tables(parts: dict[str, Any], path: FilePath) -> dict[FilePath, str]:
    """Puts the longest ways into tables beside the file, by their paths."""
    found = {}
    for n, group in enumerate(parts["leaders"]):
        motion = group["motion"]
        if motion.get("type") == "path" and len(motion["steps"]) > INLINE:
            table = _table(path, n)
            rows = zip(motion["steps"], motion["displacements"], strict=True)
            out = io.StringIO()
            lines = csv.writer(out, lineterminator="\n")
            lines.writerow(["step", "ux", "uy"])
            lines.writerows([step, repr(x), repr(y)] for step, (x, y) in rows)
            found[table] = out.getvalue()
            group["motion"] = {"type": "table", "file": table.name}
    return found


def _nodes(parts: Any) -> int:
    """About as many as the reader of files counts."""
    if isinstance(parts, dict):
        return 1 + sum(1 + _nodes(part) for part in parts.values())
    return 1 + sum(map(_nodes, parts)) if isinstance(parts, list) else 1
