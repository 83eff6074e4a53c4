"""The frame of a scene: which body particles each of its points is nearest to."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER, FRAME, Raster, bounds, distinct
from pbdkit.plugin import FollowerRule, FrameMap, FramePolicy, FrameSites
from pbdkit.plugin.frame import Indices

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Frame:
    """The frame's points and their map on the raster: u[place[point]] = Σ weight · u[body].

    `depends_on_rule` is true where the policy read the rule to make the map.
    """

    place: Indices
    map: FrameMap
    body_place: Indices
    depends_on_rule: bool = False

    def follow(self, body: Floats, out: Floats) -> None:
        """Writes the frame's displacements into `out`; both are (axis, flat place)."""
        u = body[:, self.body_place]
        weight = self.map.weight
        weighted = weight * u if weight.ndim == 1 else np.einsum("eab,be->ae", weight, u)
        for plane, values in zip(out, weighted, strict=True):
            plane[self.place] = np.bincount(self.map.point, values, len(self.place))


def build_frame(raster: Raster, policy: FramePolicy, rule: FollowerRule) -> Frame | None:
    """The policy's map for this raster; None where the scene has no frame."""
    frame = sites_of_frame(raster, rule)
    if frame is None:
        return None
    rows = frame.frame_rows
    follow = policy.follow(frame)
    _refuse_unfit(follow, len(rows), raster)
    says = np.abs(follow.weight).reshape(len(follow.point), -1).max(axis=1, initial=0.0) > 0.0
    alone = np.flatnonzero(np.bincount(follow.point[says], minlength=len(rows)) == 0)
    if len(alone):
        raise ExperimentError(
            f"'{policy.type}' gives frame point {rows[alone[0]] + 1} nobody to follow, "
            "and it would anchor the body"
        )
    place, body_place = raster.place_of(rows), raster.place_of(follow.body)
    return Frame(place, follow, body_place, depends_on_rule=bool(frame.reads))


def sites_of_frame(raster: Raster, rule: FollowerRule) -> RasterFrame | None:
    """The frame points of a raster as a policy sees them; None where there are none."""
    rows = np.flatnonzero(raster.table_kind == FRAME)
    body = bounds(raster.sites == FOLLOWER)
    assert body
    low, high = (tuple(map(add, raster.low, end)) for end in body)
    low, high = raster.hull_of_all([(low, tuple(n - 1 for n in high))])
    rows = rows[raster.sees_frame(raster.site_of(rows)[:, 0])]
    if not len(rows):
        return None
    site = raster.site_of(rows).astype(np.int32)
    return RasterFrame(raster.lattice.cell(), site, low, high, raster, rows, rule)


def _refuse_unfit(follow: FrameMap, points: int, raster: Raster) -> None:
    entries, axes = len(follow.point), raster.sites.ndim
    shapes = [(entries,), (entries, axes, axes)]
    if len(follow.body) != entries or np.shape(follow.weight) not in shapes:
        raise ExperimentError(
            "its map needs one point, body and weight (or square matrix) an entry"
        )
    if ((follow.point < 0) | (follow.point >= points)).any():
        raise ExperimentError(f"its map names a frame point outside 0 to {points - 1}")
    if (np.diff(follow.point) < 0).any():
        raise ExperimentError("its map is not sorted by frame point")
    known = (follow.body >= 0) & (follow.body < raster.count)
    if not known.all() or (raster.table_kind[follow.body] != FOLLOWER).any():
        raise ExperimentError("its map follows what is no particle of the body")
    if not np.isfinite(follow.weight).all() or follow.lag not in (0, 1):
        raise ExperimentError("its map has weights that are not finite, or a lag other than 0 or 1")


@dataclass(frozen=True)
class RasterFrame(FrameSites):
    """The frame points of a raster; `frame_rows` are their rows in the table. `reads` has an entry
    for each time that the policy read the rule."""

    raster: Raster
    frame_rows: Indices
    followers_rule: FollowerRule
    reads: list[None] = field(default_factory=list)

    @property
    def rule(self) -> FollowerRule:
        """The rule, whose reading is noted."""
        self.reads.append(None)
        return self.followers_rule

    def body_at(self, site: NDArray[np.int32]) -> Indices:
        """Looks the sites up on the raster."""
        rows = self.raster.rows_of_sites(site)
        return np.where(self.raster.table_kind[rows] == FOLLOWER, rows, -1)

    def nearest(self) -> tuple[Indices, Indices]:
        """Searches outwards from every frame point, shell of sites by shell, until all have met
        the body and every tie is in."""
        sublattice = self.raster.cells_of(self.frame_rows)[0]
        own = ((s, np.flatnonzero(sublattice == s)) for s in distinct(sublattice))
        pairs = [pair for s, points in own for pair in self._nearest_of(s, points)]
        point, body = (np.concatenate(part) for part in zip(*pairs, strict=True))
        order = np.lexsort((body, point))
        return point[order], body[order]

    def _nearest_of(self, sublattice: int, points: Indices) -> Iterator[tuple[Indices, Indices]]:
        """Of the points of a sublattice, offset by offset, those with a body particle there and
        none nearer."""
        nearest = np.full(len(points), np.inf)
        searched, radius = 0.0, max(math.hypot(*v) for v in self.cell.vectors)
        while (_with_ties(nearest) > searched).any():
            for offset in self.cell.offsets(sublattice, radius):
                if offset.length > searched:
                    open_ = np.flatnonzero(offset.length <= _with_ties(nearest))
                    body = self.body_at(self.site[points[open_]] + offset.site)
                    open_, body = open_[body >= 0], body[body >= 0]
                    nearest[open_] = np.minimum(nearest[open_], offset.length)
                    yield points[open_], body
            searched, radius = radius, radius * 1.5


def _with_ties(distance: Floats) -> Floats:
    """The distance up to which another particle counts as equally near (model.md, section 7)."""
    return distance * (1 + 1e-9)
