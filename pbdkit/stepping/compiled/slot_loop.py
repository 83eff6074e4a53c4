"""Writes what is done in a row of any particles, in a loop over the slots: neighbours may be
missing, cells cut, and there may be thousands of slots."""

from __future__ import annotations

from pbdkit.scene.homes import Home
from pbdkit.scene.raster import EMPTY, FOLLOWER
from pbdkit.stepping.compiled.particle import (
    contributions,
    here_rows,
    local_places,
    lost_lines,
    named_tuples,
    target_lines,
)
from pbdkit.stepping.compiled.plan import Function, Level, Plan, values


def write_general(plan: Plan, level: Level, events: Function | None) -> Function:
    """The function that moves the particles of any row of sublattice s."""
    out = Function(plan.shared, f"general{level.number}", "s", *plan.lead, "j0", "j1")
    sums = range(sum(level.parts))
    out.add(0, *named_tuples(plan, level), *here_rows(plan, level, "s"))
    # -0.0 + x is x, whatever its sign.
    out.add(0, f"t = np.full(({len(sums)}, j1 - j0), {plan.number(-0.0)})")
    out.add(0, *(f"t{n} = t[{n}]" for n in sums), "near = np.zeros(j1 - j0, np.int64)")
    if plan.judged:
        out.add(0, f"gone = {plan.row('lost', 's')}", "now = gone.astype(np.int64)")
    out.add(0, "for k in range(counts[s]):")
    _write_slot(out, plan, level)
    out.add(0, f"kinds = {plan.row('kind', 's')}")
    if plan.judged:
        out.add(0, "changed = 0")
    out.add(0, "for j in range(j1 - j0):")
    totals = [f"t{n}[j]" for n in sums]
    out.add(1, *_displacements(plan, level), f"moves = kinds[j] == {FOLLOWER} and near[j] > 0")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), totals, "moves"))
    if events:
        out.add(1, "changed = changed | (now[j] ^ int64(gone[j]))", "gone[j] = now[j]")
        out.add(0, "if changed:")
        out.add(1, events.call("s", *plan.lead, "j0", "j1"))
    return out


def _displacements(plan: Plan, level: Level) -> list[str]:
    lines = [f"u = {plan.vector(f'h{c}[j]' for c in plan.axes)}"]
    if level.number:
        lines.append(f"z = {plan.vector(f'z{c}[j]' for c in plan.axes)}")
    return lines


def _write_slot(out: Function, plan: Plan, level: Level) -> None:
    step = [f"steps[s, k, {n + 1}]" for n in range(len(plan.axes))]
    target = "steps[s, k, 0]"
    source = f"z{level.number - 1}" if level.number else "u"
    out.add(1, *(f"n{c} = {plan.row(f'{source}_{c}', target, step)}" for c in plan.axes))
    out.add(1, f"there = {plan.row('kind', target, step)}")
    out.add(1, f"r = {plan.vector(f'rests[s, k, {n}]' for n in range(len(plan.axes)))}")
    named = {Home.SLOT: f"weights{level.number}[s, k, {{n}}]"}
    if any(number.home is Home.CELL for number in level.seen.weights):
        for side in (0, 1):
            cell = [f"sides[s, k, {side}, {n + 2}]" for n in range(len(plan.axes))]
            first = f"sides[s, k, {side}, 0], sides[s, k, {side}, 1]"
            out.add(1, f"share_{side} = {plan.row('share', first, cell)}")
        named[Home.CELL] = "share_{n}[j]"
    w = f"Weights{level.number}({values(level.seen.weights, named)})"
    _write_bond_rows(out, plan, level)
    out.add(1, "for j in range(j1 - j0):")
    here = "z" if level.number else "u"
    out.add(2, *_displacements(plan, level), f"is_there = there[j] != {EMPTY}")
    out.add(2, f"d = {plan.vector(f'n{c}[j] - {here}.{c}' for c in plan.axes)}")
    if plan.model is not None:
        _write_bond(out, plan, level)
    out.add(2, f"{contributions(level)}, = gather{level.number}(d, r, {w}, p)")
    for n in range(sum(level.parts)):
        out.add(2, f"t{n}[j] = t{n}[j] + (c{n} if is_there else {plan.number(0.0)})")
    out.add(2, "near[j] = near[j] + (1 if is_there else 0)")


def _write_bond_rows(out: Function, plan: Plan, level: Level) -> None:
    if plan.model is None:
        return
    home = [f"homes[s, k, {n + 1}]" for n in range(len(plan.axes))]
    bonds = [number for number in level.seen.bond if number.home is Home.BOND]
    for n in range(len(bonds)):
        out.add(1, f"b{n} = {plan.row(f'bond{n}', 'homes[s, k, 0]', home)}")
    if plan.judged:
        out.add(1, "sign = signs[s, k]")
    else:
        out.add(1, f"f_k = {plan.row('broken', 'homes[s, k, 0]', home)}")


def _write_bond(out: Function, plan: Plan, level: Level) -> None:
    bond = {Home.SLOT: "limits[s, k, {n}]", Home.BOND: "b{n}[j]"}
    c = f"Constants({values(level.seen.bond, bond)})"
    if plan.judged:
        every = plan.model.breaks_frame_bonds()
        can = "is_there" if every else f"there[j] == {FOLLOWER}"
        out.add(2, f"breaks_now = 1 if breaks(sign * d, sign * r, {c}, q) and {can} else 0")
        out.add(2, "is_lost = ((now[j] >> k) & 1) | breaks_now")
        out.add(2, "now[j] = now[j] | (is_lost << k)")
    else:
        out.add(2, "is_lost = f_k[j] >= 0")
    out.add(2, *lost_lines(plan, "r", c))
