"""A motion known at scattered points: each particle by its own value, linear between them."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationInfo, model_validator

from pbdkit.experiment.columns import MOST_ROWS, in_place_of, or_a_file
from pbdkit.experiment.motion import Floats, Motion, Steps
from pbdkit.interfaces.units import Place

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
