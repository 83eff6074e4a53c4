"""Writes what a step of a pass does in its part of a tile.

Writes the loops of several steps in one pass over the memory.

The lattice is cut along its last axis into tiles that stay in the cache, and each tile along its
first into bands. Band after band every step of a pass moves a part of the tile, each as far behind
the one before as `Skew` says, along both axes; then comes the next tile.

On several threads the rows are cut into pieces that go side by side. Where they meet each step of a
piece leaves out as many rows more than the one before as it must not see; these gaps, which grow as
the pieces shrink, come after them, side by side again.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from pbdkit.scene.leaders import has_guides
from pbdkit.stepping.numba_engine.boundary import (
    held,
    leading_lines,
    slant_lines,
    write_lag,
    write_lagging_point,
    write_point,
)
from pbdkit.stepping.numba_engine.plan import Function, Plan
from pbdkit.stepping.numba_engine.time_skewing import Skew


def write_part(plan: Plan, passes: Sequence[Function], pushing: Function | None) -> Function:
    """The function by which step s of a pass moves its part of a tile of a piece: leaders are
    placed as far as the step will see, bonds are judged or moves of the inner rule made, it sweeps,
    keeps particles out of obstacles, places leaders where it has swept, and frame points follow."""
    own = "s", "made", "band_", "tile", "piece", "extent", "boxes"
    out = Function(plan.shared, "move_part", *own)
    rows, columns = Skew(plan.scene).axes
    out.add(0, "i_low, i_high, j_low, j_high = extent", "begin, end, down, up = piece")
    out.add(0, "step = step + s + 1", "bottom, top = begin + s * down, end + s * up")
    out.add(0, f"high = begin + (band_ + 1) * sizes[1] - s * {rows.step}")
    out.add(0, f"right = j_low + (tile + 1) * sizes[2] - s * {columns.step}")
    out.add(0, "low, left = high - sizes[1], right - sizes[2]")
    out.add(0, *(held(end, "made + s") for end in plan.leads))
    out.add(0, f"i0 = bottom - {rows.ahead + rows.reach}")
    out.add(0, f"i0 = i0 if band_ == 0 else max(low + {rows.sight}, i0)")
    out.add(0, f"i1 = min(high + {rows.sight}, top + {rows.back + rows.reach})")
    out.add(0, f"j0 = j_low if tile == 0 else left + {columns.sight}")
    out.add(0, f"j1 = right + {columns.sight}")
    _write_leaders(out, plan, "flat_u")
    *before, sweep = passes
    for one in before:
        _write_before(out, plan, one)
    _write_range(out)
    if has_guides(plan.scene.leading):
        _write_leaders(out, plan, "flat_v")
    _write_sweep(out, plan, sweep)
    _write_turns(out, plan)
    if pushing:
        if has_guides(plan.scene.leading):
            _write_leaders(out, plan, "flat_v")
        out.add(0, "if r0 < r1 and box[2] < box[3]:")
        out.add(1, pushing.call("r0", "r1", "made + s"))
    _write_after(out, plan)
    return out


def _write_before(out: Function, plan: Plan, one: Function) -> None:
    """What is to be done around particles before they move; then rows and columns are those of
    particles around which it is done."""
    rows, columns = Skew(plan.scene).axes
    _write_range(out)
    if plan.bonds_first:
        out.add(0, one.call("i0", "i1", "left", "right"))
    else:
        _write_sweep(out, plan, one)
        if plan.scene.frame:
            _write_frame_points(out, plan)
            write_point(out, plan, "flat_z0", "flat_z0")
    for edge, slope in (("bottom", "down"), ("top", "up")):
        out.add(0, f"{edge} += {rows.back} if {slope} > 0 else {-rows.ahead} * ({slope} < 0)")
    out.add(0, f"low, high = low - {rows.ahead}, high - {rows.ahead}")
    out.add(0, f"left, right = left - {columns.ahead}, right - {columns.ahead}")


def _write_range(out: Function) -> None:
    out.add(0, "i0, i1, j0, j1 = max(low, bottom), min(high, top), left, right")


def _write_sweep(out: Function, plan: Plan, sweep: Function) -> None:
    """A sweep over what has been reached in the range of rows and columns."""
    first = 2 * plan.scene.axes - 2
    out.add(0, "box = boxes[s].copy()", f"box[{first}] = max(box[{first}], left)")
    out.add(0, f"box[{first + 1}] = min(box[{first + 1}], right)")
    out.add(0, "r0, r1 = max(0, i0, box[0]), min(starts.shape[1] - 1, i1, box[1])")
    out.add(0, f"if r0 < r1 and box[{first}] < box[{first + 1}]:", "    " + sweep.call("r0", "r1"))


def _write_turns(out: Function, plan: Plan) -> None:
    """What the rule alone does not decide of the particles of the rows from i0 to i1, and columns
    from j0 to j1: prescribed directions, and what guided particles add to their moves."""
    if plan.rotations:
        _write_listed(out, "clamped", "e")
        out.add(2, *(f"flat_own{m}[clamped[e]] = flat_was{m}[clamped[e]]" for m in plan.rotations))
    for to, of in plan.slanted:
        _write_listed(out, f"slant_{to}{of}", "e")
        out.add(1, *slant_lines(to, of, "flat_u", "flat_v"))


def _write_after(out: Function, plan: Plan) -> None:
    """What comes after the particles of the rows from i0 to i1, and columns from j0 to j1, have
    moved."""
    _write_leaders(out, plan, "flat_v")
    if frame := plan.scene.frame:
        _write_frame_points(out, plan)
        (write_lagging_point if frame.map.lag else write_point)(out, plan, "flat_v", "flat_v")


def _write_frame_points(out: Function, plan: Plan) -> None:
    """A loop over the frame points f that follow particles of the range, the last of them there;
    those who follow some on both sides of where pieces meet wait for the gap."""
    out.add(0, f"i1 = min(high, top + {Skew(plan.scene).axes[0].apart} * (up > 0))")
    inside = "(down <= 0 or frame_begun[f] >= bottom) and (up <= 0 or frame_begun[f] < top)"
    _write_listed(out, "frame", "f", f" and {inside}")


def _write_leaders(out: Function, plan: Plan, planes: str) -> None:
    """Leaders of a part are put where they are held."""
    for end, axes in plan.leads.items():
        _write_listed(out, f"led{end}", "e")
        out.add(2, *leading_lines(plan, end, axes, f"{planes}_@[led[e]] = held[#, e]"))


def _write_listed(out: Function, name: str, e: str, besides: str = "") -> None:
    """A loop over those of a list in the rows from i0 to i1, and columns from j0 to j1."""
    out.add(0, f"first_one = {name}_rows[min(max(i0, i_low), i_high)]")
    out.add(0, f"for {e} in range(first_one, {name}_rows[max(min(i1, i_high), i_low)]):")
    out.add(1, f"if j0 <= {name}_columns[{e}] < j1{besides}:")


def write_piece(plan: Plan, passes: Sequence[Function], pushing: Function | None) -> list[Function]:
    """The functions for the steps of a pass in a piece, its own last: rows from `begin` to `end`,
    of which either end goes further `down` or `up` in every step."""
    part = write_part(plan, passes, pushing)
    out = Function(plan.shared, "move_piece", "piece", "made", "deep", "extent", "boxes")
    rows, columns = Skew(plan.scene).axes
    margin = rows.back + rows.ahead + rows.apart
    out.add(0, "begin, end, down, up = piece", "i_low, i_high, j_low, j_high = extent")
    out.add(0, f"height = end - begin + (deep - 1) * (up + {rows.step}) + {margin}")
    out.add(0, f"width = j_high - j_low + (deep - 1) * {columns.step} + {columns.ahead}")
    out.add(0, "bands = (height + sizes[1] - 1) // sizes[1]")
    out.add(0, "tiles = (width + sizes[2] - 1) // sizes[2]")
    out.add(0, "for tile in range(tiles):", "    for band_ in range(bands):")
    out.add(2, "for s in range(deep):")
    forth = part.call(*part.own)
    out.add(3, "if s % 2 == 0:", "    " + forth, "else:", "    " + _exchanged(plan, forth))
    return [part, out]


def _exchanged(plan: Plan, call: str) -> str:
    """A call in which what is there before a step and after it change places."""
    pairs = [*zip(plan.each("u_@"), plan.each("v_@"), strict=True)]
    pairs += [(f"own{m}", f"was{m}") for m in plan.kept if plan.shares]
    other = dict(pairs) | {after: before for before, after in pairs}
    return re.sub(rf"\b({'|'.join(other)})\b", lambda found: other[found[0]], call)


def write_deep_passes(out: Function, plan: Plan, piece: Function) -> None:
    """The beginning of a loop over steps: many in a pass, as long as there are several to make and
    what has been reached is more than stays in the cache."""
    out.add(0, "boxes, made = np.empty((sizes[0], box.size), np.int64), 0")
    out.add(0, "while made < count:", "    area = 1", "    for e in range(0, box.size, 2):")
    out.add(2, "area *= min(box[e + 1], kind.shape[e // 2 + 1]) - max(box[e], 0)")
    out.add(1, "deep = min(sizes[0], count - made)")
    if plan.parallel:  # pieces meet only where there is room for their gaps
        out.add(1, "height = min(box[1], kind.shape[1]) - max(box[0], 0)")
        out.add(1, f"deep = min(deep, height // ({2 * Skew(plan.scene).along[0]} * sizes[4]) - 1)")
    out.add(1, "if deep > 1 and area > sizes[3]:")
    out.depth += 2
    _write_extent(out, plan)
    out.add(0, *(f"was{m}[:] = own{m}" for m in plan.kept))
    if plan.scene.frame and plan.scene.frame.map.lag:
        out.add(0, *plan.each("fu_@ = u_@.reshape(-1)"), "for f in range(points.size):")
        out.depth -= 1
        write_lag(out, plan, "fu")
        out.depth += 1
    _write_pieces(out, plan, piece)
    if plan.shares:
        out.add(0, "if deep % 2 == 0:", *(f"    own{m}[:] = was{m}" for m in plan.kept))
    u, v = (", ".join(plan.each(f"{side}_@")) for side in "uv")
    out.add(0, "if deep % 2:", f"    {u}, {v} = {v}, {u}", "made += deep", "step += deep")
    # Leaders of the step before the last stand where the last has placed them.
    out.add(0, *plan.each("fv_@ = v_@.reshape(-1)"))
    for end, axes in plan.leads.items():
        out.add(0, held(end, "made - 2"), f"for e in range(led{end}.size):")
        out.add(1, *leading_lines(plan, end, axes, "fv_@[led[e]] = held[#, e]"))
    out.add(0, "continue")
    out.depth -= 2


def _write_pieces(out: Function, plan: Plan, piece: Function) -> None:
    """All at once, or the pieces of the threads, and then the gaps between them."""
    more = ("made", "deep", "extent", "boxes")
    if not plan.parallel:
        out.add(0, piece.call("(i_low, i_high, 0, 0)", *more))
        return
    skew = Skew(plan.scene).along[0]
    cut, after = (f"i_low + (i_high - i_low) * {n} // sizes[4]" for n in ("n", "(n + 1)"))
    up = f"-{skew} if n + 1 < sizes[4] else 0"
    out.add(0, "for c in prange(sizes[4]):", "    n = int64(c)")
    out.add(1, piece.call(f"({cut}, {after}, {skew} if n > 0 else 0, {up})", *more))
    out.add(0, "for c in prange(sizes[4] - 1):", "    n = int64(c)")
    out.add(1, piece.call(f"({after}, {after}, -{skew}, {skew})", *more))


def _write_extent(out: Function, plan: Plan) -> None:
    """What each step of a pass has reached, and how far leaders and frame points can be from it."""
    up, across = Skew(plan.scene).along
    first = 2 * plan.scene.axes - 2
    out.add(0, "for s in range(deep):", "    for e in range(box.size):")
    out.add(2, "box[e] += growth[e]", "boxes[s, e] = box[e]")
    for name, at, skew, axis in (("i", 0, up, 1), ("j", first, across, -1)):
        out.add(0, f"{name}_low = max(0, box[{at}] - {skew})")
        out.add(0, f"{name}_high = min(kind.shape[{axis}], box[{at + 1}] + {skew})")
    out.add(0, "extent = i_low, i_high, j_low, j_high")
