"""The gradient of the displacement at every particle, from the cells around it.

A polygon's mean gradient is Σ_k u_k ⊗ ½ (y_k+1 - y_k-1, x_k-1 - x_k+1) over its area (Green), on a
rectangle that of the bilinear displacement, on a triangle that of the linear one. A particle gets
the mean over the cells that meet there, by share of area; that stands at the mean of their centres,
which on an edge is not the particle, and is carried on from there with the gradient's own slope,
found in the same way. Quadratic displacements of rectangular cells are exact, edges included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Softens, SoftensCells, Vector
from pbdkit.interfaces.diagnostic import CellValues
from pbdkit.interfaces.polygons import area_share, corner_share, signed_area
from pbdkit.results.softened_stress import lost_stress
from pbdkit.results.tables import Tables, read_only
from pbdkit.scene.cells import Patch
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]
FLAT = 0.1
"""Where the centres around the corners of a cell span less than this of its area they lie in line,
as in a body of one row of cells, and tell of no slope."""


def displacement_gradient(u: NDArray[Any], cells: Iterable[tuple[Patch, Floats]]) -> Floats:
    """∂u_a/∂X_b as planes (2a + b, sublattice, cell, cell), from planes u and the cells with their
    shares; 0 where no cell is."""
    cells = list(cells)
    shape = u.shape[1:]
    area, offset, gradient = np.zeros(shape), np.zeros((2, *shape)), np.zeros((2, 2, *shape))
    for patch, share in cells:
        rest = patch.polygon.rest
        whole, slopes = _around([np.array(d) for d in patch.differences(u)], rest)
        centre = [sum(r[axis] for r in rest) / len(rest) for axis in (0, 1)]
        for corner, r in zip(patch.corners, rest, strict=True):
            corner.of(area)[...] += whole * share
            for plane, middle, place in zip(offset, centre, r, strict=True):
                corner.of(plane)[...] += (middle - place) * whole * share
            for plane, slope in zip(gradient, slopes, strict=True):
                corner.of(plane)[...] += slope * share
    some = np.where(area > 0.0, area, 1.0)
    gradient /= some
    offset /= some
    planes = gradient.reshape(4, *shape)
    return planes - _beyond(planes, offset, cells)


def _beyond(gradient: Floats, offset: Floats, cells: list[tuple[Patch, Floats]]) -> Floats:
    """What a gradient changes from the particles to the centres, (4, ...)."""
    area, slope = np.zeros(gradient.shape[1:]), np.zeros((4, 2, *gradient.shape[1:]))
    for patch, share in cells:
        rest, away = patch.polygon.rest, [corner.of(offset) for corner in patch.corners]
        at = [r + Vector(*(own - away[0])) for r, own in zip(rest, away, strict=True)]
        values = [corner.of(gradient) for corner in patch.corners]
        whole, slopes = _around([value - values[0] for value in values], at)
        usable = np.where(whole > FLAT * signed_area(rest), share, 0.0)
        for corner in patch.corners:
            corner.of(area)[...] += whole * usable
            for plane, part in zip(slope, slopes, strict=True):
                corner.of(plane)[...] += part * usable
    slope /= np.where(area > 0.0, area, 1.0)
    beyond: Floats = slope[:, 0] * offset[0] + slope[:, 1] * offset[1]
    return beyond


def _around(d: Sequence[Floats], r: Sequence[Any]) -> tuple[Any, Any]:
    """The area of a polygon with corners r, and area times the mean gradient of d, (component of d,
    axis, ...)."""
    slopes = np.zeros((len(d[0]), 2, *d[0].shape[1:]))
    for k, value in enumerate(d):
        ahead, behind = r[(k + 1) % len(r)], r[k - 1]
        slopes[:, 0] += value * ((ahead.y - behind.y) / 2)
        slopes[:, 1] += value * ((behind.x - ahead.x) / 2)
    return signed_area(r), slopes


def _known_beside(
    gradient: Floats, alike: list[tuple[Patch, Floats]], cells: list[tuple[Patch, Floats]]
) -> Floats:
    """A gradient found from some cells alone, (4, ...): where none of these is, the mean of the
    particles that share any cell with the place; NaN where they have none either."""
    shape = gradient.shape[1:]
    met, total, count = np.zeros(shape), np.zeros_like(gradient), np.zeros(shape)
    for patch, share in alike:
        for corner in patch.corners:
            corner.of(met)[...] += share
    known = met > 0.0
    for patch, share in cells:
        there_is = share > 0.0
        for here, there in product(patch.corners, repeat=2):
            here.of(count)[...] += there.of(known) & there_is
            for plane, value in zip(total, gradient * known, strict=True):
                here.of(plane)[...] += there.of(value) * there_is
    mean = np.where(count > 0.0, total, np.nan) / np.where(count > 0.0, count, 1.0)
    return np.where(known, gradient, mean)


TURNED = -1e-6
"""A share of the area at rest; nearer to zero it is rounding, of single precision too."""


class StateCells(CellValues):
    """The cells of a scene's body in a state."""

    def __init__(self, state: State, tables: Tables) -> None:
        self._state, self._tables, self._scene = state, tables, tables.scene

    def over(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """Patch by patch, each with the cells of one shape."""
        found = [np.empty(0)]
        for patch in self._scene.patches:
            counted = self._intact(patch) if intact_only else patch.whole
            values = function(patch.differences(self._state.u), patch.polygon.rest)
            found.append(np.broadcast_to(values, counted.shape)[counted])
        return np.concatenate(found)

    def gradient(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._gradient

    @cached_property
    def _gradient(self) -> Floats:
        weighed, u = self._scene.cells, self._state.u.astype(float, copy=False)
        cells = self._weighed
        whole = self._tables.of_body(displacement_gradient(u, cells))
        if weighed is not None and weighed.phase is not None:
            whole = self._by_phase(weighed.phase, u, cells, whole)
        return read_only(whole.reshape(-1, 2, 2))

    def lost_stress(self) -> Floats | None:
        """Found anew whenever it is called: one diagnostic does."""
        scene, state = self._scene, self._state
        if not (scene.tears and isinstance(scene.experiment.fracture, (Softens, SoftensCells))):
            return None
        u = state.u.astype(float, copy=False)
        planes = lost_stress(scene, state, u, self._weighed)
        return self._tables.of_body(planes).reshape(-1, 2, 2)

    @cached_property
    def _weighed(self) -> list[tuple[Patch, Floats]]:
        """The cells that count with their shares."""
        weighed = self._scene.cells
        return [
            (patch, (weighed.of(patch) if weighed else 1.0) * self._intact(patch))
            for patch in self._scene.patches
        ]

    def _by_phase(
        self, phase: NDArray[Any], u: Floats, cells: list[tuple[Patch, Floats]], whole: Floats
    ) -> Floats:
        """The gradient from the cells of a particle's own material alone: at a border it jumps.
        Who has no such cell takes the mean of those beside it that have, if there is any."""
        found, own = whole.copy(), self._tables.phase
        for number in np.unique(own).tolist():
            alike = [
                (patch, share * (patch.corners[0].of(phase[patch.polygon.kind]) == number))
                for patch, share in cells
            ]
            planes = _known_beside(displacement_gradient(u, alike), alike, cells)
            within = self._tables.of_body(planes)
            some = (own == number) & np.isfinite(within).all(axis=1)
            found[some] = within[some]
        return found

    def inside_out(self) -> str | None:
        """A warning where cells have turned over or, if none has, corners of cells; None where none
        has: a rule of positions does not mind, a body does. Torn cells do not count: the parts of a
        broken body go their own ways."""
        remedy = "let the leaders go less far, or weaken the rule where it couples x and y"
        if found := self._turned(area_share, "cells have turned over"):
            return f"the last state is inside out: {found}; {remedy}"
        if found := self._turned(corner_share, "cells have a corner that has turned over"):
            return f"the last state is folded: {found}; {remedy}"
        return None

    def _turned(self, share: Callable[..., Any], what: str) -> str | None:
        """Of how many cells the share of the area at rest is negative, and where it is worst."""
        turned = total = number = 0
        worst = 0.0
        for patch in self._scene.patches:
            counted = self._intact(patch)
            with np.errstate(all="ignore"):
                area = share(patch.differences(self._state.u), patch.polygon.rest)
                area = np.where(counted & (area < TURNED), area, 0.0)
            turned += int(np.count_nonzero(area))
            total += int(np.count_nonzero(counted))
            place = int(area.argmin())
            if area.flat[place] < worst:
                worst = float(area.flat[place])
                number = int(patch.rows(self._scene.raster, place).min()) + 1
        if not turned:
            return None
        return (
            f"{turned} of {total} {what}, the worst, at particle {number}, to {worst:.3g} of its "
            "area at rest"
        )

    def _intact(self, patch: Patch) -> NDArray[np.bool_]:
        """Which cells of a patch have no broken bond between their corners."""
        intact = patch.whole
        if self._state.broken_step is None:
            return intact
        for block, slot in patch.bonds(self._scene.neighbourhood.slots):
            plane, at_this_end = self._scene.neighbourhood.home[slot]
            home = block if at_this_end else block.seen_through(slot)
            intact = intact & (home.within(self._state.broken_step[plane]) < 0)
        return intact
