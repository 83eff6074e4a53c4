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
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.compiled.particle import (
    RUNS,
    bond_lines,
    contributions,
    difference,
    displacements,
    local_places,
    more_contributions,
    target_lines,
    write_row_loop,
)
from pbdkit.stepping.compiled.plan import Function, Plan, values
from pbdkit.stepping.compiled.tearing import damage_lines, torn_at_slot


def write_general(plan: Plan, level: Level, events: Function | None) -> Function:
    """The function that moves particles of sublattice s."""
    out = Function(plan.shared, f"general{level.number}", "s", *RUNS)
    write_row_loop(out, plan, level, "s")
    out.add(0, f"base = {plan.flat('s')}", "width = j1 - j0")
    if _is_slot_after_slot(plan):
        _write_slot_after_slot(out, plan, level)
    else:
        out.add(0, "changed = 0", "for j in range(width):")
        write_one(out, plan, level)
    if events:
        out.add(0, "if changed:", "    " + events.call("s", "base", "width"))
    return out


def write_one(out: Function, plan: Plan, level: Level) -> None:
    """The lines, in a loop, for one particle of sublattice s."""
    # -0.0 + x is x, whatever its sign.
    out.add(1, *(f"{t} = {plan.real}(-0.0)" for t in level.totals), "near, at_j = 0, base + j")
    if plan.judged:
        out.add(1, "bits = int64(flat_lost[at_j])", "now = bits")
    if plan.tears:
        out.add(1, *damage_lines(plan))
    out.add(1, *displacements(plan, level), "for k in range(counts[s]):")
    _write_slot(out, plan, level, level.totals, "near")
    out.add(1, f"moves = (flat_kind[at_j] == {FOLLOWER}) & (near > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), level.totals, "moves"))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", "flat_lost[at_j] = now")


def _write_slot_after_slot(out: Function, plan: Plan, level: Level) -> None:
    sums = [f"{t}[j]" for t in level.totals]
    out.add(0, f"t = np.full(({len(sums)}, width), {plan.number(-0.0)})")
    out.add(0, *(f"{t} = t[{n}]" for n, t in enumerate(level.totals)))
    out.add(0, "near = np.zeros(width, np.int64)", f"kinds = {plan.row('kind', 's')}")
    out.add(0, "for k in range(counts[s]):")
    _write_slot(out, plan, level, sums, "near[j]")
    out.add(0, "for j in range(width):")
    out.add(1, *displacements(plan, level), f"moves = (kinds[j] == {FOLLOWER}) & (near[j] > 0)")
    out.add(1, *target_lines(plan, level, local_places(plan, "s"), sums, "moves"))


def _is_slot_after_slot(plan: Plan) -> bool:
    """Whether all particles of a row take in one slot after the other."""
    return plan.long and not plan.gpu


def _seen(out: Function, plan: Plan, array: str, away: str) -> str:
    """The word for a value of an array, `away` from the particle's place in flat arrays: looked up,
    or from a row of them where all particles take in one slot after the other. `@` in the name is
    each axis."""
    if not _is_slot_after_slot(plan):
        return f"flat_{array}[at_j + {away}]"
    row = f"row_{array} = flat_{array}[base + {away}:base + {away} + width]"
    out.add(1, *dict.fromkeys(plan.each(row)))
    return f"row_{array}[j]"


def _write_slot(out: Function, plan: Plan, level: Level, sums: Sequence[str], near: str) -> None:
    there = _seen(out, plan, f"{level.source}_@", "away[s, k]")
    kind = _seen(out, plan, "kind", "away[s, k]")
    named = {Home.SLOT: f"weights{level.number}[s, k, {{n}}]", Home.CELL: "share_{n}"}
    depth = 1 if _is_slot_after_slot(plan) else 2
    if any(number.home is Home.CELL for number in level.seen.weights):
        for side in (0, 1):  # where cells are cut there are few slots
            out.add(depth, f"share_{side} = flat_share[at_j + cells_away[s, k, {side}]]")
    shown = [_seen(out, plan, array, "away[s, k]") for array in plan.shown]
    bonds, limits_ = (0, 0) if plan.tears else (plan.bonds, plan.limits)
    bond = [_seen(out, plan, f"bond{n}", "bonds_away[s, k]") for n in range(bonds)]
    fixed = [_seen(out, plan, f"limit{n}", "bonds_away[s, k]") for n in range(limits_)]
    first = plan.bonds_first and not plan.tears
    since = _seen(out, plan, "broken", "bonds_away[s, k]") if first else ""
    out.add(depth, f"r = {plan.vector('rests[s, k, #]')}")
    if _is_slot_after_slot(plan):
        out.add(1, "for j in range(width):")
        out.add(2, *displacements(plan, level))
    out.add(2, f"is_there = {kind} != {EMPTY}", difference(plan, level, there))
    out.add(2, *(f"b{n} = {value}" for n, value in enumerate(bond)))
    out.add(2, *(f"x{n} = {value}" for n, value in enumerate(fixed)))
    limits = {Home.SLOT: "limits[s, k, {n}]", Home.BOND: "b{n}", Home.FIXED_BOND: "x{n}"}
    c = f"Constants({values(level.seen.bond, limits)})"
    spares = plan.model and not plan.model.breaks_frame_bonds()
    can = f"({kind} == {FOLLOWER})" if spares else "is_there"
    breaks = f"breaks(signs[s, k] * d, signs[s, k] * r, {c}, q) and {can}"
    out.add(2, *bond_lines(plan, "k", "r", c, breaks, since))
    if plan.tears:
        out.add(2, *torn_at_slot(plan))
    weights = values(level.seen.weights, named)
    out.add(2, contributions(plan, level, "r", weights, shown, torn=plan.tears))
    if plan.mixed:
        _write_mixed(out, plan, level, shown)
    for n, t in enumerate(sums):
        out.add(2, f"{t} = {t} + ({plan.rounded(f'c{n}')} if is_there else {plan.number(0.0)})")
    out.add(2, f"{near} = {near} + (1 if is_there else 0)")


def _write_mixed(out: Function, plan: Plan, level: Level, shown: Sequence[str]) -> None:
    """What cells of a stiffness of their own add. Of the others' stiffness they have no share, and
    few particles are beside one."""
    nothing = plan.number(0.0)
    out.add(2, f"if share_0 == {nothing} or share_1 == {nothing}:")
    weights = []
    for side in (0, 1):
        out.add(3, f"cell_{side} = {plan.mixed} * (at_j + cells_away[s, k, {side}])")
    for m in range(plan.mixed):
        homes = {Home.SLOT: f"more{m}[s, k, {{n}}]", Home.CELL: f"flat_mixed[cell_{{n}} + {m}]"}
        weights.append(values(level.seen.weights, homes))
    out.add(3, *more_contributions(plan, level, "r", weights, shown))
