"""Writes what a kernel does with leaders, and the arrays that it is given of them.

Where some are guided, those that lead along an axis are listed for each axis by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from pbdkit.scene.guides import has_guides
from pbdkit.stepping.compiled.blocks import band_arrays
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.guidance import Guidance, Slants
from pbdkit.stepping.prescription import Led


def write_leading(out: Function, plan: Plan, *lines: str) -> None:
    """Loops over the leaders `led`, put where they are `held`; lines are patterns for each axis."""
    if not has_guides(plan.scene.leading):
        out.add(1, "held = led_values[min(made, led_values.shape[0] - 1)]")
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
        write_leading(out, plan, "fv_@[led[e]] = held[#, e]")


def write_slants(out: Function, plan: Plan) -> None:
    """What guided particles add to their moves."""
    for to, of in permutations(plan.axes, 2) if Guidance(plan.scene).slanted else ():
        out.add(1, f"for e in range(slant_{to}{of}.size):", f"    p = slant_{to}{of}[e]")
        way = f"(fv_{of}[p] - fu_{of}[p])"
        out.add(2, f"fv_{to}[p] = fv_{to}[p] + share_{to}{of}[e] * {way}")


def leading_arrays(
    plan: Plan, ways: Sequence[Led], slants: Slants, real: Any, listed: bool = False
) -> dict[str, Any]:
    """By name the places of leaders, where they are put, and room for where they stood. Each step
    has its entry in `ways`, or one is for all. Where several steps may go in a pass, leaders are
    `listed` by rows."""
    led = ways[0]
    if not has_guides(plan.scene.leading):
        at = np.concatenate([np.empty(0, np.intp), *(each.place for each in led)])
        empty = np.empty((len(plan.axes), 0))
        u = np.array([np.concatenate([empty, *(w.u for w in way)], axis=1) for way in ways], real)
        more: dict[str, Any] = {}
        if listed:
            order, more = band_arrays(plan, at)
            at, u = at[order], np.ascontiguousarray(u[..., order])
        return {"led": at, "led_values": u, "led_kept": np.empty_like(u[0])} | more
    found: dict[str, Any] = {}
    for a, axis in enumerate(plan.axes):
        some = [each for each in led if a in each.axes]
        at = np.concatenate([np.empty(0, np.intp), *(each.place for each in some)])
        u = np.concatenate([np.empty(0), *(each.u[each.axes.index(a)] for each in some)])
        u = u.astype(real)
        found |= {f"led_{axis}": at, f"held_{axis}": u, f"led_kept_{axis}": np.empty_like(u)}
    for to, of in permutations(range(len(plan.axes)), 2):
        name = plan.axes[to] + plan.axes[of]
        none = np.empty(0, np.intp), np.empty(0, real)
        found[f"slant_{name}"], found[f"share_{name}"] = slants.get((to, of), none)
    return found
