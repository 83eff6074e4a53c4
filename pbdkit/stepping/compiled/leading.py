"""Writes what a kernel does with leaders, and the arrays that it is given of them.

Where some are guided, those that lead along an axis are listed for each axis by itself.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np

from pbdkit.scene.guides import has_guides
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.guidance import Guidance, Slants
from pbdkit.stepping.prescription import Led


def write_leading(out: Function, plan: Plan, *lines: str) -> None:
    """Loops over the leaders `led`; lines are patterns for each axis."""
    if not has_guides(plan.scene.leading):
        out.add(1, "for e in range(led.size):")
        for line in lines:
            out.add(2, *plan.each(line))
        return
    for axis in plan.axes:
        out.add(1, f"for e in range(led_{axis}.size):")
        for line in lines:
            own = line.replace("[#, e]", f"_{axis}[e]").replace("led[", f"led_{axis}[")
            out.add(2, own.replace("@", axis))


def write_guiding(out: Function, plan: Plan) -> None:
    """Who leads along an axis makes no way along it that could go on."""
    if has_guides(plan.scene.leading):
        write_leading(out, plan, "fv_@[led[e]] = led_values[#, e]")


def write_slants(out: Function, plan: Plan) -> None:
    """What guided particles add to their moves."""
    for to, of in permutations(plan.axes, 2) if Guidance(plan.scene).slanted else ():
        out.add(1, f"for e in range(slant_{to}{of}.size):", f"    p = slant_{to}{of}[e]")
        way = f"(fv_{of}[p] - fu_{of}[p])"
        out.add(2, f"fv_{to}[p] = fv_{to}[p] + share_{to}{of}[e] * {way}")


def leading_arrays(plan: Plan, led: Led, slants: Slants, real: Any) -> dict[str, Any]:
    """By name the places of leaders, where they are put, and room for where they stood."""
    if not has_guides(plan.scene.leading):
        places, values, _ = zip((np.empty(0, np.intp), np.empty((len(plan.axes), 0)), ()), *led,
                                strict=True)  # fmt: skip
        u = np.concatenate(values, axis=1).astype(real)
        return {"led": np.concatenate(places), "led_values": u, "led_kept": np.empty_like(u)}
    found: dict[str, Any] = {}
    for a, axis in enumerate(plan.axes):
        some = [each for each in led if a in each.axes]
        at = np.concatenate([np.empty(0, np.intp), *(each.place for each in some)])
        u = np.concatenate([np.empty(0), *(each.u[each.axes.index(a)] for each in some)])
        u = u.astype(real)
        found |= {f"led_{axis}": at, f"led_values_{axis}": u, f"led_kept_{axis}": np.empty_like(u)}
    for to, of in permutations(range(len(plan.axes)), 2):
        name = plan.axes[to] + plan.axes[of]
        none = np.empty(0, np.intp), np.empty(0, real)
        found[f"slant_{name}"], found[f"share_{name}"] = slants.get((to, of), none)
    return found
