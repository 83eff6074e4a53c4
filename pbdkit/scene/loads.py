"""Loads on a raster: who bears which share, and what acts at a moment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells, patches
from pbdkit.lattice.raster import Floats, Raster
from pbdkit.model.boundary_conditions import Load
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.lattice import Tiling, signed_area
from pbdkit.plugin.schedule import Course
from pbdkit.scene.selection import Selecting, shares_of

STRAIGHT = 1e-9
"""Particles that lie off a line by less than this share of its length are on it."""
Planes = NDArray[np.floating[Any]]
"""The force on each particle, (axis, sublattice, cell, cell)."""


@dataclass(frozen=True)
class Loading:
    """A load with the rows and places of its particles, and what each bears of it: a `share` of
    the whole force, or the area of a body force."""

    load: Load
    rows: Indices
    place: Indices
    share: Floats


@dataclass
class Loads:
    """The loads of a scene. They go on with the steps, or stand as at the moment `held_at`."""

    each: tuple[Loading, ...]
    shape: tuple[int, ...]
    held_at: float | None = None
    _last: tuple[Any, Planes] | None = field(default=None, repr=False)

    def at(self, moment: float, dtype: Any) -> Planes:
        """What acts at the end of a step, or at a moment within it; nobody writes to it."""
        moment = moment if self.held_at is None else self.held_at
        forces = [loading.load.force_at(moment).tolist() for loading in self.each]
        key = forces, np.dtype(dtype)
        if self._last is None or self._last[0] != key:
            self._last = key, self._sum(moment).astype(dtype, copy=False)
        return self._last[1]

    def _sum(self, moment: float) -> Planes:
        forces = [np.outer(each.load.force_at(moment), each.share) for each in self.each]
        planes = np.zeros((len(forces[0]), *self.shape))
        for loading, force in zip(self.each, forces, strict=True):
            planes.reshape(len(planes), -1)[:, loading.place] += force
        return planes

    def changes(self, steps: int) -> list[int]:
        """The steps of a run in which loads begin and cease to act."""
        every = {step for loading in self.each for step in loading.load.changes()}
        return sorted(step for step in every if step <= steps)

    @property
    def courses(self) -> list[Course[float]]:
        """Of forces that change while they act."""
        return [course for loading in self.each for course in loading.load.courses]

    def next_change(self, step: int) -> float:
        """The first step after `step` in which others act; infinite where there is none."""
        every = [change for loading in self.each for change in loading.load.changes()]
        every = [change for change in every if change > step]
        return min([*every, *(c.next_change(step) for c in self.courses)], default=math.inf)

    def way(self, begin: float, end: float) -> float:
        """By what share the load that changes most does between two moments."""
        loads = (loading.load for loading in self.each)
        come = [abs(load.amplitude(end) - load.amplitude(begin)) for load in loads]
        return max([*come, *(course.way(begin, end) for course in self.courses)])


def build_loads(
    raster: Raster, tiling: Tiling, cells: WeighedCells | None, experiment: Experiment
) -> Loads | None:
    """Every load with its particles; None where there is none. Raises ExperimentError for a load
    that selects nobody or a frame point, and where forces leave the finite numbers."""
    body, found = Selecting(raster, experiment.regions), list[Loading]()
    for n, load in enumerate(experiment.loads):
        rows = body.select(load.select, ("loads", n, "select"))
        place = raster.place_of(rows)
        share = (
            shares_of(raster, rows) if load.force else _areas(raster, tiling, cells).ravel()[place]
        )
        found.append(Loading(load, rows, place, share))
        with np.errstate(all="ignore"):
            moments = [load.from_, *(bend for course in load.courses for bend in course.bends)]
            forces = [load.force_at(moment) * share.sum() for moment in moments]
            finite = np.isfinite(forces).all()
        if not finite:
            raise ExperimentError("leaves the finite numbers", ("loads", n))
    return Loads(tuple(found), raster.shape) if found else None


def _areas(raster: Raster, tiling: Tiling, cells: WeighedCells | None) -> Floats:
    """(sublattice, cell, cell): the area that belongs to each particle: an equal part of every cell
    that meets there, as far as it is weighed; where no cells are weighed, a site's of the lattice.
    """
    cell = raster.lattice.cell()
    if cells is None or cells.share is None:
        return np.full(raster.shape, abs(np.linalg.det(cell.vectors)) / len(cell.sites))
    area = np.zeros(raster.shape)
    for patch in patches(raster, tiling):
        corners = patch.polygon.rest
        each = float(signed_area(corners)) / len(corners) * cells.of(patch) * patch.whole
        for corner in patch.corners:
            corner.of(area)[...] += each
    return area
