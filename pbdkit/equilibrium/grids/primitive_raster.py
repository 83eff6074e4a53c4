"""The particles of a scene by the primitive cells of their lattice, one a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbdkit.interfaces import Slot
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.scene import Scene


@dataclass(frozen=True)
class PrimitiveRaster:
    """Primitive cells, with a ring of empty ones around: the flat place of each particle here from
    its place on the scene's raster; `shape` is (row, place)."""

    shape: Index
    low: Index
    scene: Scene

    @classmethod
    def of(cls, scene: Scene) -> PrimitiveRaster | None:
        """None where bonds lead farther than to a primitive cell beside."""
        cell = scene.raster.lattice.cell()
        steps = [primitive_step(scene, slot) for slot in scene.neighbourhood.every]
        if (
            scene.axes != 2
            or np.abs(steps).max() > 1
            or abs(np.linalg.det(cell.primitive)) != len(cell.sites)
        ):
            return None
        if len(cell.sites) == 1:
            return cls(scene.raster.shape[1:], scene.raster.first, scene)
        cells = np.array(scene.raster.shape[1:]) - 1
        corners = (
            np.array([(0, 0), (cells[0], 0), (0, cells[1]), tuple(cells)]) + scene.raster.first
        )
        ends = corners @ np.array(cell.primitive)
        sites = np.array([site.primitive for site in cell.sites])
        low = ends.min(axis=0) + sites.min(axis=0) - 1
        high = ends.max(axis=0) + sites.max(axis=0) + 1
        return cls(tuple((high - low + 1).tolist()), tuple(low.tolist()), scene)

    @property
    def is_the_scenes(self) -> bool:
        """Whether places here are places there."""
        return len(self.scene.raster.lattice.cell().sites) == 1

    def places(self, place: Indices) -> Indices:
        """The flat places here of some on the scene's raster."""
        if self.is_the_scenes:
            return place
        found: Indices = np.ravel_multi_index(tuple(self.index(place).T), self.shape)
        return found

    def index(self, place: Indices) -> Indices:
        """The same as (row, place)."""
        if self.is_the_scenes:
            return np.stack(np.unravel_index(place, self.shape), axis=-1)
        raster = self.scene.raster
        cell = raster.lattice.cell()
        s, *cells = np.unravel_index(place, raster.shape)
        whole = np.stack(cells, axis=-1) + raster.first
        sites = np.array([site.primitive for site in cell.sites])
        found: Indices = whole @ np.array(cell.primitive) + sites[s] - self.low
        return found


def primitive_step(scene: Scene, slot: Slot) -> Index:
    """Where a slot leads in the primitive basis."""
    return scene.neighbourhood.cell.primitive_step(slot.source, slot.target, slot.cell)
