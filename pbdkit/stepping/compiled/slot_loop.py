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
    out.add(0, *here_rows(plan, level, "s"), f"base = {plan.flat('s')}", "width = j1 - j0")
    (_write_slot_after_slot if plan.long else _write_one_by_one)(out, plan, level)
    if events:
        out.add(0, "if changed:", "    " + events.call("s", "base", "width"))
    out.flatten()
    return out


def _write_one_by_one(out: Function, plan: Plan, level: Level) -> None:
    sums = [f"t{n}" for n in range(sum(level.parts))]
    out.add(0, *(["changed = 0"] if plan.judged else []), "for j in range(width):")
    # -0.0 + x is x, whatever its sign.
    out.add(
        1,
        *(f"{t} = {'real' if plan.single else 'double'}(-0.0)" for t in sums),
        "near, at_j = 0, base + j",
    )
    if plan.judged:
        out.add(1, "bits = int64(flat_lost[at_j])", "now = bits")
    out.add(1, *_displacements(plan, level), "for k in range(counts[s]):")
    _write_slot(out, plan, level, sums, "near")
    out.add(1, f"moves = (flat_kind[at_j] == {FOLLOWER}) & (near > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), sums, "moves"))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", "flat_lost[at_j] = now")


def _write_slot_after_slot(out: Function, plan: Plan, level: Level) -> None:
    sums = [f"t{n}" for n in range(sum(level.parts))]
    out.add(0, f"t = np.full(({len(sums)}, width), {plan.number(-0.0)})")
    out.add(0, *(f"{t} = t[{n}]" for n, t in enumerate(sums)), "near = np.zeros(width, np.int64)")
    out.add(0, f"kinds = {plan.row('kind', 's')}", "for k in range(counts[s]):")
    sums = [f"{t}[j]" for t in sums]
    _write_slot(out, plan, level, sums, "near[j]")
    out.add(0, "for j in range(width):", *("    " + u for u in _displacements(plan, level)))
    out.add(1, f"moves = (kinds[j] == {FOLLOWER}) & (near[j] > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), sums, "moves"))


def _displacements(plan: Plan, level: Level) -> list[str]:
    lines = [f"u = {plan.vector(f'h{c}[j]' for c in plan.axes)}"]
    if level.number:
        lines.append(f"z = {plan.vector(f'z{c}[j]' for c in plan.axes)}")
    return lines


class _Rows:
    """The values of arrays some way off from each particle: rows of them where all particles take
    in one slot after the other, else looked up."""

    def __init__(self, out: Function, plan: Plan, depth: int) -> None:
        self._out, self._plan, self._depth = out, plan, depth

    def seen(self, array: str, away: str) -> str:
        """The word for a value of an array, `away` from the particle's place in flat arrays."""
        if not self._plan.long:
            return f"flat_{array}[at_j + {away}]"
        row = f"flat_{array}[base + {away}:base + {away} + width]"
        self._out.add(self._depth, f"row_{array} = {row}")
        return f"row_{array}[j]"


def _write_slot(out: Function, plan: Plan, level: Level, sums: Sequence[str], near: str) -> None:
    axes, depth = range(len(plan.axes)), 1 if plan.long else 2
    rows = _Rows(out, plan, depth)
    source, here = (f"z{level.number - 1}", "z") if level.number else ("u", "u")
    there = [rows.seen(f"{source}_{c}", "away[s, k]") for c in plan.axes]
    kind = rows.seen("kind", "away[s, k]")
    named = {Home.SLOT: f"weights{level.number}[s, k, {{n}}]"}
    if any(number.home is Home.CELL for number in level.seen.weights):
        for side in (0, 1):  # where cells are cut there are few slots
            share = f"flat_share[at_j + cells_away[s, k, {side}]]"
            out.add(depth, f"share_{side} = {share}")
        named[Home.CELL] = "share_{n}"
    bonds = sum(number.home is Home.BOND for number in level.seen.bond) if plan.model else 0
    bond = [rows.seen(f"bond{n}", "bonds_away[s, k]") for n in range(bonds)]
    since = rows.seen("broken", "bonds_away[s, k]") if plan.bonds_first else ""
    out.add(depth, f"r = {plan.vector(f'rests[s, k, {a}]' for a in axes)}")
    if plan.long:
        out.add(depth, "for j in range(width):")
        out.add(2, *_displacements(plan, level))
    out.add(2, f"is_there = {kind} != {EMPTY}")
    parts = zip(there, plan.axes, strict=True)
    out.add(2, f"d = {plan.vector(f'{value} - {here}.{c}' for value, c in parts)}")
    if plan.model is not None:
        for n, value in enumerate(bond):
            out.add(2, f"b{n} = {value}")
        c = values(level.seen.bond, {Home.SLOT: "limits[s, k, {n}]", Home.BOND: "b{n}"})
        c = f"Constants({c})"
        if plan.judged:
            can = "is_there" if plan.model.breaks_frame_bonds() else f"({kind} == {FOLLOWER})"
            sign = "signs[s, k]"
            out.add(2, f"breaks_now = breaks({sign} * d, {sign} * r, {c}, q) and {can}")
            out.add(2, "is_lost = ((now >> k) & 1) | (1 if breaks_now else 0)")
            out.add(2, "now = now | (is_lost << k)")
        else:
            out.add(2, f"is_lost = {since} >= 0")
        out.add(2, *lost_lines(plan, "r", c))
    w = f"Weights{level.number}({values(level.seen.weights, named)})"
    out.add(2, f"{contributions(level)}, = gather{level.number}(d, r, {w}, p)")
    for n, t in enumerate(sums):
        out.add(2, f"{t} = {t} + (c{n} if is_there else {plan.number(0.0)})")
    out.add(2, f"{near} = {near} + (1 if is_there else 0)")
