"""Several steps in one pass over the memory: writes it, and the arrays that it is given.

The lattice is cut along its last axis into tiles that stay in the cache, and each tile along its
first into bands. Band after band every step of a pass moves a part of the tile, each as far behind
the one before as `Skew` says, along both axes; then comes the next tile.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.stepping.compiled.following import write_point
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.passes import CACHE, Skew, cell_bytes, exceeds_cache, single_steps
from pbdkit.stepping.prescription import Led

DEEP, BAND, ROW = 16, 8, 96 * 2**10
"""Steps of a pass, rows of a band, bytes of a row of a tile (measured: longer rows gain more than
fewer bytes)."""
SHORTEST = 256
"""Columns of a tile at least."""
AHEAD, ENTRIES = 64, 2**20
"""Steps for which the places of leaders are known beforehand, and their numbers altogether."""


def goes_deep(plan: Plan) -> bool:
    """Whether several steps of a scene go together in a pass."""
    return not plan.parallel and not single_steps(plan.scene)


def pass_arrays(plan: Plan) -> dict[str, Any]:
    """What does not change from step to step: the sizes of a pass, 1 step where all stays in the
    cache anyway; and the column and the first of each row of frame points, which are sorted."""
    scene = plan.scene
    deep = DEEP if exceeds_cache(scene) else 1
    between = math.prod(scene.raster.shape[2:-1])
    tile = max(SHORTEST, ROW // (cell_bytes(scene) * between))
    arrays: dict[str, Any] = {"sizes": np.array([deep, BAND, tile, CACHE // cell_bytes(scene)])}
    if scene.frame:
        row, column = Skew(scene).ready[:, frame_order(plan)]
        arrays |= {"frame_rows": _firsts(plan, row), "frame_columns": column}
    return arrays


def frame_order(plan: Plan) -> NDArray[np.intp]:
    """Frame points by the row and column at which they can follow."""
    return np.lexsort(Skew(plan.scene).ready[::-1])


def band_arrays(plan: Plan, led: NDArray[np.intp]) -> tuple[NDArray[np.intp], dict[str, Any]]:
    """The order of leaders by row and column, and in that order the first of each row and their
    columns."""
    found = np.unravel_index(led, plan.scene.raster.shape)
    order = np.lexsort((found[-1], found[1]))
    return order, {"led_rows": _firsts(plan, found[1][order]), "led_columns": found[-1][order]}


def _firsts(plan: Plan, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.searchsorted(rows, np.arange(plan.scene.raster.shape[1] + 1))


def room_for(leaders: Led) -> int:
    """For how many steps the places of so many leaders are known beforehand."""
    return max(1, min(AHEAD, ENTRIES // max(1, sum(each.u.size for each in leaders))))


def write_part(plan: Plan, sweep: Function) -> Function:
    """The function by which step s of a pass moves its part of a tile: leaders are placed as far as
    its sweep will see, it sweeps, places leaders where it has swept, and frame points follow."""
    out = Function(plan.shared, "move_part", "s", "made", "band_", "tile", "extent", "boxes")
    skew = Skew(plan.scene)
    (up, across), (rows, columns) = skew.along, skew.reach
    first = 2 * plan.scene.axes - 2
    out.add(0, "i_low, i_high, j_low, j_high = extent", "step = step + s + 1")
    out.add(0, f"high = i_low + (band_ + 1) * sizes[1] - s * {up}")
    out.add(0, f"right = j_low + (tile + 1) * sizes[2] - s * {across}")
    out.add(0, "low, left = high - sizes[1], right - sizes[2]")
    out.add(0, "held = led_values[min(made + s, led_values.shape[0] - 1)]")
    out.add(0, f"i0, i1 = i_low if band_ == 0 else low + {rows}, high + {rows}")
    out.add(0, f"j0, j1 = j_low if tile == 0 else left + {columns}, right + {columns}")
    _write_listed(out, "led")
    out.add(2, *plan.each("flat_u_@[led[e]] = held[#, e]"))
    out.add(0, "box = boxes[s].copy()", f"box[{first}] = max(box[{first}], left)")
    out.add(0, f"box[{first + 1}] = min(box[{first + 1}], right)")
    out.add(0, "i0, i1 = max(0, low, box[0]), min(starts.shape[1] - 1, high, box[1])")
    out.add(0, f"if i0 < i1 and box[{first}] < box[{first + 1}]:", "    " + sweep.call("i0", "i1"))
    out.add(0, "i0, i1, j0, j1 = low, high, left, right")
    _write_listed(out, "led")
    out.add(2, *plan.each("flat_v_@[led[e]] = held[#, e]"))
    if plan.scene.frame:
        _write_listed(out, "frame", "f")
        write_point(out, plan, "flat_v", "flat_v")
    return out


def _write_listed(out: Function, name: str, e: str = "e") -> None:
    """A loop over those of a list in the rows from i0 to i1, and columns from j0 to j1."""
    out.add(0, f"first_one = {name}_rows[min(max(i0, i_low), i_high)]")
    out.add(0, f"for {e} in range(first_one, {name}_rows[max(min(i1, i_high), i_low)]):")
    out.add(1, f"if j0 <= {name}_columns[{e}] < j1:")


def write_deep_passes(out: Function, plan: Plan, part: Function) -> None:
    """The beginning of a loop over steps: many in a pass, as long as there are several to make and
    what has been reached is more than stays in the cache."""
    out.add(0, "boxes, made = np.empty((sizes[0], box.size), np.int64), 0")
    out.add(0, "while made < count:", "    area = 1", "    for e in range(0, box.size, 2):")
    out.add(2, "area *= min(box[e + 1], kind.shape[e // 2 + 1]) - max(box[e], 0)")
    out.add(1, "deep = min(sizes[0], count - made)", "if deep > 1 and area > sizes[3]:")
    out.depth += 2
    _write_extent(out, plan)
    out.add(0, "for tile in range(tiles):", "    for band_ in range(bands):")
    out.add(2, "for s in range(deep):")
    forth = part.call(*part.own)
    back = re.sub(r"\b[uv]_", lambda found: {"u_": "v_", "v_": "u_"}[found[0]], forth)
    out.add(3, "if s % 2 == 0:", "    " + forth, "else:", "    " + back)
    u, v = (", ".join(plan.each(f"{side}_@")) for side in "uv")
    out.add(0, "if deep % 2:", f"    {u}, {v} = {v}, {u}", "made += deep", "step += deep")
    # Leaders of the step before the last stand where the last has placed them.
    out.add(0, *plan.each("fv_@ = v_@.reshape(-1)"))
    out.add(0, "held = led_values[min(made - 2, led_values.shape[0] - 1)]")
    out.add(0, "for e in range(led.size):", *plan.each("    fv_@[led[e]] = held[#, e]"))
    out.add(0, "continue")
    out.depth -= 2


def _write_extent(out: Function, plan: Plan) -> None:
    """What each step of a pass has reached, and how many bands and tiles the last one makes it."""
    up, across = Skew(plan.scene).along
    first = 2 * plan.scene.axes - 2
    out.add(0, "for s in range(deep):", "    for e in range(box.size):")
    out.add(2, "box[e] += growth[e]", "boxes[s, e] = box[e]")
    for name, at, skew, axis in (("i", 0, up, 1), ("j", first, across, -1)):
        out.add(0, f"{name}_low = max(0, box[{at}] - {skew})")
        out.add(0, f"{name}_high = min(kind.shape[{axis}], box[{at + 1}] + {skew})")
    out.add(0, "extent = i_low, i_high, j_low, j_high")
    out.add(0, f"bands = (i_high - i_low + (deep - 1) * {up} + sizes[1] - 1) // sizes[1]")
    out.add(0, f"tiles = (j_high - j_low + (deep - 1) * {across} + sizes[2] - 1) // sizes[2]")
