"""The arrays of passes of several steps: their sizes, and who stands in which rows and columns."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.passes import CACHE, Skew, cell_bytes, exceeds_cache, single_steps
from pbdkit.stepping.prescription import Led

DEEP, BAND, ROW = 16, 8, 24 * 2**10
"""Steps of a pass, rows of a band, bytes of a row of a tile: all measured."""
SHORTEST = 256
"""Columns of a tile at least."""
AHEAD, ENTRIES = 64, 2**20
"""Steps for which the places of leaders are known beforehand, and their numbers altogether."""


def goes_deep(plan: Plan) -> bool:
    """Whether several steps of a scene go together in a pass."""
    return exceeds_cache(plan.scene) and not single_steps(plan.scene)


def pass_arrays(plan: Plan, pieces: int) -> dict[str, Any]:
    """What does not change from step to step: the sizes of a pass, with the pieces that go side by
    side; and of frame points, which are sorted, the first of each row, their columns, and the first
    rows of those whom they follow."""
    scene = plan.scene
    between = math.prod(scene.raster.shape[2:-1])
    tile = max(SHORTEST, ROW // (cell_bytes(scene) * between))
    sizes = DEEP, BAND, tile, CACHE // cell_bytes(scene), pieces
    arrays: dict[str, Any] = {"sizes": np.array(sizes)}
    if scene.frame:
        order, skew = frame_order(plan), Skew(scene)
        arrays |= _listed(plan, "frame", *skew.ready[:, order])
        arrays["frame_begun"] = skew.begun[0, order]
        if scene.frame.map.lag:
            real = scene.experiment.stepping.precision
            arrays |= {name: np.zeros(len(order), real) for name in plan.each("lag_@")}
    return arrays


def frame_order(plan: Plan) -> NDArray[np.intp]:
    """Frame points by the row and column at which they can follow."""
    return np.lexsort(Skew(plan.scene).ready[::-1])


def banded(plan: Plan, name: str, places: NDArray[np.intp]) -> tuple[Any, dict[str, Any]]:
    """The order of flat places by row and column, and in that order the first of each row and their
    columns."""
    found = np.unravel_index(places, plan.scene.raster.shape)
    order = np.lexsort((found[-1], found[1]))
    return order, _listed(plan, name, found[1][order], found[-1][order])


def _listed(
    plan: Plan, name: str, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> dict[str, Any]:
    first = np.searchsorted(rows, np.arange(plan.scene.raster.shape[1] + 1))
    return {f"{name}_rows": first, f"{name}_columns": columns}


def room_for(leaders: Led) -> int:
    """For how many steps the places of so many leaders are known beforehand."""
    return max(1, min(AHEAD, ENTRIES // max(1, sum(each.u.size for each in leaders))))
