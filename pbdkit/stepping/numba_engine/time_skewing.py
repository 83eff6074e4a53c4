"""Whether several steps can go over the memory in one pass, and how far behind each other.

A step s of a pass follows the step before it at a distance: it moves a particle as soon as step
s - 1 has moved all that the particle sees, and nothing is written over that a step before still has
to read. Both hold where the distance is what neighbours reach and what frame points lie apart from
those whom they follow. Only the order of particles differs: every number is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.plugin import RenewsBonds
from pbdkit.scene.scene import Scene
from pbdkit.stepping.program import reason_against
from pbdkit.stepping.step import Mode

CACHE = 2**24
"""Bytes of displacements up to which a pass a step is as fast (measured)."""
FARTHEST = 8
"""Cells that frame points may lie from those whom they follow, and steps of a pass apart."""
MOST_SLOTS = 32
"""Neighbours up to which a step is bound by the memory, and not by what it computes."""


def cell_bytes(scene: Scene) -> int:
    """What a step reads and writes of each repeat cell."""
    real = np.dtype(scene.experiment.stepping.precision)
    return 2 * scene.axes * real.itemsize * scene.raster.shape[0]


def exceeds_cache(scene: Scene) -> bool:
    """Whether displacements are too many for the cache, so that several steps a pass gain."""
    return cell_bytes(scene) * math.prod(scene.raster.shape[1:]) > CACHE


def single_steps(scene: Scene) -> str:
    """Why every step is a pass of its own; empty where several can go together."""
    if reason := reason_against(scene, Mode.PASSES):
        return reason
    if max(map(len, scene.neighbourhood.slots)) > MOST_SLOTS:
        return "there are many neighbours"
    if max(Skew(scene).along) > FARTHEST:
        return "frame points follow particles far away"
    return ""


class AxisSkew(NamedTuple):
    """What decides along an axis how far steps are apart, in cells: how far neighbours are; how far
    before and after a particle bonds are judged, or moves of the inner rule made, before it moves,
    and how far `below` and `above` themselves those see; and how far frame points lie from those
    whom they follow."""

    reach: int
    back: int
    ahead: int
    below: int
    above: int
    apart: int

    @property
    def step(self) -> int:
        """How far each step is behind the one before."""
        sees = max(self.reach, self.above + self.ahead, self.below + self.back)
        return max(sees + self.apart, self.back + self.ahead)

    @property
    def sight(self) -> int:
        """How far a step sees beyond where it has judged bonds, or made moves of the inner rule."""
        return max(self.reach - self.ahead, self.above)


@dataclass(frozen=True)
class Skew:
    """How far the steps of a pass are apart, along the first axis and the last."""

    scene: Scene

    @cached_property
    def axes(self) -> tuple[AxisSkew, AxisSkew]:
        """Along the first axis and the last."""
        rows, columns = self._apart
        return self._along(0, rows), self._along(-1, columns)

    @property
    def along(self) -> tuple[int, int]:
        """How far each step is behind the one before."""
        rows, columns = self.axes
        return rows.step, columns.step

    @cached_property
    def ready(self) -> NDArray[np.intp]:
        """(2, frame point): the row and column at which the last of those has moved whom a frame
        point follows."""
        return np.maximum.reduceat(self._body, self._first, axis=1)

    @cached_property
    def begun(self) -> NDArray[np.intp]:
        """(2, frame point): the row and column at which the first of those has moved."""
        return np.minimum.reduceat(self._body, self._first, axis=1)

    def _along(self, axis: int, apart: int) -> AxisSkew:
        around, fracture = self.scene.neighbourhood, self.scene.experiment.fracture
        reach = around.reach_in_cells[axis]
        if self.scene.inner:  # and its frame points follow
            far = reach + apart
            return AxisSkew(reach, far, far, reach, reach, apart)
        first = isinstance(fracture, RenewsBonds) or (self.scene.tears and fracture.can_break)
        if self.scene.has_fracture and first:
            below, above = (home[axis] for home in around.home_reach)
            back, ahead = (home[axis] for home in self.scene.home_reach)
            return AxisSkew(reach, back, ahead, above, below, apart)
        return AxisSkew(reach, 0, 0, 0, 0, apart)

    @property
    def _apart(self) -> tuple[int, int]:
        frame = self.scene.frame
        if frame is None:
            return 0, 0
        point = self._cells(frame.place)
        low, high = np.minimum(self.begun, point), np.maximum(self.ready, point)
        up, across = (high - low).max(axis=1).tolist()
        return up, across

    @property
    def _first(self) -> NDArray[np.intp]:
        """The first entry of each frame point."""
        assert self.scene.frame
        points = np.arange(len(self.scene.frame.place))
        return np.searchsorted(self.scene.frame.map.point, points)

    @cached_property
    def _body(self) -> NDArray[np.intp]:
        assert self.scene.frame
        return self._cells(self.scene.frame.body_place)

    def _cells(self, place: NDArray[np.intp]) -> NDArray[np.intp]:
        """(2, place): rows and columns."""
        found = np.unravel_index(place, self.scene.raster.shape)
        return np.stack([found[1], found[-1]])
