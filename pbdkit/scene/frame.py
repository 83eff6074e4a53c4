"""Frame of a scene: its points, and the body particles that each point follows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from operator import add

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER, FRAME, Raster, Restriction, bounds, distinct
from pbdkit.plugin import FollowerRule, FrameMap, FramePolicy, FrameSites


@dataclass(frozen=True)
class Frame:
    """Frame points and their map on the raster: u[place[point]] = Σ weight · u[body].

    Parameters
    ----------
    place
        Flat place of each frame point.
    map
        Map of the frame policy.
    body_place
        Flat place of the body particle of each entry of the map.
    depends_on_rule
        Whether the policy used the rule to create the map.
    """

    place: Indices
    map: FrameMap
    body_place: Indices
    depends_on_rule: bool = False

    def follow(self, body: Floats, out: Floats) -> None:
        """Compute the displacements of the frame points from `body`, and write them to `out`. Both
        arrays are (axis, flat place)."""
        u = body[:, self.body_place]
        weight = self.map.weight
        weighted = weight * u if weight.ndim == 1 else np.einsum("eab,be->ae", weight, u)
        for plane, values in zip(out, weighted, strict=True):
            plane[self.place] = np.bincount(self.map.point, values, len(self.place))

    def restrict(self, to: Restriction) -> Frame | None:
        """Return the frame restricted to given rows. A point is retained if it follows only
        particles of these rows. Return None if no point is retained."""
        missing = self.map.point[~to.is_present(self.body_place)]
        has_missing = np.bincount(missing, minlength=len(self.place)) > 0
        is_resolved = to.is_moving(self.place) & ~has_missing
        if not is_resolved.any():
            return None
        entries = is_resolved[self.map.point]
        point = (np.cumsum(is_resolved) - 1)[self.map.point[entries]]
        body, weight = to.rows(self.map.body[entries]), self.map.weight[entries]
        part = replace(self.map, point=point, body=body, weight=weight)
        return Frame(to.places(self.place[is_resolved]), part, to.places(self.body_place[entries]))


def build_frame(raster: Raster, policy: FramePolicy, rule: FollowerRule) -> Frame | None:
    """Build the frame of a raster with the map of a policy, or None if there are no frame points.

    Raises
    ------
    ExperimentError
        If the map is malformed, or a frame point follows no particle.
    """
    frame = sites_of_frame(raster, rule)
    if frame is None:
        return None
    rows = frame.frame_rows
    follow = policy.follow(frame)
    _refuse_unfit(follow, len(rows), raster)
    has_weight = np.abs(follow.weight).reshape(len(follow.point), -1).max(axis=1, initial=0.0) > 0.0
    unmapped = np.flatnonzero(np.bincount(follow.point[has_weight], minlength=len(rows)) == 0)
    if len(unmapped):
        raise ExperimentError(
            f"'{policy.type}' maps frame point {rows[unmapped[0]] + 1} to no particle of the body, "
            "so that the point would be fixed in space; map every frame point"
        )
    place, body_place = raster.place_of(rows), raster.place_of(follow.body)
    return Frame(place, follow, body_place, depends_on_rule=bool(frame.reads))


def sites_of_frame(raster: Raster, rule: FollowerRule) -> RasterFrame | None:
    """Return the frame points of a raster as input of a policy, or None if there are none."""
    rows = np.flatnonzero(raster.table_kind == FRAME)
    body = bounds(raster.sites == FOLLOWER)
    assert body
    low, high = (tuple(map(add, raster.low, end)) for end in body)
    low, high = raster.hull_of_all([(low, tuple(n - 1 for n in high))])
    rows = rows[raster.sees_frame(raster.site_of(rows)[:, 0])]
    if not len(rows):
        return None
    site = raster.site_of(rows).astype(np.int32)
    return RasterFrame(raster.cell, site, low, high, raster, rows, rule)


def _refuse_unfit(follow: FrameMap, points: int, raster: Raster) -> None:
    entries, axes = len(follow.point), raster.sites.ndim
    shapes = [(entries,), (entries, axes, axes)]
    if len(follow.body) != entries or np.shape(follow.weight) not in shapes:
        raise ExperimentError(
            "its map must have one point, body and weight (or square matrix) for each entry"
        )
    if ((follow.point < 0) | (follow.point >= points)).any():
        raise ExperimentError(f"its map has a frame point outside the range 0 to {points - 1}")
    if (np.diff(follow.point) < 0).any():
        raise ExperimentError("its map is not sorted by frame point")
    is_row = (follow.body >= 0) & (follow.body < raster.count)
    if not is_row.all() or (raster.table_kind[follow.body] != FOLLOWER).any():
        raise ExperimentError("its map refers to a row that is not a particle of the body")
    if not np.isfinite(follow.weight).all() or follow.delay not in (0, 1):
        raise ExperimentError(
            "its map has weights that are not finite, or a delay other than 0 or 1"
        )


@dataclass(frozen=True)
class RasterFrame(FrameSites):
    """Frame points of a raster.

    Parameters
    ----------
    raster
        Particles of the scene.
    frame_rows
        Rows of the frame points in the particle table.
    followers_rule
        Rule of the followers.
    reads
        One entry for each access of the policy to the rule.
    """

    raster: Raster
    frame_rows: Indices
    followers_rule: FollowerRule
    reads: list[None] = field(default_factory=list)

    @property
    def rule(self) -> FollowerRule:
        """Rule of the followers; each access is recorded in `reads`."""
        self.reads.append(None)
        return self.followers_rule

    def body_at(self, site: NDArray[np.int32]) -> Indices:
        """Return the rows of the body particles at sites, -1 where there is none."""
        rows = self.raster.rows_of_sites(site)
        return np.where(self.raster.table_kind[rows] == FOLLOWER, rows, -1)

    def nearest(self) -> tuple[Indices, Indices]:
        """Return all pairs (point, body) of a frame point and a body particle that is nearest to
        it. If several body particles are equally near, there is a pair with each of them.

        The search proceeds outward from every frame point, shell by shell.
        """
        sublattice = self.raster.cells_of(self.frame_rows)[0]
        groups = ((s, np.flatnonzero(sublattice == s)) for s in distinct(sublattice))
        pairs = [pair for s, points in groups for pair in self._nearest_of(s, points)]
        point, body = (np.concatenate(part) for part in zip(*pairs, strict=True))
        order = np.lexsort((body, point))
        return point[order], body[order]

    def _nearest_of(self, sublattice: int, points: Indices) -> Iterator[tuple[Indices, Indices]]:
        """Generate the pairs of frame points of a sublattice and nearest body particles. Offsets
        are tried one after the other.
        """
        nearest = np.full(len(points), np.inf)
        searched, radius = 0.0, max(math.hypot(*v) for v in self.cell.vectors)
        while (_with_ties(nearest) > searched).any():
            for offset in self.cell.offsets(sublattice, radius):
                if offset.length <= searched:
                    continue
                candidates = np.flatnonzero(offset.length <= _with_ties(nearest))
                if not len(candidates):
                    break  # Further offsets are longer.
                body = self.body_at(self.site[points[candidates]] + offset.site)
                candidates, body = candidates[body >= 0], body[body >= 0]
                nearest[candidates] = np.minimum(nearest[candidates], offset.length)
                yield points[candidates], body
            searched, radius = radius, radius * 1.5


def _with_ties(distance: Floats) -> Floats:
    """Return the distance up to which another particle counts as equally near."""
    return distance * (1 + 1e-9)
