"""The arrays of leaders and obstacles that kernels are given, for one step or for several.

Where some particles are guided, those that lead along an axis are listed for each axis by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from pbdkit.scene.obstacles import Walls, outlines_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.leaders import Slants, prescribe, steady_steps
from pbdkit.stepping.numba_engine.arrays import Arrays
from pbdkit.stepping.numba_engine.plan import Plan, banded, room_for
from pbdkit.stepping.state import State
from pbdkit.stepping.step import Led, Placed


def held(end: str, step: str) -> str:
    """The line for where the leaders of a list are held in a step of a call."""
    return f"held{end} = led_values{end}[min({step}, led_values{end}.shape[0] - 1)]"


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


def wall_arrays(scene: Scene, steps: Iterable[int]) -> Arrays:
    """The outlines of the obstacles that are there in some steps, always the same, one after the
    other; by step their points and boxes."""
    if not scene.barriers:
        return {}
    moments = [[outline for _, outline in outlines_at(scene.barriers, step)] for step in steps]
    walls = [Walls.of(now) for now in moments]
    return {
        "wall_kind": walls[0].kinds,
        "wall_first": walls[0].first,
        "wall_points": np.array([now.points for now in walls]),
        "wall_radii": np.array([now.radii for now in walls]),
        "wall_box": np.array([[o.box for o in now] for now in moments]).reshape(
            len(moments), -1, 4
        ),
    }
