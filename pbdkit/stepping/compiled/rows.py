"""Writes what is done in a row of particles that have all their neighbours, slot by slot: rest
offsets, steps and weights are literals, so that what cancels at rest folds away."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pbdkit.interfaces import Slot
from pbdkit.scene.homes import Home
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.compiled.particle import (
    RUNS,
    bond_lines,
    contributions,
    difference,
    displacements,
    local_places,
    parameters,
    target_lines,
    write_row_loop,
    write_rows,
)
from pbdkit.stepping.compiled.plan import Function, Plan, listed, values
from pbdkit.stepping.compiled.tearing import CHUNK, RowDamage

NOBODY, GENERAL, PLAIN, WITH_CELLS = range(4)
"""Kinds of rows: those where no particle follows; where something may be missing; where all
neighbours are there and cells are whole; where cells are not."""


class Words(NamedTuple):
    """The words for what one neighbour and its bond have: what stands there, with `@` for the axis;
    what is remembered of it; the shares of the cells beside its slot, none where cells are whole;
    with `{n}` for their numbers what is remembered of the bond, and its limits; and since when it
    is broken."""

    there: str
    shown: Sequence[str]
    shares: Sequence[str]
    bond: str
    limit: str
    since: str


def write_row(
    plan: Plan, level: Level, s: int, kind: int, events: Function | None
) -> list[Function]:
    """The functions that move the particles of such a row, the one to be called last."""
    out = Function(plan.shared, f"row{level.number}_{s}_{kind}", *RUNS)
    write_row_loop(out, plan, level, str(s))
    words = _write_neighbours(out, plan, level, s, kind)
    if plan.judged:
        out.add(0, f"gone = {plan.row('lost', s)}", "changed = 0")
    if plan.tears:
        out.add(0, f"marks = {plan.row('torn', s)}", "marked = 0")
    out.add(0, "for j in range(j1 - j0):")
    write_whole(out, plan, level, s, words, "gone[j]", "marks[j]" if plan.tears else "")
    if events:
        out.add(0, "if changed:")
        out.add(1, events.call(str(s), plan.flat(str(s)), "j1 - j0"))
    if not plan.tears:
        return [out]
    torn = write_torn_row(plan, level, s, kind)
    out.add(1, "marked = marked | marks[j]")
    _write_marked(out, torn)
    return [torn, out]


def _write_neighbours(out: Function, plan: Plan, level: Level, s: int, kind: int) -> list[Words]:
    """The rows of the neighbours of a row, and the words for what each has."""
    slots = plan.scene.neighbourhood.slots[s]
    for k, slot in enumerate(slots):
        there = plan.row(f"{level.source}_@", slot.target, slot.cell)
        out.add(0, *plan.each(f"n{k}@ = {there}"), *_bond_rows(plan, k, slot))
        shown = (plan.row(array, slot.target, slot.cell) for array in plan.shown)
        out.add(0, *(f"e{k}_{m} = {row}" for m, row in enumerate(shown)))
    shares: dict[str, str] = {}
    if kind == WITH_CELLS:
        rows = dict.fromkeys(row for slot in slots for row in _beside(plan, slot))
        shares = {row: f"s{n}" for n, row in enumerate(rows)}
    out.add(0, *(f"{name} = {row}" for row, name in shares.items()))
    words = []
    for k, slot in enumerate(slots):
        own = [f"e{k}_{m}[j]" for m in range(len(plan.shown))]
        beside = [f"{shares[row]}[j]" for row in _beside(plan, slot)] if shares else []
        bond = f"b{k}_{{n}}[j]", f"x{k}_{{n}}[j]", f"f{k}[j]"
        words.append(Words(f"n{k}@[j]", own, beside, *bond))
    return words


def write_whole(
    out: Function,
    plan: Plan,
    level: Level,
    s: int,
    words: Sequence[Words],
    lost: str,
    mark: str = "",
    damage: RowDamage | None = None,
) -> None:
    """The lines, in a loop, for a particle that has all its neighbours, with the words for each and
    for its `lost` bonds. Where cells can be torn, particles with a `mark` stay as they are, or with
    the damage around them the others."""
    out.add(1, *displacements(plan, level))
    if plan.judged:
        out.add(1, f"bits = int64({lost})", "now = bits")
    for k, slot in enumerate(plan.scene.neighbourhood.slots[s]):
        out.add(1, *_slot_lines(plan, level, k, slot, words[k], damage))
    chosen: tuple[str, ...] = ()
    if mark:
        chosen = f"{mark} {'!=' if damage else '=='} 0", "o@[j]"
    out.add(1, *target_lines(plan, level, local_places(plan, str(s)), level.totals, *chosen))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", f"{lost} = now")


def write_torn_row(plan: Plan, level: Level, s: int, kind: int) -> Function:
    """The function that moves the marked particles of such a row, from j0 to j1. All that it reads
    begins at j0, so that its loops vectorise."""
    out = Function(plan.shared, f"torn{level.number}_{s}_{kind}", *plan.lead, "j0", "j1")
    damage = RowDamage(plan, s)
    out.add(0, *parameters(plan, level))
    write_rows(out, plan, level, str(s))
    words = _write_neighbours(out, plan, level, s, kind)
    out.add(0, f"marks = {plan.row('torn', s)}", *damage.lines, "for j in range(j1 - j0):")
    write_whole(out, plan, level, s, words, "", "marks[j]", damage)
    return out


def _write_marked(out: Function, torn: Function) -> None:
    """A call for each chunk of a row in which particles are marked."""
    *lead, _, _ = torn.own
    out.add(0, "if marked:", f"    for begin in range(0, j1 - j0, {CHUNK}):")
    out.add(2, f"end, marked = min(begin + {CHUNK}, j1 - j0), 0", "for j in range(begin, end):")
    out.add(3, "marked = marked | marks[j]")
    out.add(2, "if marked:", "    " + torn.call(*lead, "j0 + begin", "j0 + end"))


def _slot_lines(
    plan: Plan, level: Level, k: int, slot: Slot, words: Words, damage: RowDamage | None
) -> list[str]:
    """The contributions of one neighbour."""
    bond = {
        Home.SLOT: f"limits[{slot.source}, {k}, {{n}}]",
        Home.BOND: words.bond,
        Home.FIXED_BOND: words.limit,
    }
    c = f"Constants({values(level.seen.bond, bond)})"
    # A bond is judged as its home end sees it, so that both ends agree to the last bit.
    _, at_home = plan.scene.neighbourhood.home[slot]
    seen = f"d, {plan.literal(slot.rest)}" if at_home else f"-d, {plan.literal(-slot.rest)}"
    literal = level.scene.constants.weights[slot]._asdict()
    weights = {name: plan.number(value) for name, value in literal.items()}
    if words.shares:
        weights["left"], weights["right"] = words.shares
    r = plan.literal(slot.rest)
    return [
        difference(plan, level, words.there),
        *bond_lines(plan, k, r, c, f"breaks({seen}, {c}, q)", words.since),
        *([damage.beside(slot)] if damage else []),
        contributions(plan, level, r, listed(weights.values()), words.shown, damage is not None),
        *(
            f"t{n} = {f't{n} + ' if k else ''}{plan.rounded(f'c{n}')}"
            for n in range(len(level.totals))
        ),
    ]


def _bond_rows(plan: Plan, k: int, slot: Slot) -> list[str]:
    """The rows of what is known of the bonds along a slot, where they are kept."""
    if plan.model is None or plan.tears:
        return []
    plane, at_home = plan.scene.neighbourhood.home[slot]
    rows = {f"b{k}_{n}": f"bond{n}" for n in range(plan.bonds)}
    rows |= {f"x{k}_{n}": f"limit{n}" for n in range(plan.limits)}
    if not plan.judged:
        rows[f"f{k}"] = "broken"
    step = None if at_home else slot.cell
    return [f"{name} = {plan.row(array, plane, step)}" for name, array in rows.items()]


def _beside(plan: Plan, slot: Slot) -> list[str]:
    """The rows of shares of the cells on both sides of a slot."""
    assert plan.scene.cells
    rows = []
    for side in plan.scene.cells.tiling.beside[slot]:
        target, step = (side.first.target, side.first.cell) if side.first else (slot.source, None)
        rows.append(plan.row("share", f"{side.kind}, {target}", step))
    return rows
