"""Selections of body particles in the reference configuration, and the distribution of a force over
selected particles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.lattice.raster import FOLLOWER, NOWHERE, Raster, distinct
from pbdkit.model.bodies import Body
from pbdkit.plugin import Pair
from pbdkit.plugin.operation import Selection
from pbdkit.scene.constants import signed_distance

COLLINEAR_RTOL = 1e-9
"""Distance from a line, relative to the length of the line, up to which a particle counts as lying
on it."""


def shares_of(raster: Raster, rows: Indices) -> Floats:
    """Return the fraction of a force that acts on each of the selected particles of a raster,
    (particle,)."""
    local = rows[raster.is_own(raster.site_of(rows)[:, 0])]
    parts = raster.communicator.allgather((raster.particle_offset + local, raster.reference(local)))
    numbers, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    return np.asarray(shares(at)[np.searchsorted(numbers, raster.particle_offset + rows)])


def shares(at: Floats) -> Floats:
    """Distribute a force over particles.

    Parameters
    ----------
    at
        Reference positions, (particle, axis).

    Returns
    -------
    NDArray
        Fraction of the force that acts on each particle, (particle,). If all particles lie on a
        line, the fraction is proportional to half the sum of the distances to the two adjacent
        particles. Otherwise it is the same for all particles.
    """
    order = np.lexsort(at.T)
    offset = at - at[order[0]]
    x, y = along = offset[order[-1]]
    squared = along @ along
    if len(at) == 1 or (np.abs(offset @ [-y, x]) > COLLINEAR_RTOL * squared).any():
        return np.full(len(at), 1.0 / len(at))
    half = np.diff((offset @ along)[order]) / (2 * squared)
    share = np.empty(len(at))
    share[order] = np.append(half, 0.0) + np.append(0.0, half)
    return share


@dataclass(frozen=True)
class Selecting:
    """Select body particles of a raster.

    Parameters
    ----------
    raster
        Particles of the scene.
    regions
        Named regions of the experiment.
    """

    raster: Raster
    regions: Mapping[str, Body] = field(default_factory=dict)

    @cached_property
    def _body(self) -> Indices:
        return self.raster.body_rows

    @cached_property
    def _x(self) -> Floats:
        return self.raster.reference(self._body)

    def distance(self, point: Pair) -> Floats:
        """Return the distance of each body particle, in its reference position, from a point,
        (particle,)."""
        return np.asarray(np.hypot(*(self._x - point).T))

    def select(self, selection: Selection, where: tuple[str | int, ...]) -> Indices:
        """Return the rows of the selected body particles, sorted.

        Raises
        ------
        ExperimentError
            If no particle is selected, or the selection refers to a particle or region that does
            not exist.
        """
        if selection.edge is not None:
            rows = self._edge(selection.edge)
        elif selection.box is not None:
            rows = self._box(selection.box)
        elif selection.numbers is not None:
            rows = _numbers(self.raster, selection.numbers, (*where, "numbers"))
        elif selection.region is not None:
            rows = self._region(selection.region, (*where, "region"))
        else:
            rows = self.nearest(selection.nearest or ())
        if not self.raster.communicator.any(len(rows)):
            low, high = (np.round(f(self._x, axis=0), 6).tolist() for f in (np.min, np.max))
            text = f"selects no particle; the body extends from {low} to {high} lattice units"
            raise ExperimentError(text, where)
        return distinct(rows)

    def _edge(self, edge: str) -> Indices:
        """Return the body particle with the smallest or the largest i in every row j, or with the
        smallest or the largest j in every column i."""
        axis = 0 if edge in ("left", "right") else 1
        return self.raster.ends_of_lines(axis, last=edge in ("right", "top"))

    def _box(self, box: tuple[float, float, float, float]) -> Indices:
        slack = 1e-9 * spacing(self.raster)
        low, high = np.array(box[:2]) - slack, np.array(box[2:]) + slack
        return self._body[((self._x >= low) & (self._x <= high)).all(axis=1)]

    def _region(self, name: str, where: tuple[str | int, ...]) -> Indices:
        if name not in self.regions:
            names = ", ".join(self.regions) or "the experiment has no `regions`; add them"
            hint = did_you_mean(name, self.regions)
            raise ExperimentError(f"there is no region '{name}'{hint} (known: {names})", where)
        distance = signed_distance(self.regions[name], self.raster.cell, *self._x.T)
        return self._body[distance <= 0.0]

    def nearest(self, points: Iterable[Pair]) -> Indices:
        """Return the row of the particle nearest to each point. Of equally near particles the one
        with the lowest number is chosen."""
        targets, raster = list(points), self.raster
        smallest = self.least_distances(targets)
        numbers = np.full(len(targets), NOWHERE)
        for n, point in enumerate(targets):
            ties = self.distance(point) <= smallest[n] * (1 + 1e-9) + 1e-12 * spacing(raster)
            if ties.any():
                numbers[n] = raster.particle_offset + self._body[np.argmax(ties)]
        rows = raster.communicator.smallest(numbers) - raster.particle_offset
        return rows[(rows >= 0) & (rows < raster.count)].astype(np.intp)

    def least_distances(self, points: Iterable[Pair]) -> Floats:
        """Return the distance of each point from the nearest body particle, (point,)."""
        distances = [self.distance(point).min(initial=np.inf) for point in points]
        return np.asarray(self.raster.communicator.smallest(np.array(distances)))


def spacing(raster: Raster) -> float:
    """Return the length of the first vector of the lattice."""
    return math.hypot(*raster.cell.vectors[0])


def _numbers(raster: Raster, numbers: tuple[int, ...], where: tuple[str | int, ...]) -> Indices:
    rows = []
    for n, number in enumerate(numbers):
        if number > raster.total:
            raise ExperimentError(
                f"there is no particle {number}; they are numbered 1 to {raster.total}", (*where, n)
            )
        if not 0 <= (row := number - 1 - raster.particle_offset) < raster.count:
            continue
        if raster.table_kind[row] != FOLLOWER:
            raise ExperimentError(
                f"particle {number} is a frame point; select particles of the body", (*where, n)
            )
        rows.append(row)
    return np.array(rows, np.intp)
