"""Writes what a step of a pass does in its part of a tile."""

from __future__ import annotations

from collections.abc import Sequence

from pbdkit.scene.guides import has_guides
from pbdkit.stepping.compiled.following import write_lagging_point, write_point
from pbdkit.stepping.compiled.leading import held, leading_lines, slant_lines
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.passes import Skew


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
