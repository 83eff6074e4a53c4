"""Prescribed motions of leader groups: by formula, from columns of a CSV file, from scattered
measurements, or by Newton's law (docs/model.md, section 1)."""

from __future__ import annotations

import math
from abc import abstractmethod
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, SerializeAsAny, ValidationInfo, model_validator

from pbdkit.array_types import Floats
from pbdkit.model.csv_columns import MAX_ROWS
from pbdkit.model.validation import brief, closed_part, fault, read_columns
from pbdkit.plugin import Component
from pbdkit.plugin.schedule import Force, at
from pbdkit.plugin.units import Place


def names_or_file(*names: str) -> Callable[[dict[str, Any]], None]:
    """Return an update of a JSON Schema. With the update, the schema requires either the fields
    `names` or `file`."""

    def either(schema: dict[str, Any]) -> None:
        schema["required"] = [name for name in schema.get("required", ()) if name not in names]
        schema["anyOf"] = [{"required": ["file"]}, {"required": [*names]}]

    return either


def in_place_of(
    parameters: Any, info: ValidationInfo, columns: Sequence[str], names: Sequence[str]
) -> tuple[dict[str, Any], list[list[float]]] | None:
    """Read the columns of `file` if it is given and replaces other fields.

    Parameters
    ----------
    parameters
        Raw parameters.
    info
        Validation context.
    columns
        Names of the columns.
    names
        Names of the fields that the columns replace.

    Returns
    -------
    tuple or None
        The parameters without `file`, and the rows of the columns. The result is None if no file is
        given.
    """
    if not isinstance(parameters, dict) or parameters.get("file") is None:
        return None
    if parameters.keys() & {*names}:
        raise fault(f"give either a file, or {' and '.join(names)}", key="file")
    rest = {key: value for key, value in parameters.items() if key != "file"}
    return rest, read_columns(parameters["file"], info, columns)


Steps = Annotated[int, Field(ge=1, le=2**62)]
"""Type of a number of steps."""


class Motion(Component):
    """Prescribed motion, given by displacements from the position at its start."""

    rests: ClassVar[bool] = True
    """True if the displacement is constant after the last of the knots."""

    of_reference: ClassVar[bool] = False
    """True if displacements are measured from the reference position and not from the current
    one."""

    @abstractmethod
    def offset(self, n: float, start: Floats) -> Floats:
        """Return the displacement from the start at the end of the n-th step of the motion.

        Parameters
        ----------
        n
            Number of the step of the motion, from 1. Load stepping also uses fractions, n > 0.
        start
            Positions at the start of the motion, (particle, axis).

        Returns
        -------
        NDArray
            Displacements of shape (particle, axis), or (axis,) if they are the same for all
            particles.
        """

    def knots(self) -> tuple[int, ...]:
        """Return the steps n that divide the motion into parts.

        Within each part, the displacement is a single formula in n. By default there are no such
        steps, because one formula holds for all n.
        """
        return ()

    def turned(self, n: float) -> float:
        """Return the rotation angle at the end of the n-th step, in radians."""
        return 0.0

    def rests_after(self) -> int | None:
        """Return the step n after which the displacement is constant, or None."""
        return max((1, *self.knots())) if self.rests else None


Pairs = Annotated[tuple[Place, ...], Field(strict=False, min_length=2, max_length=MAX_ROWS)]
"""Type of the points or displacements of a measurement."""
EDGE_RTOL = 1e-7
"""Distance up to which a place outside is treated as lying on the edge.

It is relative to the size of a triangle or the length of the line.
"""


class Measured(Motion):
    """Moves each particle by the displacement measured at its reference position, within `ramp`
    steps.

    Displacements are interpolated linearly on the Delaunay triangles of the points, or along the
    line through all points. If `outside` is `refuse`, particles outside the region of the points
    are an error; otherwise they have the value of the nearest point. `file` is a CSV file with the
    columns x, y, ux, uy, which replaces `points` and `displacements`.
    """

    model_config = ConfigDict(json_schema_extra=names_or_file("points", "displacements"))

    type: Literal["measured"] = "measured"
    of_reference: ClassVar[bool] = True
    file: str | None = Field(None, exclude=True)
    points: Pairs
    displacements: Pairs
    ramp: Steps = 1
    outside: Literal["refuse", "nearest"] = "refuse"

    @model_validator(mode="before")
    @classmethod
    def _read(cls, parameters: Any, info: ValidationInfo) -> Any:
        columns = ("x", "y", "ux", "uy")
        content = in_place_of(parameters, info, columns, ("points", "displacements"))
        if content is None:
            return parameters
        rest, rows = content
        points, displacements = ([tuple(row[n : n + 2]) for row in rows] for n in (0, 2))
        return rest | {"points": points, "displacements": displacements}

    @model_validator(mode="after")
    def _each_once(self) -> Measured:
        if len(self.points) != len(self.displacements):
            raise ValueError(
                f"the numbers of displacements and points differ: {len(self.displacements)} and "
                f"{len(self.points)}"
            )
        if len(set(self.points)) < len(self.points):
            x, y = next(p for p, count in Counter(self.points).items() if count > 1)
            raise ValueError(f"({x:g}, {y:g}) occurs twice among the measured points; remove one")
        return self

    def offset(self, n: float, start: Floats) -> Floats:
        """Return the measured displacements times min(n / ramp, 1); NaN outside the points."""
        return self.at(start) * min(n / self.ramp, 1.0)

    def knots(self) -> tuple[int, ...]:
        """Return the end of the ramp."""
        return (self.ramp,)

    def at(self, places: Floats) -> Floats:
        """Return the measured displacements at places, as an array of shape (place, axis); NaN
        outside the points."""
        key = places.tobytes()
        if key not in self._cache:
            self._cache.clear()
            self._cache[key] = self._extrapolated(places, self._interpolated(places))
        return self._cache[key]

    @cached_property
    def _cache(self) -> dict[bytes, Floats]:
        """Cache with the displacements of the last call."""
        return {}

    @cached_property
    def _values(self) -> Floats:
        return np.array(self.displacements)

    @cached_property
    def _triangles(self) -> Any:
        """Delaunay triangulation of the points; None if all lie on a line."""
        at = np.array(self.points)
        _, sizes, _ = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)
        if sizes[1] <= EDGE_RTOL * sizes[0]:
            return None
        from scipy.spatial import Delaunay

        return Delaunay(at)

    def _interpolated(self, places: Floats) -> Floats:
        if self._triangles is None:
            return self._on_line(places)
        triangles = self._triangles.find_simplex(places, tol=EDGE_RTOL)
        transform = self._triangles.transform[triangles]
        corners = self._triangles.simplices[triangles]
        part = np.einsum("pab,pb->pa", transform[:, :2], places - transform[:, 2])
        shares = np.concatenate([part, 1.0 - part.sum(axis=1, keepdims=True)], axis=1)
        values = np.einsum("pc,pca->pa", shares, self._values[corners])
        return np.where((triangles >= 0)[:, None], values, np.nan)

    def _extrapolated(self, places: Floats, values: Floats) -> Floats:
        outside = np.isnan(values[:, 0])
        if self.outside == "refuse" or not outside.any():
            return values
        from scipy.spatial import KDTree

        _, nearest = KDTree(np.array(self.points)).query(places[outside])
        values[outside] = self._values[nearest]
        return values

    def _on_line(self, places: Floats) -> Floats:
        at = np.array(self.points)
        ends = at[[np.lexsort(at.T[::-1])[k] for k in (0, -1)]]
        direction = (ends[1] - ends[0]) / np.square(ends[1] - ends[0]).sum()
        along, order = (places - ends[0]) @ direction, np.argsort((at - ends[0]) @ direction)
        positions, values = ((at - ends[0]) @ direction)[order], self._values[order]
        aside = places - ends[0] - along[:, None] * (ends[1] - ends[0])
        off = np.linalg.norm(aside, axis=1) > EDGE_RTOL * np.linalg.norm(ends[1] - ends[0])
        off |= (along < -EDGE_RTOL) | (along > 1.0 + EDGE_RTOL)
        result = np.stack([np.interp(along, positions, value) for value in values.T], axis=1)
        return np.where(off[:, None], np.nan, result)


class Newton(Motion):
    """Each particle is a mass that moves by Newton's law, with the step as the unit of time:

    mass · a = (fraction of `force`) + (force of the neighbours) - damping · v.

    Forces are divided by Young's modulus and thickness, in lattice units. `mass` and `damping` are
    values of a single particle. The equation is integrated by the symplectic Euler method, v += a,
    u += v, with the forces at the end of the previous step.
    """

    type: Literal["newton"] = "newton"
    rests: ClassVar[bool] = False
    mass: Annotated[float, Field(gt=0.0, le=1e300)]
    force: Force = (0.0, 0.0)
    damping: Annotated[float, Field(ge=0.0, le=1e300)] = 0.0
    velocity: Place = (0.0, 0.0)

    def offset(self, n: float, start: Floats) -> Floats:
        """Return zeros, because the motion cannot be computed before the run."""
        return np.zeros(start.shape[1])

    def faster(self, step: int, velocity: Floats, pull: Floats, share: Floats) -> Floats:
        """Return the velocities at the end of a step, (particle, axis).

        Parameters
        ----------
        step
            Number of the step.
        velocity
            Velocities at the start of the step, (particle, axis).
        pull
            Forces of the neighbours, (particle, axis).
        share
            Fraction of the force that acts on each particle, (particle,).
        """
        force = share[:, None] * np.array([at(component, step) for component in self.force])
        force += pull - self.damping * velocity
        return np.asarray(velocity + force / self.mass)

    def lightest(self, stiffness: float) -> float:
        """Return the mass below which a particle on a spring of the given stiffness is unstable.

        With the stiffness k, the mass m and the damping c, steps are stable for k ≤ 4 m - 2 c.
        Without damping this is ω ≤ 2.
        """
        return stiffness / 4.0 + self.damping / 2.0


class Hold(Motion):
    """Keeps the particles at their positions."""

    type: Literal["hold"] = "hold"

    def offset(self, n: float, start: Floats) -> Floats:
        """Return a zero displacement, (axis,)."""
        return np.zeros(start.shape[1])


class Velocity(Motion):
    """Moves by `velocity` in each of `steps` steps, and is at rest afterwards."""

    type: Literal["velocity"] = "velocity"
    velocity: Place
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """Return velocity · min(n, steps)."""
        return np.array(self.velocity) * min(n, self.steps)

    def knots(self) -> tuple[int, ...]:
        """Return the end of the motion."""
        return (self.steps,)


class Displace(Motion):
    """Moves by `displacement` in the first step, and is at rest afterwards."""

    type: Literal["displace"] = "displace"
    displacement: Place

    def offset(self, n: float, start: Floats) -> Floats:
        """Return the displacement, from the first step on."""
        return np.array(self.displacement) * min(n, 1)

    def knots(self) -> tuple[int, ...]:
        """Return the first step."""
        return (1,)


class Tabulated(Motion):
    """At step `steps[k]` of the motion the displacement from the start is `displacements[k]`.

    It is zero at step 0, interpolated linearly between these steps, and constant after the last
    one.
    """

    steps: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=MAX_ROWS)]
    displacements: Annotated[
        tuple[Place, ...], Field(strict=False, min_length=1, max_length=MAX_ROWS)
    ]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if len(self.steps) != len(self.displacements):
            raise ValueError(
                f"the numbers of displacements and steps differ: {len(self.displacements)} and "
                f"{len(self.steps)}"
            )
        if any(a >= b for a, b in zip(self.steps, self.steps[1:], strict=False)):
            raise ValueError(f"steps must increase, got {brief(self.steps)}")
        return self

    def offset(self, n: float, start: Floats) -> Floats:
        """Return the interpolated displacement, or the last displacement of the table after its
        last step."""
        k = min(bisect_left(self.steps, n), len(self.steps) - 1)
        begin, previous = (self.steps[k - 1], self.displacements[k - 1]) if k else (0, (0.0, 0.0))
        components = zip(previous, self.displacements[k], strict=True)
        return np.array(
            [np.interp(n, (begin, self.steps[k]), component) for component in components]
        )

    def knots(self) -> tuple[int, ...]:
        """Return the steps of the table."""
        return self.steps


class Path(Tabulated):
    """Has the displacements `displacements` at the steps `steps` of the motion.

    They are interpolated linearly.
    """

    type: Literal["path"] = "path"


class Table(Tabulated):
    """Has displacements that are read from a CSV `file` with the columns step, ux, uy.

    The columns replace `steps` and `displacements` of the motion `path`.
    """

    model_config = ConfigDict(json_schema_extra=names_or_file("steps", "displacements"))

    type: Literal["table"] = "table"
    file: str | None = Field(None, exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, parameters: Any, info: ValidationInfo) -> Any:
        columns = ("step", "ux", "uy")
        content = in_place_of(parameters, info, columns, ("steps", "displacements"))
        if content is None:
            return parameters
        rest, rows = content
        if rows[0] == [0.0, 0.0, 0.0]:  # Every motion starts with a displacement of zero.
            del rows[0]
        if wrong := [row[0] for row in rows if row[0] < 1 or row[0] % 1]:
            text = f"{parameters['file']}: expected whole numbers from 1 as steps, got {wrong[0]:g}"
            raise fault(f"{text}; the displacement at step 0 is zero", key="file")
        steps, displacements = [int(row[0]) for row in rows], [tuple(row[1:]) for row in rows]
        return rest | {"steps": steps, "displacements": displacements}


class Rotation(Motion):
    """Rotates around `centre` by `angle` degrees in each of `steps` steps, counterclockwise."""

    type: Literal["rotation"] = "rotation"
    centre: Place
    angle: Annotated[float, Field(ge=-1e6, le=1e6)]
    steps: Steps

    def offset(self, n: float, start: Floats) -> Floats:
        """Return (Q - 1)(start - centre) with the rotation Q by angle · min(n, steps)."""
        angle = self.turned(n)
        # 1 - cos is computed without cancellation, so that small angles are accurate.
        versine, sine = 2 * math.sin(angle / 2) ** 2, math.sin(angle)
        x, y = (np.asarray(start) - self.centre).T
        return np.stack([-versine * x - sine * y, sine * x - versine * y], axis=-1)

    def turned(self, n: float) -> float:
        """Return angle · min(n, steps) in radians."""
        return math.radians(self.angle * min(n, self.steps))

    def knots(self) -> tuple[int, ...]:
        """Return the end of the motion."""
        return (self.steps,)


class Oscillation(Motion):
    """Oscillates about the start without end: amplitude · sin(2πn / period)."""

    type: Literal["oscillation"] = "oscillation"
    rests: ClassVar[bool] = False
    amplitude: Place
    period: Annotated[float, Field(ge=1e-6, le=1e12)]

    def offset(self, n: float, start: Floats) -> Floats:
        """Return amplitude · sin(2πn / period)."""
        return np.array(self.amplitude) * math.sin(2 * math.pi * n / self.period)


AnyMotion = Annotated[
    SerializeAsAny[Motion],
    closed_part(
        Motion, Hold, Velocity, Displace, Path, Rotation, Oscillation, Table, Measured, Newton
    ),
]
"""Type of a motion in an experiment."""
