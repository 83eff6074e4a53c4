"""Passes over the memory in which several steps are made: loops over pieces, tiles and bands, and
the writer of a step in a tile.

The lattice is divided along its last axis into tiles that stay in the cache, and each tile along
the first axis into bands. In each band all steps of the pass are made one after the other. The
region of each step is shifted against the region of the previous step along both axes (time
skewing); the class `Skew` contains the distances.

On several threads, the rows are divided into pieces, which are computed in parallel. From step to
step a piece has fewer rows at its ends, because the rows of the adjacent pieces must not be read.
The gaps that remain between the pieces are computed in parallel afterwards.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.kernel import Function, KernelWriter, Lines
from pbdkit.stepping.numba_engine.plan import Passes, Plan, PlanWriter
from pbdkit.stepping.numba_engine.time_skewing import Skew
from pbdkit.stepping.program import Program


class TileWriter(PlanWriter):
    """Writer of the kernel part that makes one step of a pass in one tile. The number of the step
    in the pass is s; its region consists of the rows from i0 to i1 and the columns from j0 to j1.
    Leaders are placed in all rows and columns that the step reads. Bonds and inner rules are
    evaluated for rows and columns ahead of those in which particles move."""

    keeps_before = False
    _is_ahead = True
    """True if i0, i1, j0 and j1 must be set to the rows and columns of the particles that move
    before the next lines are written."""

    def __init__(self, plan: Plan, passes: Passes) -> None:
        arguments = "s", "moment", "band_", "tile", "piece", "extent", "boxes"
        super().__init__(plan, Function(plan.shared, "move_part", *arguments), passes)
        self._skew = Skew(plan.scene).axes

    def begin(self) -> None:
        """Write lines that compute the position of the step in the tile, and the rows and columns
        that the step reads."""
        out, (rows, columns) = self.out, self._skew
        out.add(0, "i_low, i_high, j_low, j_high = extent", "begin, end, down, up = piece")
        out.add(0, "step = step + s + 1", "bottom, top = begin + s * down, end + s * up")
        out.add(0, f"high = begin + (band_ + 1) * sizes[1] - s * {rows.step}")
        out.add(0, f"right = j_low + (tile + 1) * sizes[2] - s * {columns.step}")
        out.add(0, "low, left = high - sizes[1], right - sizes[2]")
        out.add(0, *self.plan.opening("moment + s"))
        out.add(0, f"i0 = bottom - {rows.ahead + rows.reach}")
        out.add(0, f"i0 = i0 if band_ == 0 else max(low + {rows.sight}, i0)")
        out.add(0, f"i1 = min(high + {rows.sight}, top + {rows.back + rows.reach})")
        out.add(0, f"j0 = j_low if tile == 0 else left + {columns.sight}")
        out.add(0, f"j1 = right + {columns.sight}")

    def listed(self, name: str, *lines: str, ahead: bool = False) -> None:
        """Write a loop over those entries of a list that lie in the rows from i0 to i1 and the
        columns from j0 to j1."""
        if not ahead:
            self._keep_to_moving()
        self._loop(name, "e", lines)

    def judge_bonds(self) -> None:
        """Write a call that updates the bonds in rows and columns ahead of the particles that
        move."""
        if judge := self.passes.judge:
            self._keep_to_moving()
            self.out.add(0, judge.call("i0", "i1", "left", "right"))
            self._move_on()

    def sweep(self, level: int) -> None:
        """Write a call for the part of the range that motion has reached. For an inner rule, the
        range is ahead of the particles that move."""
        out, first = self.out, 2 * self.plan.scene.axes - 2
        self._keep_to_moving()
        out.add(0, "box = boxes[s].copy()", f"box[{first}] = max(box[{first}], left)")
        out.add(0, f"box[{first + 1}] = min(box[{first + 1}], right)")
        out.add(0, "r0, r1 = max(0, i0, box[0]), min(starts.shape[1] - 1, i1, box[1])")
        out.add(0, f"if r0 < r1 and box[{first}] < box[{first + 1}]:")
        out.add(1, self.passes.sweeps[level].call("r0", "r1"))
        if level + 1 < len(self.passes.sweeps) and not self.plan.scene.frame:
            self._move_on()

    def over_rows(self, name: str, write: Callable[[Function], None]) -> None:
        """Write a call for the rows that the sweep has moved."""
        self.out.add(0, "if r0 < r1 and box[2] < box[3]:")
        self.out.add(1, self.rows(name, write).call("r0", "r1", "moment + s"))

    def follow(self, mapped: Callable[[str], Lines], planes: str, delay: int = 0) -> None:
        """Write a loop over the frame points for which the last of the particles that they follow
        lies in the range. Points that follow particles on both sides of the end of a piece are
        computed with the gap between the pieces."""
        lines = self.each(f"{planes}_@[points[f]] = t_@")
        if delay:  # The point gets the displacement that was computed for it in the previous step.
            lines = self.each(f"{planes}_@[points[f]] = delayed_@[f]")
        lines = [*lines, *delay_lines(self, mapped, planes)] if delay else [*mapped(planes), *lines]
        self.out.add(0, f"i1 = min(high, top + {self._skew[0].apart} * (up > 0))")
        inside = "(down <= 0 or frame_begun[f] >= bottom) and (up <= 0 or frame_begun[f] < top)"
        self._loop("frame", "f", lines, f" and {inside}")
        if planes != "flat_v":
            self._move_on()

    def _loop(self, name: str, e: str, lines: Iterable[str], besides: str = "") -> None:
        """Write a loop over the entries of a list in the rows from i0 to i1 and the columns from j0
        to j1."""
        self.out.add(0, f"first_one = {name}_rows[min(max(i0, i_low), i_high)]")
        self.out.add(0, f"for {e} in range(first_one, {name}_rows[max(min(i1, i_high), i_low)]):")
        self.out.add(1, f"if j0 <= {name}_columns[{e}] < j1{besides}:")
        self.out.add(2, *lines)

    def _keep_to_moving(self) -> None:
        """Write a line that sets the range to the rows and columns of the particles that move."""
        if self._is_ahead:
            self.out.add(0, "i0, i1, j0, j1 = max(low, bottom), min(high, top), left, right")
            self._is_ahead = False

    def _move_on(self) -> None:
        """Write lines that shift the range back, from the rows and columns just evaluated to those
        evaluated next."""
        out, (rows, columns) = self.out, self._skew
        for edge, slope in (("bottom", "down"), ("top", "up")):
            out.add(0, f"{edge} += {rows.back} if {slope} > 0 else {-rows.ahead} * ({slope} < 0)")
        out.add(0, f"low, high = low - {rows.ahead}, high - {rows.ahead}")
        out.add(0, f"left, right = left - {columns.ahead}, right - {columns.ahead}")
        self._is_ahead = True


def delay_lines(kernel: KernelWriter, mapped: Callable[[str], Lines], planes: str) -> Lines:
    """Return lines that compute the displacement of frame point f and store it for the next
    step."""
    return [*mapped(planes), *kernel.each("delayed_@[f] = t_@")]


def write_piece(plan: Plan, program: Program, passes: Passes) -> list[Function]:
    """Return the functions that make the steps of a pass in a piece; the last one calls the others.
    The piece has the rows from `begin` to `end` in the first step. In every further step `begin`
    changes by `down`, and `end` by `up`."""
    tile = TileWriter(plan, passes)
    tile.begin()
    for operation in program:
        operation.emit(tile)
    part = tile.out
    out = Function(plan.shared, "move_piece", "piece", "moment", "deep", "extent", "boxes")
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
    """Return a call in which the arrays before and after a step are swapped."""
    pairs = [*zip(plan.each("u_@"), plan.each("v_@"), strict=True)]
    pairs += [(f"own{m}", f"was{m}") for m in plan.copied_values if plan.shares]
    other = dict(pairs) | {v_name: u_name for u_name, v_name in pairs}
    return re.sub(rf"\b({'|'.join(other)})\b", lambda found: other[found[0]], call)


def write_deep_passes(writer: PlanWriter, program: Program, piece: Function) -> None:
    """Write the beginning of a loop over steps. Several steps are made in a pass if more than one
    remains and the part of the lattice that motion has reached does not fit in the cache."""
    out, plan = writer.out, writer.plan
    # numba would compile a function once for literal arguments and again for int64. Therefore all
    # arguments are int64.
    out.add(0, "boxes, moment = np.empty((sizes[0], box.size), np.int64), int64(0)")
    out.add(0, "while moment < count:", "    area = 1", "    for e in range(0, box.size, 2):")
    out.add(2, "area *= min(box[e + 1], kind.shape[e // 2 + 1]) - max(box[e], 0)")
    out.add(1, "deep = min(sizes[0], count - moment)")
    if plan.parallel:  # Pieces must be so high that the gaps between them fit.
        out.add(1, "height = min(box[1], kind.shape[1]) - max(box[0], 0)")
        out.add(1, f"deep = min(deep, height // ({2 * Skew(plan.scene).along[0]} * sizes[4]) - 1)")
    out.add(1, "if deep > 1 and area > sizes[3]:")
    out.depth += 2
    _write_extent(out, plan)
    out.add(0, *(f"was{m}[:] = own{m}" for m in plan.copied_values))
    if plan.scene.frame and plan.scene.frame.map.delay:
        out.add(0, *plan.each("flat_u_@ = u_@.reshape(-1)"), "for f in range(points.size):")
        out.add(1, *delay_lines(writer, FollowFrame(plan.scene).mapped(writer), "flat_u"))
    _write_pieces(out, plan, piece)
    if plan.shares:
        out.add(0, "if deep % 2 == 0:", *(f"    own{m}[:] = was{m}" for m in plan.copied_values))
    u, v = (", ".join(plan.each(f"{side}_@")) for side in "uv")
    out.add(0, "if deep % 2:", f"    {u}, {v} = {v}, {u}", "moment += deep", "step += deep")
    # In the displacements before the last step, the leaders are placed as in the last step. They
    # are now placed as in the last step but one.
    out.add(0, *plan.each("flat_v_@ = v_@.reshape(-1)"))
    out.add(0, *plan.opening("moment - 2"))
    out.depth -= 1
    for operation in program:
        operation.end_pass(writer)
    out.add(1, "continue")
    out.depth -= 1


def _write_pieces(out: Function, plan: Plan, piece: Function) -> None:
    """Write a call for one piece or, on several threads, calls for the pieces and then for the gaps
    between the pieces."""
    arguments = ("moment", "deep", "extent", "boxes")
    if not plan.parallel:
        out.add(0, piece.call("(i_low, i_high, int64(0), int64(0))", *arguments))
        return
    skew = Skew(plan.scene).along[0]
    cut, end = (f"i_low + (i_high - i_low) * {n} // sizes[4]" for n in ("n", "(n + 1)"))
    up = f"-{skew} if n + 1 < sizes[4] else 0"
    out.add(0, "for c in prange(sizes[4]):", "    n = int64(c)")
    out.add(1, piece.call(f"({cut}, {end}, {skew} if n > 0 else 0, {up})", *arguments))
    out.add(0, "for c in prange(sizes[4] - 1):", "    n = int64(c)")
    out.add(1, piece.call(f"({end}, {end}, int64(-{skew}), int64({skew}))", *arguments))


def _write_extent(out: Function, plan: Plan) -> None:
    """Write lines that compute the part of the lattice that motion has reached in each step of a
    pass, and the rows and columns in which leaders and frame points can lie."""
    up, across = Skew(plan.scene).along
    first = 2 * plan.scene.axes - 2
    out.add(0, "for s in range(deep):", "    for e in range(box.size):")
    out.add(2, "box[e] += growth[e]", "boxes[s, e] = box[e]")
    for name, at, skew, axis in (("i", 0, up, 1), ("j", first, across, -1)):
        out.add(0, f"{name}_low = max(0, box[{at}] - {skew})")
        out.add(0, f"{name}_high = min(kind.shape[{axis}], box[{at + 1}] + {skew})")
    out.add(0, "extent = i_low, i_high, j_low, j_high")
