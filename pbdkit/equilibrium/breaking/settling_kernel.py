"""Writes the kernel that settles a scene, renews and breaks its bonds, and settles again.

Of the matrix only the rows of particles whose bonds have changed are found anew, from the moves
that a nudge of each neighbour by 1 makes at rest: exact for linear rules.
"""

from __future__ import annotations

from pbdkit.scene.homes import Home
from pbdkit.stepping.compiled.bond_pass import write_bond_pass
from pbdkit.stepping.compiled.emitter import write_module
from pbdkit.stepping.compiled.following import write_frame
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.compiled.slot_loop import write_general

GOES_ON, SETTLED, FAILED = 0, 1, 2
"""What became of a call: bonds may still change, no bond changes any more, or the band does not
serve; then followers stand where they were before the last settling."""
ROWS = "int64(0)", "int64(kind.shape[1])"


def write_settling(plan: Plan) -> tuple[str, list[str]]:
    """The source of a module with ``run(given, step, tolerance, slack, most)``, which settles at
    most so often, to within the length `tolerance`, and leaves out changes of bonds within the
    share `slack`; it returns how often bonds have changed, and what became of it."""
    (level,) = plan.levels
    general = write_general(plan, level, None)
    follow = Function(plan.shared, "follow_body")
    if plan.scene.frame:
        follow.depth = -1
        write_frame(follow, plan, "flat_u", "flat_u")
    moves, derive = _write_moves(plan, follow, general), _write_derivative(plan, general)
    judge, mark, changed = write_bond_pass(plan), _write_mark(plan), _write_changed(plan)
    known, settle = _write_known(plan, derive), _write_settle(plan, follow, moves)
    run = Function(plan.shared, "run", "given", "step", "tolerance", "slack", "most")
    run.add(0, "for n in range(most):", f"    {mark.call()}")
    run.add(1, f"if not {known.call()} or not {settle.call('tolerance')}:")
    run.add(2, f"return n, {FAILED}")
    run.add(1, judge.call(*ROWS, "0", "kind.shape[2]"), f"if not {changed.call('slack')}:")
    run.add(2, f"return n, {SETTLED}")
    run.add(0, f"return most, {GOES_ON}")
    functions = [general, moves, derive, judge, mark, changed, known, settle]
    return write_module(plan, [follow, *functions] if follow.lines else functions, run)


def _write_moves(plan: Plan, follow: Function, general: Function) -> Function:
    """The function that writes r (follower, axis), the moves, with the frame in line."""
    out = Function(plan.shared, "find_moves")
    out.add(0, *[follow.call()] * bool(follow.lines), "for n in range(len(body)):")
    out.add(1, general.call("body[n, 0]", "body[n, 1]", "body[n, 2]", *ROWS))
    out.add(0, "for e in range(place.size):")
    out.add(1, *plan.each("residual[e, #] = flat_v_@[place[e]] - flat_u_@[place[e]]"))
    return out


def _write_derivative(plan: Plan, general: Function) -> Function:
    """The function that writes what each neighbour of a follower, and it itself, does to its move;
    `u` are planes at rest."""
    axes, planes = len(plan.axes), plan.each("u_@")
    out = Function(plan.shared, "derive", "e", *planes)
    out.add(0, "spot, s, i = place[e], sublattice[e], runs[e, 0]")
    out.add(0, f"for m in range(-1, {axes} * (counts[s] + 1)):")
    out.add(1, f"k, b = m // {axes}, m % {axes}")
    out.add(1, "there = spot + away[s, k] if m >= 0 and k < counts[s] else spot")
    out.add(1, f"f = ({', '.join(f'{u}.reshape(-1)' for u in planes)})[b]")
    out.add(1, "f[there] = 0.0 if m < 0 else 1.0")
    out.add(1, general.call("s", "e", "e + 1", "i", "i + 1"))
    out.add(1, "if m < 0:", *plan.each("    none_@ = flat_v_@[spot]"), "else:")
    out.add(2, *plan.each("blocks[e, k, #, b] = flat_v_@[spot] - u_@.reshape(-1)[spot] - none_@"))
    out.add(1, "f[there] = 0.0")
    return out


def _bonds(plan: Plan, pattern: str) -> list[str]:
    """The pattern for each number that is remembered of bonds."""
    return [pattern.replace("#", str(n)) for n in range(plan.bonds)]


def _write_mark(plan: Plan) -> Function:
    """The function that marks followers whose bonds, or those of the cells around them, are not as
    they were known; then they are."""
    out = Function(plan.shared, "mark")
    differs = _bonds(plan, " or flat_bond#[home] != flat_known#[home]")
    out.add(0, "cells = broken.size // len(ends)", "for n in range(len(ends)):")
    out.add(1, "way = ends[n, 2] * kind.shape[2] + ends[n, 3]", "for e in range(cells):")
    out.add(2, "home = n * cells + e")
    out.add(2, f"if flat_broken[home] != flat_known_broken[home]{''.join(differs)}:")
    out.add(3, "flat_known_broken[home] = flat_broken[home]")
    out.add(3, *_bonds(plan, "flat_known#[home] = flat_bond#[home]"))
    if plan.tears:
        out.add(3, "for m in range(mark_steps.shape[1]):")
        out.add(4, "end = ends[n, 0] * cells + e + mark_steps[n, m]")
    else:
        out.add(3, "for end in (ends[n, 0] * cells + e, ends[n, 1] * cells + e + way):")
    out.add(4, "if 0 <= end < equation.size and equation[end] >= 0:")
    out.add(5, "stale[equation[end]] = 1")
    return out


def _write_changed(plan: Plan) -> Function:
    """The function that tells whether bonds broke or changed; else they are as they were known."""
    out = Function(plan.shared, "changed", "slack")
    numbers = [n for n in plan.levels[-1].seen.bond if n.home is Home.BOND]
    changing = [str(n) for n, number in enumerate(numbers) if number.changes]
    out.add(0, "for home in range(broken.size):")
    out.add(1, "if flat_broken[home] >= 0 and flat_known_broken[home] < 0:", "    return True")
    for n in changing:
        out.add(1, f"new, old = flat_bond{n}[home], flat_known{n}[home]")
        out.add(1, "if abs(new - old) > slack * max(1.0, abs(old)):", "    return True")
    if changing:
        out.add(0, "for home in range(broken.size):")
        out.add(1, *(f"flat_bond{n}[home] = flat_known{n}[home]" for n in changing))
    out.add(0, "return False")
    return out


def _write_known(plan: Plan, derive: Function) -> Function:
    """The function that brings the factors up to date; it tells whether they serve."""
    out = Function(plan.shared, "know")
    out.add(0, "since = place.size", "for e in range(place.size):", "    if stale[e]:")
    out.add(2, derive.call("e", *plan.each("still_@")), "stale[e], since = 0, min(since, e)")
    out.add(0, "pattern = first_entry, entry_slot, entry_column, entry_weight")
    out.add(0, "factors = diagonal, inverse, randoms", "if since < place.size:")
    out.add(1, "refactor(band, blocks, pattern, factors, facts, since, alike[0])")
    out.add(0, "return facts[1] < facts[4]")
    return out


def _write_settle(plan: Plan, follow: Function, moves: Function) -> Function:
    """The function that moves the followers to where they rest, and tells whether it did."""
    out = Function(plan.shared, "settle", "tolerance")
    at = plan.each("flat_u_@[place[e]]")
    out.add(0, "factors, before = (diagonal, inverse, randoms), 0.0", "for e in range(place.size):")
    out.add(1, *(f"kept[e, {a}] = {value}" for a, value in enumerate(at)))
    out.add(0, "for n in range(corrections[0]):", f"    {moves.call()}")
    out.add(1, "correct(band, factors, facts, residual, correction)")
    out.add(1, "size, left, ways = 0.0, norm(residual), 0.0")
    out.add(1, *plan.each("size = max(size, largest(u_@.reshape(-1, 1)))"))
    out.add(1, "unsure = facts[2] * facts[5] * size", "floor = unsure * residual.size**0.5")
    out.add(1, "for a in range(correction.shape[1]):")
    out.add(2, "ways += (largest(correction[:, a : a + 1]) + facts[1] * unsure) ** 2")
    out.add(1, "if n > 0 and ways <= tolerance**2:", "    return True")
    out.add(1, "before = left if n == 0 else before")
    out.add(1, "allowed = left if n == 0 else max(facts[6] * before + floor, 1e3 * floor)")
    out.add(1, "if not left <= allowed:")
    out.add(2, "break")
    out.add(1, "for e in range(place.size):")
    out.add(2, *(f"{value} += correction[e, {a}]" for a, value in enumerate(at)))
    out.add(0, "for e in range(place.size):")
    out.add(1, *(f"{value} = kept[e, {a}]" for a, value in enumerate(at)))
    out.add(0, *[follow.call()] * bool(follow.lines), "return False")
    return out
