"""Writes the source of a scene's kernel: the sweeps that move particles, and the loop over steps.

Row by row the shortest code is run that serves: rest offsets and steps to neighbours are literals
where all neighbours are there. What varies from run to run (the rule's parameters, thresholds,
places) are arguments.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pbdkit.stepping.numba_engine.blocking import write_deep_passes, write_piece
from pbdkit.stepping.numba_engine.boundary import (
    write_frame,
    write_guiding,
    write_leading,
    write_obstacle_pass,
    write_slants,
)
from pbdkit.stepping.numba_engine.plan import Function, Level, Plan, goes_deep
from pbdkit.stepping.numba_engine.sweeps import (
    GENERAL,
    write_bond_pass,
    write_events,
    write_general,
    write_row,
)

Groups = Sequence[tuple[int, int]]
"""The sublattice and kind of the rows that occur."""


def write_kernel(plan: Plan, groups: Groups) -> tuple[str, list[str]]:
    """The source of a module with ``run(given, step, count, chunks, band)``, which takes the scene
    `count` steps further, and the names of the arrays that it is given."""
    events = write_events(plan) if plan.judged else None
    passes = [write_bond_pass(plan)] if plan.bonds_first else []
    functions = [events] if events else list(passes)
    for level in plan.levels:
        functions += _sweep(plan, level, groups, events)
        passes.append(functions[-1])
    pushing = write_obstacle_pass(plan) if plan.scene.barriers else None
    functions += [pushing] if pushing else []
    pieces = write_piece(plan, passes, pushing) if goes_deep(plan) else []
    functions += pieces
    run = Function(plan.shared, "run", "given", "step", "count", "chunks", "band")
    _write_run(run, plan, passes, pushing, *pieces[-1:])
    return write_module(plan, functions, run)


def write_module(plan: Plan, functions: Iterable[Function], run: Function) -> tuple[str, list[str]]:
    """The source of a module with these functions, of which `run` is called from outside, and the
    names of the arrays that it is given."""
    jit = f'@njit(parallel={plan.parallel}, error_model="numpy", nogil=True, cache=KEPT)'
    head = [jit, f"def run({', '.join(run.own)}):", f"    {', '.join(run.used)}, = given"]
    return module_text(plan, functions, head, run), run.used


def module_text(
    plan: Plan, functions: Iterable[Function], head: Iterable[str], run: Function
) -> str:
    """The source of a module with these functions and `run`, which has a head of its own."""
    seen = plan.levels[-1].seen
    kinds = {"Fracture": seen.fracture, "Constants": seen.bond}
    for n, level in enumerate(plan.levels):
        own = level.seen
        kinds |= {f"Rule{n}": own.rule, f"Weights{n}": own.weights, f"Own{n}": own.own}
    lines = ['"""Made by pbdkit for one kind of scene; not to be edited."""', ""]
    if plan.scene.axes == 3:
        lines.append("Vector = SpaceVector")
    for kind, numbers in kinds.items():
        lines.append(f'{kind} = namedtuple("{kind}", {[number.name for number in numbers]!r})')
    lines += [line for function in functions for line in function.source]
    lines += ["", "", *head, *("    " + line for line in run.lines)]
    return "\n".join(lines) + "\n"


def _sweep(plan: Plan, level: Level, groups: Groups, events: Function | None) -> list[Function]:
    """The functions for the rows that occur, and last the one that moves the particles of some rows
    with them."""
    out = Function(plan.shared, f"sweep{level.number}", "first_row", "last_row")
    general, found = write_general(plan, level, events), list[Function]()
    for n, (s, kind) in enumerate(groups):
        runs = [f"starts[{n}, first_row, 0]", f"starts[{n}, last_row, 1]", "first_row", "last_row"]
        if kind == GENERAL:
            found.append(general)
            runs.insert(0, str(s))
        else:
            found += write_row(plan, level, s, kind, events)
        out.add(0, found[-1].call(*runs))
    return [*dict.fromkeys(found), out]


def _write_run(
    out: Function,
    plan: Plan,
    passes: Sequence[Function],
    pushing: Function | None,
    piece: Function | None = None,
) -> None:
    if piece:
        write_deep_passes(out, plan, piece)
    else:
        out.add(0, "for made in range(count):")
    out.add(1, "step += 1")
    for side in "uv":
        out.add(1, *plan.each(f"f{side}_@ = {side}_@.reshape(-1)"))
    write_leading(out, plan, "led_kept[#, e] = fu_@[led[e]]")
    write_leading(out, plan, "fu_@[led[e]] = held[#, e]")
    write_guiding(out, plan)
    out.add(1, *(f"was{m}[:] = own{m}" for m in plan.kept))
    out.add(1, "for e in range(box.size):", "    box[e] += growth[e]")
    out.add(1, "i0, i1 = max(0, box[0]), min(starts.shape[1] - 1, box[1])")
    if plan.bonds_first:
        _write_bands(out, plan, *passes)
    else:
        for n, sweep in enumerate(passes):
            write_pass(out, plan, 1, sweep, "i0", "i1")
            if n + 1 < len(passes) and plan.scene.frame:
                out.add(1, *plan.each(f"fz{n}_@ = z{n}_@.reshape(-1)"))
                write_frame(out, plan, f"fz{n}", f"fz{n}")
    for m in plan.rotations:
        out.add(1, f"now, was = own{m}.reshape(-1), was{m}.reshape(-1)")
        out.add(1, "for e in range(clamped.size):", "    now[clamped[e]] = was[clamped[e]]")
    write_slants(out, plan)
    if pushing:
        write_guiding(out, plan)
        write_pass(out, plan, 1, pushing, "i0", "i1", "made")
    write_leading(out, plan, "fv_@[led[e]] = held[#, e]", "fu_@[led[e]] = led_kept[#, e]")
    if plan.scene.frame:
        write_frame(out, plan, "fu" if plan.scene.frame.map.lag else "fv", "fv")
    u, v = (", ".join(plan.each(f"{name}_@")) for name in "uv")
    out.add(1, f"{u}, {v} = {v}, {u}", *(["made += 1"] if piece else []))


def _write_bands(out: Function, plan: Plan, judging: Function, sweep: Function) -> None:
    """Band by band, so that what the pass over bonds has read and written is still near when it is
    swept."""
    back, ahead = (along[0] for along in plan.scene.home_reach)
    out.add(1, f"judged, last = max(0, i0 - {back}), min(starts.shape[1] - 1, i1 + {ahead})")
    out.add(1, "for low in range(i0, i1, band):", "    high = min(low + band, i1)")
    out.add(2, f"ready = last if high == i1 else min(high + {ahead}, last)")
    write_pass(out, plan, 2, judging, "judged", "ready", "0", "kind.shape[-1]")
    out.add(2, "judged = ready")
    write_pass(out, plan, 2, sweep, "low", "high")


def write_pass(
    out: Function, plan: Plan, depth: int, one: Function, low: str, high: str, *more: str
) -> None:
    """A call for rows from `low` to `high`, or for parts of them on all threads."""
    if not plan.parallel:
        out.add(depth, one.call(low, high, *more))
        return
    out.add(depth, "for c in prange(chunks):")
    span = (f"{low} + ({high} - {low}) * {c} // chunks" for c in ("c", "(c + 1)"))
    out.add(depth + 1, one.call(*span, *more))
