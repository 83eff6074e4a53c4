"""A part of a scene as a scene of its own: its rows of everything that a scene has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.ranks.subdomain import Subdomain
from pbdkit.scene.cells import WeighedCells
from pbdkit.scene.frame_points import Frame
from pbdkit.scene.homes import SceneConstants
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.loads import Loads
from pbdkit.scene.others import ALONE
from pbdkit.scene.places import Mask
from pbdkit.scene.raster import EMPTY, FOLLOWER, FRAME, Extent, Raster
from pbdkit.scene.scene import Scene

Array = NDArray[Any]


@dataclass(frozen=True)
class Part:
    """A subdomain's part of a scene: the scene of the part, and what is known of the whole.
    `ours` are which particles of each leader group that the part has are of its own rows, and
    `early` how many of these groups' particles come before."""

    subdomain: Subdomain
    scene: Scene
    ours: tuple[Mask, ...]
    early: tuple[int, ...]
    rows: slice
    """Of the table of its scene, those of its own particles."""


def part_of(scene: Scene, subdomain: Subdomain) -> Part:
    """That part of a scene that has these rows and more around them, or all."""
    window = _Window(scene.raster, subdomain)
    places = [each.place[window.leads(each)] for each in scene.leading]
    ours, early = map(window.has_own, places), map(window.comes_before, places)
    return Part(
        subdomain,
        window.scene(scene),
        tuple(ours),
        tuple(int(these.sum()) for these in early),
        window.own_rows,
    )


class _Window:
    """The rows of a part on a raster that has more, of the whole or of its surroundings."""

    def __init__(self, raster: Raster, subdomain: Subdomain) -> None:
        before = raster.extent.before if raster.extent else 0
        self._whole, self._sub = raster, (subdomain := subdomain.after(before))
        self._axes = len(raster.shape) - 1
        period = raster.lattice.cell().period[0]
        lines = raster.sites.shape[0]

        def line(row: int) -> int:
            """The first line of sites of a row of cells, in the table."""
            return int(np.clip((raster.first[0] + row) * period - raster.low[0], 0, lines))

        low, high = line(subdomain.low), line(subdomain.high)
        sites, kind = raster.sites[low:high].copy(), subdomain.cut(raster.kind, self._axes)
        seen, inner = (of(raster.shape[1]) for of in (subdomain.seen, subdomain.inner))
        for rows, before, after in ((inner, FOLLOWER, FRAME), (seen, FRAME, EMPTY)):
            moved = np.moveaxis(kind, 1, 0)
            for of, (a, b), at in ((sites, map(line, rows), low), (moved, rows, subdomain.low)):
                for outside in (of[: a - at], of[b - at :]):
                    outside[outside == before] = after
        counts = np.cumsum([0, *np.count_nonzero(raster.sites != EMPTY, axis=_others(sites))])
        first = (raster.first[0] + subdomain.low, *raster.first[1:])
        self.raster = replace(
            raster,
            shape=kind.shape,
            first=first,
            kind=kind,
            low=(raster.low[0] + low, *raster.low[1:]),
            sites=sites,
            before=raster.before + int(counts[line(seen[0])]),
            extent=Extent(raster.row_counts, before + subdomain.low),
            others=ALONE,
        )
        ends = (subdomain.begin, subdomain.end)
        begin, end = (counts[line(row)] - counts[line(seen[0])] for row in ends)
        self.own_rows = slice(int(begin), int(end))

    def scene(self, scene: Scene) -> Scene:
        """The part of a scene on it."""
        frame, inner = scene.frame, scene.inner
        return replace(
            scene,
            raster=self.raster,
            constants=self._constants(scene.constants),
            frame=self._frame(frame) if frame else None,
            cells=self._cells(scene.cells) if scene.cells else None,
            inner=self.scene(inner) if inner else None,
            leading=tuple(map(self._leading, scene.leading)),
            loads=self._loads(scene.loads) if scene.loads else None,
        )

    def leads(self, leading: Leading) -> Mask:
        """Which particles of a group the part has; masses only where their neighbours are known."""
        masses = leading.share is not None
        rows = (self._sub.inner if masses else self._sub.seen)(self._whole.shape[1])
        return self._between(leading.place, *rows)

    def moves(self, place: Indices) -> Mask:
        """Which places of the whole lie in rows of the part that do not stand still."""
        return self._between(place, *self._sub.inner(self._whole.shape[1]))

    def has_own(self, place: Indices) -> Mask:
        """Which lie in its own rows."""
        return self._between(place, self._sub.begin, self._sub.end)

    def comes_before(self, place: Indices) -> Mask:
        """Which lie in rows before these."""
        return self._between(place, 0, self._sub.begin)

    def _between(self, place: Indices, low: int, high: int) -> Mask:
        row = np.unravel_index(place, self._whole.shape)[1]
        return np.asarray((row >= low) & (row < high))

    def _places(self, place: Indices) -> Indices:
        """The same places on the raster of the part."""
        s, row, *rest = np.unravel_index(place, self._whole.shape)
        return np.ravel_multi_index((s, row - self._sub.low, *rest), self.raster.shape)

    def _cut(self, planes: Array) -> Array:
        return self._sub.cut(planes, self._axes)

    def _constants(self, constants: SceneConstants) -> SceneConstants:
        kinds = constants.by_particle, constants.by_bond
        cut = [{name: self._cut(planes) for name, planes in kind.items()} for kind in kinds]
        return replace(constants, by_particle=cut[0], by_bond=cut[1])

    def _leading(self, leading: Leading) -> Leading:
        some = self.leads(leading)
        return replace(
            leading,
            rows=leading.rows[some] - self.raster.before + self._whole.before,
            place=self._places(leading.place[some]),
            reference=leading.reference[some],
            share=None if leading.share is None else leading.share[some],
        )

    def _frame(self, frame: Frame) -> Frame | None:
        """The points whom the part can let follow; the others are renewed with the halo."""
        counts, follow = len(frame.place), frame.map
        known = self._between(frame.body_place, *self._sub.seen(self._whole.shape[1]))
        some = self.moves(frame.place) & (np.bincount(follow.point[~known], minlength=counts) == 0)
        if not some.any():
            return None
        entries = some[follow.point]
        point = (np.cumsum(some) - 1)[follow.point[entries]]
        body = follow.body[entries] - self.raster.before + self._whole.before
        cut = replace(follow, point=point, body=body, weight=follow.weight[entries])
        place = self._places(frame.place[some])
        return Frame(place, cut, self._places(frame.body_place[entries]))

    def _cells(self, cells: WeighedCells) -> WeighedCells:
        share = None if cells.share is None else self._cut(cells.share)
        weight = (
            share if cells.weight is cells.share and share is not None else self._cut(cells.weight)
        )
        phase = None if cells.phase is None else self._cut(cells.phase)
        mixed = tuple(map(self._cut, cells.mixed))
        return replace(cells, share=share, weight=weight, mixed=mixed, phase=phase)

    def _loads(self, loads: Loads) -> Loads:
        each = []
        for one in loads.each:
            some = self.moves(one.place)
            rows = one.rows[some] - self.raster.before + self._whole.before
            place, share = self._places(one.place[some]), one.share[some]
            each.append(replace(one, rows=rows, place=place, share=share))
        return Loads(tuple(each), self.raster.shape, loads.held_at)


def _others(sites: Array) -> Sequence[int]:
    return tuple(range(1, sites.ndim))
