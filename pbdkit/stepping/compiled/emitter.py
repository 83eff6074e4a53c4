"""Writes the source of a scene's kernel: the sweeps that move particles, and the loop over steps.

Row by row the shortest code is run that serves: rest offsets and steps to neighbours are literals
where all neighbours are there. What varies from run to run (the rule's parameters, thresholds,
places) are arguments.
"""

from __future__ import annotations

from collections.abc import Sequence

from pbdkit.stepping.compiled.bond_pass import write_bond_pass, write_events
from pbdkit.stepping.compiled.plan import Function, Level, Plan
from pbdkit.stepping.compiled.rows import GENERAL, write_row
from pbdkit.stepping.compiled.slot_loop import write_general


def write_kernel(plan: Plan) -> tuple[str, list[str]]:
    """The source of a module with ``run(given, step, count, chunks, band)``, which takes the scene
    `count` steps further, and the names of the arrays that it is given."""
    events = write_events(plan) if plan.judged else None
    passes = [write_bond_pass(plan)] if plan.bonds_first else []
    functions = [*passes, *([events] if events else [])]
    for level in plan.levels:
        rows = _rows(plan, level, events)
        passes.append(_sweep(plan, level, rows))
        functions += [*dict.fromkeys(rows.values()), passes[-1]]
    run = Function(plan.shared, "run")
    _write_run(run, plan, passes)
    used = [name for name in run.used if name != "step"]
    head = [
        f'@njit(parallel={plan.parallel}, error_model="numpy", nogil=True, cache=KEPT)',
        "def run(given, step, count, chunks, band):",
        f"    {', '.join(used)}, = given",
    ]
    lines = [*write_tuples(plan), *(line for f in functions for line in f.source), "", "", *head]
    lines += ["    " + line for line in run.lines]
    return "\n".join(lines) + "\n", used


def write_tuples(plan: Plan) -> list[str]:
    """The named tuples that elementwise functions are called with."""
    seen = plan.levels[-1].seen
    names = {"Fracture": seen.fracture, "Constants": seen.bond}
    for level in plan.levels:
        n, own = level.number, level.seen
        names |= {f"Rule{n}": own.rule, f"Weights{n}": own.weights, f"Own{n}": own.own}
    found = ['"""Made by pbdkit for one kind of scene; not to be edited."""', ""]
    if plan.scene.axes == 3:
        found.append("Vector = SpaceVector")
    for kind, numbers in names.items():
        found.append(f'{kind} = namedtuple("{kind}", {[number.name for number in numbers]!r})')
    return found


def _rows(plan: Plan, level: Level, events: Function | None) -> dict[tuple[int, int], Function]:
    """The functions for the rows that occur, by sublattice and kind."""
    found, general = {}, None
    for s, kind in plan.rows:
        if kind == GENERAL:
            found[s, kind] = general = general or write_general(plan, level, events)
        else:
            found[s, kind] = write_row(plan, level, s, kind, events)
    return found


def _sweep(plan: Plan, level: Level, rows: dict[tuple[int, int], Function]) -> Function:
    """The function that moves the particles of some rows."""
    out = Function(plan.shared, f"sweep{level.number}", "first_row", "last_row")
    for n, ((s, kind), row) in enumerate(rows.items()):
        runs = [f"starts[{n}, first_row, 0]", f"starts[{n}, last_row, 1]"]
        sublattice = [str(s)] if kind == GENERAL else []
        out.add(0, row.call(*sublattice, *runs, "first_row", "last_row"))
    return out


def _write_run(out: Function, plan: Plan, passes: Sequence[Function]) -> None:
    flat = [(f"f{side}_{c}", f"{side}_{c}") for side in "uv" for c in plan.axes]
    out.add(0, "for _ in range(count):")
    out.add(1, "step += 1", *(f"{name} = {plane}.reshape(-1)" for name, plane in flat))
    out.add(1, "for e in range(led.size):")
    out.add(2, *(f"led_kept[{a}, e] = fu_{c}[led[e]]" for a, c in enumerate(plan.axes)))
    out.add(1, "for e in range(led.size):")
    out.add(2, *(f"fu_{c}[led[e]] = led_values[{a}, e]" for a, c in enumerate(plan.axes)))
    out.add(1, "for e in range(box.size):", "    box[e] += growth[e]")
    out.add(1, "i0, i1 = max(0, box[0]), min(starts.shape[1] - 1, box[1])")
    if plan.bonds_first:
        # Band by band, so that what the pass has read and written is still near when it is swept.
        back, ahead = plan.home_reach
        out.add(1, f"judged, last = max(0, i0 - {back}), min(starts.shape[1] - 1, i1 + {ahead})")
        out.add(1, "for low in range(i0, i1, band):", "    high = min(low + band, i1)")
        out.add(2, f"ready = last if high == i1 else min(high + {ahead}, last)")
        _write_pass(out, plan, 2, passes[0], "judged", "ready")
        out.add(2, "judged = ready")
        _write_pass(out, plan, 2, passes[1], "low", "high")
    else:
        for n, sweep in enumerate(passes):
            _write_pass(out, plan, 1, sweep, "i0", "i1")
            if n + 1 < len(passes) and plan.scene.frame:
                moves = [f"z{n}_{c}" for c in plan.axes]
                out.add(1, *(f"f{z} = {z}.reshape(-1)" for z in moves))
                _write_frame(out, plan, f"fz{n}", f"fz{n}")
    out.add(1, "for e in range(led.size):")
    out.add(2, *(f"fv_{c}[led[e]] = led_values[{a}, e]" for a, c in enumerate(plan.axes)))
    out.add(1, "for e in range(led.size):")
    out.add(2, *(f"fu_{c}[led[e]] = led_kept[{a}, e]" for a, c in enumerate(plan.axes)))
    if plan.scene.frame:
        _write_frame(out, plan, "fu" if plan.scene.frame.map.lag else "fv", "fv")
    u, v = plan.planes("u"), plan.planes("v")
    out.add(1, f"{u}, {v} = {v}, {u}")


def _write_pass(out: Function, plan: Plan, depth: int, one: Function, low: str, high: str) -> None:
    """A call for rows from `low` to `high`, or for parts of them on all threads."""
    if not plan.parallel:
        out.add(depth, one.call(low, high))
        return
    out.add(depth, "for c in prange(chunks):")
    span = (f"{low} + ({high} - {low}) * {c} // chunks" for c in ("c", "(c + 1)"))
    out.add(depth + 1, one.call(*span))


def _write_frame(out: Function, plan: Plan, source: str, target: str) -> None:
    """Frame points from flat planes of the body."""
    assert plan.scene.frame
    out.add(1, "for f in range(points.size):")
    out.add(2, *(f"t_{c} = {plan.number(0.0)}" for c in plan.axes))
    out.add(2, "for e in range(entries[f], entries[f + 1]):")
    for a, c in enumerate(plan.axes):
        if plan.scene.frame.map.weight.ndim == 3:
            terms = [
                f"mapped[e, {a}, {b}] * {source}_{d}[bodies[e]]" for b, d in enumerate(plan.axes)
            ]
            out.add(3, f"t_{c} = t_{c} + ({' + '.join(terms)})")
        else:
            out.add(3, f"t_{c} = t_{c} + mapped[e] * {source}_{c}[bodies[e]]")
    out.add(2, *(f"{target}_{c}[points[f]] = t_{c}" for c in plan.axes))
