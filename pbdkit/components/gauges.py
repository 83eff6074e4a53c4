"""Gauges: diagnostics that correspond to the instruments of a mechanical test.

They are also quantities that a fit can measure.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from pbdkit.array_types import Floats, Indices
from pbdkit.components.diagnostics import TwoPoints
from pbdkit.errors import ExperimentError
from pbdkit.plugin import Diagnostic, Moment, Variable
from pbdkit.plugin.units import LENGTH, Place

Toward = Annotated[tuple[float, float], Field(strict=False)]
"""Type of a direction; its length does not matter."""
ON_EDGE = 1e-9
"""Distance from a cell, relative to its size, up to which a point belongs to the cell."""


class Gauge(Diagnostic):
    """Base class of instruments with one value at each time."""

    symbol: ClassVar[str]
    """Name of the measured quantity in labels."""


class Extensometer(Gauge):
    """Extension between two points, as a clip gauge or an extensometer measures it.

    The points are the body particles nearest to `between`. The extension is the component of the
    displacement of the second one, minus that of the first one, along `direction`; by default this
    is the direction from the first point to the second one. With points on both sides of the mouth
    of a crack it is the crack mouth opening displacement (CMOD).
    """

    symbol = "extension"

    type: Literal["extensometer"] = "extensometer"
    between: TwoPoints = Field(
        description="Two points; the nearest particles are used.",
        examples=[((0.0, 0.0), (1.0, 0.0))],
    )
    direction: Toward | None = Field(
        None,
        description="Direction of the extension; by default from the first point to the second.",
    )

    @model_validator(mode="after")
    def _has_direction(self) -> Extensometer:
        if self.direction is not None and not any(self.direction):
            raise ValueError("the direction is zero; give one, such as [1, 0]")
        return self

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `extension`."""
        return (Variable("extension", (), "extension between two points", LENGTH.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the extension at a moment."""
        rows = now.nearest(self.between)
        if rows[0] == rows[1]:
            raise ExperimentError(
                f"both points are nearest to particle {rows[0] + 1}; choose points that are "
                "farther apart",
                ("between",),
            )
        first, second = now.reference(rows)
        direction = np.array(self.direction or second - first)
        direction = direction / np.linalg.norm(direction)
        u, v = now.displacement(rows)
        return ((v - u) @ direction,)


class StrainGauge(Gauge):
    """Mean strain along a line of a given length, as a strain gauge measures it.

    The strain is the difference of the displacements of both ends, along the line, divided by its
    length. Displacements are interpolated within the cells of the lattice. The strain is
    linearised: if the gauge rotates by the angle φ in radians, it contains an error of φ²/2.
    """

    symbol = "strain"

    type: Literal["strain-gauge"] = "strain-gauge"
    at: Place = Field(description="Centre of the gauge.", examples=[(2.0, 1.0)])
    length: Annotated[float, Field(gt=0.0, le=1e100), LENGTH] = Field(
        description="Length of the gauge (lattice units).", examples=[2.0]
    )
    angle: Annotated[float, Field(ge=-360.0, le=360.0)] = Field(
        0.0,
        description="Angle between the x axis and the gauge, in degrees, counterclockwise.",
        examples=[45.0],
    )

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `gauge_strain`."""
        return (Variable("gauge_strain", (), "mean strain along the strain gauge", "1"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the mean strain at a moment."""
        angle = np.radians(self.angle)
        along = np.array([np.cos(angle), np.sin(angle)])
        ends = [np.array(self.at) + side * self.length / 2.0 * along for side in (-1.0, 1.0)]
        u, v = (self._displacement(now, end) for end in ends)
        return ((v - u) @ along / self.length,)

    def _displacement(self, now: Moment, point: Floats) -> Floats:
        """Return the displacement at a point, interpolated in its cell, (axis,)."""
        place = (float(point[0]), float(point[1]))
        # The cells nearby are searched first, then all cells, for a gauge shorter than a cell.
        for distance in (self.length, np.inf):
            for table in now.cells.table((place, distance)):
                weights = _weights(now.reference(table.corners.ravel()), table.corners.shape, point)
                inside = np.flatnonzero((weights >= -ON_EDGE).all(axis=1))
                if inside.size:
                    row: Indices = table.corners[inside[0]]
                    result: Floats = weights[inside[0]] @ now.displacement(row)
                    return result
        x, y = place
        raise ExperimentError(
            f"the end ({x:g}, {y:g}) of the strain gauge is not in a cell of the body; move it",
            ("at",),
        )


def _weights(reference: Floats, shape: tuple[int, ...], point: Floats) -> Floats:
    """Return the weights of the corners of cells in the interpolation at a point, (cell, corner).

    They are linear in triangles and bilinear in parallelograms. A weight is negative if the point
    is outside the cell.
    """
    corners = reference.reshape(*shape, -1)
    first, last = corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0]
    sides = np.stack([first, last], axis=2)
    s, t = np.linalg.solve(sides, (point - corners[:, 0])[:, :, None])[:, :, 0].T
    if shape[1] == 3:
        return np.stack([1.0 - s - t, s, t], axis=1)
    outside = np.minimum.reduce([s, t, 1.0 - s, 1.0 - t])
    weights = np.stack([(1.0 - s) * (1.0 - t), s * (1.0 - t), s * t, (1.0 - s) * t], axis=1)
    return np.where((outside >= -ON_EDGE)[:, None], np.maximum(weights, 0.0), -1.0)
