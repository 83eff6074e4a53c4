"""Several steps in one pass over the memory: writes it, and the arrays that it is given.

The lattice is cut along its last axis into tiles that stay in the cache, and each tile along its
first into bands. Band after band every step of a pass moves a part of the tile, each as far behind
the one before as `Skew` says, along both axes; then comes the next tile.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.stepping.compiled.following import write_point
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.passes import Skew, single_steps
from pbdkit.stepping.prescription import Led

CACHE = 2**20
"""Bytes of displacements that stay near a processor (measured: up to these a pass a step is as
fast)."""
DEEP, BAND, TILE = 16, 16, 512
"""Steps of a pass, rows of a band, columns of a tile (measured)."""
AHEAD, ENTRIES = 64, 2**20
"""Steps for which the places of leaders are known beforehand, and their numbers altogether."""


def goes_deep(plan: Plan) -> bool:
    """Whether several steps of a scene go together in a pass."""
    return not plan.parallel and not single_steps(plan.scene)


def pass_arrays(plan: Plan) -> dict[str, Any]:
    """What does not change from step to step: the sizes of a pass, 1 step where all stays in the
    cache anyway; and the column and the first of each row of frame points, which are sorted."""
    scene, real = plan.scene, np.dtype(plan.scene.experiment.stepping.precision)
    a_cell = 2 * scene.axes * real.itemsize * scene.raster.shape[0]
    cells = math.prod(scene.raster.shape[1:])
    deep = DEEP if a_cell * cells > CACHE else 1
    between = math.prod(scene.raster.shape[2:-1])
    tile = max(32, min(TILE, CACHE // (2 * a_cell * between * (BAND + DEEP))))
    arrays = {"sizes": np.array([deep, BAND, tile, CACHE // a_cell])}
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


def write_deep_passes(out: Function, plan: Plan, sweep: Function) -> None:
    """The beginning of a loop over steps: many in a pass, as long as there are several to make and
    what has been reached is more than stays in the cache."""
    up, across = Skew(plan.scene).along
    last = 2 * plan.scene.axes - 2
    out.add(0, "boxes = np.empty((sizes[0], box.size), np.int64)", "part = box.copy()")
    out.add(0, "whole, made, before = box, 0, step")
    out.add(0, "while made < count:", "    area = 1", "    for e in range(0, whole.size, 2):")
    out.add(2, "area *= min(whole[e + 1], kind.shape[e // 2 + 1]) - max(whole[e], 0)")
    out.add(1, "deep = min(sizes[0], count - made)", "if deep > 1 and area > sizes[3]:")
    out.depth += 2
    out.add(0, "for s in range(deep):", "    for e in range(whole.size):")
    out.add(2, "whole[e] += growth[e]", "boxes[s, e] = whole[e]")
    for name, at, skew, axis in (("i", 0, up, 1), ("j", last, across, -1)):
        out.add(0, f"{name}_low = max(0, whole[{at}] - {skew})")
        out.add(0, f"{name}_high = min(kind.shape[{axis}], whole[{at + 1}] + {skew})")
    for side in "uv":
        out.add(0, *plan.each(f"f{side}_@ = {side}_@.reshape(-1)"))
    for name, size, skew, low, high in (
        ("tiles", "sizes[2]", across, "j_low", "j_high"),
        ("bands", "sizes[1]", up, "i_low", "i_high"),
    ):
        out.add(0, f"{name} = ({high} - {low} + (deep - 1) * {skew} + {size} - 1) // {size}")
    out.add(0, "for tile in range(tiles):", "    for band_ in range(bands):")
    out.add(2, "for s in range(deep):", f"    high = i_low + (band_ + 1) * sizes[1] - s * {up}")
    out.add(3, f"right = j_low + (tile + 1) * sizes[2] - s * {across}")
    out.add(3, "low, left = high - sizes[1], right - sizes[2]", "step = before + made + s + 1")
    out.depth += 3
    _write_part(out, plan, sweep, last)
    out.depth -= 1
    _write_swap(out, plan, 0, "deep % 2")
    out.depth -= 2
    _write_swap(out, plan, 0, "deep % 2")
    out.add(0, "made += deep", "step = before + made")
    out.add(0, "held = led_values[min(made - 2, led_values.shape[0] - 1)]")
    out.add(0, "for e in range(led.size):", *plan.each("    fv_@[led[e]] = held[#, e]"))
    out.add(0, "continue")
    out.depth -= 2
    out.add(1, "box = whole")


def _write_swap(out: Function, plan: Plan, depth: int, condition: str) -> None:
    out.add(depth, f"if {condition}:")
    _exchange(out, plan, depth + 1)


def _exchange(out: Function, plan: Plan, depth: int) -> None:
    for name in ("", "f"):
        u, v = (", ".join(plan.each(f"{name}{side}_@")) for side in "uv")
        out.add(depth, f"{u}, {v} = {v}, {u}")


def _write_part(out: Function, plan: Plan, sweep: Function, last: int) -> None:
    """What a step does in its part of a tile: leaders are placed as far as its sweep will see, it
    sweeps, places leaders where it has swept, and frame points follow."""
    rows, columns = Skew(plan.scene).reach
    out.add(0, "held = led_values[min(made + s, led_values.shape[0] - 1)]")
    out.add(0, f"i0 = i_low if band_ == 0 else low + {rows}")
    out.add(0, f"j0 = j_low if tile == 0 else left + {columns}")
    _write_listed(out, "led", f"high + {rows}", f"right + {columns}")
    out.add(2, *plan.each("fu_@[led[e]] = held[#, e]"))
    out.add(0, "for e in range(box.size):", "    part[e] = boxes[s, e]")
    out.add(0, f"part[{last}] = max(part[{last}], left)")
    out.add(0, f"part[{last + 1}] = min(part[{last + 1}], right)", "box = part")
    out.add(0, "i0, i1 = max(0, low, box[0]), min(starts.shape[1] - 1, high, box[1])")
    out.add(0, f"if i0 < i1 and box[{last}] < box[{last + 1}]:", "    " + sweep.call("i0", "i1"))
    out.add(0, "i0, j0 = low, left")
    _write_listed(out, "led", "high", "right")
    out.add(2, *plan.each("fv_@[led[e]] = held[#, e]"))
    if plan.scene.frame:
        _write_listed(out, "frame", "high", "right", "f")
        write_point(out, plan, "fv", "fv")
    _exchange(out, plan, 0)


def _write_listed(out: Function, name: str, high: str, right: str, e: str = "e") -> None:
    """A loop over those of a list in the rows from i0 to `high`, and columns from j0 to `right`."""
    out.add(0, f"i1, j1 = min({high}, i_high), min({right}, j_high)", "i0 = max(i0, i_low)")
    out.add(0, f"for {e} in range({name}_rows[min(i0, i_high)], {name}_rows[max(i1, i_low)]):")
    out.add(1, f"if j0 <= {name}_columns[{e}] < j1:")
