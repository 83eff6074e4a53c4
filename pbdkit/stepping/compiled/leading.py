"""Writes what a kernel does with leaders, and the arrays that it is given of them.

Where some are guided, those that lead along an axis are listed for each axis by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from pbdkit.scene.guides import has_guides
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.bands import banded, room_for
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.guidance import Slants
from pbdkit.stepping.prescription import Led, Placed, prescribe, steady_steps
from pbdkit.stepping.state import State


def write_leading(out: Function, plan: Plan, *lines: str) -> None:
    """Loops over the leaders `led`, put where they are `held`; lines are patterns for each axis."""
    for end, axes in plan.leads.items():
        out.add(1, held(end, "made"), f"for e in {plan.over(f'led{end}.size')}:")
        for line in lines:
            out.add(2, *leading_lines(plan, end, axes, line))


def held(end: str, step: str) -> str:
    """The line for where the leaders of a list are held in a step of a call."""
    return f"held{end} = led_values{end}[min({step}, led_values{end}.shape[0] - 1)]"


def leading_lines(plan: Plan, end: str, axes: str, line: str) -> list[str]:
    """A pattern in the words of a list of leaders, for each of its axes."""
    for name in ("held[", "led[", "led_kept["):
        line = line.replace(name, f"{name[:-1]}{end}[")
    return plan.each(line, axes)


def write_guiding(out: Function, plan: Plan) -> None:
    """Who leads along an axis makes no way along it that could go on."""
    if has_guides(plan.scene.leading):
        write_leading(out, plan, "fv_@[led[e]] = held[#, e]")


def write_slants(out: Function, plan: Plan) -> None:
    """What guided particles add to their moves."""
    for to, of in plan.slanted:
        out.add(1, f"for e in range(slant_{to}{of}.size):", *slant_lines(to, of, "fu", "fv"))


def slant_lines(to: str, of: str, u: str, v: str) -> list[str]:
    """What the guided particle e adds to its move, in a loop in flat planes."""
    way = f"({v}_{of}[p] - {u}_{of}[p])"
    return [
        f"    p = slant_{to}{of}[e]",
        f"    {v}_{to}[p] = {v}_{to}[p] + share_{to}{of}[e] * {way}",
    ]


def foreseen(
    scene: Scene, state: State, led: Led, end: int, turning: Callable[[int], bool] = lambda _: False
) -> list[Led]:
    """Where the leaders of the coming step are put in those after it, as long as it is the same
    leaders, nothing else changes, their motions alone decide and none is `turning`."""
    if scene.leaders_overlap:  # who contradict each other are named in their own step
        return []
    step = state.step + 1
    known = steady_steps(scene, step, end - state.step, moving=True)
    last = state.step + min(known, room_for(led))
    later = takewhile(lambda n: not turning(n), range(step + 1, last + 1))
    return [prescribe(scene, state, n)[0] for n in later]


def leading_arrays(
    plan: Plan, ways: Sequence[Led], slants: Slants, real: Any, listed: bool = False
) -> dict[str, Any]:
    """By name the places of leaders, where they are put, and room for where they stood. Each step
    has its entry in `ways`, or one is for all. Where several steps may go in a pass, they are
    `listed` by rows."""
    found: dict[str, Any] = {}
    for end, names in plan.leads.items():
        axes = tuple(plan.axes.index(name) for name in names)
        at, u = _led_along(axes, ways)
        order, rows = banded(plan, f"led{end}", at) if listed else (slice(None), {})
        u = np.ascontiguousarray(u[..., order].astype(real))
        own = {"led": at[order], "led_values": u, "led_kept": np.empty_like(u[0])}
        found |= {f"{name}{end}": value for name, value in own.items()} | rows
    for to, of in plan.slanted:
        name, pair = f"{to}{of}", (plan.axes.index(to), plan.axes.index(of))
        place, share = slants.get(pair, (np.empty(0, np.intp), np.empty(0, real)))
        order, rows = banded(plan, f"slant_{name}", place) if listed else (slice(None), {})
        found |= {f"slant_{name}": place[order], f"share_{name}": share[order]} | rows
    return found


def _led_along(axes: tuple[int, ...], ways: Sequence[Led]) -> tuple[Any, Any]:
    """The places of those that lead along all of some axes, and where they are put, (step, axis,
    leader)."""

    def along(each: Placed) -> Any:
        if each.axes == axes:
            return each.u
        return each.u[[each.axes.index(a) for a in axes]]

    some = [[each for each in way if set(axes).issubset(each.axes)] for way in ways]
    at = np.concatenate([np.empty(0, np.intp), *(each.place for each in some[0])])
    empty = np.empty((len(axes), 0))
    return at, np.array([np.concatenate([empty, *map(along, way)], axis=1) for way in some])
