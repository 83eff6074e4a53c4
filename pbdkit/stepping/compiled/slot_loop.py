"""Writes what is done with any particles, in a loop over their slots: neighbours may be missing,
cells cut, and there may be thousands of slots.

Mostly particle after particle, since what is not like the middle of a body are its edges. Where
there are too many slots to write out it is everything, and all particles of a row take in one slot
after the other.
"""

from __future__ import annotations

from collections.abc import Sequence

from pbdkit.scene.homes import Home
from pbdkit.scene.raster import EMPTY, FOLLOWER
from pbdkit.stepping.compiled.particle import (
    RUNS,
    contributions,
    here_rows,
    local_places,
    lost_lines,
    named_tuples,
    target_lines,
    write_row_loop,
)
from pbdkit.stepping.compiled.plan import Function, Level, Plan, values


def write_general(plan: Plan, level: Level, events: Function | None) -> Function:
    """The function that moves particles of sublattice s."""
    out = Function(plan.shared, f"general{level.number}", "s", *RUNS)
    out.add(0, *named_tuples(plan, level))
    write_row_loop(out, plan)
    out.add(0, *here_rows(plan, level, "s"))
    (_write_slot_after_slot if plan.long else _write_one_by_one)(out, plan, level)
    if events:
        out.add(0, "if changed:")
        out.add(1, events.call("s", *plan.lead, "j0", "j1"))
    return out


def _write_one_by_one(out: Function, plan: Plan, level: Level) -> None:
    sums = [f"t{n}" for n in range(sum(level.parts))]
    out.add(0, *(["changed = 0"] if plan.judged else []), "for j in range(j1 - j0):")
    # -0.0 + x is x, whatever its sign.
    out.add(1, *(f"{t} = {plan.number(-0.0)}" for t in sums), "near = 0")
    if plan.judged:
        out.add(1, f"bits = int64(lost[{plan.place('s')}])", "now = bits")
    out.add(1, *_displacements(plan, level), "for k in range(counts[s]):")
    _write_slot(out, plan, level, 2, 2, sums, "near")
    kind = f"kind[{plan.place('s')}]"
    out.add(1, f"moves = ({kind} == {FOLLOWER}) & (near > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), sums, "moves"))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", f"lost[{plan.place('s')}] = now")


def _write_slot_after_slot(out: Function, plan: Plan, level: Level) -> None:
    sums = [f"t{n}" for n in range(sum(level.parts))]
    out.add(0, f"t = np.full(({len(sums)}, j1 - j0), {plan.number(-0.0)})")
    out.add(0, *(f"{t} = t[{n}]" for n, t in enumerate(sums)), "near = np.zeros(j1 - j0, np.int64)")
    out.add(0, f"kinds = {plan.row('kind', 's')}", "for k in range(counts[s]):")
    sums = [f"{t}[j]" for t in sums]
    _write_slot(out, plan, level, 1, 2, sums, "near[j]")
    out.add(0, "for j in range(j1 - j0):", *[f"    {u}" for u in _displacements(plan, level)])
    out.add(1, f"moves = (kinds[j] == {FOLLOWER}) & (near[j] > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), sums, "moves"))


def _displacements(plan: Plan, level: Level) -> list[str]:
    lines = [f"u = {plan.vector(f'h{c}[j]' for c in plan.axes)}"]
    if level.number:
        lines.append(f"z = {plan.vector(f'z{c}[j]' for c in plan.axes)}")
    return lines


class _Slot:
    """Writes one slot: its rows before the loop over particles, or places within it."""

    def __init__(self, out: Function, plan: Plan, depth: int) -> None:
        self._out, self._plan, self._depth = out, plan, depth

    def seen(self, name: str, array: str, first: str, step: Sequence[str]) -> str:
        """The value of an array at a particle's neighbour, or at the home of something of it."""
        if not self._plan.long:
            return f"{array}[{self._plan.place(first, step)}]"
        self._out.add(self._depth, f"{name} = {self._plan.row(array, first, step)}")
        return f"{name}[j]"


def _write_slot(
    out: Function,
    plan: Plan,
    level: Level,
    depth: int,
    inner: int,
    sums: Sequence[str],
    near: str,
) -> None:
    axes, slot = range(len(plan.axes)), _Slot(out, plan, depth)
    step = [f"steps[s, k, {a + 1}]" for a in axes]
    target, source = "steps[s, k, 0]", f"z{level.number - 1}" if level.number else "u"
    there = [slot.seen(f"n{c}", f"{source}_{c}", target, step) for c in plan.axes]
    kind = slot.seen("kinds_k", "kind", target, step)
    named = {Home.SLOT: f"weights{level.number}[s, k, {{n}}]"}
    if any(number.home is Home.CELL for number in level.seen.weights):
        for side in (0, 1):  # where cells are cut there are few slots
            cell = [f"sides[s, k, {side}, {a + 2}]" for a in axes]
            first = f"sides[s, k, {side}, 0], sides[s, k, {side}, 1]"
            out.add(depth, f"share_{side} = {slot.seen('', 'share', first, cell)}")
        named[Home.CELL] = "share_{n}"
    home = [f"homes[s, k, {a + 1}]" for a in axes]
    bonds = sum(number.home is Home.BOND for number in level.seen.bond) if plan.model else 0
    bond = [slot.seen(f"b{n}", f"bond{n}", "homes[s, k, 0]", home) for n in range(bonds)]
    is_lost = "False"
    if plan.bonds_first:
        is_lost = f"{slot.seen('since', 'broken', 'homes[s, k, 0]', home)} >= 0"
    out.add(depth, f"r = {plan.vector(f'rests[s, k, {a}]' for a in axes)}")
    if plan.long:
        out.add(depth, "for j in range(j1 - j0):")
        out.add(inner, *_displacements(plan, level))
    here = "z" if level.number else "u"
    out.add(inner, f"is_there = {kind} != {EMPTY}")
    parts = zip(there, plan.axes, strict=True)
    out.add(inner, f"d = {plan.vector(f'{value} - {here}.{c}' for value, c in parts)}")
    if plan.model is not None:
        c = values(level.seen.bond, {Home.SLOT: "limits[s, k, {n}]", Home.BOND: "b_{n}"})
        for n, value in enumerate(bond):
            c = c.replace(f"b_{n}", value)
        c = f"Constants({c})"
        if plan.judged:
            can = "is_there" if plan.model.breaks_frame_bonds() else f"({kind} == {FOLLOWER})"
            sign = "signs[s, k]"
            out.add(inner, f"breaks_now = breaks({sign} * d, {sign} * r, {c}, q) and {can}")
            out.add(inner, "is_lost = ((now >> k) & 1) | (1 if breaks_now else 0)")
            out.add(inner, "now = now | (is_lost << k)")
        else:
            out.add(inner, f"is_lost = {is_lost}")
        out.add(inner, *lost_lines(plan, "r", c))
    w = f"Weights{level.number}({values(level.seen.weights, named)})"
    out.add(inner, f"{contributions(level)}, = gather{level.number}(d, r, {w}, p)")
    for n, t in enumerate(sums):
        out.add(inner, f"{t} = {t} + (c{n} if is_there else {plan.number(0.0)})")
    out.add(inner, f"{near} = {near} + (1 if is_there else 0)")
