"""Writes how frame points follow the body.

Writes what a kernel does with leaders, and the arrays that it is given of them.

Where some are guided, those that lead along an axis are listed for each axis by itself.

Writes the pass that keeps particles out of obstacles, after the sweeps; where particles may be
guided, after the leaders too.

Rows whose particles reach no obstacle's box, as far as their displacements go, are passed over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from pbdkit.lattice.raster import FOLLOWER
from pbdkit.scene.leaders import has_guides
from pbdkit.scene.obstacles import Walls, outlines_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.leaders import Slants, prescribe, steady_steps
from pbdkit.stepping.numba_engine.arrays import Arrays
from pbdkit.stepping.numba_engine.plan import Function, Plan, banded, room_for
from pbdkit.stepping.numba_engine.sweeps import local_places
from pbdkit.stepping.operation import Led, Placed
from pbdkit.stepping.state import State


def write_frame(out: Function, plan: Plan, source: str, target: str) -> None:
    """Frame points from flat planes of the body."""
    out.add(1, f"for f in {plan.over('points.size')}:")
    write_point(out, plan, source, target)


def write_point(out: Function, plan: Plan, source: str, target: str) -> None:
    """The frame point f, in a loop."""
    _write_mapped(out, plan, source)
    out.add(2, *plan.each(f"{target}_@[points[f]] = t_@"))


def write_lagging_point(out: Function, plan: Plan, source: str, target: str) -> None:
    """The frame point f, where it was to be after the step before, in a loop."""
    out.add(2, *plan.each(f"{target}_@[points[f]] = lag_@[f]"))
    write_lag(out, plan, source)


def write_lag(out: Function, plan: Plan, source: str) -> None:
    """Where the frame point f is to be a step later, in a loop."""
    _write_mapped(out, plan, source)
    out.add(2, *plan.each("lag_@[f] = t_@"))


def _write_mapped(out: Function, plan: Plan, source: str) -> None:
    assert plan.scene.frame
    out.add(2, *plan.each(f"t_@ = {plan.number(0.0)}"))
    out.add(2, "for e in range(entries[f], entries[f + 1]):")
    for a, c in enumerate(plan.axes):
        term = f"mapped[e] * {source}_{c}[bodies[e]]"
        if plan.scene.frame.map.weight.ndim == 3:
            terms = plan.each(f"mapped[e, {a}, #] * {source}_@[bodies[e]]")
            term = f"({' + '.join(terms)})"
        out.add(3, f"t_{c} = t_{c} + {term}")


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


def write_obstacle_pass(plan: Plan) -> Function:
    """The function that pushes the particles of some rows out of all obstacles."""
    out = Function(plan.shared, "push_out", "first_row", "last_row", "moment")
    out.add(0, "m = min(moment, wall_box.shape[0] - 1)")
    out.add(0, "points, edges, radii = wall_points[m], wall_box[m], wall_radii[m]")
    out.add(0, "j0, j1 = max(0, box[2]), min(kind.shape[2], box[3])", "width = j1 - j0")
    out.add(0, "for s in range(kind.shape[0]):", "    for i in range(first_row, last_row):")
    out.add(2, "if width <= 0:", "    continue")
    out.add(2, *plan.each(f"o@ = {plan.row('v_@', 's')}"))
    out.add(2, *plan.each("l@, h@ = o@[0], o@[0]"))
    out.add(2, "for j in range(width):")
    out.add(3, *plan.each("l@ = min(l@, o@[j])"), *plan.each("h@ = max(h@, o@[j])"))
    for name, j in (("A", "0"), ("B", "width - 1")):
        out.add(2, f"j = {j}", *_places(plan, name))
    out.add(2, *plan.each("l@, h@ = min(A@, B@) + l@, max(A@, B@) + h@"))
    out.add(2, "near = 0", *_each_near("l", "h"))
    out.add(2, "if near == 0:", "    continue", "for j in range(width):")
    out.add(3, f"if kind[s, i, j0 + j] != {FOLLOWER}:", "    continue", *_places(plan, "A"))
    out.add(3, *plan.each("p@ = A@ + o@[j]"), "near = 0")
    out.add(3, *_each_near("p", "p"), "if near == 0:", "    continue")
    has_compliance = "compliance" in plan.shared
    own = [f"compliance[{n}, s, i, j0 + j]" for n in range(3)]
    own = own if has_compliance else ["1.0", "0.0", "1.0"]
    own.append("led_axes[s, i, j0 + j]" if has_guides(plan.scene.leading) else "0")
    walls = "wall_kind, points, wall_first, radii"
    out.add(3, f"{', '.join(plan.each('w@'))} = leave(px, py, {', '.join(own)}, {walls})")
    out.add(3, *plan.each("o@[j] = o@[j] + w@"))
    return out


def _each_near(low: str, high: str) -> list[str]:
    """A loop over the obstacles that notes whether what lies from one place to the other may be in
    the box of one; it does not where it is not a number."""
    return [
        "for w in range(wall_kind.size):",
        f"    if {_beyond(low, high)}:",
        "        continue",
        "    near = 1",
    ]


def _places(plan: Plan, name: str) -> list[str]:
    pairs = zip(plan.axes, local_places(plan, "s"), strict=True)
    return [f"{name}{c} = {place}" for c, place in pairs]


def _beyond(low: str, high: str) -> str:
    """Whether what lies from one place to the other misses a box; not where it is not a number."""
    return (
        f"{low}x > edges[w, 2] or {high}x < edges[w, 0] or "
        f"{low}y > edges[w, 3] or {high}y < edges[w, 1]"
    )
