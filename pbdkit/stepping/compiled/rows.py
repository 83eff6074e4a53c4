"""Writes what is done in a row of particles that have all their neighbours, slot by slot: rest
offsets, steps and weights are literals, so that what cancels at rest folds away."""

from __future__ import annotations

from pbdkit.interfaces import Slot
from pbdkit.interfaces.polygons import Side
from pbdkit.scene.homes import Home
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

NOBODY, GENERAL, PLAIN, WITH_CELLS = range(4)
"""Kinds of rows: those where no particle follows; where something may be missing; where all
neighbours are there and cells are whole; where cells are not."""


def write_row(plan: Plan, level: Level, s: int, kind: int, events: Function | None) -> Function:
    """The function that moves the particles of such a row."""
    name, with_cells = f"row{level.number}_{s}_{kind}", kind == WITH_CELLS
    out = Function(plan.shared, name, *RUNS)
    slots = plan.scene.neighbourhood.slots[s]
    out.add(0, *named_tuples(plan, level))
    write_row_loop(out, plan)
    out.add(0, *here_rows(plan, level, str(s)))
    source = _source(level)
    for k, slot in enumerate(slots):
        for c in plan.axes:
            out.add(0, f"n{k}{c} = {plan.row(f'{source}_{c}', slot.target, slot.cell)}")
        out.add(0, *_bond_rows(plan, k, slot))
    if with_cells:
        out.add(0, *_share_rows(plan, s))
    if plan.judged:
        out.add(0, f"gone = {plan.row('lost', s)}", "changed = 0")
    out.add(0, "for j in range(j1 - j0):")
    out.add(1, f"u = {plan.vector(f'h{c}[j]' for c in plan.axes)}")
    if level.number:
        out.add(1, f"z = {plan.vector(f'z{c}[j]' for c in plan.axes)}")
    if plan.judged:
        out.add(1, "bits = int64(gone[j])", "now = bits")
    for k, slot in enumerate(slots):
        _write_slot(out, plan, level, k, slot, with_cells)
    totals = [f"t{n}" for n in range(sum(level.parts))]
    out.add(1, *target_lines(plan, level, local_places(plan, str(s)), totals))
    if events:
        out.add(1, "changed = changed | (now ^ bits)", "gone[j] = now")
        out.add(0, "if changed:")
        out.add(1, events.call(str(s), plan.flat(str(s)), "j1 - j0"))
    return out


def _write_slot(
    out: Function, plan: Plan, level: Level, k: int, slot: Slot, with_cells: bool
) -> None:
    """The contributions of one neighbour."""
    r = plan.vector(map(plan.number, slot.rest))
    here = "z" if level.number else "u"
    out.add(1, f"d = {plan.vector(f'n{k}{c}[j] - {here}.{c}' for c in plan.axes)}")
    if plan.model is not None:
        _, at_home = plan.scene.neighbourhood.home[slot]
        bond = {Home.SLOT: f"limits[{slot.source}, {k}, {{n}}]", Home.BOND: f"b{k}_{{n}}[j]"}
        c = f"Constants({values(level.seen.bond, bond)})"
        if plan.judged:
            # A bond is judged as its home end sees it, so that both ends agree to the last bit.
            seen, sign = ("d", 1.0) if at_home else ("-d", -1.0)
            rest = plan.vector(plan.number(sign * value) for value in slot.rest)
            out.add(1, f"breaks_now = 1 if breaks({seen}, {rest}, {c}, q) else 0")
            out.add(1, f"is_lost = ((bits >> {k}) & 1) | breaks_now")
            out.add(1, f"now = now | (is_lost << {k})")
        else:
            out.add(1, f"is_lost = f{k}[j] >= 0")
        out.add(1, *lost_lines(plan, r, c))
    literal = [plan.number(value) for value in level.scene.constants.weights[slot]]
    if with_cells:
        left, right = (f"{_share_name(plan, slot, side)}[j]" for side in _beside(plan, slot))
        literal = [
            {"left": left, "right": right}.get(name.name, text)
            for name, text in zip(level.seen.weights, literal, strict=True)
        ]
    w = f"Weights{level.number}({values(level.seen.weights, {}, literal)})"
    out.add(1, f"{contributions(level)}, = gather{level.number}(d, {r}, {w}, p)")
    for n in range(sum(level.parts)):
        out.add(1, f"t{n} = c{n}" if k == 0 else f"t{n} = t{n} + c{n}")


def _source(level: Level) -> str:
    """The planes that a level's differences are taken of."""
    return f"z{level.number - 1}" if level.number else "u"


def _bond_rows(plan: Plan, k: int, slot: Slot) -> list[str]:
    """The rows of what is known of the bonds along a slot, where they are kept."""
    if plan.model is None:
        return []
    plane, at_home = plan.scene.neighbourhood.home[slot]
    step = None if at_home else slot.cell
    bonds = [n for n in plan.levels[-1].seen.bond if n.home is Home.BOND]
    lines = [f"b{k}_{n} = {plan.row(f'bond{n}', plane, step)}" for n in range(len(bonds))]
    return lines if plan.judged else [*lines, f"f{k} = {plan.row('broken', plane, step)}"]


def _beside(plan: Plan, slot: Slot) -> tuple[Side, Side]:
    assert plan.scene.cells
    return plan.scene.cells.tiling.beside[slot]


def _share_name(plan: Plan, slot: Slot, side: Side) -> str:
    """The row of shares of the cells to one side of a slot."""
    slots = plan.scene.neighbourhood.slots[slot.source]
    return f"s{side.kind}_{'own' if side.first is None else slots.index(side.first)}"


def _share_rows(plan: Plan, s: int) -> list[str]:
    """The rows of shares of all cells around the particles of a row, once each."""
    rows = {}
    for slot in plan.scene.neighbourhood.slots[s]:
        for side in _beside(plan, slot):
            target, step = (side.first.target, side.first.cell) if side.first else (s, None)
            at = f"{side.kind}, {target}"
            rows[_share_name(plan, slot, side)] = plan.row("share", at, step)
    return [f"{name} = {row}" for name, row in rows.items()]
