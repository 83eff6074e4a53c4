"""Writes what looks at bonds where they are kept: the pass that renews and breaks them before the
sweeps, and what notes those that a sweep has broken."""

from __future__ import annotations

from pbdkit.interfaces import RenewsBonds
from pbdkit.scene.homes import Home
from pbdkit.scene.raster import EMPTY, FOLLOWER
from pbdkit.stepping.compiled.plan import Function, Plan, values


def write_bond_pass(plan: Plan) -> Function:
    """The function that renews the bonds of some rows, and breaks them."""
    out = Function(plan.shared, "judge_bonds", "first_row", "last_row")
    axes, seen, model = range(len(plan.axes)), plan.levels[-1].seen, plan.model
    bonds = [number for number in seen.bond if number.home is Home.BOND]
    literal = [plan.number(value) for value in plan.scene.constants.fracture]
    out.add(0, f"q = Fracture({values(seen.fracture, {}, literal)})")
    out.add(0, "for n in range(len(ends)):")
    out.add(1, f"r = {plan.vector(f'end_rests[n, {a}]' for a in axes)}")
    low, high = ([f"end_blocks[n, {2 * a + b}]" for a in axes] for b in (0, 1))
    out.add(1, f"for i in range(max({low[0]}, first_row), min({high[0]}, last_row)):")
    depth = 2
    if len(plan.axes) == 3:
        out.add(2, f"for l in range({low[1]}, {high[1]}):")
        depth = 3
    out.add(depth, f"j0, j1 = {low[-1]}, {high[-1]}")
    step = [f"ends[n, {a + 2}]" for a in axes]
    for c in plan.axes:
        out.add(depth, f"h{c} = {plan.row(f'u_{c}', 'ends[n, 0]')}")
        out.add(depth, f"n{c} = {plan.row(f'u_{c}', 'ends[n, 1]', step)}")
    out.add(depth, f"one = {plan.row('kind', 'ends[n, 0]')}")
    out.add(depth, f"other = {plan.row('kind', 'ends[n, 1]', step)}")
    out.add(depth, f"since = {plan.row('broken', 'n')}", f"ways = {plan.row('lengths', 'n')}")
    out.add(depth, *(f"b{m} = {plan.row(f'bond{m}', 'n')}" for m in range(len(bonds))))
    c = values(seen.bond, {Home.SLOT: "end_limits[n, {n}]", Home.BOND: "b{n}[j]"})
    can = f"((one[j] == {FOLLOWER}) & (other[j] == {FOLLOWER}))"
    if model.breaks_frame_bonds():
        can = (
            f"((one[j] == {FOLLOWER}) & (other[j] != {EMPTY}) | "
            f"(one[j] != {EMPTY}) & (other[j] == {FOLLOWER}))"
        )
    d = f"d = {plan.vector(f'n{c}[j] - h{c}[j]' for c in plan.axes)}"
    news: list[str] = []
    changing = [m for m, number in enumerate(bonds) if number.changes]
    if isinstance(model, RenewsBonds):
        news = [f"new = update(d, r, Constants({c}), q)"]
        news += [f"new{m} = new[{position}]" for position, m in enumerate(changing)]
        for m in changing:
            c = c.replace(f"b{m}[j]", f"new{m}")
    breaks = f"breaks(d, r, Constants({c}), q)"
    # One loop that looks, and vectorises; another one writes, where there is anything to write.
    changing = changing if news else []
    differ = "".join(f" | (new{m} != b{m}[j])" for m in changing)
    out.add(depth, "some = 0", "for j in range(j1 - j0):")
    out.add(depth + 1, d, *news, f"fresh = (since[j] < 0) & {can} & ({breaks}{differ})")
    out.add(depth + 1, "some = some | (1 if fresh else 0)")
    out.add(depth, "if some:", "    for j in range(j1 - j0):")
    out.add(depth + 2, f"if (since[j] < 0) & {can}:")
    out.add(depth + 3, d, *news, *(f"b{m}[j] = new{m}" for m in changing))
    out.add(depth + 3, f"if {breaks}:", "    since[j] = step", "    ways[j] = length(r + d)")
    return out


def write_events(plan: Plan) -> Function:
    """The function that notes step and length of the bonds in a row that the sweep has just broken,
    as their home end sees them; `base` is the row's first place."""
    out = Function(plan.shared, "note_broken", "s", "base", "width")
    out.add(0, "for here in range(base, base + width):")
    out.add(1, "bits = int64(flat_lost[here])", "for k in range(counts[s]):")
    out.add(2, "there, home = here + away[s, k], here + bonds_away[s, k]")
    # The home end notes it, or this end where that is no particle of the body.
    out.add(2, f"ours = signs[s, k] > 0 or flat_kind[there] != {FOLLOWER}")
    out.add(
        2, "if (bits >> k) & 1 and ours and flat_broken[home] < 0:", "    flat_broken[home] = step"
    )
    d = plan.vector(f"flat_u_{c}[there] - flat_u_{c}[here]" for c in plan.axes)
    r = plan.vector(f"rests[s, k, {a}]" for a in range(len(plan.axes)))
    out.add(3, f"flat_lengths[home] = length(signs[s, k] * {r} + signs[s, k] * {d})")
    out.flatten()
    return out
