"""Loads on a raster: the distribution of each load over particles, and the forces at a moment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells, patches
from pbdkit.lattice.raster import Raster, Restriction
from pbdkit.model.boundary_conditions import Load
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.lattice import Tiling, signed_area
from pbdkit.plugin.schedule import TimeDependent
from pbdkit.scene.selection import Selecting, shares_of

Planes = NDArray[np.floating[Any]]
"""Type of the force on each particle, (axis, sublattice, cell, cell)."""


@dataclass(frozen=True)
class Loading:
    """Load with its particles.

    Parameters
    ----------
    load
        The load in the experiment.
    rows, place
        Rows and flat places of its particles.
    share
        Fraction of the force that acts on each particle. For a body force it is the area of each
        particle.
    """

    load: Load
    rows: Indices
    place: Indices
    share: Floats

    def restrict(self, to: Restriction) -> Loading:
        """Return the load restricted to the particles of some rows."""
        is_moving = to.is_moving(self.place)
        rows, place = to.rows(self.rows[is_moving]), to.places(self.place[is_moving])
        return replace(self, rows=rows, place=place, share=self.share[is_moving])


@dataclass
class Loads:
    """Loads of a scene.

    Parameters
    ----------
    each
        The loads.
    shape
        Shape of the raster.
    held_at
        Moment at which the loads are evaluated. If it is None, they are evaluated at each step.
    factor
        Number by which the forces are multiplied.
    """

    each: tuple[Loading, ...]
    shape: tuple[int, ...]
    held_at: float | None = None
    factor: float = 1.0
    _last: tuple[Any, Planes] | None = field(default=None, repr=False)

    def restrict(self, to: Restriction) -> Loads:
        """Return the loads restricted to the particles of some rows."""
        each = tuple(loading.restrict(to) for loading in self.each)
        return Loads(each, to.part.shape, self.held_at, self.factor)

    def at(self, moment: float, dtype: Any) -> Planes:
        """Return the forces at the end of a step, or at a moment within it. The array is shared and
        must not be changed."""
        moment = moment if self.held_at is None else self.held_at
        forces = [loading.load.force_at(moment).tolist() for loading in self.each]
        key = self.factor, forces, np.dtype(dtype)
        if self._last is None or self._last[0] != key:
            planes = self._sum(moment)
            if self.factor != 1.0:
                planes *= self.factor
            self._last = key, planes.astype(dtype, copy=False)
        return self._last[1]

    def _sum(self, moment: float) -> Planes:
        forces = [np.outer(part.load.force_at(moment), part.share) for part in self.each]
        planes = np.zeros((len(forces[0]), *self.shape))
        for loading, force in zip(self.each, forces, strict=True):
            planes.reshape(len(planes), -1)[:, loading.place] += force
        return planes

    def changes(self, steps: int) -> list[int]:
        """Return the steps of a run in which loads begin and cease to act."""
        every = {step for loading in self.each for step in loading.load.changes()}
        return sorted(step for step in every if step <= steps)

    @property
    def time_dependent(self) -> list[TimeDependent[float]]:
        """Time-dependent forces of all loads."""
        return [number for loading in self.each for number in loading.load.time_dependent]

    def next_change(self, step: int) -> float:
        """Return the first step after `step` at which the forces change, or infinity."""
        steps = [change for loading in self.each for change in loading.load.changes()]
        steps = [change for change in steps if change > step]
        return min([*steps, *(c.next_change(step) for c in self.time_dependent)], default=math.inf)

    def relative_change(self, begin: float, end: float) -> float:
        """Return the largest relative change of a load between two moments."""
        loads = (loading.load for loading in self.each)
        changes = [abs(load.amplitude(end) - load.amplitude(begin)) for load in loads]
        return max(
            [*changes, *(number.relative_change(begin, end) for number in self.time_dependent)]
        )


def build_loads(
    raster: Raster, tiling: Tiling, cells: WeighedCells | None, experiment: Experiment
) -> Loads | None:
    """Find the particles of every load, and the fraction of the load that acts on each particle.

    Returns
    -------
    Loads or None
        The result is None if the experiment has no loads.

    Raises
    ------
    ExperimentError
        If a load selects no particle or a frame point, or a force is not finite.
    """
    body, loads = Selecting(raster, experiment.regions), list[Loading]()
    for n, load in enumerate(experiment.loads):
        rows = body.select(load.select, ("loads", n, "select"))
        place = raster.place_of(rows)
        share = (
            shares_of(raster, rows) if load.force else _areas(raster, tiling, cells).ravel()[place]
        )
        loads.append(Loading(load, rows, place, share))
        with np.errstate(all="ignore"):
            moments = [
                load.from_,
                *(knot for number in load.time_dependent for knot in number.breakpoints),
            ]
            forces = [load.force_at(moment) * share.sum() for moment in moments]
            finite = np.isfinite(forces).all()
        if not finite:
            raise ExperimentError("the force is not finite; reduce it", ("loads", n))
    return Loads(tuple(loads), raster.shape) if loads else None


def _areas(raster: Raster, tiling: Tiling, cells: WeighedCells | None) -> Floats:
    """Return the area of each particle, (sublattice, cell, cell).

    The weighted area of every cell is divided equally among its corners. If cells are not weighted,
    each particle has the area of a site of the lattice.
    """
    cell = raster.cell
    if cells is None or cells.share is None:
        return np.full(raster.shape, abs(np.linalg.det(cell.vectors)) / len(cell.sites))
    area = np.zeros(raster.shape)
    for patch in patches(raster, tiling):
        corners = patch.polygon.rest
        area_of_corner = float(signed_area(corners)) / len(corners) * cells.of(patch) * patch.whole
        for corner in patch.corners:
            corner.of(area)[...] += area_of_corner
    return area
