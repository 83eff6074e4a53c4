"""Who moves whom in a scene, as long as the roles stay: followers in an order in which those that
move each other are near, and the frame put in terms of the body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import frame_matrices
from pbdkit.analysis.linear_response import by_sublattice
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.places import slot_step
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Entry = tuple[Indices, Indices, Indices, Floats]


@dataclass(frozen=True)
class Pattern:
    """`place` is the flat place of each follower. Follower e is moved by the entries from
    `first[e]` to `first[e + 1]`: through a `slot` (that after the last: by itself), by the follower
    `column`, times a `weight` (entry, axis, axis). `reach` is how far a column lies from e."""

    place: Indices
    first: Indices
    slot: Indices
    column: Indices
    weight: Floats

    @property
    def reach(self) -> int:
        """The half width of the band."""
        row = np.repeat(np.arange(len(self.place)), np.diff(self.first))
        return int(np.abs(row - self.column).max(initial=0))

    @property
    def alike(self) -> bool:
        """Whether all axes follow alike."""
        axes = self.weight.shape[-1]
        return bool((self.weight == self.weight[:, :1, :1] * np.eye(axes)).all())


def pattern_at(scene: Scene, step: int) -> Pattern:
    """With the roles of a step; followers row by row or column by column, what lies nearer."""
    rows = np.flatnonzero(kinds_at(scene.raster, scene.leading, step) == FOLLOWER)
    places, (x, y) = scene.raster.place_of(rows), scene.raster.reference(rows).round(6).T
    found = (_pattern(scene, places[np.lexsort(keys)]) for keys in ((x, y), (y, x)))
    return min(found, key=lambda pattern: pattern.reach)


def _pattern(scene: Scene, place: Indices) -> Pattern:
    parts = [*_entries(scene, place.astype(np.int64))]
    row, slot, column, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((slot, row))
    first = np.searchsorted(row[order], np.arange(len(place) + 1))
    return Pattern(
        place.astype(np.int64), first, slot[order], column[order], weight[order].astype(float)
    )


def _entries(scene: Scene, place: Indices) -> Iterator[Entry]:
    """(follower, slot, column, weight) of some entries at a time."""
    size, one = scene.raster.kind.size, np.eye(scene.axes)
    column_at = np.full(size, -1)
    every = column_at[place] = np.arange(len(place))

    def entries(rows: Indices, slot: int, there: Indices, weight: Floats) -> Entry:
        free = column_at[there] >= 0
        slots = np.full(np.count_nonzero(free), slot)
        return rows[free], slots, column_at[there[free]], weight[free]

    for s, own in by_sublattice(scene, place):
        ones = np.broadcast_to(one, (len(own), *one.shape))
        count = len(scene.neighbourhood.slots[s])
        yield entries(every[own], count, place[own], ones)
        for k, slot in enumerate(scene.neighbourhood.slots[s]):
            there = place[own] + slot_step(scene.raster.shape, slot)
            yield entries(every[own], k, there, ones)
            for some, body, weight in _followed(scene, there):
                yield entries(every[own][some], k, body, weight)


def _followed(scene: Scene, there: Indices) -> Iterator[tuple[Indices, Indices, Floats]]:
    """Which of some places are frame points, with a body place each that they follow and its
    weight: the first of each, then the second, and so on."""
    if (frame := scene.frame) is None:
        return
    point_at = np.full(scene.raster.kind.size, -1)
    point_at[frame.place] = np.arange(len(frame.place))
    some = np.flatnonzero(point_at[there] >= 0)
    first, last = (
        np.searchsorted(frame.map.point, point_at[there[some]], side) for side in ("left", "right")
    )
    matrices = frame_matrices(frame.map.weight, scene.axes)
    for e in range(int((last - first).max(initial=0))):
        has = first + e < last
        entry = (first + e)[has]
        yield some[has], frame.body_place[entry], matrices[entry]
