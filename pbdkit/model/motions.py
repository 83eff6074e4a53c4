"""Prescribed motions, a closed family: displacement of a leader group by step (model.md, section
1), by formula, from columns of a CSV file, from scattered measurements, or by Newton's law.
"""

from __future__ import annotations

import csv
import math
from abc import abstractmethod
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path as FilePath
from typing import Annotated, Any, ClassVar, Literal, Self, TextIO

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, SerializeAsAny, ValidationInfo, model_validator

from pbdkit.errors import did_you_mean
from pbdkit.model.reading import beside
from pbdkit.model.validation import brief, closed_part, fault
from pbdkit.plugin import Component
from pbdkit.plugin.schedule import Force, at
from pbdkit.plugin.units import Place

MOST_BYTES, MOST_ROWS = 2**26, 200_000
LONGEST_LINE = 2**16
"""Maximum number of characters in a line."""


def or_a_file(*names: str) -> Callable[[dict[str, Any]], None]:
    """For a model's JSON Schema: these fields are needed, or `file` in their place."""

    def either(schema: dict[str, Any]) -> None:
        schema["required"] = [name for name in schema.get("required", ()) if name not in names]
        schema["anyOf"] = [{"required": ["file"]}, {"required": [*names]}]

    return either


def in_place_of(
    given: Any, info: ValidationInfo, columns: Sequence[str], names: Sequence[str]
) -> tuple[dict[str, Any], list[list[float]]] | None:
    """What is given besides `file`, and the rows of these columns in it, which take the place of
    the fields of these names; None where no file is given."""
    if not isinstance(given, dict) or given.get("file") is None:
        return None
    if given.keys() & {*names}:
        raise fault(f"give either a file, or {' and '.join(names)}", key="file")
    rest = {key: value for key, value in given.items() if key != "file"}
    return rest, read_columns(given["file"], info, columns)


def read_columns(given: Any, info: ValidationInfo, names: Sequence[str]) -> list[list[float]]:
    """The rows of a file, relative to the experiment's, numbers in the order of the names.

    Raises a fault of the key `file` that says what is wrong in it, where, and the remedy.
    """
    try:
        path = beside(info).path(given, "CSV")
        if path.stat().st_size > MOST_BYTES:
            raise fault(f"{path}: is larger than 64 MiB; leave out points", key="file")
        return list(_rows(path, names))
    except UnicodeDecodeError as error:
        raise fault(
            f"{given}: is not UTF-8: {error.reason}; save it as UTF-8", key="file"
        ) from None
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise fault(f"{given}: cannot be read: {reason}", key="file") from None
    except ValueError as error:
        raise fault(str(error), key="file") from None


def _rows(path: FilePath, names: Sequence[str]) -> Iterator[list[float]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(_bounded(file, path), skipinitialspace=True)
        columns = _columns([name.strip() for name in next(lines, [])], names, path)
        count = 0
        for row in lines:
            if not row:
                continue
            count += 1
            if count > MOST_ROWS:
                raise fault(f"{path}: has more than {MOST_ROWS} rows; leave out some", key="file")
            place = f"{path}:{lines.line_num}"
            yield [_number(row[n : n + 1], name, place) for name, n in columns.items()]
        if not count:
            raise fault(f"{path}: holds no row of numbers below its first line", key="file")


def _bounded(file: TextIO, path: FilePath) -> Iterator[str]:
    """Yield the lines of a table. Raises a fault where one is longer than those of a table are."""
    while line := file.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            text = f"{path}: has a line of more than {LONGEST_LINE} characters"
            raise fault(f"{text}; leave out the columns that are not needed", key="file")
        yield line


def _columns(header: list[str], names: Sequence[str], path: FilePath) -> dict[str, int]:
    """Return where the columns stand. Raises a fault where one is missing, or there twice."""
    for name in names:
        if header.count(name) != 1:
            found = f"two '{name}'" if name in header else f"no '{name}'"
            text = f"needs columns {', '.join(names)}, named in its first line; there are"
            hint = _separators(header) or did_you_mean(name, {*header} - {*names})
            raise fault(f"{path}:1: {text} {found}{hint}", key="file")
    return {name: header.index(name) for name in names}


def _separators(header: list[str]) -> str:
    """A hint where something else than commas stands between the columns."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if any(separator in column for column in header):
            return (
                f"; the columns of this file are separated by {name}: save it with commas between "
                "columns, and points in numbers"
            )
    return ""


def _number(cell: list[str], name: str, place: str) -> float:
    """The number in a cell, empty where the row is too short. Python would take 1_0 for 10."""
    text = "".join(cell)
    try:
        number = math.nan if "_" in text else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        got = repr(text)[:40] if text else "nothing"
        raise fault(f"{place}: column '{name}' needs a finite number, got {got}", key="file")
    return number


Floats = NDArray[np.floating[Any]]
Steps = Annotated[int, Field(ge=1, le=2**62)]


class Motion(Component):
    """A prescribed motion, counted from the position at which it starts."""

    rests: ClassVar[bool] = True
    """Whether the motion ends, at the last of its knots."""

    of_reference: ClassVar[bool] = False
    """Whether `start` is where particles lie at rest, wherever the motion finds them."""

    @abstractmethod
    def offset(self, n: float, start: Floats) -> Floats:
        """How far from their start the leaders stand at the end of the motion's n-th step, n ≥ 1;
        on the way to an equilibrium also between two steps, n > 0.

        `start` are the positions at which the motion found them, (particle, axis); so is what is
        returned, or (axis,) where it is the same for all.
        """

    def knots(self) -> tuple[int, ...]:
        """The steps n between which, and after which, the offset changes as one formula in n; by
        default it always does."""
        return ()

    def turned(self, n: float) -> float:
        """By what angle the motion has turned at the end of its n-th step, radians."""
        return 0.0

    def rests_after(self) -> int | None:
        """The step n from which on the offset stays as it is; None where it never does."""
        return max((1, *self.knots())) if self.rests else None


Pairs = Annotated[tuple[Place, ...], Field(strict=False, min_length=2, max_length=MOST_ROWS)]
ON_EDGE = 1e-7
"""By what share of a triangle, or of a line's length, a place outside counts as on the edge."""


class Measured(Motion):
    """Moves each particle by the displacement measured where it lies at rest, from where it then
    is: linear on the Delaunay triangles of the points, or along the line on which they lie; within
    `ramp` steps.
    `outside` says what of particles beyond the points: they are refused, or take the value of the
    nearest point.

    `file`: a CSV with columns x, y, ux, uy; its content takes its place.
    """

    model_config = ConfigDict(json_schema_extra=or_a_file("points", "displacements"))

    type: Literal["measured"] = "measured"
    of_reference: ClassVar[bool] = True
    file: str | None = Field(None, exclude=True)
    points: Pairs
    displacements: Pairs
    ramp: Steps = 1
    outside: Literal["refuse", "nearest"] = "refuse"

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any, info: ValidationInfo) -> Any:
        read = in_place_of(given, info, ("x", "y", "ux", "uy"), ("points", "displacements"))
        if read is None:
            return given
        rest, rows = read
        points, displacements = ([tuple(row[n : n + 2]) for row in rows] for n in (0, 2))
        return rest | {"points": points, "displacements": displacements}

    @model_validator(mode="after")
    def _each_once(self) -> Measured:
        if len(self.points) != len(self.displacements):
            raise ValueError(
                f"as many displacements as points are needed: {len(self.displacements)} given for "
                f"{len(self.points)}"
            )
        if len(set(self.points)) < len(self.points):
            twice = next(p for p, times in Counter(self.points).items() if times > 1)
            raise ValueError(f"({twice[0]:g}, {twice[1]:g}) is measured twice; keep one of them")
        return self

    def offset(self, n: float, start: Floats) -> Floats:
        """The measured displacement of each, min(n / ramp, 1) of it; NaN outside the points."""
        return self.at(start) * min(n / self.ramp, 1.0)

    def knots(self) -> tuple[int, ...]:
        """The end of the ramp."""
        return (self.ramp,)

    def at(self, places: Floats) -> Floats:
        """The measured displacements at places, (place, axis), NaN outside."""
        key = places.tobytes()
        if key not in self._known:
            self._known.clear()
            self._known[key] = self._beyond(places, self._interpolated(places))
        return self._known[key]

    @cached_property
    def _known(self) -> dict[bytes, Floats]:
        """The last that were asked for."""
        return {}

    @cached_property
    def _values(self) -> Floats:
        return np.array(self.displacements)

    @cached_property
    def _triangles(self) -> Any:
        """None where all points lie on a line."""
        at = np.array(self.points)
        _, sizes, _ = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)
        if sizes[1] <= ON_EDGE * sizes[0]:
            return None
        from scipy.spatial import Delaunay

        return Delaunay(at)

    def _interpolated(self, places: Floats) -> Floats:
        if self._triangles is None:
            return self._on_line(places)
        found = self._triangles.find_simplex(places, tol=ON_EDGE)
        transform, corners = self._triangles.transform[found], self._triangles.simplices[found]
        part = np.einsum("pab,pb->pa", transform[:, :2], places - transform[:, 2])
        shares = np.concatenate([part, 1.0 - part.sum(axis=1, keepdims=True)], axis=1)
        values = np.einsum("pc,pca->pa", shares, self._values[corners])
        return np.where((found >= 0)[:, None], values, np.nan)

    def _beyond(self, places: Floats, found: Floats) -> Floats:
        beyond = np.isnan(found[:, 0])
        if self.outside == "refuse" or not beyond.any():
            return found
        from scipy.spatial import KDTree

        _, nearest = KDTree(np.array(self.points)).query(places[beyond])
        found[beyond] = self._values[nearest]
        return found

    def _on_line(self, places: Floats) -> Floats:
        at = np.array(self.points)
        ends = at[[np.lexsort(at.T[::-1])[k] for k in (0, -1)]]
        way = (ends[1] - ends[0]) / np.square(ends[1] - ends[0]).sum()
        along, order = (places - ends[0]) @ way, np.argsort((at - ends[0]) @ way)
        known, values = ((at - ends[0]) @ way)[order], self._values[order]
        aside = places - ends[0] - along[:, None] * (ends[1] - ends[0])
        off = np.linalg.norm(aside, axis=1) > ON_EDGE * np.linalg.norm(ends[1] - ends[0])
        off |= (along < -ON_EDGE) | (along > 1.0 + ON_EDGE)
        found = np.stack([np.interp(along, known, value) for value in values.T], axis=1)
        return np.where(off[:, None], np.nan, found)


class Newton(Motion):
    """Each particle is a mass that its neighbours and a force move; a step is the unit of time:

    mass · a = its share of `force` + what its neighbours exert - damping · v,

    forces over Young's modulus and thickness, in lattice units; `mass` and `damping` of each. By
    the symplectic Euler method, v += a, u += v, with the forces at the end of the last step.
    """

    type: Literal["newton"] = "newton"
    rests: ClassVar[bool] = False
    mass: Annotated[float, Field(gt=0.0, le=1e300)]
    force: Force = (0.0, 0.0)
    damping: Annotated[float, Field(ge=0.0, le=1e300)] = 0.0
    velocity: Place = (0.0, 0.0)

    def offset(self, n: float, start: Floats) -> Floats:
        """Nothing is known beforehand."""
        return np.zeros(start.shape[1])

    def faster(self, step: int, velocity: Floats, pull: Floats, share: Floats) -> Floats:
        """The velocities (particle, axis) at the end of a step, with what neighbours exert and each
        one's share of the force."""
        force = share[:, None] * np.array([at(each, step) for each in self.force])
        force += pull - self.damping * velocity
        return np.asarray(velocity + force / self.mass)

    def lightest(self, stiffness: float) -> float:
        """The mass below which a particle held by such a spring swings ever farther: steps are
        stable for k ≤ 4 m - 2 c, which without damping is ω ≤ 2."""
        return stiffness / 4.0 + self.damping / 2.0


class Hold(Motion):
    """Stays where it is."""

    type: Literal["hold"] = "hold"

    def offset(self, n: float, start: Floats) -> Floats:
        """None."""
        return np.zeros(start.shape[1])


class Velocity(Motion):
    """Moves by `velocity` in each of `steps` steps, then holds."""

    type: Literal["velocity"] = "velocity"
    velocity: Place
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """velocity · min(n, steps)."""
        return np.array(self.velocity) * min(n, self.steps)

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Displace(Motion):
    """Moves by `displacement` in the first step, then holds."""

    type: Literal["displace"] = "displace"
    displacement: Place

    def offset(self, n: float, start: Floats) -> Floats:
        """The displacement, from the first step on."""
        return np.array(self.displacement) * min(n, 1)

    def knots(self) -> tuple[int, ...]:
        """The first step."""
        return (1,)


class Tabulated(Motion):
    """Stands `displacements[k]` from its start at its step `steps[k]`; linear between, from no
    displacement at its step 0, and the last is kept."""

    steps: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=MOST_ROWS)]
    displacements: Annotated[
        tuple[Place, ...], Field(strict=False, min_length=1, max_length=MOST_ROWS)
    ]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if len(self.steps) != len(self.displacements):
            raise ValueError(
                f"as many displacements as steps are needed: {len(self.displacements)} given "
                f"for {len(self.steps)}"
            )
        if any(a >= b for a, b in zip(self.steps, self.steps[1:], strict=False)):
            raise ValueError(f"steps must increase, got {brief(self.steps)}")
        return self

    def offset(self, n: float, start: Floats) -> Floats:
        """Linear interpolation; beyond the last step its displacement."""
        k = min(bisect_left(self.steps, n), len(self.steps) - 1)
        begin, before = (self.steps[k - 1], self.displacements[k - 1]) if k else (0, (0.0, 0.0))
        ways = zip(before, self.displacements[k], strict=True)
        return np.array([np.interp(n, (begin, self.steps[k]), way) for way in ways])

    def knots(self) -> tuple[int, ...]:
        """Its steps."""
        return self.steps


class Path(Tabulated):
    """Along `displacements`, at its steps `steps`."""

    type: Literal["path"] = "path"


class Table(Tabulated):
    """The same from a `file`, a CSV with columns step, ux, uy; its content takes its place."""

    model_config = ConfigDict(json_schema_extra=or_a_file("steps", "displacements"))

    type: Literal["table"] = "table"
    file: str | None = Field(None, exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any, info: ValidationInfo) -> Any:
        read = in_place_of(given, info, ("step", "ux", "uy"), ("steps", "displacements"))
        if read is None:
            return given
        rest, rows = read
        if rows[0] == [0.0, 0.0, 0.0]:  # where every motion starts
            del rows[0]
        if wrong := [row[0] for row in rows if row[0] < 1 or row[0] % 1]:
            text = f"{given['file']}: steps are whole numbers from 1 on, got {wrong[0]:g}"
            raise fault(f"{text}; at step 0 nothing is displaced yet", key="file")
        steps, displacements = [int(row[0]) for row in rows], [tuple(row[1:]) for row in rows]
        return rest | {"steps": steps, "displacements": displacements}


class Rotation(Motion):
    """Turns about `centre` by `angle` degrees a step, counterclockwise, for `steps` steps."""

    type: Literal["rotation"] = "rotation"
    centre: Place
    angle: Annotated[float, Field(ge=-1e6, le=1e6)]
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """(Q - 1)(start - centre), Q the rotation by angle · min(n, steps)."""
        turned = self.turned(n)
        # 1 - cos without cancellation, so that small turns keep their digits.
        less, sine = 2 * math.sin(turned / 2) ** 2, math.sin(turned)
        x, y = (np.asarray(start) - self.centre).T
        return np.stack([-less * x - sine * y, sine * x - less * y], axis=-1)

    def turned(self, n: float) -> float:
        """angle · min(n, steps)."""
        return math.radians(self.angle * min(n, self.steps))

    def knots(self) -> tuple[int, ...]:
        """The end of the motion."""
        return (self.steps,)


class Oscillation(Motion):
    """Swings about its start: amplitude · sin(2πn / period), for ever."""

    type: Literal["oscillation"] = "oscillation"
    rests: ClassVar[bool] = False
    amplitude: Place
    period: Annotated[float, Field(ge=1e-6, le=1e12)]

    def offset(self, n: float, start: Floats) -> Floats:
        """amplitude · sin(2πn / period)."""
        return np.array(self.amplitude) * math.sin(2 * math.pi * n / self.period)


AnyMotion = Annotated[
    SerializeAsAny[Motion],
    closed_part(
        Motion, Hold, Velocity, Displace, Path, Rotation, Oscillation, Table, Measured, Newton
    ),
]
