"""The frame across which no traction goes (model.md, section 7)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import numpy as np

from pbdkit.components.frames import is_upright
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import FrameMap, FramePolicy, FrameSites, Stiffness
from pbdkit.interfaces.rule import material_of

NEGLIGIBLE = 1e-17
"""Weights below this, of body particles far along an edge, are left out."""
COLUMNS = 256
"""To how many displacements of the body the frame's answers are held at once."""


class TractionFree(FramePolicy):
    """One layer of points that stand where no traction crosses the edge, half a cell outside the
    outermost particles, for bodies that fill a rectangle of a square or rectangular lattice.

    Above the upper edge, with the spacings a and b: u_g = u_f - b ∂v/∂x and
    v_g = v_f - (xy/yy) b ∂u/∂x of the rule's stiffness (ν for an isotropic one in plane stress),
    ∂/∂x being the central difference along the edge, the mean of both rows (one-sided where the
    edge ends); other edges likewise, corners by extrapolation. Rotation, tension with free
    contraction and pure bending are exact.
    """

    type: Literal["traction-free"] = "traction-free"

    edges_are_free: ClassVar[bool] = True

    def depth(self, reach: int) -> int:
        """One layer."""
        return 1

    def follow(self, frame: FrameSites) -> FrameMap:
        """The points depend on one another along the edge: the map is what their equations make of
        a displacement of each body particle."""
        stiffness = material_of(frame.rule)
        if stiffness is None or frame.rule.varying.keys() - {"stiffness"}:
            raise ExperimentError(
                f"'{self.type}' needs a rule that is calibrated to one material ('elastic', "
                f"'orthotropic'; 'stiffness' may differ), which '{frame.rule.type}' is not"
            )
        equations = _Equations(frame)
        equations.balance_edges(stiffness)
        equations.extrapolate_corners()
        return equations.solved()


class _Equations:
    """M u = 0 for the displacements u at all sites of a box, of the points around it and of the
    body particles in it. Unknown 2n is x of the n-th, 2n + 1 its y; the rows count likewise, the
    points alone."""

    def __init__(self, frame: FrameSites) -> None:
        low, high = np.array(frame.low), np.array(frame.high)
        self._beyond = (frame.site > high).astype(int) - (frame.site < low)
        if (
            not is_upright(frame.cell)
            or not self._beyond.any(axis=1).all()
            or len(frame.site) != 2 * (high - low + 1).sum() + 4
        ):
            raise ExperimentError(
                "a traction-free frame needs a body that fills a rectangle of sites of a square or "
                "rectangular lattice; 'natural' takes every body"
            )
        a, b = frame.cell.vectors
        self._frame, self._site, self._spacings = frame, frame.site, (a.x, b.y)
        self._first, self._shape = low - 1, tuple(high - low + 3)
        self._entries: list[tuple[Any, Any, Any]] = []
        self._add_both(np.arange(len(frame.site)), frame.site, 1.0)

    def balance_edges(self, c: Stiffness) -> None:
        """No shear and no tension across the edges."""
        for along, contraction in ((0, c.xy / c.yy), (1, c.xy / c.xx)):
            across = 1 - along
            points = np.flatnonzero((self._beyond[:, across] != 0) & (self._beyond[:, along] == 0))
            side, step = self._beyond[points, across], np.eye(2, dtype=int)[along]
            inner = self._site[points] - side[:, None] * np.eye(2, dtype=int)[across]
            slope = side * self._spacings[across] / (2 * self._spacings[along])
            self._add_both(points, inner, -1.0)
            for some, steps in self._differences(self._site[points, along], along):
                for n, weight in steps.items():
                    for row in (self._site[points], inner):
                        there, factor = row[some] + n * step, weight * slope[some]
                        self._add(points[some], along, there, across, factor)
                        self._add(points[some], across, there, along, contraction * factor)

    def _differences(self, site: Any, along: int) -> Iterator[tuple[Any, dict[int, float]]]:
        """Which sites take which difference along the edge, as weights by step: the central one,
        and where the edge ends the one that is exact for parabolas."""
        low, high = self._first[along] + 1, self._first[along] + self._shape[along] - 2
        ends = {0: -1.5, 1: 2.0, 2: -0.5} if high - low > 1 else {0: -1.0, 1: 1.0}
        if high > low:
            yield (site > low) & (site < high), {-1: -0.5, 1: 0.5}
            yield site == low, ends
            yield site == high, {-n: -weight for n, weight in ends.items()}

    def extrapolate_corners(self) -> None:
        """A corner completes the parallelogram of the three sites next to it."""
        points = np.flatnonzero(self._beyond.all(axis=1))
        site, beyond = self._site[points], self._beyond[points]
        for back, factor in (([1, 0], -1.0), ([0, 1], -1.0), ([1, 1], 1.0)):
            self._add_both(points, site - beyond * back, factor)

    def solved(self) -> FrameMap:
        """The points' weights of the body particles."""
        from scipy.sparse import coo_array, hstack
        from scipy.sparse.linalg import splu

        row, column, value = map(np.concatenate, zip(*self._entries, strict=True))
        ring = self._place(self._site)
        inner = np.setdiff1d(column // 2, ring)
        size = 2 * len(ring), 2 * math.prod(self._shape)
        M = coo_array((value, (row, column)), size).tocsc()
        A, B = (M[:, (2 * places[:, None] + (0, 1)).ravel()] for places in (ring, inner))
        inverse, parts = splu(A), []
        for first in range(0, B.shape[1], COLUMNS):
            answers = inverse.solve(-B[:, first : first + COLUMNS].toarray())
            answers[np.abs(answers) < NEGLIGIBLE] = 0.0
            parts.append(coo_array(answers))
        weights = hstack(parts).tobsr((2, 2))
        weights.sort_indices()
        point = np.repeat(np.arange(len(ring)), np.diff(weights.indptr))
        sites = np.column_stack(np.unravel_index(inner, self._shape)) + self._first
        body = self._frame.body_at(sites.astype(np.int32))[weights.indices]
        return FrameMap(point, body, weights.data)

    def _add_both(self, points: Any, site: Any, factor: float) -> None:
        for axis in (0, 1):
            self._add(points, axis, site, axis, factor)

    def _add(self, points: Any, row: int, site: Any, axis: int, factor: Any) -> None:
        """Adds factor · (component `axis` at some sites) to the equations `row` of some points."""
        column = 2 * self._place(site) + axis
        self._entries.append((2 * points + row, column, np.broadcast_to(factor, points.shape)))

    def _place(self, site: Any) -> Any:
        return np.ravel_multi_index(tuple((site - self._first).T), self._shape)
