"""Writes the loops of several steps in one pass over the memory.

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

from pbdkit.stepping.compiled.following import write_lag
from pbdkit.stepping.compiled.leading import held, leading_lines
from pbdkit.stepping.compiled.part import write_part
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.passes import Skew


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
