"""Selections of body particles in the reference configuration, and the distribution of a total
force over a selection.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.lattice.raster import FOLLOWER, NOWHERE, Floats, Raster, distinct
from pbdkit.model.bodies import Body
from pbdkit.plugin import Pair
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.particles import Selection
from pbdkit.scene.constants import signed_distance

STRAIGHT = 1e-9
"""Particles that lie off a line by less than this share of its length are on it."""


def shares_of(raster: Raster, rows: Indices) -> Floats:
    """(particle,): the parts of a force on all that are selected, of those that a raster has."""
    own = raster.is_own(raster.site_of(rows)[:, 0])
    every = raster.communicator.allgather((raster.before + rows[own], raster.reference(rows[own])))
    numbers, at = (np.concatenate(part) for part in zip(*every, strict=True))
    return np.asarray(shares(at)[np.searchsorted(numbers, raster.before + rows)])


def shares(at: Floats) -> Floats:
    """(particle,): the part of a force that falls to each of some places, (particle, axis): half
    the way to the next one on both sides where all lie on a line, else all alike."""
    order = np.lexsort(at.T)
    way = at - at[order[0]]
    x, y = along = way[order[-1]]
    squared = along @ along
    if len(at) == 1 or (np.abs(way @ [-y, x]) > STRAIGHT * squared).any():
        return np.full(len(at), 1.0 / len(at))
    half = np.diff((way @ along)[order]) / (2 * squared)
    share = np.empty(len(at))
    share[order] = np.append(half, 0.0) + np.append(0.0, half)
    return share


@dataclass(frozen=True)
class Selecting:
    """Chooses body particles of a raster; what it looks at is made once."""

    raster: Raster
    regions: Mapping[str, Body] = field(default_factory=dict)

    @cached_property
    def _body(self) -> Indices:
        return self.raster.body_rows

    @cached_property
    def _x(self) -> Floats:
        return self.raster.reference(self._body)

    def distance(self, point: Pair) -> Floats:
        """(particle,): how far each body particle is from a point at rest."""
        return np.asarray(np.hypot(*(self._x - point).T))

    def select(self, selection: Selection, where: tuple[str | int, ...]) -> Indices:
        """The rows of the selected body particles, sorted."""
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
            text = f"selects no particle; the body reaches from {low} to {high}"
            raise ExperimentError(text, where)
        return distinct(rows)

    def _edge(self, edge: str) -> Indices:
        """The body particle of smallest or largest i in every row j, or j in every column i."""
        axis = 0 if edge in ("left", "right") else 1
        return self.raster.ends_of_lines(axis, last=edge in ("right", "top"))

    def _box(self, box: tuple[float, float, float, float]) -> Indices:
        slack = 1e-9 * spacing(self.raster)
        low, high = np.array(box[:2]) - slack, np.array(box[2:]) + slack
        return self._body[((self._x >= low) & (self._x <= high)).all(axis=1)]

    def _region(self, name: str, where: tuple[str | int, ...]) -> Indices:
        if name not in self.regions:
            known = ", ".join(self.regions) or "there is none: add `regions`"
            hint = did_you_mean(name, self.regions)
            raise ExperimentError(f"there is no region '{name}'{hint} (known: {known})", where)
        distance = signed_distance(self.regions[name], self.raster.lattice.cell(), *self._x.T)
        return self._body[distance <= 0.0]

    def nearest(self, points: Iterable[Pair]) -> Indices:
        """The row of the particle nearest to each point, the lowest number on ties."""
        every, raster = list(points), self.raster
        least = self.least_distances(every)
        numbers = np.full(len(every), NOWHERE)
        for n, point in enumerate(every):
            ties = self.distance(point) <= least[n] * (1 + 1e-9) + 1e-12 * spacing(raster)
            if ties.any():
                numbers[n] = raster.before + self._body[np.argmax(ties)]
        rows = raster.communicator.smallest(numbers) - raster.before
        return rows[(rows >= 0) & (rows < raster.count)].astype(np.intp)

    def least_distances(self, points: Iterable[Pair]) -> Floats:
        """(point,): how far each point is from the body."""
        own = [self.distance(point).min(initial=np.inf) for point in points]
        return np.asarray(self.raster.communicator.smallest(np.array(own)))


def spacing(raster: Raster) -> float:
    """The length of the lattice's first vector."""
    return math.hypot(*raster.lattice.cell().vectors[0])


def _numbers(raster: Raster, numbers: tuple[int, ...], where: tuple[str | int, ...]) -> Indices:
    found = []
    for n, number in enumerate(numbers):
        if number > raster.total:
            raise ExperimentError(
                f"there is no particle {number}; they are numbered 1 to {raster.total}", (*where, n)
            )
        if not 0 <= (row := number - 1 - raster.before) < raster.count:
            continue
        if raster.table_kind[row] != FOLLOWER:
            raise ExperimentError(
                f"particle {number} is a frame point: only body particles can lead", (*where, n)
            )
        found.append(row)
    return np.array(found, np.intp)
