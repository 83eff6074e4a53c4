"""Writes the source of a scene's kernel for a GPU: many steps a launch.

The order within a step is that of `stepping/numpy_engine.py`. Between its parts all threads wait
for each other, at places that are few: what a part writes, none reads before the next.
"""

from __future__ import annotations

from collections.abc import Iterable

from pbdkit.stepping.compiled.bond_pass import write_events
from pbdkit.stepping.compiled.emitter import module_text
from pbdkit.stepping.compiled.following import write_frame
from pbdkit.stepping.compiled.leading import write_leading
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.gpu.places import THREAD, Whole, write_bonds, write_sweep


def write_kernel(plan: Plan, whole: Whole, alone: bool) -> tuple[str, list[str]]:
    """The source of a module with ``run(step, count, ...)``, which takes the scene `count` steps
    further, and the names of the arrays that follow these two. A block that is `alone` waits for
    its own threads only, which takes much less time."""
    events = write_events(plan) if plan.judged else None
    judge = write_bonds(plan) if plan.bonds_first else None
    sweeps = [write_sweep(plan, level, whole, events) for level in plan.levels]
    functions = [function for function in (events, judge, *sweeps) if function]
    run = Function(plan.shared, "run", "step", "count")
    run.add(0, "me, threads = cuda.grid(1), cuda.gridsize(1)")
    wait = "cuda.syncthreads()" if alone else "everyone.sync()"
    if not alone:
        run.add(0, "everyone = cuda.cg.this_grid()")
    run.add(0, "for made in range(count):", "    step += 1")
    _write_step(run, plan, judge, sweeps, wait)
    head = ["@kernel", f"def run({', '.join([*run.own, *run.used])}):"]
    return module_text(plan, functions, head, run), run.used


def _write_step(
    out: Function, plan: Plan, judge: Function | None, sweeps: Iterable[Function], wait: str
) -> None:
    leading = "led_kept[#, e] = flat_u_@[led[e]]", "flat_u_@[led[e]] = held[#, e]"
    write_leading(out, plan, *leading)
    for m in plan.kept:
        out.add(1, f"for e in {plan.over(f'flat_own{m}.size')}:")
        out.add(2, f"flat_was{m}[e] = flat_own{m}[e]")
    out.add(1, wait)
    if judge:
        out.add(1, judge.call(*THREAD), wait)
    for n, sweep in enumerate(sweeps):
        if n and plan.scene.frame:
            write_frame(out, plan, f"flat_z{n - 1}", f"flat_z{n - 1}")
            out.add(1, wait)
        out.add(1, sweep.call(*THREAD), wait)
    after = "flat_v_@[led[e]] = held[#, e]", "flat_u_@[led[e]] = led_kept[#, e]"
    write_leading(out, plan, *after)
    if frame := plan.scene.frame:
        out.add(1, wait)
        write_frame(out, plan, "flat_u" if frame.map.lag else "flat_v", "flat_v")
        out.add(1, wait)
    u, v = (", ".join(plan.each(f"flat_{name}_@")) for name in "uv")
    out.add(1, f"{u}, {v} = {v}, {u}")
