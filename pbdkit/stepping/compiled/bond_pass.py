"""Writes what looks at bonds where they are kept: the pass that renews and breaks them before the
sweeps, and what notes those that a sweep has broken."""

from __future__ import annotations

from typing import NamedTuple

from pbdkit.interfaces import RenewsBonds
from pbdkit.scene.homes import Home
from pbdkit.scene.raster import EMPTY, FOLLOWER
from pbdkit.stepping.compiled.particle import parameters
from pbdkit.stepping.compiled.plan import Function, Plan, values
from pbdkit.stepping.compiled.tearing import marking_lines, stress_lines


def write_bond_pass(plan: Plan) -> Function:
    """The function that renews the bonds of some rows and columns, and breaks them."""
    rows, columns = ("first_row", "last_row"), ("first_column", "last_column")
    out = Function(plan.shared, "judge_bonds", *rows, *columns)
    axes = range(len(plan.axes))
    low, high = ([f"end_blocks[n, {2 * a + b}]" for a in axes] for b in (0, 1))
    out.add(0, parameters(plan, plan.levels[-1])[-1], "for n in range(len(ends)):")
    out.add(1, f"r = {plan.vector('end_rests[n, #]')}")
    out.add(1, f"for i in range(max({low[0]}, first_row), min({high[0]}, last_row)):")
    for depth, name in enumerate(plan.lead[1:], 2):
        out.add(depth, f"for {name} in range({low[depth - 1]}, {high[depth - 1]}):")
    out.depth = len(plan.axes)
    step = [f"ends[n, {a + 2}]" for a in axes]
    out.add(0, f"j0, j1 = max({low[-1]}, first_column), min({high[-1]}, last_column)")
    out.add(0, "if j0 >= j1:", "    continue")
    out.add(0, *plan.each(f"h@ = {plan.row('u_@', 'ends[n, 0]')}"))
    out.add(0, *plan.each(f"n@ = {plan.row('u_@', 'ends[n, 1]', step)}"))
    out.add(0, f"one = {plan.row('kind', 'ends[n, 0]')}")
    out.add(0, f"other = {plan.row('kind', 'ends[n, 1]', step)}")
    out.add(0, f"since = {plan.row('broken', 'n')}", f"ways = {plan.row('lengths', 'n')}")
    out.add(0, *(f"b{m} = {plan.row(f'bond{m}', 'n')}" for m in range(plan.bonds)))
    out.add(0, *(f"x{m} = {plan.row(f'limit{m}', 'n')}" for m in range(plan.limits)))
    if plan.tears:
        out.add(0, f"bond_base, base = {plan.flat('n')}, {plan.flat('ends[n, 0]')}")
    _write_judging(out, plan)
    return out


class Judging(NamedTuple):
    """What is done with the bond j of plane n: the lines that look at it, whether it breaks and
    whether what it remembers differs then, and the lines that write both."""

    look: list[str]
    breaks: str
    differ: str
    write: list[str]


def judging(plan: Plan, d: str, home: str) -> Judging:
    """For a bond whose d has this pattern, and whose end where it is kept has this flat place."""
    numbers = plan.levels[-1].seen.bond
    homes = {Home.SLOT: "end_limits[n, {n}]", Home.BOND: "b{n}[j]", Home.FIXED_BOND: "x{n}[j]"}
    c = values(numbers, homes)
    look = [f"d = {plan.vector(d)}"]
    kept = [number.changes for number in numbers if number.home is Home.BOND]
    renews = isinstance(plan.model, RenewsBonds)
    changing = [m for m, changes in enumerate(kept) if changes and renews]
    if changing:
        cells = ""
        if plan.softens_cells:
            look += stress_lines(plan, home)
            cells = ", left, right"
        look.append(f"new = update(d, r, Constants({c}), q{cells})")
    for position, m in enumerate(changing):
        look.append(f"new{m} = new[{position}]")
        c = c.replace(f"b{m}[j]", f"new{m}")
    breaks = f"breaks(d, r, Constants({c}), q)"
    differ = "".join(f" | (new{m} != b{m}[j])" for m in changing)
    renewed = [f"b{m}[j] = new{m}" for m in changing]
    broken = [f"if {breaks}:", "    since[j] = step", "    ways[j] = length(r + d)"]
    return Judging(look, breaks, differ, [*look, *renewed, *broken])


def _write_judging(out: Function, plan: Plan) -> None:
    """One row of bonds."""
    can = f"((one[j] == {FOLLOWER}) & (other[j] == {FOLLOWER}))"
    if plan.model.breaks_frame_bonds():
        can = (
            f"((one[j] == {FOLLOWER}) & (other[j] != {EMPTY}) | "
            f"(one[j] != {EMPTY}) & (other[j] == {FOLLOWER}))"
        )
    own = judging(plan, "n@[j] - h@[j]", "base + j")
    # Loops that look, and vectorise; the last one writes, where there is anything to write. What is
    # far from breaking is told by lengths alone, which takes half the time.
    out.add(0, "some = 0", "for j in range(j1 - j0):")
    out.add(1, *own.look, f"some = some | (1 if {own.breaks}{own.differ} else 0)")
    out.add(0, "if some:", "    some = 0", "    for j in range(j1 - j0):")
    out.add(2, *own.look, f"fresh = (since[j] < 0) & {can} & ({own.breaks}{own.differ})")
    out.add(2, "some = some | (1 if fresh else 0)")
    out.add(0, "if some:", "    for j in range(j1 - j0):")
    write = [*own.write, *marking_lines(plan, "bond_base + j", "base + j")]
    out.add(2, f"if (since[j] < 0) & {can}:", *("    " + line for line in write))


def write_events(plan: Plan) -> Function:
    """The function that notes step and length of the bonds in a row that the sweep has just broken,
    as their home end sees them; `base` is the row's first place."""
    out = Function(plan.shared, "note_broken", "s", "base", "width")
    out.add(0, "for here in range(base, base + width):")
    out.add(1, "bits = int64(flat_lost[here])", "for k in range(counts[s]):")
    out.add(2, "there, home = here + away[s, k], here + bonds_away[s, k]")
    # The home end notes it, or this end where that is no particle of the body.
    out.add(2, f"ours = signs[s, k] > 0 or flat_kind[there] != {FOLLOWER}")
    out.add(2, "if (bits >> k) & 1 and ours and flat_broken[home] < 0:")
    out.add(3, "flat_broken[home] = step")
    d, r = plan.vector("flat_u_@[there] - flat_u_@[here]"), plan.vector("rests[s, k, #]")
    out.add(3, f"flat_lengths[home] = length(signs[s, k] * {r} + signs[s, k] * {d})")
    return out
