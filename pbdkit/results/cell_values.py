"""What the cells of the body show at a moment, and whether some are inside out."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.diagnostic import CellValues
from pbdkit.interfaces.polygons import area_share, corner_share
from pbdkit.results.gradient import displacement_gradient
from pbdkit.results.tables import Tables, broken_along, read_only
from pbdkit.scene.cells import Patch
from pbdkit.stepping.state import Floats, State

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
        weighed = self._scene.cells
        cells = (
            (patch, (weighed.of(patch) if weighed else 1.0) * self._intact(patch))
            for patch in self._scene.patches
        )
        planes = displacement_gradient(self._state.u.astype(float, copy=False), cells)
        return read_only(self._tables.of_body(planes).reshape(-1, 2, 2))

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
            intact = intact & ~broken_along(self._scene, self._state, block, slot)
        return intact
