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

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import RenewsBonds
from pbdkit.interfaces.rule import shares_particles
from pbdkit.scene.guides import has_guides
from pbdkit.scene.scene import Scene
from pbdkit.stepping.clamps import Clamps

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
    experiment = scene.experiment
    if experiment.neighbours.nearness():
        return "neighbours are found anew"
    if scene.inner:
        return "the rule moves by another's moves"
    if shares_particles(experiment.rule):
        return "neighbours see what is remembered of each other"
    if Clamps(scene).numbers:
        return "leaders are clamped"
    if has_guides(scene.leading):
        return "leaders lead along an axis"
    if scene.barriers:
        return "obstacles push"
    if max(map(len, scene.neighbourhood.slots)) > MOST_SLOTS:
        return "there are many neighbours"
    if scene.has_fracture and isinstance(experiment.fracture, RenewsBonds):
        return "bonds remember"
    if scene.frame and scene.frame.map.lag:
        return "the frame lags"
    if max(Skew(scene).along) > FARTHEST:
        return "frame points follow particles far away"
    return ""


@dataclass(frozen=True)
class Skew:
    """How far, in cells along the first axis and the last, the steps of a pass are apart."""

    scene: Scene

    @property
    def reach(self) -> tuple[int, int]:
        """How far neighbours are."""
        reach = self.scene.neighbourhood.reach_in_cells
        return int(reach[0]), int(reach[-1])

    @cached_property
    def along(self) -> tuple[int, int]:
        """What neighbours reach and frame points lie apart from those whom they follow."""
        (rows, columns), (up, across) = self.reach, self._apart
        return rows + up, columns + across

    @cached_property
    def ready(self) -> NDArray[np.intp]:
        """(2, frame point): the row and column at which the last of those has moved whom a frame
        point follows."""
        return np.maximum.reduceat(self._body, self._first, axis=1)

    @property
    def _apart(self) -> tuple[int, int]:
        frame = self.scene.frame
        if frame is None:
            return 0, 0
        point = self._cells(frame.place)
        low = np.minimum(np.minimum.reduceat(self._body, self._first, axis=1), point)
        up, across = (np.maximum(self.ready, point) - low).max(axis=1).tolist()
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
